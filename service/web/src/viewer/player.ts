// Playback: the current time of the animation, and how it advances.

import { h } from "../dom";
import { choice, group } from "./controls";

export type Ending = "loop" | "back and forth" | "once";

export class Player {
  /** Current time in frames, 0 … frames − 1; between two frames the shape is interpolated. */
  time = 0;
  playing = false;
  speed = 1;
  ending: Ending = "loop";
  private direction = 1;
  private before = 0;

  constructor(
    private readonly frames: number,
    private readonly fps: number,
    private readonly onTime: () => void,
    private readonly onStop: () => void,
  ) {}

  play(): void {
    if (this.playing || this.frames < 2) return;
    this.playing = true;
    if (this.ending === "once" && this.time >= this.frames - 1) this.time = 0;
    this.before = performance.now();
    requestAnimationFrame(this.tick);
  }

  pause(): void {
    this.playing = false;
    this.onStop();
  }

  /** Go to a time, in frames. */
  seek(time: number): void {
    this.time = Math.min(this.frames - 1, Math.max(0, time));
    this.onTime();
  }

  private readonly tick = (now: number): void => {
    if (!this.playing) return;
    // A background tab gets no animation frames; playback continues where it stopped, without catching up.
    const passed = Math.min(0.25, (now - this.before) / 1000);
    this.before = now;
    this.time += this.direction * passed * this.fps * this.speed;
    this.turnAround();
    this.onTime();
    if (this.playing) requestAnimationFrame(this.tick);
  };

  private turnAround(): void {
    const last = this.frames - 1;
    if (this.ending !== "back and forth") this.direction = 1;
    if (this.time >= 0 && this.time <= last) return;
    if (this.ending === "back and forth") {
      this.direction = this.time > last ? -1 : 1;
      this.time = this.time > last ? Math.max(0, 2 * last - this.time) : Math.min(last, -this.time);
    } else if (this.ending === "loop") {
      this.time %= last;
    } else {
      this.time = last;
      this.pause();
    }
  }
}

/** The selectors of the speed and of what happens after the last frame. */
export function paceControls(player: Player): HTMLElement {
  const speeds: [string, string][] = [["1", "1 ×"], ["0.5", "½ ×"], ["0.25", "¼ ×"], ["2", "2 ×"], ["4", "4 ×"]];
  const endings: [string, string][] = [["loop", "loop"], ["back and forth", "back and forth"], ["once", "stop"]];
  return group(
    "Playback",
    h(
      "div",
      { class: "row pace" },
      choice("Speed", speeds, (value) => (player.speed = Number(value))),
      choice("At the end", endings, (value) => (player.ending = value as Ending)),
    ),
  );
}
