// Keyboard and pointer control of the picture, and the keys of the time slider.

import { h } from "../dom";
import type { Side } from "./stage";

const TURN = Math.PI / 24;
/** A pointer that moves further than this between down and up, CSS pixels, rotates the view instead of choosing a point. */
const STILL = 5;

/** Actions of keys and clicks on the picture. */
export interface Commands {
  turn(across: number, down: number): void;
  zoom(factor: number): void;
  step(by: number): void;
  toggle(): void;
  look(side: Side): void;
  fit(): void;
  follow(): void;
  fullScreen(): void;
  help(): void;
  /** Show the values of the point at this position in the window; null: the middle of the picture. */
  pick(x: number | null, y: number | null): void;
}

/** Make a canvas respond to keys and clicks. */
export function control(canvas: HTMLCanvasElement, commands: Commands): void {
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-label", "3-D view: arrow keys rotate, plus and minus zoom, space plays and pauses, Enter shows a point's values, question mark lists all keys");
  const actions = keys(commands);
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const action = actions[event.key];
    if (action === undefined) return;
    event.preventDefault();
    action();
  });
  let down: [number, number] | null = null;
  canvas.addEventListener("pointerdown", (event) => (down = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null));
  canvas.addEventListener("pointerup", (event) => {
    if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < STILL) commands.pick(event.clientX, event.clientY);
    down = null;
  });
}

function keys(commands: Commands): Record<string, () => void> {
  return {
    ArrowLeft: () => commands.turn(-TURN, 0),
    ArrowRight: () => commands.turn(TURN, 0),
    ArrowUp: () => commands.turn(0, -TURN),
    ArrowDown: () => commands.turn(0, TURN),
    "+": () => commands.zoom(1.2),
    "=": () => commands.zoom(1.2),
    "-": () => commands.zoom(1 / 1.2),
    ",": () => commands.step(-1),
    ".": () => commands.step(1),
    " ": () => commands.toggle(),
    "1": () => commands.look("front"),
    "2": () => commands.look("side"),
    "3": () => commands.look("top"),
    "0": () => commands.fit(),
    c: () => commands.follow(),
    f: () => commands.fullScreen(),
    "?": () => commands.help(),
    Enter: () => commands.pick(null, null),
  };
}

/** The time slider: dragging moves continuously, keys move by whole frames. */
export function timeSlider(frames: number, now: () => number, seek: (time: number) => void): HTMLInputElement {
  const slider = h("input", { type: "range", min: 0, max: frames - 1, step: "any", "aria-label": "Frame" });
  slider.addEventListener("input", () => seek(Number(slider.value)));
  slider.addEventListener("keydown", (event) => {
    const frame = Math.round(now());
    const places: Record<string, number> = {
      ArrowLeft: frame - 1, ArrowDown: frame - 1, ArrowRight: frame + 1, ArrowUp: frame + 1,
      PageUp: frame + 10, PageDown: frame - 10, Home: 0, End: frames - 1,
    };
    const place = places[event.key];
    if (place === undefined) return;
    event.preventDefault();
    seek(place);
  });
  return slider;
}
