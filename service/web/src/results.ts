// What a job was understood as, its metrics, and its files.

import { artifactPath, call, headers } from "./api";
import { fill, h } from "./dom";
import type { Artifact, Job } from "./types";
import { bytes, count, number, percent } from "./words";

const MESHES: Record<string, string> = {
  given: "as given",
  grid: "from the grid",
  delaunay: "made by triangulating the best-seen frame",
  none: "none: points alone",
};

const METRICS: Record<string, string> = {
  e3d_sequence: "3-D error, one orthogonal alignment for the whole sequence; relative",
  e3d_frame: "3-D error, each frame turned to fit best; relative",
  e3d_frame_similarity: "3-D error, each frame turned, mirrored and scaled to fit; relative",
  e3d_mocap: "3-D error in the motion-capture literature's way; relative to the shape's spread",
  reprojection_median: "Distance between a seen track and the projected shape, median; the tracks' unit",
  reprojection_rms: "The same, root mean square: outliers count here",
  rotation_degrees: "Angle between estimated and true cameras, mean; degrees",
};

/** The panel "Understood as". */
export class Understood {
  private readonly facts = h("dl", { class: "facts" });
  private readonly notes = h("ul", { class: "notes" });
  readonly element = h(
    "section",
    { class: "panel", "aria-labelledby": "understood-title" },
    h("h3", { id: "understood-title" }, "Understood as"),
    this.facts,
    this.notes,
  );

  show(job: Job): void {
    const seen = job.interpretation;
    const rows: [string, string][] = [
      ["Tracks", `${count(seen.num_frames, "frame")} of ${count(seen.num_points, "point")}, ${percent(seen.hidden_fraction)} hidden`],
      ["Read as", `${seen.layout}, y ${seen.y_axis}`],
      ["Mesh", `${count(seen.num_faces, "face")}, ${MESHES[seen.mesh_source] ?? seen.mesh_source}`],
      ["Ground truth", seen.has_ground_truth ? "given; errors are measured against it" : "none"],
      ["Cameras", seen.has_rotations ? "given" : "estimated"],
      ["Method", `${String(job.options["method"])}, preset ${String(job.options["preset"])}`],
    ];
    fill(this.facts, JSON.stringify(rows), () => rows.flatMap(([term, value]) => [h("dt", {}, term), h("dd", {}, value)]));
    fill(this.notes, seen.notes.join("\n"), () => seen.notes.map((note) => h("li", {}, note)));
    this.notes.hidden = seen.notes.length === 0;
  }
}

/** The panel "Metrics". */
export class Metrics {
  private readonly rows = h("tbody", {});
  private readonly warnings = h("ul", { class: "notes warn" });
  readonly element = h(
    "section",
    { class: "panel", "aria-labelledby": "metrics-title" },
    h("h3", { id: "metrics-title" }, "Metrics"),
    this.warnings,
    h("table", {}, h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "name"), h("th", { scope: "col", class: "figure" }, "value"))), this.rows),
  );

  show(job: Job): void {
    const metrics = Object.entries(job.metrics ?? {});
    this.element.hidden = metrics.length === 0 && job.warnings.length === 0;
    fill(this.rows, JSON.stringify(metrics), () =>
      metrics.map(([name, value]) =>
        h(
          "tr",
          {},
          h("th", { scope: "row" }, h("code", {}, name), METRICS[name] ? h("span", { class: "hint" }, METRICS[name]) : null),
          h("td", { class: "figure" }, number(value)),
        ),
      ),
    );
    fill(this.warnings, job.warnings.join("\n"), () => job.warnings.map((warning) => h("li", {}, warning)));
    this.warnings.hidden = job.warnings.length === 0;
  }
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
    const path = artifactPath(job.id, artifact.name);
    const link = h("a", { href: path, download: artifact.name }, artifact.name);
    link.addEventListener("click", (event) => {
      if (!("Authorization" in headers())) return;
      event.preventDefault(); // a plain link cannot carry the token
      void saveWithToken(path, artifact.name);
    });
    return h("li", {}, link, h("span", { class: "muted" }, bytes(artifact.bytes)), h("span", { class: "hint" }, artifact.description));
  }
}

async function saveWithToken(path: string, name: string): Promise<void> {
  const url = URL.createObjectURL(await (await call(path)).blob());
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
