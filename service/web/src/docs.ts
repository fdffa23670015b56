// The API's description, drawn from the service's own OpenAPI document: what /openapi.json says is what stands here.

import { Refusal, call } from "./api";
import { h } from "./dom";
import { refusalBox } from "./refusal";
import type { Schema } from "./types";

interface Media {
  schema?: Schema & { $ref?: string; items?: Schema & { $ref?: string }; required?: string[] };
  example?: unknown;
}

interface Operation {
  summary?: string;
  description?: string;
  tags?: string[];
  parameters?: { name: string; in: string; required?: boolean; description?: string; schema?: Schema }[];
  requestBody?: { required?: boolean; content: Record<string, Media> };
  responses: Record<string, { description?: string; content?: Record<string, Media> }>;
}

interface Document {
  info: { title: string; version: string; summary?: string; description?: string };
  paths: Record<string, Record<string, Operation>>;
  components?: { schemas?: Record<string, Schema> };
}

const main = document.getElementById("main") as HTMLElement;

try {
  const api = (await (await call("openapi.json")).json()) as Document;
  main.replaceChildren(...manual(api));
} catch (error) {
  if (!(error instanceof Refusal)) throw error;
  main.replaceChildren(refusalBox(error.problem));
}

function manual(api: Document): HTMLElement[] {
  const operations = Object.entries(api.paths).flatMap(([path, methods]) =>
    Object.entries(methods).map(([method, operation]) => ({ path, method: method.toUpperCase(), operation })),
  );
  const contents = operations.map(({ path, method, operation }) =>
    h("li", {}, h("a", { href: `#${anchor(method, path)}` }, `${method} ${path}`), h("span", { class: "hint" }, operation.summary ?? "")),
  );
  return [
    h("header", {}, h("h2", {}, `${api.info.title} API ${api.info.version}`), ...prose(api.info.summary), ...prose(api.info.description)),
    h("nav", { class: "card", "aria-label": "Addresses" }, h("ul", { class: "contents-list" }, ...contents)),
    ...operations.map((one) => section(api, one.method, one.path, one.operation)),
  ];
}

function anchor(method: string, path: string): string {
  return `${method}-${path}`.replace(/[^A-Za-z0-9]+/g, "-");
}

function section(api: Document, method: string, path: string, operation: Operation): HTMLElement {
  const parameters = (operation.parameters ?? []).map((one) =>
    row(one.name, `${one.in}${one.required ? ", required" : ""}`, one.description ?? one.schema?.description ?? "", one.schema),
  );
  const bodies = Object.entries(operation.requestBody?.content ?? {}).map(([type, media]) => body(api, type, media));
  return h(
    "article",
    { class: "card", id: anchor(method, path) },
    h("h3", { class: "address" }, h("span", { class: "method" }, method), ` ${path}`),
    ...prose(operation.summary),
    ...prose(operation.description),
    parameters.length > 0 && table("Parameters", parameters),
    ...bodies,
    table(
      "Answers",
      Object.entries(operation.responses).map(([status, answer]) =>
        row(status, Object.keys(answer.content ?? {}).join(", "), answer.description ?? ""),
      ),
    ),
  );
}

function body(api: Document, type: string, media: Media): HTMLElement {
  const schema = resolve(api, media.schema);
  const fields = Object.entries(schema?.properties ?? {}).map(([name, field]) =>
    row(name, media.schema?.required?.includes(name) ? "required" : "", field.description ?? "", field),
  );
  return h(
    "div",
    {},
    fields.length > 0 ? table(`Body: ${type}`, fields) : h("p", { class: "muted" }, `Body: ${type}`),
    media.example !== undefined && h("pre", { tabindex: 0, "aria-label": "Example" }, h("code", {}, JSON.stringify(media.example, null, 2))),
  );
}

function resolve(api: Document, schema: Media["schema"]): Schema | undefined {
  const name = schema?.$ref?.split("/").at(-1);
  return name === undefined ? schema : api.components?.schemas?.[name];
}

function table(caption: string, rows: HTMLElement[]): HTMLElement {
  return h("table", {}, h("caption", {}, caption), h("tbody", {}, ...rows));
}

function row(name: string, kind: string, meaning: string, schema?: Schema): HTMLElement {
  const initial = schema?.default === undefined || schema.default === null ? "" : ` Default: ${JSON.stringify(schema.default)}.`;
  return h(
    "tr",
    {},
    h("th", { scope: "row" }, h("code", {}, name), h("span", { class: "hint" }, kind)),
    h("td", {}, ...inline(meaning + initial)),
  );
}

/** Paragraphs of a description; the little Markdown in it is `code`. */
function prose(text: string | undefined): HTMLElement[] {
  return (text ?? "")
    .split(/\n\s*\n/)
    .filter((part) => part.trim())
    .map((part) => h("p", {}, ...inline(part)));
}

function inline(text: string): (Node | string)[] {
  return text.split("`").map((part, index) => (index % 2 === 1 ? h("code", {}, part) : part));
}
