// A refusal as a sentence, with what was expected, what came, and the ways on.

import { button, h } from "./dom";
import type { Problem } from "./types";

/** Codes that the page itself gives: the service has no explanation of them. */
const OURS = ["unreachable", "unknown", "no_events"];

/** What to do, where the service's own words are about requests. */
const ON_THE_PAGE: Record<string, string> = {
  film_as_tracks: "Choose it under Film instead: its points are followed for you.",
  unknown_format: "Choose a file of one of these kinds; the guide shows an example of each.",
  picture_as_tracks: "Depth comes from motion: choose a film, or a zip of all its pictures, under Film.",
  member_name: "Give the arrays in the file plain names without folders, such as tracks and visibility, and save it again.",
  duplicate_member: "Give each array in the file a name of its own, and save it again.",
};

/** What the service advises about an option, and what a person does on the page instead. */
const SCHEMA = "Compare with the schema at /v1/options.";
const FIELD = "Change the value, or clear the field for the default.";

/**
 * Make the box that shows a problem. `choose` is called with the reading a person picks where several fit; `inPlace` means that
 * the box stands where the fault is, which need not be named again.
 */
export function refusalBox(problem: Problem, choose?: ((choice: Record<string, unknown>) => void) | null, inPlace = false): HTMLElement {
  const whole = inPlace ? unnamed(problem) : problem.detail;
  const hintInside = Boolean(problem.hint && whole.endsWith(problem.hint));
  const detail = hintInside ? whole.slice(0, -(problem.hint as string).length).trim() : whole;
  const facts: [string, string | null | undefined][] = [
    ["Where", problem.field],
    ["Expected", problem.expected],
    ["Got", problem.got],
  ];
  const shown = inPlace ? [] : facts.filter(([, value]) => value && !detail.includes(value));
  const advice = (inPlace && ON_THE_PAGE[problem.code]) || problem.hint?.replace(SCHEMA, FIELD);
  const hint = advice && (hintInside || !whole.includes(advice)) ? h("p", {}, ...withCode(advice)) : null;
  const list = h("dl", { class: "facts" }, ...shown.flatMap(([term, value]) => [h("dt", {}, term), h("dd", {}, value as string)]));
  const choices = choose ? (problem.choices ?? []).map((choice) => choiceButton(choice, choose)) : [];
  return h(
    "div",
    { class: "refusal", role: "alert" },
    h("p", { class: "sentence" }, detail),
    shown.length > 0 && list,
    hint,
    choices.length > 0 && h("div", { class: "row", role: "group", "aria-label": "Possible interpretations" }, ...choices),
    h("p", { class: "row small" }, ...helpLinks(problem), h("span", { class: "code" }, problem.code)),
  );
}

/** Text between backticks as code. */
function withCode(text: string): (Node | string)[] {
  return text.split("`").map((part, index) => (index % 2 === 1 ? h("code", {}, part) : part));
}

/** The sentence without the name of the field, which is the service's word for the place where it is shown. */
function unnamed({ detail, field }: Problem): string {
  if (!field || !detail.startsWith(`${field}: `)) return detail;
  const rest = detail.slice(field.length + 2);
  return rest.charAt(0).toUpperCase() + rest.slice(1);
}

/** Where a person can read on: the guide's section on the kind of file, and the explanation of the code. */
function helpLinks({ code, field }: Problem): HTMLElement[] {
  const links: HTMLElement[] = [];
  const section = GUIDE[(field ?? "").split(".")[0] ?? ""];
  if (section) links.push(h("a", { href: `guide#${section}`, target: "_blank" }, `What ${section === "films" ? "films" : "files"} can I send?`));
  // The guide explains what the page itself reports.
  const about = OURS.includes(code) ? "guide#errors" : `errors/${code}`;
  links.push(h("a", { href: about, target: "_blank" }, "About this error"));
  return links;
}

const GUIDE: Record<string, string> = {
  tracks: "tracks",
  mesh: "meshes",
  ground_truth: "truth",
  rotations: "truth",
  film: "films",
  region: "films",
};

function choiceButton(choice: Record<string, unknown>, choose: (choice: Record<string, unknown>) => void): HTMLElement {
  const { layout, evidence, options } = choice;
  const values = (options ?? {}) as Record<string, unknown>;
  const words = layout ?? Object.entries(values).map(([name, value]) => `${name}: ${String(value)}`).join(", ");
  return button(String(words), () => choose(values), { title: evidence === undefined ? null : String(evidence) });
}
