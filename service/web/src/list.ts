// The list of jobs, newest first.

import { type Refusal, listJobs } from "./api";
import { button, fill, h, say } from "./dom";
import { type Job, isFinal } from "./types";
import { STATUS_WORDS, ago, count, title } from "./words";

interface Row {
  element: HTMLLIElement;
  link: HTMLAnchorElement;
  name: HTMLElement;
  about: HTMLElement;
  status: HTMLElement;
  meter: HTMLProgressElement;
}

export class JobList {
  readonly element: HTMLElement;
  private readonly items = h("ol", { class: "jobs" });
  private readonly empty = h("p", { class: "muted" }, "No jobs yet.");
  private readonly older = button("Older jobs", () => void this.more(), { class: "link", hidden: true });
  private readonly rows = new Map<string, Row>();
  private jobs: Job[] = [];
  private next: string | null = null;
  private selected: string | null = null;

  constructor() {
    this.element = h("section", { class: "card", "aria-labelledby": "jobs-title" });
    this.element.append(h("h2", { id: "jobs-title" }, "Jobs"), this.empty, this.items, this.older);
  }

  /** True while a listed job may still change. */
  get busy(): boolean {
    return this.jobs.some((job) => !isFinal(job.status));
  }

  /** Ask for the newest page and show it; jobs of older pages stay as they are. Returns what was learned. */
  async refresh(): Promise<Job[]> {
    const page = await listJobs();
    const fresh = new Set(page.jobs.map((job) => job.id));
    const oldest = page.jobs.at(-1)?.created_at;
    // Beyond the newest page only what is older than it can still exist unseen; the rest has been deleted.
    const kept = this.jobs.filter((job) => !fresh.has(job.id) && page.next !== null && oldest !== undefined && job.created_at < oldest);
    if (kept.length === 0) this.next = page.next;
    this.jobs = [...page.jobs, ...kept];
    this.show();
    return page.jobs;
  }

  private async more(): Promise<void> {
    if (this.next === null) return;
    const page = await listJobs(this.next).catch((refusal: Refusal) => refusal);
    if (page instanceof Error) return;
    const known = new Set(this.jobs.map((job) => job.id));
    this.jobs.push(...page.jobs.filter((job) => !known.has(job.id)));
    this.next = page.next;
    this.show();
  }

  /** Put in what has just been learned about one job. */
  update(job: Job): void {
    const at = this.jobs.findIndex((one) => one.id === job.id);
    if (at >= 0) this.jobs[at] = job;
    else this.jobs.unshift(job);
    this.show();
  }

  remove(id: string): void {
    this.jobs = this.jobs.filter((job) => job.id !== id);
    this.show();
  }

  select(id: string | null): void {
    this.selected = id;
    this.show();
  }

  private show(): void {
    this.empty.hidden = this.jobs.length > 0;
    this.older.hidden = this.next === null;
    const shown = new Set(this.jobs.map((job) => job.id));
    for (const [id, row] of this.rows) {
      if (shown.has(id)) continue;
      row.element.remove();
      this.rows.delete(id);
    }
    this.jobs.forEach((job, index) => {
      const row = this.rows.get(job.id) ?? this.row(job.id);
      this.write(row, job);
      if (this.items.children[index] !== row.element) this.items.insertBefore(row.element, this.items.children[index] ?? null);
    });
  }

  private row(id: string): Row {
    const name = h("span", { class: "job-name" });
    const about = h("span", { class: "muted small" });
    const status = h("span", { class: "status" });
    const meter = h("progress", { max: 1, value: 0, "aria-hidden": "true" });
    const link = h("a", { href: `#job=${encodeURIComponent(id)}` }, name, status, about, meter);
    const row = { element: h("li", {}, link), link, name, about, status, meter };
    this.rows.set(id, row);
    return row;
  }

  private write(row: Row, job: Job): void {
    const seen = job.interpretation;
    say(row.name, title(job));
    say(row.about, `${count(seen.num_frames, "frame")}, ${count(seen.num_points, "point")}, ${ago(job.created_at)}`);
    fill(row.status, job.status, () => [STATUS_WORDS[job.status]]);
    row.status.dataset["status"] = job.status;
    row.meter.hidden = job.status !== "running";
    row.meter.value = job.progress?.fraction ?? 0;
    if (job.id === this.selected) row.link.setAttribute("aria-current", "true");
    else row.link.removeAttribute("aria-current");
  }
}
