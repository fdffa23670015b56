// Numbers, sizes, times and names for display.

import type { Interpretation, Job, Options, Status } from "./types";

const whole = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });

export function count(value: number, one: string, many = `${one}s`): string {
  return `${whole.format(value)} ${value === 1 ? one : many}`;
}

export function number(value: number | null | undefined): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size >= 1e5 || size < 1e-4) return value.toExponential(2);
  if (size >= 100) return value.toFixed(1);
  return value.toPrecision(size < 1 ? 3 : 4);
}

/** A non-breaking space between a number and its percent sign. */
const PERCENT = "\u00a0%";

export function percent(fraction: number): string {
  const value = 100 * fraction;
  return `${value > 0 && value < 10 ? value.toFixed(1) : Math.round(value)}${PERCENT}`;
}

const twoDigits = new Intl.NumberFormat("en", { minimumSignificantDigits: 2, maximumSignificantDigits: 2 });

/** A share of the object's size in percent: two significant digits below 10, whole numbers from 10; never in exponential notation. */
export function ofSize(share: number): string {
  const value = 100 * share;
  // Smaller values are rounding errors: two identical results differ by as much.
  const digits = value < 5e-5 ? "0" : value < 10 ? twoDigits.format(value) : whole.format(value);
  return `${digits}${PERCENT} of the size`;
}

/** A length in the picture with its unit: pixels for a film, else the unit of the tracks. */
export function inTracksUnit(value: number, job: Job): string {
  return `${number(value)} ${job.interpretation.mesh_source === "film" ? "pixels" : "(tracks' unit)"}`;
}

/** A message of the service, with non-breaking spaces between numbers and percent signs. */
export function unbroken(text: string): string {
  return text.replace(/(\d) %/g, `$1${PERCENT}`);
}

export function bytes(value: number): string {
  if (value < 1000) return `${value} B`;
  const units = ["kB", "MB", "GB"];
  let scaled = value / 1000;
  let unit = 0;
  while (scaled >= 999.5 && unit < units.length - 1) {
    scaled /= 1000;
    unit += 1;
  }
  return `${scaled < 9.95 ? scaled.toFixed(1) : Math.round(scaled)} ${units[unit]}`;
}

function seconds(value: number): string {
  if (value < 1) return "a second";
  if (value < 90) return count(Math.round(value), "second");
  if (value < 5400) return count(Math.round(value / 60), "minute");
  return `${(value / 3600).toFixed(1)} hours`;
}

/** How long a job with these inputs and options takes; null: no estimate. The test for a sheet is not in it, as only the tracks show whether it is needed. */
export function expected({ estimate, image_size, has_rotations }: Interpretation, options: Options): string | null {
  if (!estimate) return null;
  const time = `about ${seconds(estimate.seconds + (estimate.tracking_seconds ?? 0))} once it runs`;
  const isTested = !has_rotations && !options["surface"] && (image_size || options["image_size"] || options["focal"] || options["field_of_view"]);
  return isTested ? `${time}. The test for a sheet such as paper can add half a minute; Surface: free omits it.` : time;
}

/** The same, abbreviated for a heading. */
export function duration(value: number): string {
  if (value < 60) return `${value < 9.95 ? value.toFixed(1) : Math.round(value)} s`;
  if (value < 5400) return `${Math.floor(value / 60)}:${String(Math.floor(value % 60)).padStart(2, "0")} min`;
  return `${(value / 3600).toFixed(1)} h`;
}

export function ago(iso: string, now = Date.now()): string {
  const age = (now - Date.parse(iso)) / 1000;
  if (age < 5) return "just now";
  if (age < 90) return `${Math.round(age)} s ago`;
  if (age < 5400) return `${Math.round(age / 60)} min ago`;
  if (age < 129600) return `${Math.round(age / 3600)} h ago`;
  return new Date(iso).toLocaleDateString();
}

export function title(job: Job): string {
  const own = job.name || `Job ${(job.outputs_of ?? job.id).slice(0, 8)}`;
  return job.outputs_of ? `${own}: more files` : own;
}

export const STATUS_WORDS: Record<Status, string> = {
  queued: "Queued",
  running: "Running",
  cancelling: "Cancelling",
  succeeded: "Done",
  failed: "Failed",
  cancelled: "Cancelled",
};

const STAGES: Record<string, string> = {
  track: "Tracking the film",
  loading: "Reading the tracks",
  cameras: "Estimating the cameras",
  initialise: "Computing the first shapes",
  reweight: "Refining the shapes",
  finish: "Finishing",
  exporting: "Writing the files",
};

/** One line on the state of a job. */
export function standing(job: Job): string {
  return `${state(job)}${timeLeft(job)}`;
}

/** The end of that line: the time that a running job still needs. */
export function timeLeft({ status, progress }: Job): string {
  if (status !== "running") return "";
  const left = progress?.seconds_left ?? null;
  return left === null ? "." : `; about ${seconds(left)} left.`;
}

/** The line without its end. */
export function state(job: Job): string {
  switch (job.status) {
    case "queued":
      if (job.place_in_queue === null) return "Queued; waiting for a worker.";
      return job.place_in_queue === 0
        ? "Next in the queue."
        : `Queued; ${count(job.place_in_queue, "job")} ahead of this one.`;
    case "running": {
      const progress = job.progress;
      if (progress === null) return "Started";
      const stage = STAGES[progress.stage] ?? progress.stage;
      const step =
        progress.stage === "reweight" && progress.max_reweightings > 0
          ? `, reweighting ${progress.reweighting}`
          : "";
      return `${stage}${step}`;
    }
    case "cancelling":
      return "Stopping at the next iteration.";
    case "succeeded":
      // The section "Verdict" shows the solver's sentence beside the verdict: convergence alone does not make a result good.
      return job.verdict ? "" : `${job.sentence ?? "Done."} The quality of this result was not assessed.`;
    case "failed":
      return job.error?.detail ?? "The job failed; see the service's log for details.";
    case "cancelled":
      return "This job was cancelled before it finished, so it has no result. “Try again” runs it with the same files.";
  }
}
