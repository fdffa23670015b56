// The files of a new job: a film, or tracks with a mesh. Each slot accepts a dropped or chosen file and shows its contents.

import { CameraDialog, canRecord } from "./camera";
import { button, h, uniqueId } from "./dom";
import { looksLikeFilm, looksLikeTracks, servedFrame } from "./film";
import { Filming } from "./filming";
import { type Entry, describe, peek } from "./peek";
import type { Point } from "./region";
import { type Inspection, PARTS, type Part } from "./types";
import { bytes } from "./words";

export const PLACES: Record<Part, { label: string; hint: string }> = {
  film: { label: "Film", hint: "mp4, mov, webm, avi, gif, zip of pictures" },
  tracks: { label: "Tracks", hint: "npz, npy, mat, csv …" },
  mesh: { label: "Mesh", hint: "optional: obj, ply, glb, npz" },
  ground_truth: { label: "Ground truth", hint: "optional: used to measure errors" },
  rotations: { label: "Cameras", hint: "optional: if known" },
};

interface Slot {
  row: HTMLElement;
  input: HTMLInputElement;
  hint: HTMLElement;
  contents: HTMLElement;
  answer: HTMLElement;
  remove: HTMLButtonElement;
  file: File | null;
}

export class Slots {
  readonly element = h("div", { class: "zone" });
  /** True if the service tracks films. */
  hasFilms = false;
  private readonly slots = new Map<Part, Slot>();
  private readonly filming = new Filming(() => this.onChange());
  private readonly title = h("p", { class: "zone-title" }, "Drop tracks and a mesh here");
  private readonly grid = h("input", { type: "text", id: "grid", placeholder: "rows×columns", size: 10, autocomplete: "off" });

  /** `onChange` is called when the files or the region have changed. */
  constructor(private readonly onChange: () => void) {
    const promise = h("p", { class: "hint" }, "Files are sent to this service only.");
    this.element.append(this.title, promise, ...PARTS.map((part) => this.slot(part)));
    this.arrange();
    this.grid.addEventListener("change", onChange);
    this.acceptDrops();
  }

  /** Show the slot for a film: the service tracks films. */
  acceptFilms(): void {
    this.hasFilms = true;
    this.title.textContent = "Drop a film here, or tracks and a mesh";
    this.arrange();
  }

  /** The files to submit, and the size of a grid if there is no mesh file. A film is submitted alone: the service tracks it. */
  get given(): { files: [Part, File][]; grid: string } {
    const film = this.file("film");
    if (film) return { files: [["film", film]], grid: "" };
    const files = PARTS.map((part): [Part, File | null] => [part, this.file(part)]);
    const grid = this.file("mesh") ? "" : this.grid.value.trim().replace("×", "x");
    return { files: files.filter((one): one is [Part, File] => one[1] !== null), grid };
  }

  /** The region to track in the film: corners in film pixels; null: the whole picture. */
  get region(): Point[] | null {
    return this.file("film") && this.filming.outline;
  }

  file(part: Part): File | null {
    return this.slots.get(part)?.file ?? null;
  }

  /** The file after which the job is named. */
  get main(): File | null {
    return this.file("film") ?? this.file("tracks");
  }

  /** Show an error message in the slot of its file; return false if that slot is not shown. */
  refuse(part: string, box: HTMLElement): boolean {
    const slot = this.slots.get((part === "region" ? "film" : part) as Part);
    if (slot === undefined || slot.row.hidden) return false;
    slot.answer.replaceChildren(box);
    slot.row.scrollIntoView({ block: "nearest" });
    return true;
  }

  /** Remove all error messages. */
  clear(): void {
    for (const { answer } of this.slots.values()) answer.replaceChildren();
  }

  focus(part: Part): void {
    this.slots.get(part)?.input.focus();
  }

  /** Fill the slots with these files and empty the others. */
  async fill(files: [Part, File][]): Promise<void> {
    for (const part of PARTS) await this.show(part, files.find(([of]) => of === part)?.[1] ?? null);
    this.onChange();
  }

  /** Choose the region to track in the film: corners in film pixels. */
  async outline(corners: Point[]): Promise<void> {
    await this.filming.take(corners);
  }

  /** Take the interpretation of the current files: it may have the first frame of a film that the browser cannot decode. */
  async seen(seen: Inspection): Promise<void> {
    const film = this.file("film");
    const picture = film && (await servedFrame(seen).catch(() => null)); // not a picture after all
    if (picture) this.filming.offer(film, picture);
  }

  /** Assign dropped files to slots by their names and contents. */
  async take(files: File[]): Promise<void> {
    for (const file of files) {
      const entries = await peek(file);
      const part = this.hasFilms && looksLikeFilm(file, entries) ? "film" : roleOf(file.name, entries, this.file("tracks") !== null);
      await this.show(part, file);
      if (part === "tracks") await this.show("film", null); // the last drop wins
    }
    if (files.length > 0) this.onChange();
  }

  private slot(part: Part): HTMLElement {
    const { label, hint } = PLACES[part];
    const id = uniqueId("file");
    const slot: Slot = {
      row: h("div", { class: "slot", "data-part": part }),
      input: h("input", { type: "file", id, class: "visually-hidden", "aria-describedby": `${id}-hint` }),
      hint: h("span", { class: "hint", id: `${id}-hint` }, hint),
      contents: h("p", { class: "contents hint" }),
      answer: h("div", { class: "slot-answer", "aria-live": "assertive" }),
      remove: button("×", () => void this.put(part, null).then(() => slot.input.focus()), {
        class: "quiet",
        hidden: true,
        "aria-label": `Remove ${label.toLowerCase()}`,
      }),
      file: null,
    };
    slot.input.addEventListener("change", () => void this.put(part, slot.input.files?.[0] ?? null));
    this.slots.set(part, slot);
    // The label covers the whole row, to be an easy touch target.
    const choose = h("label", { for: id, class: "choose" }, label);
    const pick = h("span", { class: "pick", "aria-hidden": "true" }, "Choose");
    slot.row.append(slot.input, choose, pick, slot.hint, slot.remove, slot.contents);
    if (part === "mesh") slot.row.append(h("span", { class: "grid-size" }, h("label", { for: "grid" }, "or points on a grid"), this.grid));
    if (part === "film") slot.row.append(this.recording(), this.filming.element);
    slot.row.append(slot.answer);
    return slot.row;
  }

  private recording(): HTMLElement | string {
    if (!canRecord()) return "";
    const film = (recorded: File): void => void this.put("film", recorded);
    return h("span", { class: "record" }, button("Record with the camera", () => void new CameraDialog(film).open(), { class: "link" }));
  }

  private async put(part: Part, file: File | null): Promise<void> {
    const meant = file === null ? part : await this.meant(part, file);
    if (meant !== part) await this.show(part, null);
    await this.show(meant, file);
    this.onChange();
  }

  /** Return the part that a chosen file belongs to: film for a film chosen as tracks, tracks for the reverse. */
  private async meant(part: Part, file: File): Promise<Part> {
    if (part === "tracks" && this.hasFilms && looksLikeFilm(file, await peek(file))) return "film";
    if (part === "film" && looksLikeTracks(file, await peek(file))) return "tracks";
    return part;
  }

  private async show(part: Part, file: File | null): Promise<void> {
    const slot = this.slots.get(part) as Slot;
    slot.file = file;
    slot.remove.hidden = file === null;
    slot.row.classList.toggle("full", file !== null);
    slot.hint.textContent = file === null ? PLACES[part].hint : `${file.name}, ${bytes(file.size)}`;
    slot.contents.textContent = "";
    if (part === "mesh") (this.grid.parentElement as HTMLElement).hidden = file !== null;
    if (part === "film") {
      this.arrange();
      this.filming.show(file);
    }
    if (file === null) {
      slot.input.value = "";
      return;
    }
    const entries = await peek(file);
    if (slot.file === file && entries.length > 0) slot.contents.textContent = describe(entries);
  }

  /** A film replaces the slots of tracks, mesh, ground truth and cameras. */
  private arrange(): void {
    const hasFilm = this.file("film") !== null;
    for (const [part, slot] of this.slots) slot.row.hidden = part === "film" ? !this.hasFilms : hasFilm;
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

/** Return the role of a dropped file: by the arrays in it, then by its name; else tracks first and a mesh second. */
function roleOf(name: string, entries: Entry[], haveTracks: boolean): Part {
  for (const [part, pattern] of WITHIN) if (entries.some((entry) => pattern.test(entry.name))) return part;
  for (const [part, pattern] of NAMED) if (pattern.test(name)) return part;
  return haveTracks && !/track/i.test(name) ? "mesh" : "tracks";
}
