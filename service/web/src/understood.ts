// How inputs are understood: asked of the service before a job is made of them, and shown again with the job.

import { Refusal, inspect } from "./api";
import { button, fill, h } from "./dom";
import { Glimpse } from "./glimpse";
import type { Inspection as InspectionAnswer, Interpretation, Job } from "./types";
import { bytes, count, percent } from "./words";

const MESHES: Record<string, string> = {
  given: "as given",
  grid: "from the grid",
  delaunay: "made by triangulating the best-seen frame",
  none: "none: points alone",
  film: "from the grid of tracked points",
};

/** What the service made of the inputs, as terms and words. */
function facts(seen: Interpretation): [string, string][] {
  // A film is opened before a job is made of it, and tracked when the job runs.
  if (seen.num_points === 0) return [["Film", seen.num_frames > 0 ? count(seen.num_frames, "frame") : "frames not counted yet"]];
  return [
    ["Tracks", `${count(seen.num_frames, "frame")} of ${count(seen.num_points, "point")}, ${percent(seen.hidden_fraction)} hidden`],
    ["Layout", `${seen.layout}, y ${seen.y_axis}`],
    ["Mesh", seen.num_faces > 0 ? `${count(seen.num_faces, "face")}, ${MESHES[seen.mesh_source] ?? seen.mesh_source}` : "none: points alone"],
    ["Ground truth", seen.has_ground_truth ? "given; errors are measured against it" : "none"],
    ["Cameras", seen.has_rotations ? "given" : "estimated"],
  ];
}

/** Terms, words and notes; rewritten only where they differ. */
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
    this.facts.show([...facts(job.interpretation), method], job.interpretation.notes);
  }
}

/** Files up to this size are asked about by themselves; they travel again with the job. */
const BY_ITSELF = 64e6;
const SETTLES = 250;

/** Asks how the chosen files are understood while the form is being filled in. */
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

  /** `form` gives what would be sent, null where there is neither a film nor tracks; `refused` shows why it would be refused, `onSeen` gets the answer. */
  constructor(
    private readonly form: () => FormData | null,
    private readonly refused: (refusal: Refusal | null) => void,
    private readonly onSeen: (seen: InspectionAnswer) => void,
  ) {
    this.clear();
  }

  /** The files or the options that say how to read them are others now. */
  changed(): void {
    this.clear();
    this.refused(null);
    const form = this.form();
    if (form === null) return;
    const size = [...form.values()].reduce((sum, value) => sum + (value instanceof File ? value.size : 0), 0);
    if (size <= BY_ITSELF) this.timer = setTimeout(() => void this.send(), SETTLES);
    else {
      this.words.textContent = `${bytes(size)} are not read before you ask.`;
      this.ask.hidden = false;
    }
  }

  /** Stop asking; a job is being made of it. */
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
    this.words.textContent = "Reading…";
    try {
      const seen = await inspect(form, asking.signal);
      if (asking.signal.aborted) return;
      this.facts.show(facts(seen), seen.notes);
      this.found.hidden = false;
      this.glimpse.show(seen.sample ?? []);
      this.onSeen(seen);
      this.words.textContent = "";
    } catch (error) {
      if (asking.signal.aborted) return;
      this.words.textContent = "";
      if (!(error instanceof Refusal)) throw error;
      // An older service has no such question, and a busy one no time for it: sending says what there is to say.
      if (error.problem.status === 422 || error.problem.status === 413) this.refused(error);
    }
  }
}
