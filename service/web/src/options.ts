// The form for a job's options, built from the service's schema: new options appear automatically.

import { h, uniqueId } from "./dom";
import type { Options, Schema } from "./types";

/** Not in the form: the region is drawn on the first frame. */
const DRAWN = ["region_polygon", "region_frame"];

/** Collapsible groups of options by purpose. Options in none of them are in the group "Advanced". */
const FOLDS: [string, string[]][] = [
  ["Files to write", ["outputs", "fps", "axes", "normals", "colours", "glb_motion", "glb_quantized"]],
  ["Camera", ["camera", "focal", "field_of_view", "image_size", "principal_point"]],
  ["Frames and points", ["frames", "stride", "max_points", "min_seen", "order"]],
  ["Input format", ["layout", "rows", "coordinates", "coordinate_order", "y_axis", "visibility"]],
  ["Film", ["template_frame", "grid_step", "longest_side"]],
  ["Surface and smoothness", ["surface", "temporal_weight", "spatial_weight", "robust_scale"]],
];
const EXPERTS = "Advanced";

/** Label of an option, and its unit. */
const NAMES: Record<string, [string, string?]> = {
  outputs: ["Files"],
  fps: ["Frame rate", "frames/s"],
  axes: ["Axes of PLY and OBJ"],
  normals: ["Normals"],
  colours: ["Colours"],
  glb_motion: ["Motion in glTF"],
  glb_quantized: ["16-bit glTF"],
  camera: ["Camera model"],
  focal: ["Focal length", "pixels"],
  field_of_view: ["Angle of view", "degrees"],
  image_size: ["Picture size", "w×h, pixels"],
  principal_point: ["Principal point", "x,y, pixels"],
  frames: ["Frames", "from:to:step"],
  stride: ["Use every n-th point"],
  max_points: ["Maximum points"],
  min_seen: ["Visible in at least", "frames"],
  layout: ["Order of the axes"],
  rows: ["Order of the rows"],
  coordinates: ["Meaning of x and y"],
  coordinate_order: ["Order of x and y"],
  y_axis: ["Direction of y"],
  visibility: ["Visibility values"],
  template_frame: ["Start frame"],
  grid_step: ["Point spacing", "pixels"],
  longest_side: ["Longest side tracked", "pixels"],
  surface: ["Surface"],
  temporal_weight: ["Smoothness in time", "λ1"],
  spatial_weight: ["Surface smoothness", "λ2"],
  robust_scale: ["Outlier threshold", "track radii"],
  time_limit: ["Time limit", "seconds"],
  max_reweightings: ["Maximum reweightings"],
  basis_size: ["Basis shapes"],
  refine_rotations: ["Refine cameras"],
};

const LABELS: Record<string, string> = {
  pseudo_inverse: "pseudo-inverse",
  spatio_temporal: "spatio-temporal",
  scaled_orthographic: "no perspective, scale per frame",
  orthographic: "no perspective, one scale",
  auto: "automatic",
  paper: "as published",
  glb: "glTF",
  ply: "PLY",
  obj: "OBJ",
  usd: "USD",
  mdd: "MDD",
  abc: "Alembic",
  mat: "MATLAB",
  csv: "tables (csv)",
  viewer: "y up, as in viewers",
  tracks: "as in the tracks",
  expected_error: "expected error",
  frames_points: "frames, points",
  points_frames: "points, frames",
  xy: "x, then y",
  yx: "y, then x",
};

/** Return the label of an option. */
export function nameOf(name: string): string {
  return NAMES[name]?.[0] ?? sentence(name.replaceAll("_", " "));
}

interface Field {
  name: string;
  schema: Schema;
  fold: HTMLDetailsElement;
  answer: HTMLElement;
  element: HTMLElement;
  read: () => unknown;
  write: (value: unknown) => void;
}

export class OptionsForm {
  readonly element = h("div", { class: "folds" });
  private fields: Field[] = [];

  /** Build the form from the schema. Before that, jobs are submitted with the defaults. */
  load(schema: Schema): void {
    const properties = schema.properties ?? {};
    const names = Object.keys(properties).filter((name) => !DRAWN.includes(name));
    const placed = FOLDS.flatMap(([, members]) => members);
    const folds: [string, string[]][] = [...FOLDS, [EXPERTS, names.filter((name) => !placed.includes(name))]];
    this.fields = [];
    this.element.replaceChildren(
      ...folds.map(([heading, members]) => this.fold(heading, members.filter((name) => names.includes(name)), properties)),
    );
  }

  private fold(heading: string, names: string[], properties: Record<string, Schema>): HTMLElement {
    const changed = h("span", { class: "muted" });
    const fold = h("details", { class: "more", hidden: names.length === 0 }, h("summary", {}, `${heading} `, changed));
    fold.append(h("div", { class: "options" }, ...names.map((name) => this.row(name, properties, fold))));
    fold.addEventListener("change", () => {
      const given = Object.keys(this.values()).filter((name) => names.includes(name)).length;
      changed.textContent = given > 0 ? `(${given} changed)` : "";
    });
    return fold;
  }

  /** The options that differ from the defaults. */
  values(): Options {
    const given: Options = {};
    for (const field of this.fields) {
      const value = field.read();
      if (value !== undefined && JSON.stringify(value) !== JSON.stringify(field.schema.default ?? null)) given[field.name] = value;
    }
    return given;
  }

  /** Set one option, for example an interpretation that the service offered. */
  set(name: string, value: unknown): void {
    const field = this.fields.find((one) => one.name === name);
    field?.write(value);
    field?.fold.dispatchEvent(new Event("change", { bubbles: true }));
  }

  /** Fill the form with the options of a job. */
  fill(options: Options): void {
    for (const field of this.fields) field.write(field.name in options ? options[field.name] : (field.schema.default ?? null));
    for (const fold of new Set(this.fields.map((field) => field.fold))) fold.dispatchEvent(new Event("change", { bubbles: true }));
  }

  focus(): void {
    this.element.querySelector("summary")?.focus();
  }

  /** Show an error message below its option; return false if the form has no such option. */
  refuse(name: string, box: HTMLElement): boolean {
    const field = this.fields.find((one) => one.name === name);
    if (field === undefined) return false;
    field.answer.replaceChildren(box);
    field.fold.open = true;
    field.element.scrollIntoView({ block: "nearest" });
    return true;
  }

  /** Remove all error messages. */
  clear(): void {
    for (const { answer } of this.fields) answer.replaceChildren();
  }

  private row(name: string, properties: Record<string, Schema>, fold: HTMLDetailsElement): HTMLElement {
    const schema = properties[name] as Schema;
    const id = uniqueId("option");
    const control = controlFor(schema, id);
    const answer = h("div", { class: "slot-answer", "aria-live": "assertive" });
    this.fields.push({ name, schema, fold, answer, ...control });
    const hint = h("p", { class: "hint", id: `${id}-hint` }, describe(schema, String(control.read() ?? "")));
    control.element.setAttribute("aria-describedby", hint.id);
    control.element.addEventListener("change", () => {
      hint.textContent = describe(schema, String(control.read() ?? ""));
    });
    const unit = NAMES[name]?.[1];
    const group = control.element.getAttribute("role") === "group";
    if (group) control.element.setAttribute("aria-label", nameOf(name));
    const words = [nameOf(name), unit ? h("span", { class: "unit" }, ` ${unit}`) : null];
    const label = group ? h("span", { title: name }, ...words) : h("label", { for: id, title: name }, ...words);
    return h("div", { class: "option" }, label, control.element, hint, answer);
  }
}

type Control = Pick<Field, "read" | "write" | "element">;

function controlFor(schema: Schema, id: string): Control {
  const kinds = schema.anyOf ?? [schema];
  const nullable = kinds.some((kind) => kind.type === "null");
  const main = kinds.find((kind) => kind.type !== "null") ?? schema;
  const initial = schema.default ?? null;
  const values = main.enum ?? (main.const === undefined ? undefined : [main.const]);
  if (values) return choice(id, values, nullable, initial);
  if (main.type === "boolean") return tick(id, initial === true);
  if (main.type === "array" && main.items?.enum) return several(id, main.items.enum, initial);
  return entry(id, main, nullable, initial);
}

function choice(id: string, values: unknown[], nullable: boolean, initial: unknown): Control {
  const all = nullable ? [null, ...values] : values;
  const element = h(
    "select",
    { id },
    ...all.map((value, index) => h("option", { value: index }, value === null ? "automatic" : label(value))),
  );
  const write = (value: unknown): void => {
    element.value = String(Math.max(0, all.indexOf(value)));
  };
  write(initial);
  return { element, read: () => all[Number(element.value)], write };
}

function tick(id: string, initial: boolean): Control {
  const element = h("input", { id, type: "checkbox" });
  element.checked = initial;
  return { element, read: () => element.checked, write: (value) => void (element.checked = value === true) };
}

/** Any subset of some values: a checkbox for each. */
function several(id: string, values: unknown[], initial: unknown): Control {
  const boxes = values.map((_, index) => h("input", { id: `${id}-${index}`, type: "checkbox" }));
  const write = (value: unknown): void => {
    boxes.forEach((box, index) => (box.checked = Array.isArray(value) && value.includes(values[index])));
  };
  write(initial);
  const element = h(
    "div",
    { id, class: "row", role: "group" },
    ...boxes.map((box, index) => h("label", { for: box.id }, box, ` ${label(values[index])}`)),
  );
  return { element, read: () => values.filter((_, index) => boxes[index]?.checked), write };
}

function entry(id: string, schema: Schema, nullable: boolean, initial: unknown): Control {
  const numeric = schema.type === "number" || schema.type === "integer";
  const element = h("input", {
    id,
    type: numeric ? "number" : "text",
    step: schema.type === "integer" ? 1 : "any",
    min: schema.minimum ?? schema.exclusiveMinimum,
    max: schema.maximum ?? schema.exclusiveMaximum,
    placeholder: nullable ? "automatic" : null,
    inputmode: numeric ? "decimal" : null,
  });
  const write = (value: unknown): void => {
    element.value = value === null || value === undefined ? "" : String(value);
  };
  write(initial);
  const read = (): unknown => {
    if (element.value === "") return nullable ? null : initial;
    return numeric ? Number(element.value) : element.value;
  };
  return { element, read, write };
}

function label(value: unknown): string {
  return LABELS[String(value)] ?? String(value);
}

/** The part of a description that belongs to the chosen value ("robust: …"), or the whole description if there is none. */
function describe(schema: Schema, chosen: string): string {
  const text = schema.description ?? "";
  const starts = (schema.enum ?? []).map((value) => text.indexOf(`${String(value)}: `)).filter((at) => at >= 0);
  const from = text.indexOf(`${chosen}: `);
  if (!chosen || !starts.includes(from)) return text;
  const to = Math.min(...starts.filter((at) => at > from), text.length);
  const part = text.slice(from + chosen.length + 2, to).replace(/[.;, ]+$/, "");
  return `${sentence(part)}.`;
}

function sentence(text: string): string {
  return `${text.charAt(0).toUpperCase()}${text.slice(1)}`;
}
