// How the service interprets the inputs: shown before a job is submitted, and again with the job.

import { Refusal, inspect } from "./api";
import { button, fill, h } from "./dom";
import { Glimpse } from "./glimpse";
import type { Inspection as InspectionAnswer, Interpretation, Job, Options } from "./types";
import { bytes, count, expected, percent } from "./words";

const MESHES: Record<string, string> = {
  given: "as given",
  grid: "from the grid",
  delaunay: "triangulated in the frame with the most visible points",
  none: "none, points only",
  film: "from the grid of tracked points",
};

/** The service's notes, except the one on a film's size and frames, which `facts` contains. */
function notesOf(seen: Interpretation): string[] {
  return seen.notes.filter((note) => seen.num_points > 0 || !note.startsWith("A film of "));
}

/** The interpretation of the inputs, as terms and descriptions. */
function facts(seen: Interpretation): [string, string][] {
  // The points of a film are not known until the job tracks it.
  if (seen.num_points === 0) {
    const [size, fps] = [seen.image_size?.replace("x", "×"), seen.fps];
    const film = [
      size ? `${size} pixels` : "",
      seen.num_frames > 0 ? count(seen.num_frames, "frame") : "",
      fps ? `${Number(fps.toPrecision(3))} frames per second` : "",
    ].filter(Boolean);
    return [
      ["Film", film.join(", ") || "as given"],
      ["Points", "tracked when the job runs"],
    ];
  }
  return [
    ["Tracks", `${count(seen.num_frames, "frame")} of ${count(seen.num_points, "point")}, ${percent(seen.hidden_fraction)} hidden`],
    ["Layout", `${seen.layout}, y ${seen.y_axis}`],
    ["Mesh", seen.num_faces > 0 ? `${count(seen.num_faces, "face")}, ${MESHES[seen.mesh_source] ?? seen.mesh_source}` : "none, points only"],
    ["Ground truth", seen.has_ground_truth ? "given; errors are measured against it" : "none"],
    ["Cameras", seen.has_rotations ? "given" : "estimated"],
  ];
}

/** Terms, descriptions and notes; updated only if they differ. */
class Facts {
  readonly list = h("dl", { class: "facts" });
  readonly notes = h("ul", { class: "notes" });

  show(rows: [string, string][], notes: string[]): void {
    fill(this.list, JSON.stringify(rows), () => rows.flatMap(([term, value]) => [h("dt", {}, term), h("dd", {}, value)]));
    fill(this.notes, notes.join("\n"), () => notes.map((note) => h("li", {}, note)));
    this.notes.hidden = notes.length === 0;
  }
}

/** The panel "Interpretation" of a job. */
export class Understood {
  private readonly facts = new Facts();
  readonly element = h(
    "section",
    { class: "panel", "aria-labelledby": "understood-title" },
    h("h3", { id: "understood-title" }, "Interpretation"),
    this.facts.list,
    this.facts.notes,
  );

  show(job: Job): void {
    const method: [string, string] = ["Method", `${String(job.options["method"])}, preset ${String(job.options["preset"])}`];
    this.facts.show([...facts(job.interpretation), method], notesOf(job.interpretation));
  }
}

/** Files up to this total size, in bytes, are checked automatically; they are uploaded again with the job. */
const BY_ITSELF = 64e6;
const SETTLES = 250;

/** Shows how the service interprets the chosen files while the form is being filled in. */
export class Inspection {
  private readonly facts = new Facts();
  private readonly glimpse = new Glimpse();
  private readonly words = h("p", { class: "muted", role: "status" });
  private readonly ask = button("Check the files", () => void this.send());
  private readonly found = h(
    "div",
    { class: "found", hidden: true },
    h("h3", { id: "found-title" }, "How your files are interpreted"),
    this.glimpse.canvas,
    this.facts.list,
    this.facts.notes,
  );
  readonly element = h("section", { class: "inspection", "aria-labelledby": "found-title" }, this.words, this.ask, this.found);
  private asking: AbortController | null = null;
  private timer = 0;

  /** `form` returns what would be submitted, or null without a film or tracks; `refused` shows the error, if any; `onSeen` gets the interpretation. */
  constructor(
    private readonly form: () => FormData | null,
    private readonly refused: (refusal: Refusal | null) => void,
    private readonly onSeen: (seen: InspectionAnswer) => void,
  ) {
    this.clear();
  }

  /** The files, or the options for reading them, have changed. */
  changed(): void {
    this.clear();
    this.refused(null);
    const form = this.form();
    if (form === null) return;
    const size = [...form.values()].reduce((sum, value) => sum + (value instanceof File ? value.size : 0), 0);
    if (size <= BY_ITSELF) this.timer = setTimeout(() => void this.send(), SETTLES);
    else {
      this.words.textContent = `Files this large (${bytes(size)}) are checked on request only.`;
      this.ask.hidden = false;
    }
  }

  /** Stop checking: the job is being submitted. */
  stop(): void {
    clearTimeout(this.timer);
    this.asking?.abort();
    this.asking = null;
    if (this.found.hidden) this.clear();
  }

  private clear(): void {
    clearTimeout(this.timer);
    this.asking?.abort();
    this.asking = null;
    this.words.textContent = "";
    this.ask.hidden = true;
    this.found.hidden = true;
    this.glimpse.stop();
  }

  private async send(): Promise<void> {
    const form = this.form();
    if (form === null) return;
    this.clear();
    const asking = new AbortController();
    this.asking = asking;
    this.words.textContent = "Sending and reading the files…";
    try {
      const seen = await inspect(form, asking.signal);
      if (asking.signal.aborted) return;
      const time = expected(seen, JSON.parse(String(form.get("options"))) as Options);
      this.facts.show([...facts(seen), ...(time ? [["Time", time] as [string, string]] : [])], notesOf(seen));
      this.found.hidden = false;
      this.glimpse.show(seen.sample ?? []);
      this.onSeen(seen);
      this.words.textContent = "";
    } catch (error) {
      if (asking.signal.aborted) return;
      this.words.textContent = "";
      if (!(error instanceof Refusal)) throw error;
      // Ignore other errors, for example of older services without this endpoint or of busy ones: submitting reports them.
      if (error.problem.status === 422 || error.problem.status === 413) this.refused(error);
    }
  }
}
