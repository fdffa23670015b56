// The wire contract, as the page reads it. schemas/job.py is where it is defined.

export type Status = "queued" | "running" | "cancelling" | "succeeded" | "failed" | "cancelled";

export interface Problem {
  title: string;
  status: number;
  detail: string;
  code: string;
  field?: string | null;
  expected?: string | null;
  got?: string | null;
  hint?: string | null;
  retryable?: boolean;
  choices?: Record<string, unknown>[] | null;
}

export interface Progress {
  stage: string;
  fraction: number;
  reweighting: number;
  max_reweightings: number;
  objective: number | null;
  residual: number | null;
  seconds_left: number | null;
  updated_at: string;
}

export interface Artifact {
  name: string;
  media_type: string;
  bytes: number;
  sha256: string;
  description: string;
}

export interface Interpretation {
  num_frames: number;
  num_points: number;
  num_faces: number;
  hidden_fraction: number;
  mesh_source: string;
  mesh_grid: [number, number] | null;
  has_ground_truth: boolean;
  has_rotations: boolean;
  layout: string;
  y_axis: string;
  notes: string[];
}

export interface Inspection extends Interpretation {
  /** A list a frame: x and y of each point in turn, 0 … 1000, y down, −1 twice where hidden. */
  sample?: number[][];
}

export type Options = Record<string, unknown>;

export interface Job {
  id: string;
  name: string;
  status: Status;
  created_at: string;
  started_at: string | null;
  finished_at: string | null;
  expires_at: string | null;
  attempt: number;
  place_in_queue: number | null;
  options: Options;
  interpretation: Interpretation;
  progress: Progress | null;
  metrics: Record<string, number> | null;
  outcome: string | null;
  sentence: string | null;
  warnings: string[];
  artifacts: Artifact[];
  error: Problem | null;
}

export interface JobPage {
  jobs: Job[];
  next: string | null;
}

/** The part of a JSON Schema that the options' schema uses. */
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

/** The input files of a job, by the name of their form part. */
export const PARTS = ["tracks", "mesh", "ground_truth", "rotations"] as const;
export type Part = (typeof PARTS)[number];

export function isFinal(status: Status): boolean {
  return status === "succeeded" || status === "failed" || status === "cancelled";
}
