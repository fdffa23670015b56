// Which of two records of a job is newer: events repeat past states, and responses arrive out of order.

import { type Job, type Progress, isFinal } from "./types";

const ORDER: Job["status"][] = ["queued", "running", "cancelling"];
const rank = (status: Job["status"]): number => (isFinal(status) ? ORDER.length : ORDER.indexOf(status));

/** Return the record if it is newer than the known one, else null. */
export function newer(known: Job | null, job: Job): Job | null {
  if (known === null) return job;
  if (job.attempt !== known.attempt) return job.attempt > known.attempt ? job : null;
  if (rank(job.status) !== rank(known.status)) return rank(job.status) > rank(known.status) ? job : null;
  if ((job.progress?.updated_at ?? "") < (known.progress?.updated_at ?? "")) return null;
  // The place in the queue changes with other jobs, so stored events lack it; only a fresh response has it.
  return job.status === "queued" ? { ...job, place_in_queue: job.place_in_queue ?? known.place_in_queue } : job;
}

/** Return the record with this progress, or null if the progress is outdated. */
export function progressed(known: Job | null, progress: Progress): Job | null {
  if (known === null || isFinal(known.status)) return null;
  if (known.progress !== null && known.progress.updated_at >= progress.updated_at) return null;
  return { ...known, status: known.status === "queued" ? "running" : known.status, place_in_queue: null, progress };
}
