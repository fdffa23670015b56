// Code that submits the same job: the same options and parts, and this service's URL.

import { getOptions } from "./api";
import { button, fill, h } from "./dom";
import type { Job, Schema } from "./types";

type Language = "Python" | "Shell" | "curl";

export class Snippets {
  readonly element: HTMLElement;
  private readonly code = h("code", {});
  private readonly copied = h("span", { class: "muted", role: "status" });
  private readonly tabs: HTMLButtonElement[];
  private language: Language = "Python";
  private job: Job | null = null;

  constructor() {
    const languages: Language[] = ["Python", "Shell", "curl"];
    this.tabs = languages.map((language) =>
      button(language, () => this.choose(language), { "aria-pressed": String(language === this.language) }),
    );
    const copy = button("Copy", () => void this.copy(), { class: "quiet" });
    this.element = h(
      "section",
      { class: "panel snippets", "aria-labelledby": "snippet-title" },
      h("h3", { id: "snippet-title" }, "Use from code"),
      h("div", { class: "row", role: "group", "aria-label": "Language" }, ...this.tabs, copy, this.copied),
      h("pre", { tabindex: 0, role: "region", "aria-label": "Code" }, this.code),
    );
  }

  show(job: Job): void {
    this.job = job;
    void getOptions().then(
      (schema) => this.write(job, schema),
      () => this.write(job, {}), // without the defaults, every option is written out, which is equivalent
    );
  }

  private write(job: Job, schema: Schema): void {
    const text = snippet(job, given(job, schema), this.language, new URL(".", document.baseURI).href.replace(/\/$/, ""));
    fill(this.code, text, () => [text]);
  }

  private choose(language: Language): void {
    this.language = language;
    for (const tab of this.tabs) tab.setAttribute("aria-pressed", String(tab.textContent === language));
    if (this.job) this.show(this.job);
  }

  private async copy(): Promise<void> {
    // The clipboard is available only on HTTPS and localhost; elsewhere the text is selected for Ctrl+C.
    try {
      await navigator.clipboard.writeText(this.code.textContent ?? "");
      this.copied.textContent = "Copied.";
    } catch {
      getSelection()?.selectAllChildren(this.code);
      this.copied.textContent = "Selected. Press Ctrl+C to copy.";
    }
    setTimeout(() => (this.copied.textContent = ""), 3000);
  }
}

type Given = [string, unknown][];

/** The options of a job that differ from the defaults. */
function given(job: Job, schema: Schema): Given {
  const differs = (name: string, value: unknown): boolean => JSON.stringify(value) !== JSON.stringify(schema.properties?.[name]?.default ?? null);
  return Object.entries(job.options).filter(([name, value]) => differs(name, value));
}

/** The parts of the form, with placeholder file names; a grid is given by its size, and a missing mesh as "none". */
function parts(job: Job): [string, string][] {
  const seen = job.interpretation;
  if (ofFilm(job)) return [["film", "film.mp4"]];
  const found: [string, string][] = [["tracks", "tracks.npz"]];
  if (seen.mesh_grid) found.push(["mesh", seen.mesh_grid.join("x")]);
  else if (seen.mesh_source === "given" || seen.mesh_source === "grid") found.push(["mesh", "mesh.npz"]);
  else if (seen.mesh_source === "none") found.push(["mesh", "none"]);
  if (seen.has_ground_truth) found.push(["ground_truth", "truth.npz"]);
  if (seen.has_rotations) found.push(["rotations", "cameras.npz"]);
  return found;
}

const ofFilm = (job: Job): boolean => job.interpretation.mesh_source === "film";

/** Return the code for a job. */
function snippet(job: Job, options: Given, language: Language, url: string): string {
  if (language === "Python") return python(job, options, url);
  if (language === "Shell") return shell(job, options, url);
  return curl(job, options, url);
}

function python(job: Job, chosen: Given, url: string): string {
  const literal = (value: unknown): string =>
    value === true ? "True" : value === false ? "False" : JSON.stringify(value);
  const options = chosen.map(([name, value]) => `${JSON.stringify(name)}: ${literal(value)}`).join(", ");
  const files = parts(job)
    .slice(1)
    .map(([part, file]) => `    ${part}=${JSON.stringify(file)},\n`);
  const name = job.name ? `    name=${JSON.stringify(job.name)},\n` : "";
  return (
    `from pliant.client import Client\n\n` +
    `job = Client(${JSON.stringify(url)}).submit(\n    ${ofFilm(job) ? 'film="film.mp4"' : '"tracks.npz"'},\n${files.join("")}${name}${options ? `    options={${options}},\n` : ""})\n` +
    `shapes = job.wait(timeout=3600).shapes  # array (${job.interpretation.num_frames}, ${job.interpretation.num_points}, 3)\n`
  );
}

const quote = (text: string): string => (/^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

function shell(job: Job, chosen: Given, url: string): string {
  const files = parts(job)
    .slice(1)
    .map(([part, file]) => `--${part.replace("_", "-")} ${file}`);
  const options = chosen.map(([name, value]) => `--option ${quote(`${name}=${typeof value === "object" ? JSON.stringify(value) : String(value)}`)}`);
  const name = job.name ? [`--name ${quote(job.name)}`] : [];
  return `${[`pliant submit ${ofFilm(job) ? "film.mp4" : "tracks.npz"}`, ...files, ...name, `--url ${quote(url)}`, ...options, "--output result"].join(" \\\n  ")}\n`;
}

function curl(job: Job, chosen: Given, url: string): string {
  const fields = [
    ...parts(job).map(([part, file]) => `-F ${part}=${/\.(npz|mp4)$/.test(file) ? "@" : ""}${file}`),
    ...(job.name ? [`-F ${quote(`name=${job.name}`)}`] : []),
    ...(chosen.length > 0 ? [`-F ${quote(`options=${JSON.stringify(Object.fromEntries(chosen))}`)}`] : []),
  ];
  return (
    `${[`curl ${quote(`${url}/v1/jobs`)}`, ...fields].join(" \\\n  ")}\n\n` +
    `# this job's record, and its animated mesh\n` +
    `curl ${quote(`${url}/v1/jobs/${job.id}`)}\n` +
    `curl -O ${quote(`${url}/v1/jobs/${job.id}/artifacts/shapes.glb`)}\n`
  );
}
