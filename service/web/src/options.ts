// The form for a job's options, made from the service's own schema: a new option appears here by itself.

import { h, uniqueId } from "./dom";
import type { Options, Schema } from "./types";

/** Shown by name at the top; the rest is folded away. */
const FIRST = ["method", "preset"];
/** Not in the form: the region is drawn, on the first frame. */
const DRAWN = ["region_polygon", "region_frame"];

const LABELS: Record<string, string> = {
  pseudo_inverse: "pseudo-inverse",
  temporal: "temporal",
  spatio_temporal: "spatio-temporal",
  robust: "robust",
  auto: "automatic",
  paper: "as published",
};

interface Field {
  name: string;
  schema: Schema;
  read: () => unknown;
  write: (value: unknown) => void;
}

export class OptionsForm {
  readonly first = h("div", { class: "options" });
  readonly more = h("details", { class: "more" });
  private fields: Field[] = [];

  /** Build the form from the schema. Until then a job is sent with the defaults. */
  load(schema: Schema): void {
    const properties = schema.properties ?? {};
    const names = Object.keys(properties);
    const rest = names.filter((name) => !FIRST.includes(name) && !DRAWN.includes(name));
    this.fields = [];
    this.first.replaceChildren(...FIRST.filter((name) => names.includes(name)).map((name) => this.row(name, properties)));
    const changed = h("span", { class: "muted" });
    const body = h("div", { class: "options" }, ...rest.map((name) => this.row(name, properties)));
    this.more.replaceChildren(h("summary", {}, "More options ", changed), body);
    body.addEventListener("change", () => {
      const given = Object.keys(this.values()).filter((name) => !FIRST.includes(name)).length;
      changed.textContent = given > 0 ? `(${given} changed)` : "";
    });
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

  /** Set one option, for instance a reading that the service offered. */
  set(name: string, value: unknown): void {
    const field = this.fields.find((one) => one.name === name);
    field?.write(value);
    this.more.dispatchEvent(new Event("change"));
  }

  private row(name: string, properties: Record<string, Schema>): HTMLElement {
    const schema = properties[name] as Schema;
    const id = uniqueId("option");
    const control = controlFor(schema, id);
    this.fields.push({ name, schema, ...control });
    const words = describe(schema, String(control.read() ?? ""));
    const hint = h("p", { class: "hint", id: `${id}-hint` }, words);
    control.element.setAttribute("aria-describedby", hint.id);
    control.element.addEventListener("change", () => {
      hint.textContent = describe(schema, String(control.read() ?? ""));
    });
    const title = sentence(name.replaceAll("_", " "));
    const group = control.element.getAttribute("role") === "group";
    if (group) control.element.setAttribute("aria-label", title);
    const label = group ? h("span", {}, title) : h("label", { for: id }, title);
    return h("div", { class: "option" }, label, control.element, hint);
  }
}

interface Control extends Pick<Field, "read" | "write"> {
  element: HTMLElement;
}

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

/** Any of some values: a tick for each. */
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

/** The part of a description that belongs to the chosen value ("robust: …"), or all of it where there is no such part. */
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
