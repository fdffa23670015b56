// Per-point values shown as colours, and their scales from dark to bright.

import { ofSize } from "../words";
import { type Preview, isHidden, isRejected } from "./preview";

export type Colouring = "film" | "plain" | "expected" | "seen" | "displacement" | "error" | "residual" | "difference";

/** Six evenly spaced colours of increasing lightness, readable in greyscale and with red-green colour blindness. */
export const SCALE = ["#2b2f77", "#28608f", "#1f8f8a", "#58b96d", "#b5d44a", "#fbe94b"];
/** From blue over light grey to red, for values of both signs. */
const DIVERGING = ["#2166ac", "#74add1", "#dfe6ea", "#f0e4dd", "#e08a66", "#b2182b"];
/** Positions without a value: hidden in the frame, or unknown. */
const UNKNOWN = -32767;
const TOP = 32767;

export interface Values {
  /** Meaning of the colours, for the legend. */
  words: string;
  /** Values at the ends of the scale, with units. */
  low: string;
  high: string;
  scale: string[];
  /** True if some positions have no value and are grey. */
  hasUnknown: boolean;
  /** Why they have none; "hidden" by default. */
  unknown?: string;
  /** Write one value per point of a frame: 0 … 32767 from one end of the scale to the other, `UNKNOWN` for grey. */
  write: (frame: number, into: Int16Array, stride: number, at: number) => void;
}

/** The value of a point in a frame; NaN if there is none. */
type Value = (frame: number, point: number) => number;

/** Return the values of a colouring; null for those without: plain, and the film's picture. */
export async function valuesFor(colouring: Colouring, preview: Preview, signal: AbortSignal): Promise<Values | null> {
  if (colouring === "displacement") return displacement(preview);
  if (colouring === "seen") return seen(preview);
  if (colouring === "error") {
    const value = distance(preview, await preview.field("truth", signal));
    return scaled(preview, value, "Distance from the ground truth", ofSize, false);
  }
  if (colouring === "expected") {
    const [spread, residuals] = await Promise.all([preview.field("spread", signal), preview.field("residuals", signal)]);
    return scaled(preview, ifSeen(preview, residuals, deviation(preview, spread)), "Expected error", ofSize, hides(preview));
  }
  if (colouring === "residual") return residual(preview, signal);
  return null;
}

/** Return the colourings that a preview has data for, with their labels. */
export function colourings(preview: Preview): [Colouring, string][] {
  const all: [Colouring, string, boolean][] = [
    ["film", "film", preview.has("picture") && preview.faces.length > 0],
    ["plain", "plain", true],
    ["expected", "expected error", preview.has("spread")],
    ["error", "3-D error", preview.has("truth")],
    ["seen", "visibility", preview.counts(0) !== null],
    ["residual", "residual", true],
    ["displacement", "displacement", true],
  ];
  return all.filter(([, , has]) => has).map(([name, words]) => [name, words]);
}

/** A job's result and its name. */
export interface Named {
  preview: Preview;
  title: string;
}

/** The error of one job minus that of the other, for two jobs with the same points and frames: 3-D errors if both have them. */
export async function errorDifference(mine: Named, theirs: Named, signal: AbortSignal): Promise<Values | null> {
  const [one, other] = [mine.preview, theirs.preview];
  if (one.points !== other.points || one.frames !== other.frames) return null;
  const values = async (preview: Preview, field: "truth" | "spread"): Promise<Value> => {
    const residuals = await preview.field("residuals", signal);
    const error = field === "truth" ? distance(preview, await preview.field("truth", signal)) : deviation(preview, await preview.field("spread", signal));
    return ifSeen(preview, residuals, error);
  };
  const field = one.has("truth") && other.has("truth") ? "truth" : "spread";
  if (!one.has(field) || !other.has(field)) return null;
  const [here, there] = await Promise.all([values(one, field), values(other, field)]);
  const value: Value = (frame, point) => here(frame, point) - there(frame, point);
  const most = quantile(one, (frame, point) => Math.abs(value(frame, point)));
  const words = `${field === "truth" ? "3-D error" : "Expected error"}, “${mine.title}” minus “${theirs.title}”`;
  const mapped: Value = (frame, point) => 0.5 + value(frame, point) / (2 * most);
  const ends = { low: `−${ofSize(most)}`, high: `+${ofSize(most)}`, scale: DIVERGING };
  return { words, ...ends, hasUnknown: hides(one) || hides(other), unknown: "hidden in one of the two", write: writer(one, mapped) };
}

/** Standard deviation of each position, as a share of the object's size. */
function deviation(preview: Preview, spread: Uint16Array): Value {
  const unit = (preview.header.spread_step ?? 0) / preview.size;
  return (frame, point) => unit * (spread[preview.points * frame + point] as number);
}

/** Distance of each point from its mean position over the frames that have arrived, as a share of the object's size. */
function displacement(preview: Preview): Values {
  const { points, positions, ready } = preview;
  const mean = new Float32Array(3 * points);
  for (let frame = 0; frame < ready; frame += 1) {
    const at = 3 * points * frame;
    for (let i = 0; i < mean.length; i += 1) mean[i] = (mean[i] as number) + (positions[at + i] as number) / ready;
  }
  const unit = preview.header.step / preview.size;
  const value: Value = (frame, point) => {
    const at = 3 * (points * frame + point);
    const offset = (axis: number): number => (positions[at + axis] as number) - (mean[3 * point + axis] as number);
    return unit * Math.hypot(offset(0), offset(1), offset(2));
  };
  return scaled(preview, value, "Distance from the mean position", ofSize, false);
}

export function distance(preview: Preview, truth: Int16Array): Value {
  const { points, positions } = preview;
  const unit = preview.header.step / preview.size;
  return (frame, point) => {
    const at = 3 * (points * frame + point);
    const offset = (axis: number): number => (positions[at + axis] as number) - (truth[at + axis] as number);
    return unit * Math.hypot(offset(0), offset(1), offset(2));
  };
}

/** Share of the frames in which a point is visible; grey if there is none. */
function seen(preview: Preview): Values {
  const value: Value = (_, point) => {
    const count = preview.counts(point)?.seen ?? 0;
    return count === 0 ? NaN : count / preview.allFrames;
  };
  const never = Array.from({ length: preview.points }, (_, point) => value(0, point)).some(Number.isNaN);
  const high = `${preview.allFrames} of ${preview.allFrames} frames`;
  return { words: "Visible in", low: "0", high, scale: SCALE, hasUnknown: never, write: writer(preview, value) };
}

async function residual(preview: Preview, signal: AbortSignal): Promise<Values> {
  const residuals = await preview.field("residuals", signal);
  const bits = preview.has("rejected") ? await preview.field("rejected", signal) : null;
  const { points } = preview;
  const unit = preview.header.residual_step;
  const value: Value = (frame, point) => {
    const at = 2 * (points * frame + point);
    return unit * Math.hypot(residuals[at] as number, residuals[at + 1] as number);
  };
  const known = ifSeen(preview, residuals, value);
  const counted: Value = (frame, point) => (bits && isRejected(bits, points, frame, point) ? NaN : known(frame, point));
  const figure = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
  return scaled(preview, known, "Distance from track to projection", (top) => `${figure.format(top)} (tracks' unit)`, hides(preview), counted);
}

/** Positions hidden in a frame have no value: they are inferred from their neighbours. */
function ifSeen(preview: Preview, residuals: Int16Array, value: Value): Value {
  return (frame, point) => (isHidden(residuals[2 * (preview.points * frame + point)] as number) ? NaN : value(frame, point));
}

/** Return the 99th percentile of a sample, so that a few large values do not darken all others. */
function quantile(preview: Preview, value: Value): number {
  const sample: number[] = [];
  const frames = Math.max(1, Math.min(preview.frames, preview.ready));
  const total = preview.points * frames;
  const stride = Math.max(1, Math.floor(total / 20_000)) | 1;
  for (let i = 0; i < total; i += stride) {
    const found = value(Math.floor(i / preview.points), i % preview.points);
    if (!Number.isNaN(found)) sample.push(found);
  }
  sample.sort((a, b) => a - b);
  return sample[Math.floor(0.99 * sample.length)] || Number.MIN_VALUE;
}

/** Return values scaled from 0 to the 99th percentile of `counted`. */
function scaled(preview: Preview, value: Value, words: string, unit: (top: number) => string, hasUnknown: boolean, counted = value): Values {
  const top = quantile(preview, counted);
  return { words, low: "0", high: unit(top), scale: SCALE, hasUnknown, write: writer(preview, (frame, point) => value(frame, point) / top) };
}

/** Return true if a point is hidden in some frame, or if this is unknown. */
function hides(preview: Preview): boolean {
  for (let frame = 0; frame < preview.frames; frame += 1) if (preview.facts(frame).hidden !== 0) return true;
  return false;
}

function writer(preview: Preview, share: Value): Values["write"] {
  return (frame, into, stride, at) => {
    for (let point = 0; point < preview.points; point += 1) {
      const found = share(frame, point);
      into[stride * point + at] = Number.isNaN(found) ? UNKNOWN : Math.max(0, Math.min(TOP, TOP * found));
    }
  };
}
