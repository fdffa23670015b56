// A region of a film's picture: a rectangle or a lasso, in film pixels, y down.

import { h } from "./dom";

export type Point = [x: number, y: number];

export interface Rectangle {
  kind: "rectangle";
  x: number;
  y: number;
  width: number;
  height: number;
}
export interface Lasso {
  kind: "lasso";
  corners: Point[];
}
export type Region = Rectangle | Lasso;

export interface Size {
  width: number;
  height: number;
}

/** Maximum number of corners of a lasso; the service accepts 1000. */
const MOST_CORNERS = 500;
/** A region with a side shorter than this share of the picture's longest side is a click, not a region. */
const SMALLEST = 0.01;

const clamp = (value: number, low: number, high: number): number => Math.min(Math.max(value, low), high);
const rounded = (value: number): number => Math.round(10 * value) / 10;

/** Return the corners [x, y] that the option `region_polygon` takes. */
export function polygon(region: Region): Point[] {
  if (region.kind === "lasso") return region.corners.map(([x, y]): Point => [rounded(x), rounded(y)]);
  const { x, y, width, height } = region;
  const [left, top, right, bottom] = [rounded(x), rounded(y), rounded(x + width), rounded(y + height)];
  return [[left, top], [right, top], [right, bottom], [left, bottom]];
}

/** Return the nearest point inside the picture. */
export function within([x, y]: Point, size: Size): Point {
  return [clamp(x, 0, size.width), clamp(y, 0, size.height)];
}

/** Return the rectangle that a drag spans, or null for one that is too small. */
export function spanned([x0, y0]: Point, [x1, y1]: Point, size: Size): Rectangle | null {
  const [width, height] = [Math.abs(x1 - x0), Math.abs(y1 - y0)];
  if (Math.min(width, height) < SMALLEST * Math.max(size.width, size.height)) return null;
  return { kind: "rectangle", x: Math.min(x0, x1), y: Math.min(y0, y1), width, height };
}

/** Return the lasso of a stroke, thinned to `MOST_CORNERS`, or null for one that is too small. */
export function closed(stroke: Point[], size: Size): Lasso | null {
  const every = Math.ceil(stroke.length / MOST_CORNERS);
  const corners = stroke.filter((_, index) => index % every === 0);
  const box = bounds(corners);
  if (corners.length < 3 || Math.min(box.width, box.height) < SMALLEST * Math.max(size.width, size.height)) return null;
  return { kind: "lasso", corners };
}

/** Return the initial rectangle of keyboard drawing: the middle of the picture. */
export function centred({ width, height }: Size): Rectangle {
  return { kind: "rectangle", x: width / 4, y: height / 4, width: width / 2, height: height / 2 };
}

/** Return the region moved, kept inside the picture. */
export function moved(region: Region, [dx, dy]: Point, size: Size): Region {
  const box = bounds(polygon(region));
  const x = clamp(dx, -box.x, size.width - box.x - box.width);
  const y = clamp(dy, -box.y, size.height - box.y - box.height);
  if (region.kind === "rectangle") return { ...region, x: region.x + x, y: region.y + y };
  return { kind: "lasso", corners: region.corners.map(([left, top]): Point => [left + x, top + y]) };
}

/** Return the rectangle, or the bounding box of a lasso, with its right and lower sides moved. */
export function resized(region: Region, [dx, dy]: Point, size: Size): Rectangle {
  const box = region.kind === "rectangle" ? region : bounds(region.corners);
  const least = SMALLEST * Math.max(size.width, size.height);
  const width = clamp(box.width + dx, least, size.width - box.x);
  const height = clamp(box.height + dy, least, size.height - box.y);
  return { kind: "rectangle", x: box.x, y: box.y, width, height };
}

/** Return a description of a region. */
export function described(region: Region | null): string {
  if (region === null) return "No region: everything in the picture is tracked, the background included. Draw around the object.";
  const { x, y, width, height } = bounds(polygon(region));
  const size = `${Math.round(width)} × ${Math.round(height)} pixels at ${Math.round(x)}, ${Math.round(y)}`;
  return region.kind === "rectangle" ? `Rectangle, ${size}.` : `Lasso with ${region.corners.length} corners, ${size}.`;
}

/** Draw a picture on a canvas with everything outside the region darkened. */
export function paint(canvas: HTMLCanvasElement, picture: ImageBitmap, outline: Point[], isClosed = true): void {
  const context = canvas.getContext("2d") as CanvasRenderingContext2D;
  const scale = canvas.width / picture.width;
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  if (outline.length < 2) return;
  const path = new Path2D();
  for (const [x, y] of outline) path.lineTo(x * scale, y * scale);
  if (isClosed) {
    path.closePath();
    context.fillStyle = "rgb(0 0 0 / 0.5)";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.save();
    context.clip(path); // also what the outline runs around twice
    context.drawImage(picture, 0, 0, canvas.width, canvas.height);
    context.restore();
  }
  // A light line on a dark one is visible on every picture.
  const width = Math.max(2, canvas.width / 320);
  context.lineJoin = "round";
  for (const [colour, times] of [["#000000", 2.2], ["#5ce0cf", 1]] as const) {
    context.strokeStyle = colour;
    context.lineWidth = times * width;
    context.stroke(path);
  }
}

/** Darken everything outside a mask picture on a canvas, by the service's rule: dark is outside, or transparent if a part is transparent. */
export function paintMask(canvas: HTMLCanvasElement, mask: ImageBitmap): void {
  const { width, height } = canvas;
  const layer = h("canvas", { width, height });
  const context = layer.getContext("2d") as CanvasRenderingContext2D;
  context.drawImage(mask, 0, 0, width, height);
  const shade = context.getImageData(0, 0, width, height);
  const { data } = shade;
  let isTransparent = false;
  for (let i = 3; i < data.length; i += 4) isTransparent ||= (data[i] as number) < 128;
  for (let i = 0; i < data.length; i += 4) {
    const [red, green, blue, alpha] = data.subarray(i, i + 4) as unknown as [number, number, number, number];
    const isInside = isTransparent ? alpha >= 128 : 0.299 * red + 0.587 * green + 0.114 * blue >= 128;
    data.set([0, 0, 0, isInside ? 0 : 128], i);
  }
  context.putImageData(shade, 0, 0);
  canvas.getContext("2d")?.drawImage(layer, 0, 0);
}

function bounds(corners: Point[]): Omit<Rectangle, "kind"> {
  const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => y)];
  const [x, y] = [Math.min(...xs), Math.min(...ys)];
  return { x, y, width: Math.max(...xs) - x, height: Math.max(...ys) - y };
}
