// The buttons that save the view: picture, film, self-contained page, and USDZ.

import { quickLookLink } from "../links";
import { button, h, say } from "../dom";
import { compose, fileName, filmFormat, png, record, save, standalonePage } from "./export";

const FPS = 30;
/** Minimum length of a turntable in seconds: in a faster one, the shape is hard to judge. */
const TURNTABLE_SECONDS = 6;
/** Maximum length of a recording in seconds; recordings are made in real time. */
const LONGEST = 60;

export interface Saveable {
  title: string;
  preview: string;
  film: string | undefined;
  usdz: string | undefined;
  /** Duration of the sequence. */
  seconds: number;
  background: () => string;
  canvases: () => HTMLCanvasElement[];
  pose: (share: number, kind: "turntable" | "camera") => HTMLCanvasElement[];
  /** Begin a recording; the returned function ends it. */
  begin: () => () => void;
  signal: AbortSignal;
}

export class Saving {
  readonly element: HTMLElement;
  private readonly words = h("p", { class: "hint", role: "status" });
  /** Outside the status, which would be announced every second. */
  private readonly left = h("span", { class: "hint", hidden: true });
  private readonly stop = button("Stop recording", () => this.recording?.abort(), { hidden: true });
  private recording: AbortController | null = null;

  constructor(private readonly what: Saveable) {
    const format = filmFormat();
    const films = format
      ? [button("Turntable", () => void this.film("turntable")), button("Camera's film", () => void this.film("camera"))]
      : [];
    const unsupported = format ? "" : "This browser cannot record films. Current versions of Chrome, Edge, Firefox and Safari can.";
    const hasPage = document.querySelector('meta[name="pliant-standalone-script"]') !== null;
    this.element = h(
      "div",
      { class: "saving" },
      h(
        "div",
        { class: "row" },
        h("span", { class: "hint" }, "Save"),
        button("Picture", () => void this.picture()),
        ...films,
        hasPage && button("HTML page", () => void this.page()),
        what.usdz !== undefined && quickLookLink(what.usdz, "View in AR (USDZ)"),
        this.stop,
        this.left,
      ),
      h("p", { class: "hint", hidden: unsupported === "" }, unsupported),
      this.words,
    );
    what.signal.addEventListener("abort", () => this.recording?.abort());
  }

  private async picture(): Promise<void> {
    const canvas = compose(this.what.canvases(), this.what.background());
    await this.guarded(async () => save(await png(canvas), fileName(this.what.title, ".png")));
  }

  private async film(kind: "turntable" | "camera"): Promise<void> {
    const format = filmFormat();
    if (format === null || this.recording) return;
    const recording = (this.recording = new AbortController());
    const end = this.what.begin();
    this.stop.hidden = this.left.hidden = false;
    const seconds = Math.min(LONGEST, kind === "turntable" ? Math.max(TURNTABLE_SECONDS, this.what.seconds) : this.what.seconds);
    const onShare = (share: number): void => {
      say(this.words, "Recording…");
      say(this.left, `${Math.round(seconds * (1 - share))} s left`);
    };
    await this.guarded(async () => {
      const draw = (share: number): HTMLCanvasElement[] => this.what.pose(share, kind);
      const made = await record({ seconds, fps: FPS, draw, background: this.what.background(), onShare }, format.type, recording.signal);
      save(made, fileName(this.what.title, `-${kind}${format.end}`));
    });
    this.recording = null;
    this.stop.hidden = this.left.hidden = true;
    if (!this.what.signal.aborted) end();
  }

  private async page(): Promise<void> {
    await this.guarded(async () => {
      const { title, preview, film } = this.what;
      save(await standalonePage(title, { preview, film: film ?? null }), fileName(title, ".html"));
    });
  }

  private async guarded(action: () => Promise<void>): Promise<void> {
    try {
      say(this.words, "");
      await action();
      say(this.words, "Saved.");
    } catch (error) {
      const stopped = error instanceof DOMException && error.name === "AbortError";
      say(this.words, stopped ? "Stopped. Nothing was saved." : error instanceof Error ? error.message : String(error));
    }
  }
}
