// The film beside the mesh at the same frame, with the tracks or the projected mesh over it; without a film, the tracks alone.

import { edges } from "./body";
import type { FilmFrames } from "./filmframes";
import { type Preview, isHidden } from "./preview";
import { scattered } from "./scattered";
import type { Crop } from "./stage";

/** Maximum number of points drawn over a film, so that the picture stays visible, and without one. */
const MOST = { film: 500, plain: 3000 };
const TAIL = 6;

export class FilmPane {
  readonly canvas = document.createElement("canvas");
  showsTracks = true;
  showsMesh = false;
  private readonly context = this.canvas.getContext("2d") as CanvasRenderingContext2D;
  /** The part of the picture plane that the pane shows. */
  readonly frame: Crop;
  private readonly some: number[];
  private wires: Uint32Array | null = null;
  private colours = { dots: "#b4482c", wire: "#ffffff", paper: "#ffffff" };
  private time = 0;
  private last: ImageBitmap | null = null;

  constructor(
    private readonly preview: Preview,
    private readonly residuals: Int16Array,
    private readonly film: FilmFrames | null,
  ) {
    this.some = scattered(preview.points, film ? MOST.film : MOST.plain);
    this.frame = film?.frame ?? this.around();
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", film ? "The film at the same moment, with its tracks" : "The tracks at the same moment");
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  /** Width of the picture divided by its height. */
  get shape(): number {
    return this.frame.width / this.frame.height;
  }

  theme(dots: string, wire: string): void {
    this.colours = { ...this.colours, dots, wire };
    this.draw();
  }

  /** Show a time, in frames; tracks are measurements and are not interpolated. */
  show(time: number): void {
    this.time = time;
    this.draw();
  }

  private draw(): void {
    const { canvas, context, preview } = this;
    const density = Math.min(2, devicePixelRatio);
    const [width, height] = [Math.round(canvas.clientWidth * density), Math.round(canvas.clientHeight * density)];
    if (width === 0 || height === 0) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    context.clearRect(0, 0, width, height);
    const frame = Math.min(Math.round(this.time), Math.max(0, preview.ready - 1));
    const scale = Math.min(width / this.frame.width, height / this.frame.height);
    const [dx, dy] = [(width - scale * this.frame.width) / 2, (height - scale * this.frame.height) / 2];
    if (this.film) {
      const picture = this.film.picture(frame * preview.header.frame_stride, () => this.draw());
      this.last = picture ?? this.last;
      if (this.last && this.last.width > 0) context.drawImage(this.last, dx, dy, scale * this.frame.width, scale * this.frame.height);
    }
    const up = preview.header.y_axis === "up";
    const at = ([x, y]: [number, number]): [number, number] => {
      const down = up ? this.frame.top + this.frame.height - (y - this.frame.top) : y;
      return [dx + scale * (x - this.frame.left), dy + scale * (down - this.frame.top)];
    };
    if (this.showsMesh) this.mesh(frame, at, density);
    if (this.showsTracks) this.tracks(frame, at, density);
  }

  private mesh(frame: number, at: (place: [number, number]) => [number, number], density: number): void {
    const { preview, context } = this;
    this.wires ??= edges(preview.faces, preview.points);
    const places = Array.from({ length: preview.points }, (_, point) => at(preview.project(frame, ...preview.place(frame, point))));
    context.beginPath();
    for (let i = 0; i < this.wires.length; i += 2) {
      const [from, to] = [places[this.wires[i] as number], places[this.wires[i + 1] as number]] as [[number, number], [number, number]];
      context.moveTo(...from);
      context.lineTo(...to);
    }
    context.strokeStyle = this.colours.wire;
    context.globalAlpha = this.preview.points > 2000 ? 0.4 : 0.65;
    context.lineWidth = density * Math.max(0.35, Math.min(1, 40 / Math.sqrt(preview.points)));
    context.stroke();
    context.globalAlpha = 1;
  }

  private tracks(frame: number, at: (place: [number, number]) => [number, number], density: number): void {
    const { context } = this;
    context.fillStyle = context.strokeStyle = this.colours.dots;
    context.lineWidth = density;
    for (const point of this.some) {
      const here = this.track(frame, point);
      if (here === null) continue;
      const [x, y] = at(here);
      context.globalAlpha = 0.35;
      context.beginPath();
      context.moveTo(x, y);
      for (let back = 1; back <= Math.min(TAIL, frame); back += 1) {
        const past = this.track(frame - back, point);
        if (past === null) break;
        context.lineTo(...at(past));
      }
      context.stroke();
      context.globalAlpha = 0.9;
      context.fillRect(x - density, y - density, 2 * density, 2 * density);
    }
    context.globalAlpha = 1;
  }

  /** Return the tracked position of a point: its projection plus the residual; null if it is hidden. */
  private track(frame: number, point: number): [number, number] | null {
    const { preview, residuals } = this;
    const from = 2 * (preview.points * frame + point);
    const [u, v] = [residuals[from] as number, residuals[from + 1] as number];
    if (isHidden(u)) return null;
    const [x, y] = preview.project(frame, ...preview.place(frame, point));
    return [x + preview.header.residual_step * u, y + preview.header.residual_step * v];
  }

  /** Return the bounding box of the tracks of all frames, with a margin. */
  private around(): Crop {
    const { preview } = this;
    const [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]] as [[number, number], [number, number]];
    for (let frame = 0; frame < preview.ready; frame += Math.max(1, Math.floor(preview.ready / 30))) {
      for (const point of this.some) {
        const place = this.track(frame, point);
        if (place === null) continue;
        for (const axis of [0, 1] as const) {
          low[axis] = Math.min(low[axis], place[axis]);
          high[axis] = Math.max(high[axis], place[axis]);
        }
      }
    }
    const edge = 0.05 * Math.max(high[0] - low[0], high[1] - low[1], 1e-9);
    return { left: low[0] - edge, top: low[1] - edge, width: high[0] - low[0] + 2 * edge, height: high[1] - low[1] + 2 * edge };
  }
}
