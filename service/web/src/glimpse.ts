// The sample of the tracks that the service sends with its interpretation, played as dots with trails: a wrong interpretation looks wrong.

import { h } from "./dom";

const SIDE = 1000;
const HIDDEN = -1;
const TRAIL = 5;
/** Frames of the sample per second; positions in between are interpolated. */
const PACE = 8;

export class Glimpse {
  readonly canvas = h("canvas", { class: "glimpse", role: "img", "aria-label": "Sample of the tracks", width: 640, height: 400 });
  private sample: number[][] = [];
  private running = 0;
  private waiting = 0;

  /** Play a sample; an empty one hides the picture. */
  show(sample: number[][]): void {
    this.stop();
    this.sample = sample;
    this.canvas.hidden = sample.length === 0;
    if (sample.length === 0) return;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) this.draw(Math.min(TRAIL, sample.length - 1));
    else this.running = requestAnimationFrame(this.tick);
  }

  stop(): void {
    cancelAnimationFrame(this.running);
    clearTimeout(this.waiting);
    this.running = 0;
  }

  private readonly tick = (now: number): void => {
    if (!this.canvas.checkVisibility()) {
      this.waiting = setTimeout(() => (this.running = requestAnimationFrame(this.tick)), 500); // the form is collapsed
      return;
    }
    // Play forwards and backwards: few sequences end where they began.
    const last = this.sample.length - 1;
    const at = last > 0 ? ((now / 1000) * PACE) % (2 * last) : 0;
    this.draw(at > last ? 2 * last - at : at);
    this.running = requestAnimationFrame(this.tick);
  };

  private draw(time: number): void {
    const context = this.canvas.getContext("2d");
    if (context === null) return;
    const { width, height } = this.canvas;
    const scale = Math.min(width, height) / SIDE;
    const [left, top] = [(width - scale * SIDE) / 2, (height - scale * SIDE) / 2];
    context.clearRect(0, 0, width, height);
    context.fillStyle = context.strokeStyle = getComputedStyle(this.canvas).getPropertyValue("--dots").trim();
    context.lineWidth = 1.5;
    const points = (this.sample[0]?.length ?? 0) / 2;
    for (let point = 0; point < points; point += 1) {
      const here = this.at(point, time);
      if (here === null) continue;
      context.globalAlpha = 0.35;
      context.beginPath();
      context.moveTo(left + scale * here[0], top + scale * here[1]);
      for (let back = 1; back <= TRAIL && time - back >= 0; back += 1) {
        const past = this.at(point, time - back);
        if (past === null) break;
        context.lineTo(left + scale * past[0], top + scale * past[1]);
      }
      context.stroke();
      context.globalAlpha = 1;
      context.beginPath();
      context.arc(left + scale * here[0], top + scale * here[1], 3, 0, 7);
      context.fill();
    }
  }

  private at(point: number, time: number): [number, number] | null {
    const first = Math.floor(time);
    const [a, b] = [this.sample[first], this.sample[Math.min(first + 1, this.sample.length - 1)]];
    const [ax, ay, bx, by] = [a?.[2 * point], a?.[2 * point + 1], b?.[2 * point], b?.[2 * point + 1]] as [number, number, number, number];
    if (ax === HIDDEN) return null;
    const share = bx === HIDDEN ? 0 : time - first;
    return [ax + share * (bx - ax), ay + share * (by - ay)];
  }
}
