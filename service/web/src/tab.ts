// The state of a job while its tab is in the background: progress in the title, and a notification at the end.

import { button, say } from "./dom";
import { type Job, isFinal } from "./types";
import { headline, verdictOf } from "./verdict";
import { STATUS_WORDS, percent, title } from "./words";

const PLAIN = "Pliant";

export class Tab {
  /** Requests permission when pressed: browsers block requests without a user action. */
  readonly element = button("Notify me at the end", () => void this.ask(), { class: "quiet", hidden: true });
  private wanted = false;
  private job: Job | null = null;

  show(job: Job): void {
    const before = this.job;
    this.job = job;
    document.title = `${lead(job)}${title(job)} – ${PLAIN}`;
    const pending = !isFinal(job.status);
    this.element.hidden = !pending || typeof Notification === "undefined" || Notification.permission === "denied";
    if (!pending && before !== null && !isFinal(before.status) && this.wanted) this.notify(job);
  }

  /** Reset the title: another job is shown, or none. */
  leave(): void {
    document.title = PLAIN;
  }

  private async ask(): Promise<void> {
    const permission = Notification.permission === "default" ? await Notification.requestPermission() : Notification.permission;
    this.wanted = permission === "granted";
    say(this.element, this.wanted ? "You will be notified" : "Notifications are blocked for this page");
    this.element.disabled = true;
  }

  private notify(job: Job): void {
    this.wanted = false;
    const note = new Notification(`${title(job)}: ${outcome(job).toLowerCase()}`, { body: job.trust_sentence ?? job.sentence ?? "", tag: job.id });
    note.addEventListener("click", () => {
      window.focus();
      note.close();
    });
  }
}

/** The start of the title, which stays readable in narrow tabs. */
function lead(job: Job): string {
  return `${job.status === "running" ? percent(job.progress?.fraction ?? 0) : outcome(job)} – `;
}

/** The verdict if there is one, else the status of the job. */
function outcome(job: Job): string {
  const verdict = verdictOf(job);
  return verdict ? headline(verdict, job) : STATUS_WORDS[job.status];
}
