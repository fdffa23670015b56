// The remaining time, counted down between two messages of the service.

import type { Job } from "./types";

const EVERY = 1000;

export class Countdown {
  private timer = 0;
  private job: Job | null = null;
  private heard = 0;

  /** `onTick` gets the record with the current remaining time. */
  constructor(private readonly onTick: (job: Job) => void) {}

  /** Update the record; the countdown restarts only if the progress has a new timestamp. */
  show(job: Job): void {
    if (job.progress?.updated_at !== this.job?.progress?.updated_at) this.heard = performance.now();
    this.job = job;
    this.tick();
  }

  stop(): void {
    clearTimeout(this.timer);
    this.job = null;
  }

  private readonly tick = (): void => {
    clearTimeout(this.timer);
    const { job } = this;
    if (job === null) return;
    const left = job.progress?.seconds_left ?? null;
    if (job.status !== "running" || job.progress === null || left === null) {
      this.onTick(job);
      return;
    }
    const seconds = left - (performance.now() - this.heard) / 1000;
    // The job is still running at the end of its countdown: the estimate was wrong, and there is no other one yet.
    this.onTick({ ...job, progress: { ...job.progress, seconds_left: seconds > 0 ? seconds : null } });
    if (seconds > 0) this.timer = setTimeout(this.tick, EVERY);
  };
}
