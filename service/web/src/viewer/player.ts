// Playback: the current time of the animation, and how it advances.

import { h } from "../dom";
import type { Clock } from "./clock";
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
    private readonly clock: Clock,
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
    this.time = this.clock.frame(this.turnedAround(this.clock.seconds(this.time) + this.direction * passed * this.speed));
    this.onTime();
    if (this.playing) requestAnimationFrame(this.tick);
  };

  /** Return the seconds at which playback continues, from seconds that may be before the first or after the last frame. */
  private turnedAround(seconds: number): number {
    const { last } = this.clock;
    if (this.ending !== "back and forth") this.direction = 1;
    if (seconds >= 0 && seconds <= last) return seconds;
    if (this.ending === "back and forth") {
      this.direction = seconds > last ? -1 : 1;
      return seconds > last ? Math.max(0, 2 * last - seconds) : Math.min(last, -seconds);
    }
    if (this.ending === "loop") return seconds % last;
    this.pause();
    return last;
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
