// The film section of the form: advice, a frame, and the region: drawn on that frame, or a mask picture.

import { fill, button, h } from "./dom";
import { keepRegion, keptRegion, mark } from "./draft";
import { RegionDialog } from "./draw";
import { firstFrame } from "./film";
import { openFrames } from "./frames";
import { type Point, type Region, described, paint, paintMask, polygon } from "./region";
import type { Options } from "./types";

const ADVICE = "Tip: turn the object by 30° or more, and keep it sharp and large in the picture.";
const UNDECODED =
  "This browser cannot decode the film. Its first frame appears here once the service has decoded it. " +
  "Without a first frame, you cannot draw a region, but you can choose a mask picture. " +
  "Without a region, everything in the picture is tracked, the background included.";
/** Longest side of the small picture, in its own pixels. */
const SIDE = 640;

/** A region drawn on a frame, which is counted from 0. `picture` is that frame; null for the first one, and for a restored region until it is decoded. */
interface Drawn {
  region: Region;
  frame: number;
  picture: ImageBitmap | null;
  isRestored?: boolean;
}

export class Filming {
  private readonly canvas = h("canvas", { role: "img" });
  private readonly words = h("p", { class: "hint", role: "status" });
  private readonly draw = button("Draw a region", () => this.edit());
  private readonly masks = h("input", { type: "file", accept: "image/png,image/jpeg,image/webp,image/bmp", hidden: true, "aria-label": "Mask picture" });
  private readonly clear = button("Remove the region", () => this.remove(), { class: "quiet" });
  readonly element = h(
    "div",
    { class: "filming", hidden: true },
    h("p", { class: "hint" }, ADVICE),
    this.canvas,
    this.words,
    h("div", { class: "row" }, this.draw, button("Choose a mask picture", () => this.masks.click()), this.masks, this.clear),
  );
  private film: File | null = null;
  /** What the film is recognised by when it is chosen again; null: nothing. */
  private mark: string | null = null;
  private picture: ImageBitmap | null = null;
  /** The first frame as the service decoded it, while the browser may still be decoding the film. */
  private served: ImageBitmap | null = null;
  private drawn: Drawn | null = null;
  /** A mask picture instead of a drawn region; null for the picture if the browser cannot decode it. */
  private masking: { file: File; picture: ImageBitmap | null } | null = null;
  /** Number of frames according to the service, once it has read the film; 0: unknown. */
  private frames = Promise.resolve(0);
  private tellFrames: (frames: number) => void = () => undefined;
  /** Whether the browser gave up decoding the film. */
  private undecoded = false;
  private shown: Promise<void> = Promise.resolve();

  /** `onChange` is called when the region has changed. */
  constructor(private readonly onChange: () => void) {
    this.masks.addEventListener("change", () => {
      const [file] = this.masks.files ?? [];
      this.masks.value = "";
      if (file) void this.useMask(file).then(this.onChange);
    });
  }

  /** The options for a drawn region; empty without one. */
  get options(): Options {
    if (this.drawn === null) return {};
    const { region, frame } = this.drawn;
    return { region_polygon: polygon(region), ...(frame > 0 && { region_frame: frame }) };
  }

  /** The mask picture; null: a drawn region, or the whole picture. */
  get mask(): File | null {
    return this.masking?.file ?? null;
  }

  /** Show another film, or none; ends before the first frame is decoded, with the region that was drawn on this film before a reload. */
  async show(film: File | null): Promise<void> {
    this.film = film;
    this.release();
    const known = film && (await mark(film));
    if (this.film !== film) return;
    this.mark = known;
    const kept = known === null ? null : keptRegion(known);
    this.drawn = kept && { ...kept, picture: null, isRestored: true };
    this.shown = this.begin(film);
  }

  /** Set a region as if it had been drawn on the first frame, once the film is shown. */
  async take(corners: Point[]): Promise<void> {
    await this.shown;
    if (this.film) this.choose({ region: { kind: "lasso", corners }, frame: 0, picture: null });
  }

  /** Use a mask picture for the first frame instead of a drawn region. */
  async useMask(file: File): Promise<void> {
    this.release();
    this.keep();
    const masking: Filming["masking"] = { file, picture: null };
    this.masking = masking;
    const picture = await createImageBitmap(file).catch(() => null); // the service will report the error
    masking.picture = picture;
    if (this.masking === masking) this.update();
    else picture?.close();
  }

  /** Show the first frame of the film as the service decoded it, if the browser cannot. */
  offer(film: File, picture: ImageBitmap): void {
    if (this.film !== film || this.picture || this.served) return picture.close();
    this.served = picture;
    if (this.undecoded) this.settle(null);
  }

  /** The service refuses the film: if the browser cannot show it either, advice on its region would contradict the error. */
  refused(): void {
    this.element.hidden = this.picture === null;
  }

  /** The film is not refused, or not any more. */
  accepted(): void {
    this.element.hidden = this.film === null;
  }

  /** Take the number of frames according to the service. */
  count(film: File, frames: number): void {
    if (this.film !== film) return;
    this.tellFrames(frames); // a dialog that is open already
    this.frames = Promise.resolve(frames);
  }

  private async begin(film: File | null): Promise<void> {
    this.picture?.close();
    this.served?.close();
    this.picture = this.served = null;
    this.frames = new Promise((resolve) => (this.tellFrames = resolve));
    this.undecoded = false;
    this.element.hidden = film === null;
    this.write(film ? "Reading the first frame…" : "");
    if (film === null) return;
    const picture = await firstFrame(film);
    if (this.film !== film) {
      picture?.close();
      return;
    }
    this.settle(picture);
  }

  /** Show the frame decoded by the browser, else the one decoded by the service. */
  private settle(decoded: ImageBitmap | null): void {
    this.undecoded = decoded === null;
    this.picture = decoded ?? this.served;
    if (decoded) {
      this.served?.close();
      this.accepted(); // whether the service refuses it or not: this is the film that its error is about
    }
    this.served = null;
    this.update();
    if (this.film && this.isElsewhere) void this.findFrame(this.film);
  }

  /** Whether the region was drawn on a frame that is not decoded, other than the first. */
  private get isElsewhere(): boolean {
    return this.drawn !== null && this.drawn.frame > 0 && this.drawn.picture === null;
  }

  /** Decode the frame that a restored region was drawn on, once the service has counted the frames. */
  private async findFrame(film: File): Promise<void> {
    const { drawn } = this;
    const frames = this.undecoded ? null : await openFrames(film, this.frames);
    const picture = (await frames?.picture(drawn?.frame ?? 0).catch(() => null)) ?? null;
    frames?.close();
    if (drawn === null || this.drawn !== drawn || picture === null) return picture?.close();
    this.drawn = { ...drawn, picture };
    this.update();
  }

  private edit(): void {
    const { film, picture } = this;
    if (film === null || picture === null) return;
    const drawn = this.isElsewhere ? null : this.drawn; // a region fits its own frame only
    const given = { region: drawn?.region ?? null, frame: drawn?.frame ?? 0, picture: drawn?.picture ?? picture };
    const frames = this.undecoded ? Promise.resolve(null) : openFrames(film, this.frames);
    new RegionDialog(given, frames, (done) => this.choose({ ...done, picture: done.picture === this.picture ? null : done.picture })).open();
  }

  /** Remove the drawn region or the mask picture. */
  clearRegion(): void {
    this.choose(null);
  }

  private remove(): void {
    this.clearRegion();
    this.draw.focus(); // the button, which had the focus, is hidden
  }

  private choose(drawn: Drawn | null): void {
    this.release(drawn?.picture);
    this.drawn = drawn;
    this.keep();
    this.update();
    this.onChange();
  }

  private keep(): void {
    if (this.film && this.mark !== null) keepRegion(this.mark, this.film.name, this.drawn);
  }

  /** Forget the region, except a picture that is still used. */
  private release(kept: ImageBitmap | null = null): void {
    if (this.drawn?.picture !== kept) this.drawn?.picture?.close();
    this.masking?.picture?.close();
    this.drawn = this.masking = null;
  }

  private update(): void {
    const { drawn, mask } = this;
    const frame = drawn && drawn.frame > 0 ? ` Drawn on frame ${drawn.frame}.` : "";
    const restored = drawn?.isRestored ? " Restored: you drew it on this film before." : "";
    if (mask) this.write(`Region of the first frame: the mask picture ${mask.name}. What is white in it is tracked.`);
    else if (this.picture || drawn) this.write(`${described(drawn?.region ?? null)}${frame}${restored}`);
    else this.write(this.undecoded ? UNDECODED : "Reading the first frame…");
  }

  private write(words: string): void {
    const { masking } = this;
    const drawn = this.isElsewhere ? null : this.drawn;
    const picture = drawn?.picture ?? this.picture;
    fill(this.words, words, () => [words]);
    this.canvas.hidden = this.draw.hidden = picture === null;
    this.clear.hidden = this.drawn === null && masking === null;
    this.draw.textContent = drawn ? "Change the region" : "Draw a region";
    this.canvas.setAttribute("aria-label", drawn && drawn.frame > 0 ? `Frame ${drawn.frame} of the film` : "First frame of the film");
    if (picture === null) return;
    const scale = SIDE / Math.max(picture.width, picture.height);
    this.canvas.width = Math.round(picture.width * scale);
    this.canvas.height = Math.round(picture.height * scale);
    paint(this.canvas, picture, drawn ? polygon(drawn.region) : []);
    if (masking?.picture) paintMask(this.canvas, masking.picture);
  }
}
