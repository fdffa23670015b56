// Per-point values for colour, and the scale from dark to bright that shows them.

import { type Preview, isHidden } from "./preview";

export type Colouring = "plain" | "displacement" | "error" | "residual";

/** Six colours, evenly spaced, rising in lightness all the way, so that they also read in grey and without red or green. */
export const SCALE = ["#2b2f77", "#28608f", "#1f8f8a", "#58b96d", "#b5d44a", "#fbe94b"];

export interface Values {
  /** The value that gets the brightest colour, in the tracks' unit. */
  top: number;
  /** Write frame f's values, 0 … 32767 from 0 to top, one a point. */
  write: (frame: number, into: Int16Array, stride: number, at: number) => void;
}

/** Prepare a colouring; null for plain. */
export async function valuesFor(colouring: Colouring, preview: Preview, signal: AbortSignal): Promise<Values | null> {
  if (colouring === "displacement") return displacement(preview);
  if (colouring === "error") return distance(preview, await preview.field("truth", signal));
  if (colouring === "residual") return residual(preview, await preview.field("residuals", signal));
  return null;
}

/** Distance of each point from its mean position over the frames that have arrived. */
function displacement(preview: Preview): Values {
  const { points, positions, ready } = preview;
  const mean = new Float32Array(3 * points);
  for (let frame = 0; frame < ready; frame += 1) {
    const at = 3 * points * frame;
    for (let i = 0; i < mean.length; i += 1) mean[i] = (mean[i] as number) + (positions[at + i] as number) / ready;
  }
  const value = (frame: number, point: number): number => {
    const at = 3 * (points * frame + point);
    const x = (positions[at] as number) - (mean[3 * point] as number);
    const y = (positions[at + 1] as number) - (mean[3 * point + 1] as number);
    const z = (positions[at + 2] as number) - (mean[3 * point + 2] as number);
    return preview.header.step * Math.sqrt(x * x + y * y + z * z);
  };
  return scaled(preview, ready, value);
}

function distance(preview: Preview, truth: Int16Array): Values {
  const { points, positions, frames } = preview;
  const value = (frame: number, point: number): number => {
    const at = 3 * (points * frame + point);
    const x = (positions[at] as number) - (truth[at] as number);
    const y = (positions[at + 1] as number) - (truth[at + 1] as number);
    const z = (positions[at + 2] as number) - (truth[at + 2] as number);
    return preview.header.step * Math.sqrt(x * x + y * y + z * z);
  };
  return scaled(preview, Math.min(frames, preview.ready), value);
}

function residual(preview: Preview, residuals: Int16Array): Values {
  const { points, frames } = preview;
  const value = (frame: number, point: number): number => {
    const at = 2 * (points * frame + point);
    const x = residuals[at] as number;
    const y = residuals[at + 1] as number;
    return isHidden(x) ? 0 : preview.header.residual_step * Math.sqrt(x * x + y * y);
  };
  return scaled(preview, frames, value);
}

/** The top of the scale is the 99th percentile of a sample, so that a few outliers do not make everything else dark. */
function scaled(preview: Preview, frames: number, value: (frame: number, point: number) => number): Values {
  const sample: number[] = [];
  const total = preview.points * frames;
  const stride = Math.max(1, Math.floor(total / 20_000)) | 1;
  for (let i = 0; i < total; i += stride) sample.push(value(Math.floor(i / preview.points), i % preview.points));
  sample.sort((a, b) => a - b);
  const top = sample[Math.floor(0.99 * sample.length)] || Number.MIN_VALUE;
  const write = (frame: number, into: Int16Array, every: number, at: number): void => {
    for (let point = 0; point < preview.points; point += 1) {
      into[every * point + at] = Math.min(32767, (32767 * value(frame, point)) / top);
    }
  };
  return { top, write };
}
