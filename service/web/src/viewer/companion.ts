// Another job's result beside this one: at the same frame and from the same side.

import { Body, seenFromBehind } from "./body";
import { type Picture, pictureOf } from "./picture";
import { Preview } from "./preview";
import { Stage } from "./stage";

export interface Other {
  id: string;
  title: string;
  preview: string;
}

export class Companion {
  readonly element = document.createElement("div");
  readonly stage: Stage;
  private readonly body: Body;

  static async open(other: Other, signal: AbortSignal): Promise<Companion> {
    const preview = await Preview.open(other.preview, signal);
    const picture = preview.has("picture") ? await pictureOf(preview, signal) : null;
    signal.throwIfAborted();
    return new Companion(preview, picture);
  }

  private constructor(
    readonly preview: Preview,
    picture: Picture | null,
  ) {
    this.element.className = "view other";
    this.stage = new Stage(this.element, preview);
    this.body = new Body(preview, preview.positions);
    this.body.colour(null, picture);
    this.body.reverse(seenFromBehind(preview, preview.clearest) !== preview.header.mirrored);
    this.stage.flip(preview.header.mirrored);
    this.stage.add(this.body.group);
    this.stage.canvas.style.pointerEvents = "none"; // the main view rotates both
    this.stage.canvas.setAttribute("role", "img");
    this.stage.canvas.setAttribute("aria-label", "The other job's result, from the same side");
    this.element.append(this.stage.canvas);
    this.stage.look("front");
    preview.onFrames = () => this.stage.redraw();
  }

  theme(clay: string, wire: string): void {
    this.body.theme(clay, wire);
    this.stage.redraw();
  }

  wireframe(on: boolean): void {
    this.body.wireframe(on);
    this.stage.redraw();
  }

  /** Show the same frame; a shorter sequence stays at its last one. */
  show(time: number, main: Stage): void {
    this.body.show(Math.min(time, this.preview.frames - 1));
    this.stage.mirror(main);
  }

  dispose(): void {
    this.body.dispose();
    this.stage.dispose();
    this.element.remove();
  }
}

/** RMS over the frames of a job's error or expected error, as a share of the object's size; null if unknown. */
export function meanError(preview: Preview, name: "error" | "expected"): number | null {
  let sum = 0;
  for (let frame = 0; frame < preview.frames; frame += 1) {
    const value = preview.facts(frame)[name];
    if (value === null) return null;
    sum += value * value;
  }
  return Math.sqrt(sum / Math.max(1, preview.frames));
}
