// The chart above the slider: error and share of hidden points of every frame, aligned with the slider.

import { h, svg, fill } from "../dom";
import { ofSize, percent } from "../words";
import type { Preview } from "./preview";

const HEIGHT = 44;

export class Timeline {
  readonly element: HTMLElement;
  private readonly chart = svg("svg", { viewBox: `0 0 1000 ${HEIGHT}`, preserveAspectRatio: "none", "aria-hidden": "true" });
  private readonly needle = svg("line", { class: "needle", y1: 0, y2: HEIGHT });
  private readonly words = h("span", { class: "hint" });
  private readonly errors: (number | null)[];
  private readonly hidden: (number | null)[];
  private readonly name: string;
  private readonly top: number;

  /** `onSeek` gets the frame that was clicked. */
  constructor(
    private readonly preview: Preview,
    onSeek: (frame: number) => void,
  ) {
    const facts = Array.from({ length: preview.frames }, (_, frame) => preview.facts(frame));
    const measured = facts.some(({ error }) => error !== null);
    this.name = measured ? "3-D error" : "expected error";
    this.errors = facts.map(({ error, expected }) => (measured ? error : expected));
    this.hidden = facts.map(({ hidden }) => hidden);
    this.element = h("div", { class: "frames-chart" }, this.words, this.chart as unknown as HTMLElement);
    this.element.hidden = this.errors.every((value) => value === null) && this.hidden.every((value) => value === null);
    this.top = Math.max(...this.errors.map((value) => value ?? 0)) || 1;
    this.draw(this.top);
    this.chart.addEventListener("pointerdown", (event) => this.seek(event as PointerEvent, onSeek));
    this.chart.addEventListener("pointermove", (event) => {
      if ((event as PointerEvent).buttons === 1) this.seek(event as PointerEvent, onSeek);
    });
    this.show(0);
  }

  /** Draw the errors of another job over those of this one; null removes them. */
  compare(other: Preview | null, title = ""): void {
    this.draw(this.top);
    this.element.querySelector(".key-other")?.remove();
    if (other === null) return;
    const name = this.name === "3-D error" ? "error" : "expected";
    const values = Array.from({ length: Math.min(other.frames, this.preview.frames) }, (_, frame) => other.facts(frame)[name]);
    if (values.every((value) => value === null)) return;
    const top = Math.max(this.top, ...values.map((value) => value ?? 0));
    this.draw(top);
    this.element.prepend(h("span", { class: "hint key-other" }, `${this.name} of ${title}`));
    this.needle.before(svg("polyline", { class: "other-error", points: this.line(values, top) }));
  }

  /** Move the needle to a time, in frames, and show and return the values of that frame. */
  show(time: number): string {
    const frame = Math.min(this.preview.frames - 1, Math.round(time));
    const x = this.x(time);
    this.needle.setAttribute("x1", String(x));
    this.needle.setAttribute("x2", String(x));
    const [error, hidden] = [this.errors[frame] ?? null, this.hidden[frame] ?? null];
    const said = [
      error !== null && `${this.name} ${ofSize(error)}`,
      hidden !== null && `${percent(hidden)} of the points hidden`,
    ].filter((one): one is string => one !== false);
    const key = said.join();
    fill(this.words, key, () => [
      error !== null && h("span", { class: "key-error" }, said[0] as string),
      hidden !== null && h("span", { class: "key-hidden" }, said.at(-1) as string),
    ]);
    return said.join(", ");
  }

  /** Draw the chart, scaled to the maximum error `top`. */
  private draw(top: number): void {
    this.chart.replaceChildren(...this.areas(top), this.needle);
  }

  private areas(top: number): SVGElement[] {
    const made: SVGElement[] = [];
    if (this.hidden.some((value) => value !== null && value > 0)) {
      const points = `${this.line(this.hidden, 1)} 1000,${HEIGHT} 0,${HEIGHT}`;
      made.push(svg("polygon", { class: "hidden-share", points }));
    }
    if (this.errors.some((value) => value !== null)) made.push(svg("polyline", { class: "frame-error", points: this.line(this.errors, top) }));
    return made;
  }

  private line(values: (number | null)[], top: number): string {
    const y = (value: number | null): string => (HEIGHT - 2 - (HEIGHT - 4) * Math.min(1, (value ?? 0) / top)).toFixed(1);
    return values.map((value, frame) => `${this.x(frame).toFixed(1)},${y(value)}`).join(" ");
  }

  private x(time: number): number {
    return (1000 * time) / Math.max(1, this.preview.frames - 1);
  }

  private seek(event: PointerEvent, onSeek: (frame: number) => void): void {
    const box = this.chart.getBoundingClientRect();
    const share = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    onSeek(Math.round(share * (this.preview.frames - 1)));
  }
}
