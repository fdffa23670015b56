// The animation of the front page: a waving sheet with point tracks on the left and the moving mesh on the right.
// It is computed from a formula as an illustration and is not the result of a solve.

const [COLUMNS, ROWS] = [40, 20];
const TRAIL = 7;
const FRAME = 1000 / 30;

interface Place {
  x: number;
  y: number;
  z: number;
}

export class Hero {
  readonly canvas = document.createElement("canvas");
  private readonly context = this.canvas.getContext("2d");
  private readonly still = matchMedia("(prefers-reduced-motion: reduce)");
  private readonly themes = matchMedia("(prefers-color-scheme: dark)");
  private seen = false;
  private last = 0;
  private colours = { dot: "", wire: "", clay: [0, 0, 0] };

  constructor() {
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "A waving sheet: point tracks on the left become a shaded surface on the right.");
    this.themes.addEventListener("change", () => this.draw(this.last));
    new ResizeObserver(() => this.draw(this.last)).observe(this.canvas);
    new IntersectionObserver(([entry]) => {
      const was = this.seen;
      this.seen = entry?.isIntersecting ?? false;
      if (this.seen && !was) requestAnimationFrame(this.tick);
    }).observe(this.canvas);
  }

  private readonly tick = (now: number): void => {
    if (!this.seen || this.canvas.offsetParent === null) {
      this.seen = false;
      return;
    }
    if (now - this.last >= FRAME) this.draw(now);
    if (!this.still.matches) requestAnimationFrame(this.tick);
  };

  private draw(now: number): void {
    const { canvas, context } = this;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (context === null || width === 0) return;
    this.last = now;
    const density = Math.min(2, devicePixelRatio);
    if (canvas.width !== Math.round(width * density)) canvas.width = Math.round(width * density);
    if (canvas.height !== Math.round(height * density)) canvas.height = Math.round(height * density);
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, width, height);
    this.readColours();
    const scale = Math.min(width / 2.3, height / 1.75);
    const at = (column: number, row: number, time: number): Place => {
      const { x, y, z } = sheet(column / COLUMNS, row / ROWS, time);
      return { x: width / 2 + scale * x, y: height / 2 + scale * y, z };
    };
    const time = now / 1000;
    this.tracks(context, at, time);
    this.surface(context, at, time);
  }

  private tracks(context: CanvasRenderingContext2D, at: (c: number, r: number, t: number) => Place, time: number): void {
    context.strokeStyle = context.fillStyle = this.colours.dot;
    context.lineWidth = 1;
    for (let column = 0; column <= 0.52 * COLUMNS; column += 1) {
      for (let row = 0; row <= ROWS; row += 1) {
        const share = 1 - Math.max(0, column / COLUMNS - 0.36) / 0.17;
        if (share <= 0) continue;
        const here = at(column, row, time);
        context.globalAlpha = 0.35 * share;
        context.beginPath();
        context.moveTo(here.x, here.y);
        for (let back = 1; back <= TRAIL; back += 1) {
          const past = at(column, row, time - 0.05 * back);
          context.lineTo(past.x, past.y);
        }
        context.stroke();
        context.globalAlpha = 0.9 * share;
        context.beginPath();
        context.arc(here.x, here.y, 1.5, 0, 7);
        context.fill();
      }
    }
    context.globalAlpha = 1;
  }

  private surface(context: CanvasRenderingContext2D, at: (c: number, r: number, t: number) => Place, time: number): void {
    const quads: { depth: number; corners: Place[]; share: number }[] = [];
    for (let column = Math.floor(0.36 * COLUMNS); column < COLUMNS; column += 1) {
      for (let row = 0; row < ROWS; row += 1) {
        const corners = [at(column, row, time), at(column + 1, row, time), at(column + 1, row + 1, time), at(column, row + 1, time)];
        const depth = corners.reduce((sum, corner) => sum + corner.z, 0);
        quads.push({ depth, corners, share: Math.min(1, Math.max(0, column / COLUMNS - 0.36) / 0.17) });
      }
    }
    quads.sort((one, other) => one.depth - other.depth);
    for (const { corners, share } of quads) {
      context.globalAlpha = share;
      context.fillStyle = this.shade(corners);
      context.beginPath();
      for (const corner of corners) context.lineTo(corner.x, corner.y);
      context.closePath();
      context.fill();
      context.globalAlpha = 0.3 * share;
      context.strokeStyle = this.colours.wire;
      context.lineWidth = 0.5;
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  private shade(corners: Place[]): string {
    const [a, b, , d] = corners as [Place, Place, Place, Place];
    const unit = Math.hypot(b.x - a.x, b.y - a.y) || 1;
    const [ux, uy, uz] = [(b.x - a.x) / unit, (b.y - a.y) / unit, (150 * (b.z - a.z)) / unit];
    const [vx, vy, vz] = [(d.x - a.x) / unit, (d.y - a.y) / unit, (150 * (d.z - a.z)) / unit];
    const normal = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx] as const;
    const length = Math.hypot(...normal) || 1;
    const lit = Math.abs(-0.45 * normal[0] - 0.5 * normal[1] + 0.74 * normal[2]) / length;
    const [r, g, b2] = this.colours.clay.map((part) => Math.round(part * (0.42 + 0.62 * lit)));
    return `rgb(${r} ${g} ${b2})`;
  }

  private readColours(): void {
    const style = getComputedStyle(this.canvas);
    const colour = (name: string): string => style.getPropertyValue(name).trim();
    const clay = colour("--clay");
    this.colours = { dot: colour("--dots"), wire: colour("--wire"), clay: [1, 3, 5].map((at) => Number.parseInt(clay.slice(at, at + 2), 16)) };
  }
}

/** A point of the sheet, u and v in [0, 1], at a time in seconds: rotated slightly, without perspective. */
function sheet(u: number, v: number, time: number): Place {
  const [x, y] = [2.1 * (u - 0.5), 1.05 * (v - 0.5)];
  const wave = 0.5 + 0.5 * u;
  const z = 0.13 * wave * Math.sin(5.2 * u - 1.7 * time + 1.1 * v) + 0.05 * Math.sin(7 * v + 3 * u - 1.1 * time);
  const turn = -0.5 + 0.16 * Math.sin(0.4 * time);
  const tilt = 0.5;
  const [cx, sx] = [Math.cos(turn), Math.sin(turn)];
  const [across, away] = [cx * x + sx * z, cx * z - sx * x];
  return { x: across, y: Math.cos(tilt) * y - Math.sin(tilt) * away, z: Math.sin(tilt) * y + Math.cos(tilt) * away };
}
