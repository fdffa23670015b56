// The types of the API. schema.d.ts is generated from the service's OpenAPI document:
//   python -m pliant.service openapi --schemas > openapi.json && npx openapi-typescript openapi.json -o src/schema.d.ts

import type { components } from "./schema";

type Schemas = components["schemas"];

export type Status = Schemas["Status"];
/** A problem reported by the service or detected by the page. */
export type Problem = Pick<Schemas["Problem"], "title" | "status" | "detail"> & {
  [Name in Exclude<keyof Schemas["Problem"], "code">]?: Schemas["Problem"][Name] | undefined;
} & { code: Schemas["ProblemCode"] | "unreachable" | "unknown" | "no_events" };
export type Progress = Schemas["Progress"];
export type Artifact = Schemas["Artifact"];
export type Interpretation = Schemas["Interpretation"];
export type Inspection = Schemas["Inspection"];
/** Options by name; the form is built from the schema at /v1/options. */
export type Options = Record<string, unknown>;
export type Verdict = "good" | "with_care" | "do_not_use";
/** The verdict, reached without ground truth; missing in records of older services, null if a job was not judged. */
interface Trust {
  verdict?: Verdict | null;
  verdict_reasons?: string[];
  trust_sentence?: string | null;
}
export type Job = Omit<Schemas["Job"], "options" | "error" | keyof Trust> & Trust & { options: Options; error: Problem | null };
export type Share = Schemas["Share"];
export type JobPage = Omit<Schemas["JobPage"], "jobs"> & { jobs: Job[] };

/** The subset of JSON Schema that the options' schema uses. */
export interface Schema {
  type?: string;
  enum?: unknown[];
  const?: unknown;
  anyOf?: Schema[];
  items?: Schema;
  default?: unknown;
  description?: string;
  title?: string;
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
  exclusiveMaximum?: number;
  properties?: Record<string, Schema>;
}

/** The input files of a job by the names of their form parts. */
export const PARTS = ["film", "tracks", "mesh", "ground_truth", "rotations"] as const;
export type Part = (typeof PARTS)[number];

export function isFinal(status: Status): boolean {
  return status === "succeeded" || status === "failed" || status === "cancelled";
}

/** Whether a job was submitted as a film. A file of `pliant track` has the film's mesh, too, but contains tracks. */
export function ofFilm({ interpretation }: Pick<Job, "interpretation">): boolean {
  return interpretation.format.startsWith("film (");
}
