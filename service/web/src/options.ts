// The form for a job's options, built from the service's schema: new options appear automatically.

import { h, uniqueId } from "./dom";
import { type Interpretation, type Job, type Options, type Schema, ofFilm } from "./types";

/** Not in the form: the region is drawn on a frame of the film. */
const DRAWN = ["region_polygon", "region_frame"];

/** Collapsible groups of options by purpose. Options in none of them are in the group "Advanced". */
const FOLDS: [string, string[]][] = [
  ["Files to write", ["outputs", "fps", "axes", "normals", "colours", "glb_motion", "glb_quantized"]],
  ["Lens", ["camera", "focal", "field_of_view", "image_size", "principal_point"]],
  ["Frames and points", ["frames", "stride", "max_points", "min_seen", "order"]],
  ["Input format", ["layout", "rows", "coordinates", "coordinate_order", "y_axis", "visibility"]],
  ["Tracking a film", ["template_frame", "grid_step", "longest_side"]],
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

/** Help for options whose description in the schema is meant for programs. “value: …” describes one choice. */
const HELP: Record<string, string> = {
  camera:
    "perspective: a pinhole camera. scaled_orthographic: one scale per frame. orthographic: no scales. " +
    "auto: perspective if the tracks are clearly more probable with it, else no perspective.",
  focal: "In pixels of the tracks. If empty, it is estimated for a perspective camera.",
  field_of_view: "Horizontal angle, instead of the focal length. Fill in the picture size too, unless the input is a film.",
  principal_point: "For example 319.5,239.5. If empty: the centre of the picture, or that of the tracks if the picture size is unknown.",
  surface:
    "isometric: a sheet that bends without stretching, such as paper or cloth, seen in perspective. free: no such assumption. " +
    "auto: isometric if the tracks are those of a sheet and its edge lengths determine a focal length; needs the picture size or the focal length.",
  order:
    "film: neighbouring frames are alike. any: photographs in no order, at most 360; needs the Gaussian prior. " +
    "auto: any order if neighbouring frames are no more alike than others.",
  basis_size: "Number of basis shapes in the factorization for the rotations. If empty, it is selected from the data.",
  preset: "auto: weights that are not given are measured from noise and motion. paper: the published setting.",
  temporal_weight: "Weight of smoothness in time, dimensionless. If empty: chosen by the preset.",
  spatial_weight: "Weight of smoothness along the surface, dimensionless. If empty: chosen by the preset.",
  robust_scale: "Residual at which the loss changes from quadratic to linear, in RMS radii of the tracks. If empty: chosen by the preset.",
  temporal_order: "1 penalises velocity, 2 acceleration. Automatic: chosen by the preset. No effect with the Gaussian prior.",
  loss: "Loss of the data term; used by the robust method only.",
  laplacian: "An 8-direction stencil on a pixel grid, or a mesh Laplacian. Automatic: by the mesh.",
  prior:
    "gaussian: a Gaussian over the frames for the positions of each point, learned from the tracks; the only prior with an error estimate. It needs the " +
    "robust method and the automatic preset. smooth: the published method; the error is not estimated. " +
    "smooth+low_rank: also favours shapes that few basis shapes explain; the error is not estimated.",
  low_rank_weight: "Weight of the low-rank prior, dimensionless. If empty, it is chosen from the data. No effect with other priors.",
  precision: "Precision of the large arrays. The Gaussian prior needs float64.",
  time_limit: "The job fails if it takes longer. If empty, only the service's own limit applies.",
  outputs: "Written besides the NPZ file and the report. glTF: animated. PLY, OBJ: one mesh per frame, in a zip. MDD: point cache for Blender, Maya and Houdini. Tables: errors of every frame and of every point.",
  normals:
    "animated: they move with the shape, in glTF and in every frame of PLY, OBJ and USD. static: those of the first shape, in glTF only. " +
    "none: viewers compute their own.",
  colours:
    "none: no colours. error: by the distance from the ground truth, or by the reprojection residual where there is none. " +
    "expected_error: by the error that the solver expects, in percent of the object's size, with the Gaussian prior and for isometric surfaces.",
  axes: "viewer: y up, as in glTF. tracks: those of the tracks, as in the NPZ file.",
  glb_quantized: "Positions of 16 bits and normals of 8 bits: about half the size, rounded to a 65,000th of the largest extent and half a degree.",
  glb_motion:
    "auto: as few modes of motion as keep every point within a thousandth of the bounding box's diagonal. " +
    "frames: one morph target per frame, exact in single precision; up to 200 frames.",
  layout: "auto: by the names in the file and by smoothness in time; an error if several fit.",
  rows: "interleaved: rows are x1, y1, x2, y2 … stacked: all x, then all y. auto: from the data.",
  coordinates:
    "pixels: used unchanged, whatever their unit. unit: from 0 to 1. signed: from −1 to 1. " +
    "auto: by the values; values from 0 to 1 are an error unless the picture size is given.",
  image_size: "For example 640x480. Needed if coordinates are fractions of it. Its centre is the principal point of a perspective camera.",
  coordinate_order: "auto: x before y, unless the points lie inside the picture only in the other order.",
  frames: "Start:stop:step as in Python, for example 10:200:2. If empty: all frames.",
  max_points: "Points are chosen evenly, and the mesh is simplified accordingly. If empty: all points.",
  template_frame:
    "Frame whose points are tracked in both directions, counted in the complete film from 0. If empty: the frame that the region is drawn on if it lies in the middle third of the film, otherwise the sharpest frame of that third, or a frame on the way there if most of the region is lost.",
  grid_step: "Distance of neighbouring points in the film's pixels. If empty, it is chosen for about 4,000 points.",
  longest_side: "Larger films are scaled down for tracking. Tracks remain in the film's own pixels.",
};

const LABELS: Record<string, string> = {
  gaussian: "Gaussian",
  "smooth+low_rank": "smooth and low rank",
  grid8: "grid, 8 directions",
  huber: "Huber",
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

/** Return the options of a job that describe its region, which the form does not contain. */
export function drawn(options: Options): Options {
  return Object.fromEntries(Object.entries(options).filter(([name, value]) => DRAWN.includes(name) && Boolean(value)));
}

/** Return the options of a job without the frame rate and the picture size that its input states: another input states its own. */
export function chosen({ options, interpretation }: Job): Options {
  const stated: Options = { fps: interpretation.fps, image_size: interpretation.image_size };
  return Object.fromEntries(Object.entries(options).filter(([name, value]) => !(name in stated && value === stated[name])));
}

/** Options whose value an input may state itself. */
const STATED = ["fps", "image_size"];

/** Return what an input states itself, by option and in words; null: it is a film that is not read yet, and states both. */
export function statedBy(interpretation: Interpretation | null): Record<string, string> {
  if (interpretation === null) return Object.fromEntries(STATED.map((name) => [name, "the film's"]));
  const { fps, image_size: size } = interpretation;
  const whose = ofFilm({ interpretation }) ? "the film's" : "the file's";
  return { ...(fps && { fps: `${Number(fps.toPrecision(4))}, ${whose}` }), ...(size && { image_size: `${size}, ${whose}` }) };
}

interface Field {
  name: string;
  schema: Schema;
  /** Not sent: the default, or null while the input states its own value. */
  base: unknown;
  fold: HTMLDetailsElement;
  answer: HTMLElement;
  element: HTMLElement;
  read: () => unknown;
  write: (value: unknown) => void;
}

export class OptionsForm {
  readonly element = h("div", { class: "folds" });
  private fields: Field[] = [];
  private stated: Record<string, string> = {};

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

  /** The options that differ from the defaults and from what the input states. */
  values(): Options {
    return Object.fromEntries(this.fields.filter(isGiven).map((field) => [field.name, field.read()]));
  }

  /** Show what the input states itself instead of the defaults, unless the user has chosen something else. */
  state(stated: Record<string, string>): void {
    this.stated = stated;
    for (const field of this.fields.filter(({ name }) => STATED.includes(name))) {
      const isOpen = !isGiven(field);
      field.base = field.name in stated ? null : (field.schema.default ?? null);
      if (isOpen) field.write(field.base);
      (field.element as HTMLInputElement).placeholder = stated[field.name] ?? (field.base === null ? "automatic" : "");
      field.fold.dispatchEvent(new Event("change")); // counts again
    }
  }

  /** Set one option, for example an interpretation that the service offered. */
  set(name: string, value: unknown): void {
    const field = this.fields.find((one) => one.name === name);
    field?.write(value);
    field?.element.dispatchEvent(new Event("change", { bubbles: true }));
  }

  /** Fill the form with options that the user chose, the default among them if a film was to have it. */
  restore(options: Options): void {
    for (const field of this.fields) if (STATED.includes(field.name) && field.name in options) field.base = null;
    this.fill(options);
  }

  /** Set every option to its default, or to what the input states. */
  reset(): void {
    this.state(this.stated);
    this.fill({});
  }

  /** Fill the form with the options of a job. */
  fill(options: Options): void {
    for (const field of this.fields) field.write(field.name in options ? options[field.name] : field.base);
    for (const { element } of this.fields) element.dispatchEvent(new Event("change", { bubbles: true }));
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
    this.fields.push({ name, schema, base: schema.default ?? null, fold, answer, ...control });
    const hint = h("p", { class: "hint", id: `${id}-hint` }, describe(name, schema, String(control.read() ?? "")));
    control.element.setAttribute("aria-describedby", hint.id);
    control.element.addEventListener("change", () => {
      hint.textContent = describe(name, schema, String(control.read() ?? ""));
    });
    const unit = NAMES[name]?.[1];
    const group = control.element.getAttribute("role") === "group";
    if (group) control.element.setAttribute("aria-label", nameOf(name));
    const words = [nameOf(name), unit ? h("span", { class: "unit" }, ` ${unit}`) : null];
    const label = group ? h("span", { title: name }, ...words) : h("label", { for: id, title: name }, ...words);
    return h("div", { class: "option" }, label, control.element, hint, answer);
  }
}

/** Whether the user has chosen a value. */
function isGiven({ base, read }: Field): boolean {
  const value = read();
  return value !== undefined && JSON.stringify(value) !== JSON.stringify(base);
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
    if (element.value === "") return nullable ? null : undefined;
    return numeric ? Number(element.value) : element.value;
  };
  return { element, read, write };
}

function label(value: unknown): string {
  return LABELS[String(value)] ?? String(value);
}

/** The part of a help text that belongs to the chosen value ("robust: …"), the part before all of these if there is none, or the whole text without such parts. */
function describe(name: string, schema: Schema, chosen: string): string {
  const text = HELP[name] ?? schema.description ?? "";
  const place = (value: string): number => text.search(new RegExp(`(?<![\\w+])${value.replaceAll("+", "\\+")}: `));
  const starts = (schema.enum ?? []).map((value) => place(String(value))).filter((at) => at >= 0);
  if (!chosen || starts.length === 0) return text;
  const from = place(chosen);
  if (from < 0) return text.slice(0, Math.min(...starts)).trim();
  const to = Math.min(...starts.filter((at) => at > from), text.length);
  const part = text.slice(from + chosen.length + 2, to).replace(/[.;, ]+$/, "");
  return `${sentence(part)}.`;
}

function sentence(text: string): string {
  return `${text.charAt(0).toUpperCase()}${text.slice(1)}`;
}
