// The list of jobs, newest first.

import { listJobs } from "./api";
import { button, fill, h, say } from "./dom";
import { follow } from "./events";
import { newer, progressed } from "./news";
import { explained } from "./refusal";
import { type Job, type Progress, isFinal, ofFilm } from "./types";
import { badge, headline, verdictOf } from "./verdict";
import { STATUS_WORDS, ago, count, percent, title } from "./words";

/** Number of running jobs followed besides the one that is shown; browsers open at most six connections to a host. */
const FOLLOWED = 2;

interface Row {
  element: HTMLLIElement;
  link: HTMLAnchorElement;
  name: HTMLElement;
  about: HTMLElement;
  status: HTMLElement;
  meter: HTMLProgressElement;
}

export class JobList {
  readonly element: HTMLDetailsElement;
  private readonly items = h("ol", { class: "jobs" });
  private readonly empty = h("p", { class: "muted" }, "No jobs yet.");
  private readonly older = button("Older jobs", () => void explained(this.older, () => this.more()), { class: "link", hidden: true });
  private readonly rows = new Map<string, Row>();
  private readonly followed = new Map<string, AbortController>();
  private jobs: Job[] = [];
  private next: string | null = null;
  /** Whether older pages are shown, after which `next` follows. */
  private paged = false;
  private selected: string | null = null;
  /** The selected job that the list was last scrolled to. */
  private revealed: string | null = null;
  /** Whether the newest page has arrived; until then the list may contain only the job that is shown. */
  private listed = false;

  constructor() {
    const summary = h("summary", {}, h("h2", { id: "jobs-title" }, "Jobs"));
    this.element = h("details", { class: "card", open: true }, summary, this.empty, this.items, this.older);
  }

  /** True while a listed job is not final. */
  get busy(): boolean {
    return this.jobs.some((job) => !isFinal(job.status));
  }

  /** Fetch, show and return the newest page; jobs of older pages stay as they are. */
  async refresh(): Promise<Job[]> {
    const page = await listJobs();
    const fresh = new Set(page.jobs.map((job) => job.id));
    const oldest = page.jobs.at(-1)?.created_at;
    // A job missing from the newest page still exists only if it is older than that page; otherwise it was deleted.
    const kept = this.jobs.filter((job) => !fresh.has(job.id) && page.next !== null && oldest !== undefined && job.created_at < oldest);
    this.paged &&= kept.length > 0;
    if (!this.paged) this.next = page.next;
    this.listed = true;
    const known = new Map(this.jobs.map((job) => [job.id, job]));
    this.jobs = [...page.jobs.map((job) => newer(known.get(job.id) ?? null, job) ?? (known.get(job.id) as Job)), ...kept];
    this.show();
    return page.jobs;
  }

  private async more(): Promise<void> {
    if (this.next === null) return;
    const page = await listJobs(this.next);
    const known = new Set(this.jobs.map((job) => job.id));
    this.jobs.push(...page.jobs.filter((job) => !known.has(job.id)));
    this.next = page.next;
    this.paged = true;
    this.show();
  }

  /** Update one job in the list, or add it. */
  update(job: Job): void {
    const at = this.jobs.findIndex((one) => one.id === job.id);
    if (at >= 0) this.jobs[at] = newer(this.jobs[at] ?? null, job) ?? (this.jobs[at] as Job);
    else this.jobs.push(job);
    this.show();
  }

  /** Follow the events of the first running jobs; `Detail` follows the one that is shown. */
  private followRunning(): void {
    const running = this.jobs.filter((job) => job.id !== this.selected && (job.status === "running" || job.status === "cancelling"));
    const wanted = new Set(running.slice(0, FOLLOWED).map((job) => job.id));
    for (const [id, leaving] of this.followed) {
      if (wanted.has(id)) continue;
      leaving.abort();
      this.followed.delete(id);
    }
    for (const id of wanted) if (!this.followed.has(id)) this.follow(id);
  }

  private follow(id: string): void {
    const leaving = new AbortController();
    this.followed.set(id, leaving);
    const follower = {
      onJob: (job: Job) => this.update(job),
      onProgress: (progress: Progress) => {
        const job = progressed(this.jobs.find((one) => one.id === id) ?? null, progress);
        if (job) this.update(job);
      },
      onTrouble: () => undefined, // the next refresh of the list reports it at the top of the page
    };
    // Following ends early if the service refuses, for example without a token; the next refresh of the list begins it again.
    void follow(id, follower, leaving.signal).finally(() => {
      if (this.followed.get(id) === leaving) this.followed.delete(id);
    });
  }

  has(id: string): boolean {
    return this.jobs.some((job) => job.id === id);
  }

  remove(id: string): void {
    this.jobs = this.jobs.filter((job) => job.id !== id);
    this.show();
  }

  select(id: string | null): void {
    this.selected = id;
    this.show();
  }

  /** Scroll the list to the selected job, once for each selection; the page itself stays where it is. */
  private reveal(): void {
    const row = this.selected === null ? undefined : this.rows.get(this.selected);
    if (row === undefined || !this.listed || this.revealed === this.selected) return;
    this.revealed = this.selected;
    const [list, item] = [this.items.getBoundingClientRect(), row.element.getBoundingClientRect()];
    this.items.scrollTop += Math.max(0, item.bottom - list.bottom) + Math.min(0, item.top - list.top);
  }

  private show(): void {
    this.jobs.sort((one, other) => (one.created_at < other.created_at ? 1 : one.created_at > other.created_at ? -1 : 0));
    this.followRunning();
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
    this.reveal();
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
    const sizes = [seen.num_frames > 0 && count(seen.num_frames, "frame"), seen.num_points > 0 && count(seen.num_points, "point")];
    const about = [ofFilm(job) && "film", ...sizes, ago(job.created_at)].filter(Boolean).join(", ");
    say(row.about, about);
    const verdict = verdictOf(job);
    fill(row.status, verdict ? headline(verdict, job) : place(job), () => [verdict ? badge(verdict, job) : place(job)]);
    row.status.dataset["status"] = job.status;
    row.meter.hidden = job.status !== "running";
    row.meter.value = job.progress?.fraction ?? 0;
    if (job.id === this.selected) row.link.setAttribute("aria-current", "true");
    else row.link.removeAttribute("aria-current");
  }
}

/** The status in a few words, with the progress or the number of jobs ahead. */
function place(job: Job): string {
  const { status, progress, place_in_queue: ahead } = job;
  if (status === "running" && progress) return `${STATUS_WORDS[status]}, ${percent(Math.round(100 * progress.fraction) / 100)}`;
  if (status === "queued" && ahead !== null) return ahead === 0 ? "Next" : `${ahead} ahead`;
  return STATUS_WORDS[status];
}
