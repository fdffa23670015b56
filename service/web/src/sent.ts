// What this tab has sent, by job: a film is shown while it is tracked, the code of a job names its files, and its record has no estimate for a film.

import { type Interpretation, type Job, ofFilm } from "./types";

const [NAMES, TIMES] = ["pliant-sent", "pliant-times"];

const sent = new Map<string, Map<string, File>>();

type Names = Record<string, Record<string, string>>;

/** Keep the files of a submitted job while the tab is open, and their names when the page is reloaded. */
export function remember(id: string, files: [part: string, File][]): void {
  sent.set(id, new Map(files));
  keepNames(id, Object.fromEntries(files.map(([part, file]) => [part, file.name])));
}

/** A job that reuses the inputs of another one has the same files. */
export function rememberSame(id: string, other: string): void {
  sent.set(id, sent.get(other) ?? new Map());
  keepNames(id, names()[other] ?? {});
}

/** Return a file that was sent since the page was loaded. */
export function sentFile(id: string, part: string): File | undefined {
  return sent.get(id)?.get(part);
}

/** Return the names of the files that this tab has sent, by part; empty for jobs submitted elsewhere. */
export function sentNames(id: string): Record<string, string> {
  return names()[id] ?? {};
}

/** Keep how many seconds a job is expected to take, if the check of its files has shown it. */
export function rememberTime(id: string, estimate: Interpretation["estimate"]): void {
  if (estimate) sessionStorage.setItem(TIMES, JSON.stringify({ ...times(), [id]: estimate.seconds + (estimate.tracking_seconds ?? 0) }));
}

/** Return how many seconds a job is expected to take, null if it is unknown. */
export function expectedSeconds(job: Job): number | null {
  if (job.outputs_of) return null; // its record is of the job whose result it writes
  return (ofFilm(job) ? times()[job.id] : job.interpretation.estimate?.seconds) ?? null;
}

function times(): Record<string, number> {
  return JSON.parse(sessionStorage.getItem(TIMES) ?? "{}") as Record<string, number>;
}

function names(): Names {
  return JSON.parse(sessionStorage.getItem(NAMES) ?? "{}") as Names;
}

function keepNames(id: string, files: Record<string, string>): void {
  sessionStorage.setItem(NAMES, JSON.stringify({ ...names(), [id]: files }));
}
