// The key figures of a job.

import { fill, h } from "./dom";
import { expectedSeconds } from "./sent";
import { type Job, isFinal } from "./types";
import { duration, inTracksUnit, ofSize } from "./words";

const whole = new Intl.NumberFormat("en");

export class Figures {
  readonly element = h("dl", { class: "figures" });

  show(job: Job): void {
    const rows = figures(job);
    fill(this.element, JSON.stringify(rows), () => rows.map(([term, value]) => h("div", {}, h("dt", {}, term), h("dd", {}, value))));
  }
}

function figures(job: Job): [string, string][] {
  const rows: [string, string][] = [];
  const { num_frames: frames, num_points: points } = job.interpretation;
  if (frames > 0) rows.push(["Frames", whole.format(frames)]);
  if (points > 0) rows.push(["Points", whole.format(points)]); // none before a film is tracked
  const { e3d_frame_scaled: error, reprojection_median: residual } = job.metrics ?? {};
  if (error !== undefined) rows.push(["3-D error", `${ofSize(error)}, measured against the ground truth`]);
  if (residual !== undefined) rows.push(["Reprojection", inTracksUnit(residual, job)]);
  if (job.started_at && job.finished_at) rows.push(["Duration", duration((Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000)]);
  if (isFinal(job.status)) return rows;
  const { progress } = job;
  const expected = expectedSeconds(job);
  const left = progress?.seconds_left ?? null;
  if (progress !== null && progress.residual !== null) rows.push(["Residual", inTracksUnit(progress.residual, job)]);
  // Until the remaining time is known: two estimates may contradict each other.
  if (left === null && expected !== null) rows.push(["Expected time", duration(expected)]);
  else if (progress) rows.push(["Time left", left === null ? "–" : duration(left)]);
  return rows;
}
