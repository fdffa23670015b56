// Two small live charts: the objective and the residual after each reweighting.

import { h, svg } from "./dom";
import type { Job, Progress } from "./types";
import { number } from "./words";

interface Sample {
  step: number;
  value: number;
}

const WIDTH = 300;
const HEIGHT = 96;

export class Curves {
  readonly element = h("div", { class: "curves" });
  private attempt = 0;
  private readonly objective = new Curve("Objective", "the energy being minimised");
  private readonly residual = new Curve("Residual", "median reprojection residual, in the tracks' unit");

  constructor() {
    this.element.append(this.objective.element, this.residual.element);
    this.element.hidden = true;
  }

  /** Add the current progress of a running job. */
  progress(progress: Progress): void {
    if (progress.stage !== "reweight" && progress.stage !== "finish") return;
    if (progress.objective !== null) this.objective.add(progress.reweighting, progress.objective);
    if (progress.residual !== null) this.residual.add(progress.reweighting, progress.residual);
    this.show();
  }

  /** Show the complete trace from a finished job's report, including values that the page has missed. */
  report(report: Record<string, unknown>): void {
    const trace = (report["trace"] ?? {}) as Record<string, unknown>;
    this.objective.set(numbers(trace["objective"]));
    this.residual.set(numbers(trace["residual"]));
    this.show();
  }

  /** Add the progress in a record. A new attempt starts new curves. */
  job(job: Job): void {
    if (job.attempt !== this.attempt) {
      this.objective.clear();
      this.residual.clear();
      this.attempt = job.attempt;
    }
    if (job.progress) this.progress(job.progress);
  }

  private show(): void {
    this.element.hidden = this.objective.length < 2 && this.residual.length < 2;
    this.objective.draw();
    this.residual.draw();
  }
}

function numbers(given: unknown): number[] {
  return Array.isArray(given) ? given.filter((value): value is number => typeof value === "number") : [];
}

class Curve {
  readonly element: HTMLElement;
  private samples: Sample[] = [];
  private readonly now = h("output", { class: "now" });
  private readonly line = svg("polyline", { class: "curve-line" });
  private readonly dot = svg("circle", { class: "curve-dot", r: 3 });
  private readonly marks = svg("g", { class: "curve-marks" });
  private readonly chart: SVGElement;

  constructor(
    private readonly name: string,
    meaning: string,
  ) {
    this.chart = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img" }, this.marks, this.line, this.dot);
    const caption = h("figcaption", {}, h("span", { class: "curve-name" }, name), this.now, h("span", { class: "hint" }, meaning));
    this.element = h("figure", { class: "curve" }, caption, this.chart);
  }

  get length(): number {
    return this.samples.length;
  }

  /** Samples arrive in any order: first the current one, then past ones that the event stream repeats. */
  add(step: number, value: number): void {
    const at = this.samples.findIndex((sample) => sample.step >= step);
    if (at < 0) this.samples.push({ step, value });
    else this.samples.splice(at, this.samples[at]?.step === step ? 1 : 0, { step, value });
  }

  clear(): void {
    this.samples = [];
  }

  set(values: number[]): void {
    if (values.length > 0) this.samples = values.map((value, step) => ({ step, value }));
  }

  draw(): void {
    this.element.hidden = this.samples.length < 2;
    const first = this.samples[0];
    const last = this.samples.at(-1);
    if (!first || !last || this.samples.length < 2) return;
    const values = this.samples.map((sample) => sample.value);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    // A range of more than a decade gets a logarithmic axis; otherwise all but the first step would be a flat line.
    const logarithmic = low > 0 && high / low > 10;
    const scale = (value: number): number => (logarithmic ? Math.log10(value) : value);
    const span = scale(high) - scale(low) || 1;
    const x = (step: number): number => 4 + ((WIDTH - 8) * (step - first.step)) / (last.step - first.step || 1);
    const y = (value: number): number => 14 + (HEIGHT - 28) * (1 - (scale(value) - scale(low)) / span);
    const points = this.samples.map(({ step, value }) => `${x(step).toFixed(1)},${y(value).toFixed(1)}`);
    this.line.setAttribute("points", points.join(" "));
    this.dot.setAttribute("cx", x(last.step).toFixed(1));
    this.dot.setAttribute("cy", y(last.value).toFixed(1));
    this.marks.replaceChildren(...this.grid(y(high), y(low), high, low));
    this.now.textContent = number(last.value);
    const words = `${this.name} from ${number(first.value)} to ${number(last.value)} in ${this.samples.length} steps`;
    this.chart.setAttribute("aria-label", words);
  }

  private grid(top: number, bottom: number, high: number, low: number): SVGElement[] {
    const rule = (at: number): SVGElement => svg("line", { x1: 0, x2: WIDTH, y1: at, y2: at });
    const text = (at: number, value: number): SVGElement =>
      svg("text", { x: WIDTH, y: at, "text-anchor": "end" }, document.createTextNode(number(value)));
    return [rule(top), rule(bottom), text(top - 4, high), text(bottom + 11, low)];
  }
}
