// The verdict on a result: a badge with icon and text, the expected error, and the reasons.

import { fill, h, svg } from "./dom";
import type { Job, Verdict } from "./types";
import { percent, unbroken } from "./words";

const VERDICTS: Record<Verdict, string> = { good: "Good", with_care: "Use with care", do_not_use: "Do not use" };

/** A shape for each verdict, so that colour is not the only difference. */
const ICONS: Record<Verdict, [outline: string, sign: string]> = {
  good: ["M8 1a7 7 0 1 0 0 14A7 7 0 0 0 8 1z", "M4.7 8.3l2.3 2.3 4.4-4.9"],
  with_care: ["M8 1.2L15.4 14.4H.6z", "M8 5.6v4.2M8 11.9v.6"],
  do_not_use: ["M5 1h6l4 4v6l-4 4H5l-4-4V5z", "M5.4 5.4l5.2 5.2M10.6 5.4l-5.2 5.2"],
};

/** Start of the service's sentence on a result whose error it cannot estimate. */
const UNESTIMATED = "The error is not estimated";

/** Return the verdict in words; a verdict without an error estimate must not read like one that has it. */
export function headline(verdict: Verdict, job: Job): string {
  return isUnestimated(job) ? `${VERDICTS[verdict]}, error not estimated` : VERDICTS[verdict];
}

function isUnestimated(job: Job): boolean {
  return job.trust_sentence?.startsWith(UNESTIMATED) ?? false;
}

/** Return the sentence on the expected error; without an estimate, which the badge states, only what depth rests on. */
function trustOf(job: Job): string {
  const sentence = job.trust_sentence ?? "";
  if (!isUnestimated(job)) return sentence;
  const rest = sentence.slice(UNESTIMATED.length).replace(/^; /, "");
  return rest.charAt(0).toUpperCase() + rest.slice(1);
}

/** Return the badge of a verdict. */
export function badge(verdict: Verdict, job: Job): HTMLElement {
  const [outline, sign] = ICONS[verdict];
  const icon = svg(
    "svg",
    { viewBox: "0 0 16 16", width: 16, height: 16, "aria-hidden": "true" },
    svg("path", { d: outline, class: "badge-outline" }),
    svg("path", { d: sign, class: "badge-sign" }),
  );
  return h("span", { class: isUnestimated(job) ? "badge unestimated" : "badge", "data-verdict": verdict }, icon, headline(verdict, job));
}

/** Return the verdict of a finished job, or null if it has none or an unknown one. */
export function verdictOf(job: Job): Verdict | null {
  const { status, verdict } = job;
  return status === "succeeded" && verdict && verdict in VERDICTS ? verdict : null;
}

/** The section "Verdict", hidden for jobs without one. */
export class VerdictBox {
  private readonly badge = h("p", {});
  private readonly trust = h("p", { class: "trust" });
  private readonly interval = h("p", {});
  private readonly evidence = h("dl", { class: "evidence" });
  private readonly figures = h("details", { hidden: true }, h("summary", {}, "Figures behind the verdict"), this.evidence);
  private readonly reasons = h("ul", { class: "reasons" });
  private readonly outcome = h("p", { class: "outcome" });
  readonly element = h(
    "section",
    { class: "verdict", "aria-labelledby": "verdict-title", hidden: true },
    h("h3", { id: "verdict-title", class: "visually-hidden" }, "Verdict"),
    this.badge,
    this.trust,
    this.interval,
    this.reasons,
    this.outcome,
    this.figures,
  );

  show(job: Job): void {
    const verdict = verdictOf(job);
    this.element.hidden = verdict === null;
    if (verdict === null) return;
    this.element.dataset["verdict"] = verdict;
    const reasons = job.verdict_reasons ?? [];
    fill(this.badge, headline(verdict, job), () => [badge(verdict, job)]);
    const trust = trustOf(job);
    fill(this.trust, trust, () => [unbroken(trust)]);
    fill(this.reasons, reasons.join("\n"), () => reasons.map((reason) => h("li", {}, unbroken(reason))));
    fill(this.outcome, job.sentence ?? "", () => [job.sentence && `Solver: ${job.sentence}`]);
  }

  /** Show what only the report contains: the interval of the expected error and the figures behind the verdict. */
  report(report: Record<string, unknown>): void {
    const interval = report["expected_error_interval"];
    const [low, high] = Array.isArray(interval) ? interval.map(Number) : [];
    const words =
      low === undefined || high === undefined ? "" : `Likely range of the true error: ${percent(low)} to ${percent(high)} (correct in three of four test sequences; the error can be larger where a motion of the camera would explain the deformation as well).`;
    fill(this.interval, words, () => [words]);
    const rows = evidenceOf(report);
    this.figures.hidden = rows.length === 0;
    fill(this.evidence, JSON.stringify(rows), () => rows.map(([term, value]) => h("div", {}, h("dt", {}, term), h("dd", {}, value))));
  }
}

/** Return the figures behind the verdict, each with its unit, as far as the report contains them. */
function evidenceOf(report: Record<string, unknown>): [string, string][] {
  const degrees = (value: number): string => `${value < 10 ? Number(value.toPrecision(2)) : Math.round(value)}°`;
  const share = (value: number): string => `${value < 0.0005 ? "below 0.1\u00a0%" : percent(value)} of the object's size`;
  const known: [name: string, term: string, words: (value: number) => string][] = [
    ["turn_degrees", "Turn between the most different views", degrees],
    ["degrees_per_frame", "Turn per frame (median)", degrees],
    ["deformation_per_frame", "Change of shape per frame (median)", share],
    ["held_out_error", "Prediction error of held-out observations (median)", share],
  ];
  return known.flatMap(([name, term, words]) => {
    const value = report[name];
    return typeof value === "number" ? [[term, words(value)] as [string, string]] : [];
  });
}
