// Code that submits the same job: the same options and parts, and this service's URL.

import { getOptions } from "./api";
import { button, fill, h } from "./dom";
import { chosen, statedBy } from "./options";
import { sentNames } from "./sent";
import { type Job, type Schema, ofFilm } from "./types";

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

/** The options of a job that differ from the defaults, or from what its input states itself. */
function given(job: Job, schema: Schema): Given {
  const stated = statedBy(job.interpretation);
  const differs = (name: string, value: unknown): boolean => JSON.stringify(value) !== JSON.stringify(schema.properties?.[name]?.default ?? null);
  return Object.entries(chosen(job)).filter(([name, value]) => name in stated || differs(name, value));
}

interface FormPart {
  part: string;
  value: string;
  isFile: boolean;
}

/**
 * The parts of the form. Files have their own names if this tab has sent them, else placeholders; a grid is given by its size, and a missing
 * mesh as "none".
 */
function parts(job: Job): [FormPart, ...FormPart[]] {
  const seen = job.interpretation;
  const names = sentNames(job.retry_of && !sentNames(job.id)["film"] ? job.retry_of : job.id);
  const file = (part: string, placeholder: string): FormPart => ({ part, value: names[part] ?? placeholder, isFile: true });
  const masked = names["region"] || (seen.has_region && !job.options["region_polygon"]);
  if (ofFilm(job)) return [file("film", "film.mp4"), ...(masked ? [file("region", "mask.png")] : [])];
  const found: [FormPart, ...FormPart[]] = [file("tracks", "tracks.npz")];
  if (names["mesh"]) found.push(file("mesh", ""));
  else if (seen.mesh_grid) found.push({ part: "mesh", value: seen.mesh_grid.join("x"), isFile: false });
  else if (seen.mesh_source === "given" || seen.mesh_source === "grid") found.push(file("mesh", "mesh.npz"));
  else if (seen.mesh_source === "none") found.push({ part: "mesh", value: "none", isFile: false });
  if (seen.has_ground_truth) found.push(file("ground_truth", "truth.npz"));
  if (seen.has_rotations) found.push(file("rotations", "cameras.npz"));
  return found;
}

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
  const [main, ...others] = parts(job);
  const files = others.map(({ part, value }) => `    ${part}=${JSON.stringify(value)},\n`);
  const first = `${main.part === "film" ? "film=" : ""}${JSON.stringify(main.value)}`;
  const { num_frames, num_points } = job.interpretation;
  const name = job.name ? `    name=${JSON.stringify(job.name)},\n` : "";
  return (
    `from pliant.client import Client\n\n` +
    `job = Client(${JSON.stringify(url)}).submit(\n    ${first},\n${files.join("")}${name}${options ? `    options={${options}},\n` : ""})\n` +
    `shapes = job.wait(timeout=3600).shapes  # array (${num_frames || "frames"}, ${num_points || "points"}, 3)\n`
  );
}

const quote = (text: string): string => (/^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** A file name in curl's option -F, where commas and semicolons separate fields. */
const inField = (name: string): string => (/[,;"]/.test(name) ? `"${name.replace(/["\\]/g, "\\$&")}"` : name);

function shell(job: Job, chosen: Given, url: string): string {
  const [main, ...others] = parts(job);
  const files = others.map(({ part, value }) => `--${part.replace("_", "-")} ${quote(value)}`);
  const options = chosen.map(([name, value]) => `--option ${quote(`${name}=${typeof value === "object" ? JSON.stringify(value) : String(value)}`)}`);
  const name = job.name ? [`--name ${quote(job.name)}`] : [];
  return `${[`pliant submit ${quote(main.value)}`, ...files, ...name, `--url ${quote(url)}`, ...options, "--output result"].join(" \\\n  ")}\n`;
}

function curl(job: Job, chosen: Given, url: string): string {
  const fields = [
    ...parts(job).map(({ part, value, isFile }) => `-F ${quote(isFile ? `${part}=@${inField(value)}` : `${part}=${value}`)}`),
    ...(job.name ? [`-F ${quote(`name=${job.name}`)}`] : []),
    ...(chosen.length > 0 ? [`-F ${quote(`options=${JSON.stringify(Object.fromEntries(chosen))}`)}`] : []),
  ];
  const animated = (job.options["outputs"] as string[]).includes("glb");
  return (
    `${[`curl ${quote(`${url}/v1/jobs`)}`, ...fields].join(" \\\n  ")}\n\n` +
    `# this job's record, and its ${animated ? "animated mesh" : "arrays"}\n` +
    `curl ${quote(`${url}/v1/jobs/${job.id}`)}\n` +
    `curl --fail -O ${quote(`${url}/v1/jobs/${job.id}/artifacts/shapes.${animated ? "glb" : "npz"}`)}\n`
  );
}
