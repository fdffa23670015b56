// The film section of the form: advice, the first frame, and the region drawn on it.

import { fill, button, h } from "./dom";
import { RegionDialog } from "./draw";
import { firstFrame } from "./film";
import { type Point, type Region, described, paint, polygon } from "./region";

const ADVICE = "Tip: turn the object by 30° or more, and keep it sharp and large in the picture.";
const UNDECODED =
  "This browser cannot decode the film. Its first frame appears here once the service has decoded it. " +
  "Without a first frame, you cannot draw a region, and the whole picture is tracked.";
/** Longest side of the small picture, in its own pixels. */
const SIDE = 640;

export class Filming {
  private readonly canvas = h("canvas", { role: "img", "aria-label": "First frame of the film" });
  private readonly words = h("p", { class: "hint", role: "status" });
  private readonly draw = button("Draw a region", () => this.edit());
  private readonly clear = button("Whole picture", () => this.choose(null), { class: "quiet" });
  readonly element = h(
    "div",
    { class: "filming", hidden: true },
    h("p", { class: "hint" }, ADVICE),
    this.canvas,
    this.words,
    h("div", { class: "row" }, this.draw, this.clear),
  );
  private film: File | null = null;
  private picture: ImageBitmap | null = null;
  /** The first frame as the service decoded it, while the browser may still be decoding the film. */
  private served: ImageBitmap | null = null;
  private region: Region | null = null;
  /** Whether the browser gave up decoding the film. */
  private undecoded = false;
  private shown: Promise<void> = Promise.resolve();

  /** `onChange` is called when the region has changed. */
  constructor(private readonly onChange: () => void) {}

  /** The option `region_polygon`; null: the whole picture. */
  get outline(): Point[] | null {
    return this.region && polygon(this.region);
  }

  /** Show another film, or none. */
  show(film: File | null): void {
    this.shown = this.begin(film);
  }

  /** Set a region as if it had been drawn, once the film is shown. */
  async take(corners: Point[]): Promise<void> {
    await this.shown;
    if (this.film) this.choose({ kind: "lasso", corners });
  }

  /** Show the first frame of the film as the service decoded it, if the browser cannot. */
  offer(film: File, picture: ImageBitmap): void {
    if (this.film !== film || this.picture || this.served) return picture.close();
    this.served = picture;
    if (this.undecoded) this.settle(null);
  }

  private async begin(film: File | null): Promise<void> {
    this.film = film;
    this.picture?.close();
    this.served?.close();
    this.picture = this.served = this.region = null;
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
    if (decoded) this.served?.close();
    this.served = null;
    this.write(this.picture ? described(this.region) : UNDECODED);
  }

  private edit(): void {
    if (this.picture) new RegionDialog(this.picture, this.region, (region) => this.choose(region)).open();
  }

  private choose(region: Region | null): void {
    this.region = region;
    this.write(described(region));
    this.onChange();
  }

  private write(words: string): void {
    const { picture } = this;
    fill(this.words, words, () => [words]);
    this.canvas.hidden = this.draw.hidden = picture === null;
    this.clear.hidden = this.region === null;
    this.draw.textContent = this.region ? "Change the region" : "Draw a region";
    if (picture === null) return;
    const scale = SIDE / Math.max(picture.width, picture.height);
    this.canvas.width = Math.round(picture.width * scale);
    this.canvas.height = Math.round(picture.height * scale);
    paint(this.canvas, picture, this.outline ?? []);
  }
}
