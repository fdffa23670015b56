// The values of one point, chosen by click, tap or number, and marked in every frame of the view.

import { BufferAttribute, BufferGeometry, Points, PointsMaterial } from "three";
import { button, fill, h, uniqueId } from "../dom";
import { count, number, ofSize } from "../words";
import { distance } from "./colours";
import { type Preview, isHidden, isRejected } from "./preview";

export class Probe {
  readonly element: HTMLElement;
  readonly marker = new Points(new BufferGeometry(), new PointsMaterial({ size: 11, sizeAttenuation: false, depthTest: false, transparent: true }));
  private readonly input: HTMLInputElement;
  private readonly list = h("dl", { class: "facts", "aria-live": "polite" });
  private readonly clear: HTMLButtonElement;
  private point: number | null = null;
  private frame = -1;
  private residuals: Int16Array | null = null;
  private rejected: Uint8Array | null = null;
  private spread: Uint16Array | null = null;
  private truth: Int16Array | null = null;
  private names: string[] | null = null;

  /** `onChange` is called when the view must be redrawn. */
  constructor(
    private readonly preview: Preview,
    private readonly signal: AbortSignal,
    private readonly onChange: () => void,
  ) {
    const id = uniqueId("point");
    const last = preview.points - 1;
    this.input = h("input", { type: "number", id, min: 0, max: last, step: 1, placeholder: `0–${last}` });
    this.input.addEventListener("input", () => {
      const asked = this.input.valueAsNumber;
      this.choose(Number.isInteger(asked) && asked >= 0 && asked <= last ? asked : null, false);
    });
    const clear = (): void => {
      this.choose(null);
      this.input.focus(); // the button, which had the focus, is hidden
    };
    this.clear = button("Clear", clear, { class: "quiet", hidden: true });
    const hint = h("p", { class: "hint", id: `${id}-hint` }, "or click one in the picture");
    this.input.setAttribute("aria-describedby", hint.id);
    this.element = h("div", { class: "probe" }, h("span", { class: "tool" }, h("label", { for: id }, "Point"), this.input, this.clear, hint), this.list);
    this.marker.frustumCulled = false;
    this.marker.renderOrder = 2;
    this.marker.visible = false;
    this.marker.geometry.setAttribute("position", new BufferAttribute(new Float32Array(3), 3));
  }

  /** Keep screen readers from announcing the values of every frame while the shape is played. */
  hush(playing: boolean): void {
    this.list.setAttribute("aria-live", playing ? "off" : "polite");
  }

  theme(colour: string): void {
    this.marker.material.color.set(colour);
  }

  /** Show a point's values; null shows none. */
  choose(point: number | null, write = true): void {
    this.point = point;
    this.frame = -1;
    if (write) this.input.value = point === null ? "" : String(point);
    this.marker.visible = point !== null;
    this.clear.hidden = point === null;
    if (point === null) fill(this.list, "", () => []);
    else void this.load();
    this.onChange();
  }

  /** Update marker and values to a time, in frames. */
  show(time: number): void {
    if (this.point === null) return;
    const { preview, point } = this;
    const frame = Math.min(Math.round(time), Math.max(0, preview.ready - 1));
    const place = preview.place(frame, point);
    const position = this.marker.geometry.getAttribute("position") as BufferAttribute;
    position.setXYZ(0, ...place);
    position.needsUpdate = true;
    if (frame === this.frame) return;
    this.frame = frame;
    const rows = this.rows(frame, point, place);
    fill(this.list, JSON.stringify(rows), () => rows.flatMap(([term, value]) => [h("dt", {}, term), h("dd", {}, value)]));
  }

  private rows(frame: number, point: number, place: [number, number, number]): [string, string][] {
    const { preview } = this;
    const name = this.names?.[point];
    const rows: [string, string][] = [...(name ? [["Name", name] satisfies [string, string]] : []), ["Position", `${place.map((value) => number(value)).join(", ")} (tracks' unit)`]];
    if (this.spread) {
      const std = ((preview.header.spread_step ?? 0) * (this.spread[preview.points * frame + point] as number)) / preview.size;
      rows.push(["Expected error", ofSize(std)]);
    }
    if (this.truth) rows.push(["3-D error", `${ofSize(distance(preview, this.truth)(frame, point))}, measured against the ground truth`]);
    const counts = preview.counts(point);
    if (counts) {
      const rejected = counts.rejected > 0 ? `, ${counts.rejected} rejected as outliers` : "";
      rows.push(["Visible in", `${counts.seen} of ${count(preview.allFrames, "frame")}${rejected}`]);
    }
    if (this.residuals) rows.push(["In this frame", this.now(frame, point)]);
    return rows;
  }

  private now(frame: number, point: number): string {
    const hidden = isHidden((this.residuals as Int16Array)[2 * (this.preview.points * frame + point)] as number);
    if (hidden) return "hidden: inferred from its neighbours and other frames";
    return this.rejected && isRejected(this.rejected, this.preview.points, frame, point) ? "rejected as an outlier" : "visible";
  }

  private async load(): Promise<void> {
    const { preview, signal } = this;
    const wanted = async <T>(has: boolean, get: () => Promise<T>): Promise<T | null> => (has ? get() : null);
    try {
      [this.residuals, this.rejected, this.spread, this.truth, this.names] = await Promise.all([
        preview.field("residuals", signal),
        wanted(preview.has("rejected"), () => preview.field("rejected", signal)),
        wanted(preview.has("spread"), () => preview.field("spread", signal)),
        wanted(preview.has("truth"), () => preview.field("truth", signal)),
        wanted(preview.has("names"), () => preview.field("names", signal)),
      ]);
    } catch {
      return; // position and counts are shown without them
    }
    this.frame = -1;
    this.onChange();
  }

  dispose(): void {
    this.marker.geometry.dispose();
    this.marker.material.dispose();
  }
}
