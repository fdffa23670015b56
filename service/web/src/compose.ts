// The form for a new job: files by drop or by choice, what is in them, options, and the service's answer if it says no.

import { type Example, Refusal, exampleFile, getOptions, listExamples, newKey, submit } from "./api";
import { button, h, uniqueId } from "./dom";
import { OptionsForm } from "./options";
import { type Entry, describe, peek } from "./peek";
import { refusalBox } from "./refusal";
import { type Job, PARTS, type Part } from "./types";
import { bytes, percent } from "./words";

const SLOTS: Record<Part, { label: string; hint: string }> = {
  tracks: { label: "Tracks", hint: "npz, npy, mat, csv" },
  mesh: { label: "Mesh", hint: "optional, obj, ply, npz" },
  ground_truth: { label: "Ground truth", hint: "optional, for errors" },
  rotations: { label: "Cameras", hint: "optional, if known" },
};

interface Slot {
  input: HTMLInputElement;
  name: HTMLElement;
  contents: HTMLElement;
  remove: HTMLButtonElement;
  file: File | null;
}

export class Compose {
  readonly element: HTMLDetailsElement;
  private readonly options = new OptionsForm();
  private readonly slots = new Map<Part, Slot>();
  private readonly grid = h("input", { type: "text", id: "grid", placeholder: "rows×columns", size: 10, autocomplete: "off" });
  private readonly label = h("input", { type: "text", id: "job-name", maxlength: 200, autocomplete: "off" });
  private readonly send = h("button", { type: "submit", class: "primary" }, "Reconstruct");
  private readonly stop = button("Stop", () => this.sending?.abort(), { hidden: true });
  private readonly answer = h("div", { class: "answer", "aria-live": "assertive" });
  private readonly examples = h("p", { class: "examples" });
  private sending: AbortController | null = null;
  /** Kept while it is unknown whether the service has got the job: sending again must not make a second one. */
  private key: string | null = null;
  private offered: Example[] = [];

  constructor(private readonly onJob: (job: Job) => void) {
    const zone = h(
      "div",
      { class: "zone" },
      h("p", { class: "zone-title" }, "Drop tracks here, and a mesh"),
      h("p", { class: "hint" }, "Files stay on this service; nothing is sent elsewhere."),
      ...PARTS.map((part) => this.slot(part)),
    );
    const form = h(
      "form",
      { class: "compose", onsubmit: (event: SubmitEvent) => void this.submit(event), "aria-labelledby": "compose-title" },
      zone,
      this.examples,
      this.options.first,
      this.options.more,
      h("div", { class: "option" }, h("label", { for: "job-name" }, "name (optional)"), this.label),
      h("div", { class: "row" }, this.send, this.stop),
      this.answer,
    );
    const summary = h("summary", {}, h("h2", { id: "compose-title" }, "New reconstruction"));
    form.addEventListener("change", () => (this.key = null));
    this.element = h("details", { class: "card", open: true }, summary, form);
    this.acceptDrops();
  }

  /** Fetch what the service knows about options and examples. */
  async load(): Promise<void> {
    this.options.load(await getOptions());
    try {
      const { examples } = await listExamples();
      this.offered = examples;
      this.examples.replaceChildren(...this.exampleButtons(examples));
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      this.examples.replaceChildren(); // a service without examples is whole all the same
    }
  }

  private exampleButtons(examples: Example[]): (Node | string)[] {
    if (examples.length === 0) return [];
    const buttons = examples.flatMap((example, index) => [
      index > 0 ? ", " : "",
      button(example.title, () => void this.takeExample(example), { class: "link" }),
    ]);
    return ["Nothing at hand? Try a ", ...buttons, "."];
  }

  /** Take the first example and send it: the shortest way to a moving mesh. */
  async tryOut(): Promise<void> {
    const example = this.offered[0];
    if (example === undefined) return;
    this.element.open = true;
    await this.takeExample(example);
    if (this.slots.get("tracks")?.file) this.send.form?.requestSubmit();
  }

  /** True where the service makes examples. */
  get hasExamples(): boolean {
    return this.offered.length > 0;
  }

  private async takeExample(example: Example): Promise<void> {
    this.answer.replaceChildren(h("p", { class: "muted" }, "Making the example…"));
    try {
      for (const part of PARTS) await this.put(part, null);
      for (const { part, file } of example.files) {
        if (part in SLOTS) await this.put(part as Part, await exampleFile(example.name, file));
      }
      this.label.value = example.title;
      this.answer.replaceChildren();
      this.send.focus();
    } catch (error) {
      this.refuse(error);
    }
  }

  private slot(part: Part): HTMLElement {
    const id = uniqueId("file");
    const input = h("input", { type: "file", id, class: "visually-hidden", "aria-describedby": `${id}-hint` });
    const name = h("span", { class: "file-name hint", id: `${id}-hint` }, SLOTS[part].hint);
    const contents = h("span", { class: "contents hint" });
    const remove = button("×", () => void this.put(part, null).then(() => input.focus()), {
      class: "quiet",
      hidden: true,
      "aria-label": `Remove ${SLOTS[part].label.toLowerCase()}`,
    });
    input.addEventListener("change", () => void this.put(part, input.files?.[0] ?? null));
    this.slots.set(part, { input, name, contents, remove, file: null });
    const choose = h("label", { for: id, class: "choose" }, SLOTS[part].label);
    const row = h("div", { class: "slot", "data-part": part }, input, choose, name, remove, contents);
    if (part === "mesh") row.append(h("span", { class: "grid-size" }, h("label", { for: "grid" }, "or points on a grid"), this.grid));
    return row;
  }

  private async put(part: Part, file: File | null): Promise<void> {
    const slot = this.slots.get(part) as Slot;
    slot.file = file;
    this.key = null;
    slot.remove.hidden = file === null;
    slot.name.textContent = file === null ? SLOTS[part].hint : `${file.name}, ${bytes(file.size)}`;
    slot.name.classList.toggle("hint", file === null);
    slot.contents.textContent = "";
    if (part === "mesh") this.grid.disabled = file !== null;
    if (file === null) {
      slot.input.value = "";
      return;
    }
    const entries = await peek(file);
    if (slot.file === file && entries.length > 0) slot.contents.textContent = describe(entries);
  }

  private acceptDrops(): void {
    const over = (event: DragEvent): void => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      document.body.classList.toggle("dropping", event.type === "dragover");
    };
    document.addEventListener("dragover", over);
    document.addEventListener("dragleave", over);
    document.addEventListener("drop", (event) => {
      over(event);
      void this.take([...(event.dataTransfer?.files ?? [])]);
    });
  }

  /** Put dropped files where their names and contents say they belong. */
  async take(files: File[]): Promise<void> {
    for (const file of files) await this.put(roleOf(file.name, await peek(file), this.slots.get("tracks")?.file != null), file);
  }

  private async submit(event: SubmitEvent): Promise<void> {
    event.preventDefault();
    if (this.sending) return;
    const form = this.form();
    if (form === null) {
      this.answer.replaceChildren(h("p", { class: "sentence bad" }, "Choose a track file first, or try the example."));
      this.slots.get("tracks")?.input.focus();
      return;
    }
    this.sending = new AbortController();
    this.busy(true);
    const meter = h("progress", { max: 1, value: 0, "aria-label": "Upload" });
    const words = h("span", { class: "muted" }, "Sending…");
    this.answer.replaceChildren(h("p", { class: "sending" }, meter, words));
    const onSent = (fraction: number): void => {
      meter.value = fraction;
      words.textContent = fraction < 1 ? `Sending, ${percent(fraction)}` : "Sent; the service is reading it…";
    };
    try {
      this.key ??= newKey();
      const job = await submit(form, this.key, onSent, this.sending.signal);
      this.key = null;
      this.answer.replaceChildren();
      this.onJob(job);
    } catch (error) {
      if (!(error instanceof Refusal && error.problem.status === 0)) this.key = null;
      this.refuse(error);
    } finally {
      this.sending = null;
      this.busy(false);
    }
  }

  private form(): FormData | null {
    const form = new FormData();
    form.append("options", JSON.stringify(this.options.values()));
    if (this.label.value.trim()) form.append("name", this.label.value.trim());
    const grid = this.grid.value.trim().replace("×", "x");
    if (grid && !this.slots.get("mesh")?.file) form.append("mesh", grid);
    for (const part of PARTS) {
      const file = this.slots.get(part)?.file;
      if (file) form.append(part, file, file.name);
      else if (part === "tracks") return null;
    }
    return form;
  }

  private busy(busy: boolean): void {
    this.send.disabled = busy;
    this.stop.hidden = !busy;
  }

  private refuse(error: unknown): void {
    if (error instanceof DOMException && error.name === "AbortError") {
      this.answer.replaceChildren(h("p", { class: "muted" }, "Stopped; nothing was kept."));
    } else if (error instanceof Refusal) {
      const choose = (choice: Record<string, unknown>): void => {
        for (const [name, value] of Object.entries(choice)) this.options.set(name, value);
        this.send.form?.requestSubmit();
      };
      this.answer.replaceChildren(refusalBox(error.problem, choose));
    } else throw error;
  }
}

const WITHIN: [Part, RegExp][] = [
  ["tracks", /^(tracks|points|pred_tracks|trajs?_e|W|tracks_xyz|visibility)$/],
  ["ground_truth", /^(shapes|S|ground_truth|truth|points3d)$/i],
  ["mesh", /^(faces|triangles|grid)$/i],
  ["rotations", /^(rotations|Rs|R)$/],
];
const NAMED: [Part, RegExp][] = [
  ["mesh", /\.(obj|ply|glb|gltf|png)$/i],
  ["ground_truth", /truth|(^|[_-])gt([_.-]|$)/i],
  ["rotations", /rotation|camera/i],
  ["mesh", /mesh|faces/i],
];

/** Decide what a dropped file is: by the arrays in it, then by its name, then tracks first and a mesh second. */
export function roleOf(name: string, entries: Entry[], haveTracks: boolean): Part {
  for (const [part, pattern] of WITHIN) if (entries.some((entry) => pattern.test(entry.name))) return part;
  for (const [part, pattern] of NAMED) if (pattern.test(name)) return part;
  return haveTracks && !/track/i.test(name) ? "mesh" : "tracks";
}
