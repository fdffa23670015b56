// One job: its state, the interpretation of its inputs, and its result.

import { Refusal, artifactPath, cancelJob, deleteJob, getJob, getReport, isShared, isSingle, listJobs, retryJob } from "./api";
import { Afterwards } from "./afterwards";
import { Countdown } from "./countdown";
import { Curves } from "./curves";
import { button, fill, h, say } from "./dom";
import { follow } from "./events";
import { refusalBox } from "./refusal";
import { Figures } from "./figures";
import { LiveTracks } from "./live";
import { newer, progressed } from "./news";
import { Files, Metrics, Sheet, Warnings, saveLink } from "./results";
import { rememberSame } from "./sent";
import { Snippets } from "./snippets";
import { Tab } from "./tab";
import { type Job, type Progress, isFinal } from "./types";
import { Understood } from "./understood";
import { VerdictBox } from "./verdict";
import type { Other } from "./viewer/companion";
import type { Sources } from "./viewer/viewer";
import { STATUS_WORDS, ago, bytes, percent, state, timeLeft, title } from "./words";

export interface DetailEvents {
  onJob: (job: Job) => void;
  onDeleted: (id: string) => void;
}

const PREVIEW = "preview.bin";
const FILM = "film_frames.bin";
const USDZ = "shapes.usdz";
const ANIMATION = "shapes.glb";

export class Detail {
  readonly element: HTMLElement;
  private readonly heading = h("h2", { tabindex: -1, id: "job-title" });
  private readonly status = h("span", { class: "status" });
  private readonly when = h("span", { class: "muted" });
  private readonly actions = h("div", { class: "row actions" });
  private readonly verdict = new VerdictBox();
  private readonly figures = new Figures();
  private readonly state = h("span", { role: "status" });
  /** Outside the status, which would be announced every second. */
  private readonly left = h("span", {});
  private readonly standing = h("p", { class: "standing" }, this.state, this.left);
  private readonly meter = h("progress", { max: 1, value: 0, "aria-label": "Progress of this job" });
  private readonly share = h("span", { class: "muted" });
  private readonly trouble = h("div", { class: "trouble" });
  private readonly failure = h("div", {});
  private readonly stage = h("div", { class: "stage", hidden: true });
  private readonly curves = new Curves();
  private readonly understood = new Understood();
  private readonly metrics = new Metrics();
  private readonly warnings = new Warnings();
  private readonly tab = new Tab();
  private readonly live: LiveTracks;
  private readonly countdown = new Countdown((job) => this.showProgress(job));
  private readonly sheet = new Sheet();
  private readonly files = new Files();
  private readonly snippets = new Snippets();
  private readonly afterwards = new Afterwards();
  private readonly leaving = new AbortController();
  private job: Job | null = null;
  private finished = false;
  /** Whether the job was deleted elsewhere. */
  private gone = false;

  constructor(
    readonly id: string,
    private readonly events: DetailEvents,
  ) {
    this.live = new LiveTracks(id);
    this.element = h(
      "article",
      { class: "detail", "aria-labelledby": "job-title" },
      h("header", { class: "detail-head" }, h("div", {}, this.heading, h("p", { class: "row" }, this.status, this.when)), this.actions),
      this.verdict.element,
      this.warnings.element,
      this.standing,
      h("div", { class: "meter" }, this.meter, this.share, this.tab.element),
      this.trouble,
      this.failure,
      this.live.element,
      this.stage,
      this.afterwards.element,
      this.figures.element,
      this.sheet.element,
      this.curves.element,
      h("div", { class: "panels" }, h("div", {}, this.metrics.element), h("div", {}, this.understood.element, this.files.element)),
      this.snippets.element,
    );
    void this.follow();
  }

  /** Stop following the job and release the graphics card. */
  close(): void {
    this.leaving.abort();
    this.countdown.stop();
    this.tab.leave();
    this.live.close();
  }

  focus(): void {
    this.heading.focus({ preventScroll: true });
    if (this.element.getBoundingClientRect().top > innerHeight * 0.5) {
      const smooth = !matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.element.scrollIntoView({ behavior: smooth ? "smooth" : "auto" });
    }
  }

  private async follow(): Promise<void> {
    const follower = {
      onJob: (job: Job) => {
        this.curves.job(job);
        this.learn(job);
      },
      onProgress: (progress: Progress) => this.progress(progress),
      onTrouble: (refusal: Refusal | null) => {
        this.element.classList.toggle("unknown", refusal !== null && this.job === null);
        if (refusal && this.job === null) say(this.heading, refusal.problem.status === 404 ? "This job does not exist" : "This job cannot be shown");
        this.tell(refusal);
        // The last estimate of the remaining time may be wrong by now.
        if (refusal && this.job?.progress) this.countdown.show({ ...this.job, progress: { ...this.job.progress, seconds_left: null } });
      },
    };
    await follow(this.id, follower, this.leaving.signal);
  }

  /** Show an error above the result, once; null removes it. */
  private tell(refusal: Refusal | null): void {
    fill(this.trouble, refusal ? JSON.stringify(refusal.problem) : "", () => (refusal ? [refusalBox(refusal.problem)] : []));
  }

  /** An event stream starts with past events: they complete the curves, but must not reset the progress. */
  private progress(progress: Progress): void {
    this.curves.progress(progress);
    const job = progressed(this.job, progress);
    if (job) this.show(job);
  }

  /** Show a record unless it is older than the one shown. */
  learn(job: Job): void {
    const news = newer(this.job, job);
    if (news) this.show(news);
  }

  /** Fetch the record again, because the list lacks this job: say so if it was deleted elsewhere. */
  async check(): Promise<void> {
    if (this.job === null || this.gone) return;
    try {
      this.learn(await getJob(this.id));
    } catch (error) {
      if (!(error instanceof Refusal && error.problem.status === 404) || this.leaving.signal.aborted) return;
      this.gone = true;
      this.tell(new Refusal({ ...error.problem, detail: "This job was deleted. What is still shown here cannot be opened again.", hint: null }));
      this.actions.replaceChildren();
      for (const part of [this.standing, this.afterwards.element, this.files.element]) part.hidden = true;
    }
  }

  private show(job: Job): void {
    this.job = job;
    say(this.heading, title(job));
    say(this.status, STATUS_WORDS[job.status]);
    this.status.dataset["status"] = job.status;
    say(this.when, `${isFinal(job.status) ? "" : "submitted "}${ago(job.created_at)}${job.expires_at && !isShared() ? `, kept until ${new Date(job.expires_at).toLocaleDateString()}` : ""}`);
    this.countdown.show(job);
    this.tab.show(job);
    this.live.show(job);
    this.showMeter(job);
    this.showActions(job);
    fill(this.failure, JSON.stringify(job.error), () => (job.error ? [refusalBox(job.error)] : []));
    this.verdict.show(job);
    this.warnings.show(job);
    this.understood.show(job);
    this.metrics.show(job);
    this.sheet.show(job);
    this.files.show(job);
    if (!isShared()) this.snippets.show(job); // it is hidden there, and the link may not read the options
    this.afterwards.show(job);
    this.events.onJob(job);
    if (job.status === "succeeded" && !this.finished) {
      this.finished = true;
      void this.showResult(job);
    }
  }

  /** Show what changes with time: the progress with the current remaining time. */
  private showProgress(job: Job): void {
    const words = job.status === "failed" ? "" : state(job);
    this.standing.hidden = words === "";
    say(this.state, words);
    say(this.left, timeLeft(job));
    this.figures.show(job);
  }

  private showMeter(job: Job): void {
    const running = job.status === "running" || job.status === "cancelling";
    (this.meter.parentElement as HTMLElement).hidden = !running;
    this.meter.value = job.progress?.fraction ?? 0;
    say(this.share, percent(this.meter.value));
  }

  private showActions(job: Job): void {
    const actions: [string, () => Promise<unknown>][] = [];
    if (job.status === "queued" || job.status === "running") actions.push(["Cancel", () => cancelJob(job.id)]);
    if (job.status === "failed" || job.status === "cancelled") actions.push(["Try again", () => retryJob(job.id)]);
    if (isFinal(job.status)) actions.push(["Delete", () => deleteJob(job.id)]);
    const mesh = job.artifacts.find((artifact) => artifact.name === ANIMATION);
    fill(this.actions, [mesh?.sha256, ...actions.map(([label]) => label)].join(), () => [
      mesh && saveLink(job, mesh, "Download glTF", "button primary"),
      ...actions.map(([label, act]) => this.action(label, act)),
    ]);
  }

  private action(label: string, act: () => Promise<unknown>): HTMLButtonElement {
    let sure = label !== "Delete";
    const made = button(label, () => {
      if (!sure) {
        sure = true;
        made.textContent = "Delete permanently?";
        made.classList.add("danger");
        setTimeout(() => {
          sure = false;
          made.textContent = label;
          made.classList.remove("danger");
        }, 4000);
        return;
      }
      made.disabled = true;
      act()
        .then((answer) => this.acted(label, answer as Job | undefined))
        .catch((error: unknown) => {
          made.disabled = false;
          if (!(error instanceof Refusal)) throw error;
          this.tell(error);
        });
    }, { class: label === "Delete" ? "quiet" : null });
    return made;
  }

  private acted(label: string, job: Job | undefined): void {
    if (label === "Delete") this.events.onDeleted(this.id);
    if (job && job.id !== this.id) rememberSame(job.id, this.id);
    if (!job || this.leaving.signal.aborted) return;
    this.tell(null);
    if (job.id !== this.id) {
      location.hash = `job=${encodeURIComponent(job.id)}`;
      return;
    }
    this.show(job);
    this.heading.focus({ preventScroll: true });
  }

  private async showResult(job: Job): Promise<void> {
    const preview = job.artifacts.find((artifact) => artifact.name === PREVIEW);
    if (job.artifacts.some((artifact) => artifact.name === "report.json")) {
      getReport(job.id)
        .then((report) => {
          this.curves.report(report);
          this.verdict.report(report);
        })
        .catch((error: unknown) => {
          if (!(error instanceof Refusal)) throw error; // the charts keep their live values
        });
    }
    if (!preview) return;
    this.stage.hidden = false;
    this.stage.replaceChildren(h("p", { class: "view waiting" }, `Loading the mesh, ${bytes(preview.bytes)}…`));
    try {
      const { Viewer } = await import("./viewer/viewer");
      if (this.leaving.signal.aborted) return;
      await Viewer.open(this.stage, this.sources(job), this.leaving.signal);
    } catch (error) {
      if (this.leaving.signal.aborted) return;
      const words = error instanceof Error ? error.message : String(error);
      const sentence = `The mesh cannot be displayed here (${words}). The files below are complete; shapes.glb opens in any 3-D viewer.`;
      this.stage.replaceChildren(h("p", { class: "view waiting" }, sentence));
    }
  }

  private sources(job: Job): Sources {
    const path = (name: string): string | undefined =>
      job.artifacts.some((artifact) => artifact.name === name) ? artifactPath(job.id, name) : undefined;
    const others = async (): Promise<Other[]> => {
      const { jobs } = await listJobs();
      const finished = jobs.filter((one) => one.id !== job.id && one.artifacts.some(({ name }) => name === PREVIEW));
      return finished.map((one) => ({ id: one.id, title: title(one), preview: artifactPath(one.id, PREVIEW) }));
    };
    return {
      title: title(job),
      preview: artifactPath(job.id, PREVIEW),
      film: path(FILM),
      usdz: path(USDZ),
      ...(isSingle() ? {} : { others }),
    };
  }
}
