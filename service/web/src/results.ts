// The metrics and the files of a job.

import { Refusal, artifactPath, call, headers } from "./api";
import { fill, h } from "./dom";
import { saveWithToken } from "./links";
import type { Artifact, Job } from "./types";
import { bytes, number, unbroken } from "./words";

/** Title and meaning of each metric, shown beside its name in the record. */
const METRICS: Record<string, [string, string]> = {
  e3d_frame_scaled: ["3-D error", "distance from the ground truth after rotating each frame and scaling all; share of the object's size"],
  e3d_frame: ["3-D error without scale", "the same without the scale; result and ground truth must have one unit"],
  e3d_sequence: ["3-D error, one alignment", "the same after one orthogonal alignment for the whole sequence"],
  e3d_frame_similarity: ["Shape error", "the same after rotating, mirroring and scaling each frame to fit"],
  e3d_mocap: ["3-D error, motion capture", "as the motion capture literature defines it; share of the shape's spread"],
  size_ratio: ["Size ratio", "size of the ground truth divided by the result's; far from 1, their units differ and only scaled errors have a meaning"],
  coverage: ["Coverage", "share of the positions within their 90\u00a0% interval"],
  reprojection_median: ["Reprojection, median", "median distance from a visible track to the projected shape, in the tracks' unit"],
  reprojection_rms: ["Reprojection, root mean square", "root mean square of the same distances; sensitive to outliers"],
  rotation_degrees: ["Camera error", "mean angle between estimated and true cameras, in degrees"],
  focal_error: ["Focal length error", "error of the focal length, share of the true value"],
};

/** The panel "Metrics". */
export class Metrics {
  private readonly rows = h("tbody", {});
  readonly element = h(
    "section",
    { class: "panel", "aria-labelledby": "metrics-title" },
    h("h3", { id: "metrics-title" }, "Metrics"),
    h("table", {}, h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Name"), h("th", { scope: "col", class: "figure" }, "Value"))), this.rows),
  );

  show(job: Job): void {
    const order = Object.keys(METRICS);
    const place = (name: string): number => (order.includes(name) ? order.indexOf(name) : order.length);
    const metrics = Object.entries(job.metrics ?? {}).sort(([one], [other]) => place(one) - place(other));
    this.element.hidden = metrics.length === 0;
    fill(this.rows, JSON.stringify(metrics), () =>
      metrics.map(([name, value]) =>
        h(
          "tr",
          {},
          metricHead(name),
          h("td", { class: "figure" }, number(value)),
        ),
      ),
    );
  }
}

function metricHead(name: string): HTMLElement {
  const known = METRICS[name];
  if (known === undefined) return h("th", { scope: "row" }, h("code", {}, name));
  const [title, meaning] = known;
  return h("th", { scope: "row" }, h("span", { class: "metric" }, title), h("span", { class: "hint" }, h("code", {}, name), ` ${meaning}`));
}

/** Warnings to read before using a result, shown above the viewer. */
export class Warnings {
  private readonly items = h("ul", { class: "notes warn" });
  readonly element = h("section", { class: "warnings", "aria-label": "Warnings", hidden: true }, this.items);

  show(job: Job): void {
    // The reasons of the verdict are already shown.
    const reasons = new Set(job.verdict_reasons ?? []);
    const warnings = job.warnings.filter((warning) => !reasons.has(warning));
    this.element.hidden = warnings.length === 0;
    fill(this.items, warnings.join("\n"), () => warnings.map((warning) => h("li", {}, unbroken(warning))));
  }
}

const SHEET = "contact_sheet.jpg";

/** The panel "Tracked film": frames with the tracks drawn over them. */
export class Sheet {
  private readonly figure = h("figure", { class: "sheet" });
  readonly element = h(
    "section",
    { class: "panel", "aria-labelledby": "sheet-title", hidden: true },
    h("h3", { id: "sheet-title" }, "Tracked film"),
    this.figure,
  );

  show(job: Job): void {
    const sheet = job.artifacts.find(({ name }) => name === SHEET);
    this.element.hidden = sheet === undefined;
    if (sheet === undefined) return;
    fill(this.figure, `${job.id} ${sheet.sha256}`, () => {
      const picture = h("img", { alt: "Frames of the film with the tracks drawn over them" });
      addressOf(artifactPath(job.id, SHEET))
        .then((address) => (picture.src = address))
        .catch((error: unknown) => {
          if (!(error instanceof Refusal)) throw error; // the alternative text remains
        });
      const link = saveLink(job, sheet, `Save ${SHEET}`);
      return [picture, h("figcaption", { class: "hint" }, `${sheet.description} Check that the points stay on the object. `, link)];
    });
  }
}

/** Return an address for a picture: the path itself, or a data: URL of its content if the request needs a token. */
async function addressOf(path: string): Promise<string> {
  if (!("Authorization" in headers())) return path;
  const content = await (await call(path)).blob();
  return new Promise((resolve, reject) => {
    const reader = new FileReader(); // the content security policy allows data: for pictures, not blob:
    reader.onload = () => resolve(String(reader.result));
    reader.onerror = () => reject(reader.error as DOMException);
    reader.readAsDataURL(content);
  });
}

/** The panel "Files". */
export class Files {
  private readonly items = h("ul", { class: "files" });
  readonly element = h(
    "section",
    { class: "panel", "aria-labelledby": "files-title" },
    h("h3", { id: "files-title" }, "Files"),
    this.items,
  );

  show(job: Job): void {
    this.element.hidden = job.artifacts.length === 0;
    fill(this.items, JSON.stringify(job.artifacts), () => job.artifacts.map((artifact) => this.item(job, artifact)));
  }

  private item(job: Job, artifact: Artifact): HTMLElement {
    const link = saveLink(job, artifact, artifact.name);
    return h("li", {}, link, h("span", { class: "muted" }, bytes(artifact.bytes)), h("span", { class: "hint" }, artifact.description));
  }
}

/** A link that saves a file of a job. */
export function saveLink(job: Job, artifact: Artifact, words: string, kind: string | null = null): HTMLAnchorElement {
  const path = artifactPath(job.id, artifact.name);
  const link = h("a", { href: path, download: artifact.name, class: kind }, words);
  link.addEventListener("click", (event) => {
    if (!("Authorization" in headers())) return;
    event.preventDefault(); // a plain link cannot carry the token
    void saveWithToken(link, path, artifact.name);
  });
  return link;
}
