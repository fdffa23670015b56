// The files of a new job: a film, or tracks with a mesh. Each slot accepts a dropped or chosen file and shows its contents.

import { CameraDialog, canRecord } from "./camera";
import { button, h, say, uniqueId } from "./dom";
import { filmOfRegion } from "./draft";
import { keepServed, looksLikeFilm, looksLikePicture, looksLikeTracks, servedFrame } from "./film";
import { Filming } from "./filming";
import { type Entry, describe, isReadable, peek } from "./peek";
import type { Point } from "./region";
import { type Inspection, type Options, PARTS, type Part } from "./types";
import { bytes } from "./words";

export const PLACES: Record<Part, { label: string; hint: string }> = {
  film: { label: "Film", hint: "mp4, mov, webm, mkv, avi, gif, zip of pictures" },
  tracks: { label: "Tracks", hint: "npz, npy, mat, csv …" },
  mesh: { label: "Mesh", hint: "optional: obj, ply, glb, npz, or a png mask of the points" },
  ground_truth: { label: "Ground truth", hint: "optional: used to measure errors" },
  rotations: { label: "Cameras", hint: "optional: if known" },
};

const MASK_AS_MESH = "A mask of the points: each pixel that is not black is a point.";

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
  /** Ends when all given files are read and in their slots. */
  read: Promise<void> = Promise.resolve();
  /** The last recording of the camera, which exists in this page only; null once it was submitted. */
  private recorded: File | null = null;
  private readonly slots = new Map<Part, Slot>();
  private readonly filming = new Filming(() => this.onChange());
  private readonly title = h("p", { class: "zone-title" }, "Drop tracks and a mesh here");
  /** Which of the dropped or chosen files were left out, and why. */
  private readonly leftOut = h("p", { class: "left-out", role: "status" });
  private readonly grid = h("input", { type: "text", id: "grid", placeholder: "rows×columns", size: 10, autocomplete: "off" });

  /** `onChange` is called when the files or the region have changed. */
  constructor(private readonly onChange: () => void) {
    const promise = h("p", { class: "hint" }, "Files are sent to this service only.");
    this.element.append(this.title, promise, this.leftOut, ...PARTS.map((part) => this.slot(part)));
    this.arrange();
    this.grid.addEventListener("change", onChange);
    this.acceptDrops();
  }

  /** Show the slot for a film: the service tracks films. */
  acceptFilms(): void {
    this.hasFilms = true;
    this.title.textContent = "Drop a film here, or tracks and a mesh";
    const [slot, drawn] = [this.slots.get("film"), filmOfRegion()];
    if (slot && slot.file === null && drawn !== null) slot.contents.textContent = `The region you drew on ${drawn} is kept: choose the film again to use it.`;
    this.arrange();
  }

  /** The files to submit, and the size of a grid if there is no mesh file. A film is submitted alone: the service tracks it. */
  get given(): { files: [Part | "region", File][]; grid: string } {
    const film = this.file("film");
    const { mask } = this.filming;
    if (film) return { files: [["film", film], ...(mask ? [["region", mask] as ["region", File]] : [])], grid: "" };
    const files = PARTS.map((part): [Part, File | null] => [part, this.file(part)]);
    const grid = this.file("mesh") ? "" : this.grid.value.trim().replace("×", "x");
    return { files: files.filter((one): one is [Part, File] => one[1] !== null), grid };
  }

  /** The options for the region drawn on the film; empty without one. */
  get region(): Options {
    return this.file("film") ? this.filming.options : {};
  }

  file(part: Part): File | null {
    return this.slots.get(part)?.file ?? null;
  }

  /** Whether the film is a recording that would be lost with the page. */
  get isUnsaved(): boolean {
    return this.recorded !== null && this.file("film") === this.recorded;
  }

  /** The service has the files. */
  saved(): void {
    this.recorded = null;
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
    if (part === "film") this.filming.refused();
    slot.row.scrollIntoView({ block: "nearest" });
    return true;
  }

  /** Remove all error messages. */
  clear(): void {
    for (const { answer } of this.slots.values()) answer.replaceChildren();
    this.filming.accepted();
  }

  focus(part: Part): void {
    this.slots.get(part)?.input.focus();
  }

  /** Remove the files that were changed or deleted since they were chosen, which a browser cannot send, and return their names. */
  async removeChanged(): Promise<string[]> {
    const { files } = this.given;
    const readable = await Promise.all(files.map(([, file]) => isReadable(file)));
    const changed = files.filter((_, index) => !readable[index]);
    for (const [part] of changed) {
      if (part === "region") this.filming.clearRegion();
      else await this.show(part, null);
    }
    if (changed.length > 0) this.onChange();
    return changed.map(([, file]) => file.name);
  }

  /** Fill the slots with these files and empty the others. */
  fill(files: [Part, File][]): Promise<void> {
    return this.inTurn(async () => {
      for (const part of PARTS) await this.show(part, files.find(([of]) => of === part)?.[1] ?? null);
      this.onChange();
    });
  }

  /** Choose the region to track in the film: corners in film pixels. */
  async outline(corners: Point[]): Promise<void> {
    await this.filming.take(corners);
  }

  /** Take the interpretation of the current files: the number of a film's frames, and the first one for browsers that cannot decode it. */
  async seen(seen: Inspection): Promise<void> {
    const film = this.file("film");
    if (film === null) return;
    this.filming.count(film, seen.given_frames ?? 0);
    keepServed(film, seen);
    const picture = await servedFrame(film).catch(() => null); // not a picture after all
    if (picture) this.filming.offer(film, picture);
  }

  /** Assign dropped files to slots by their names and contents. */
  private async take(files: File[]): Promise<void> {
    const readable = await Promise.all(files.map(isReadable));
    const contents = files.filter((_, index) => readable[index]);
    const read = await Promise.all(contents.map(async (file): Promise<[File, Entry[]]> => [file, await peek(file)]));
    // The meaning of the other files depends on the film or the tracks.
    const rank = ([file, entries]: [File, Entry[]]): number =>
      looksLikeFilm(file, entries) ? 0 : looksLikeTracks(file, entries) && roleOf(file.name, entries, false) === "tracks" ? 1 : 2;
    const leftOut: string[] = [];
    const replaced: string[] = [];
    const taken = new Map<string, string>();
    for (const [file, entries] of read.sort((one, other) => rank(one) - rank(other))) {
      const part = this.placeOf(file, entries);
      if (part === null) leftOut.push(file.name);
      else if (part === "region") await this.filming.useMask(file);
      else await this.show(part, file);
      if (part === "tracks") await this.show("film", null); // the last drop wins
      if (part === null) continue;
      const place = part === "tracks" ? "film" : part;
      const before = taken.get(place);
      if (before !== undefined) replaced.push(before);
      taken.set(place, file.name);
    }
    const folders = files.filter((_, index) => !readable[index]).map(({ name }) => name);
    if (files.length > 0) await this.settle(leftOut, folders, replaced);
  }

  /** Return the part that a dropped file belongs to; null if it is of an unknown kind, or does not belong to a film. */
  private placeOf(file: File, entries: Entry[]): Part | "region" | null {
    if (this.hasFilms && looksLikeFilm(file, entries)) return "film";
    const part = roleOf(file.name, entries, this.file("tracks") !== null);
    const isKnown = looksLikeTracks(file, entries) || looksLikePicture(file) || NAMED.some(([, pattern]) => pattern.test(file.name));
    if (this.file("film") === null) return isKnown || this.main === null ? part : null;
    if (looksLikePicture(file)) return "region";
    return part === "tracks" && looksLikeTracks(file, entries) ? part : null;
  }

  /** Report the files that were left out; a picture chosen as a mesh before its film is the film's mask. */
  private async settle(leftOut: string[] = [], folders: string[] = [], replaced: string[] = []): Promise<void> {
    const [film, mesh] = [this.file("film"), this.file("mesh")];
    if (film && mesh && looksLikePicture(mesh)) {
      await this.show("mesh", null);
      await this.filming.useMask(mesh);
    }
    const belongs = film ? "Only a mask picture can be added to a film." : "This page does not know files of this kind.";
    const reasons: [string[], string][] = [
      [leftOut, belongs],
      [folders, "A folder cannot be read: zip its pictures first."],
      [replaced, "A job has one film or one track file, and one file of every other kind."],
    ];
    const told = reasons.filter(([names]) => names.length > 0).map(([names, why]) => `Left out: ${names.join(", ")}. ${why}`);
    say(this.leftOut, told.join(" "));
    this.onChange();
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
      remove: button("×", () => void this.inTurn(() => this.put(part, null)).then(() => slot.input.focus()), {
        class: "quiet",
        hidden: true,
        "aria-label": `Remove ${label.toLowerCase()}`,
      }),
      file: null,
    };
    slot.input.addEventListener("change", () => {
      const file = slot.input.files?.[0] ?? null;
      void this.inTurn(() => this.put(part, file));
    });
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
    const film = (recorded: File): void => {
      this.recorded = recorded;
      void this.inTurn(() => this.put("film", recorded));
    };
    return h("span", { class: "record" }, button("Record with the camera", () => void new CameraDialog(film).open(), { class: "link" }));
  }

  /** Do this once all earlier files are in their slots: the last file wins, however long each takes to read. */
  private inTurn(work: () => Promise<void>): Promise<void> {
    const done = this.read.then(work);
    this.read = done.catch(() => undefined); // reported by `done`
    return done;
  }

  private async put(part: Part, file: File | null): Promise<void> {
    const meant = file === null ? part : await this.meant(part, file);
    if (meant === null) {
      (this.slots.get(part) as Slot).input.value = "";
      return this.settle([(file as File).name]);
    }
    if (meant === "region") await this.filming.useMask(file as File);
    else {
      if (meant !== part) await this.show(part, null);
      await this.show(meant, file);
    }
    await this.settle();
  }

  /** Return the part that a chosen file belongs to: film for a film chosen as tracks, tracks for the reverse; as `placeOf` while a film is chosen. */
  private async meant(part: Part, file: File): Promise<Part | "region" | null> {
    const entries = await peek(file);
    if (part === "tracks" && this.hasFilms && looksLikeFilm(file, entries)) return "film";
    if (part === "film" && looksLikeTracks(file, entries)) return "tracks";
    return part === "film" && this.file("film") ? this.placeOf(file, entries) : part;
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
      await this.filming.show(file);
    }
    if (file === null) {
      slot.input.value = "";
      return;
    }
    const entries = await peek(file);
    if (slot.file === file) slot.contents.textContent = part === "mesh" && looksLikePicture(file) ? MASK_AS_MESH : describe(entries);
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
      const files = [...(event.dataTransfer?.files ?? [])];
      void this.inTurn(() => this.take(files));
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
  ["mesh", /\.(obj|ply|glb|gltf|png)$/i], // a picture without a film is a mask of the points
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
