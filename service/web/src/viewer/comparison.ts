// Comparison with another job: its selection, its pane, its curve in the timeline, and the difference of the errors.

import { h, say } from "../dom";
import { ofSize } from "../words";
import { type Values, errorDifference } from "./colours";
import { Companion, type Other, meanError } from "./companion";
import { choice, group } from "./controls";
import type { Preview } from "./preview";
import type { Timeline } from "./timeline";

/** The parts of the viewer that a comparison changes. */
export interface Compared {
  preview: Preview;
  /** The name of this viewer's job. */
  title: string;
  timeline: Timeline;
  /** The element to which the other job's pane is added. */
  panes: HTMLElement;
  signal: AbortSignal;
  /** The colour selector, once it exists. */
  colours: () => HTMLSelectElement | null;
  paint: (values: Values) => void;
  repaint: () => void;
  /** Runs an action that may fail and shows the error. */
  guarded: (action: () => Promise<void>) => Promise<void>;
}

export class Comparison {
  /** The mean errors of both jobs, as text. */
  readonly summary = h("p", { class: "hint", role: "status" });
  companion: Companion | null = null;

  private readonly own: HTMLElement;
  private title = "";
  /** Ends what the last choice asked for. */
  private asking = new AbortController();

  constructor(private readonly parts: Compared) {
    parts.signal.addEventListener("abort", () => this.asking.abort());
    this.own = h("span", { class: "view-name" }, `${parts.title} (this job)`);
  }

  /** Return the difference of the errors; null if there is no other job, or if its points differ. */
  async difference(): Promise<Values | null> {
    const { preview, title, signal } = this.parts;
    return this.companion && errorDifference({ preview, title }, { preview: this.companion.preview, title: this.title }, signal);
  }

  /** Return the job selector; the jobs are fetched now, and again when it gets the focus. */
  choice(others: () => Promise<Other[]>): HTMLElement {
    let known: Other[] = [];
    const made = choice("Compare with", [["", "no other job"]], (id) => void this.show(known.find((one) => one.id === id) ?? null));
    const select = made.querySelector("select") as HTMLSelectElement;
    const load = (): void => {
      void this.parts.guarded(async () => {
        known = await others();
        const have = new Set([...select.options].map(({ value }) => value));
        select.append(...known.filter(({ id }) => !have.has(id)).map(({ id, title }) => h("option", { value: id }, title)));
      });
    };
    load();
    select.addEventListener("focus", load);
    return group("Compare", made);
  }

  private async show(other: Other | null): Promise<void> {
    const { timeline, panes, paint, repaint, guarded } = this.parts;
    this.asking.abort();
    this.asking = new AbortController();
    const { signal } = this.asking;
    await guarded(async () => {
      this.companion?.dispose();
      this.companion = null;
      timeline.compare(null);
      this.own.remove();
      say(this.summary, "");
      this.offerDifference(false);
      if (other === null) return;
      const companion = await Companion.open(other, signal);
      this.companion = companion;
      this.title = other.title;
      companion.element.append(h("span", { class: "view-name" }, other.title));
      panes.querySelector(".view:not(.film)")?.append(this.own);
      panes.append(companion.element);
      timeline.compare(companion.preview, other.title);
      const values = await this.difference();
      signal.throwIfAborted();
      if (values) {
        this.offerDifference(true);
        paint(values);
      }
      say(this.summary, this.words(other, companion.preview, values !== null));
      repaint();
    });
  }

  /** Add the difference of errors to the colours and select it, or remove it and return to the first colours. */
  private offerDifference(on: boolean): void {
    const select = this.parts.colours();
    if (select === null) return;
    const shown = select.value === "difference";
    select.querySelector("option[value=difference]")?.remove();
    if (on) select.append(h("option", { value: "difference", selected: true }, "error difference"));
    if (on) select.value = "difference";
    else if (shown) {
      select.selectedIndex = 0;
      select.dispatchEvent(new Event("change"));
    }
  }

  private words(other: Other, theirs: Preview, sharesPoints: boolean): string {
    const { preview } = this.parts;
    const name = [preview, theirs].every((one) => meanError(one, "error") !== null) ? "error" : "expected";
    const [here, there] = [meanError(preview, name), meanError(theirs, name)];
    const words = name === "error" ? "3-D error, measured against the ground truth" : "Expected error";
    const figures = here !== null && there !== null ? `${words}: this job ${ofSize(here)}, ${other.title} ${ofSize(there)}.` : "";
    const shares = sharesPoints ? "The colours show where this job's error is larger (red) or smaller (blue)." : "The two jobs do not have the same points, so errors are not compared point by point.";
    return `${figures} ${shares}`.trim();
  }
}
