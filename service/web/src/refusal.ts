// An error message: a sentence, the expected and the actual value, advice, and links.

import { Refusal } from "./api";
import { button, h } from "./dom";
import type { Problem } from "./types";

/** Codes defined by the page: the service has no explanation of them. */
const OURS = ["unreachable", "unknown", "no_events"];

/** What to do on the page, where the service's hint is about requests. */
const ON_THE_PAGE: Record<string, string> = {
  film_as_tracks: "Choose it under Film instead; its points are tracked for you.",
  tracks_as_film: "Choose it under Tracks instead.",
  unknown_format: "Choose a file of one of these kinds; the guide shows an example of each.",
  picture_as_tracks: "Depth comes from motion: choose a film, or a zip of all its pictures, under Film.",
  member_name: "Save the file again with plain array names without folders, such as tracks and visibility.",
  duplicate_member: "Save the file again with a unique name for each array.",
};

/** Instead of the service's message about an HTTP header, which is of no use to a visitor. */
const GATE = "This service needs a token. Paste the token you were given; this page keeps it until you close the tab.";

/** The hint of the service about an option, and its replacement on the page. */
const SCHEMA = "Compare with the schema at /v1/options.";
const FIELD = "Change the value, or clear the field to use the default.";

/**
 * Return a box that shows a problem. `choose` is called with the interpretation that the user picks if several fit; `inPlace` means
 * that the box is next to the field concerned, so the field is not named again.
 */
export function refusalBox(given: Problem, choose?: ((choice: Record<string, unknown>) => void) | null, inPlace = false): HTMLElement {
  const header = given.field === "Authorization"; // an HTTP header means nothing to a visitor, who has a token or a link
  const problem = given.code === "unauthorized" ? { ...given, detail: GATE, field: null } : header ? { ...given, field: null } : given;
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

/** Do what a control asks for; an error is shown after the control until it is used again. */
export async function explained(control: HTMLElement, action: () => Promise<void>): Promise<void> {
  if (control.nextElementSibling?.matches(".refusal")) control.nextElementSibling.remove();
  try {
    await action();
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    control.after(refusalBox(error.problem));
  }
}

/** Text between backticks as code. */
function withCode(text: string): (Node | string)[] {
  return text.split("`").map((part, index) => (index % 2 === 1 ? h("code", {}, part) : part));
}

/** The sentence without the leading name of the field, which is clear from its position on the page. */
function unnamed({ detail, field }: Problem): string {
  if (!field || !detail.startsWith(`${field}: `)) return detail;
  const rest = detail.slice(field.length + 2);
  return rest.charAt(0).toUpperCase() + rest.slice(1);
}

/** Links to the guide's section on the kind of file, and to the explanation of the code. */
function helpLinks({ code, field }: Problem): HTMLElement[] {
  const links: HTMLElement[] = [];
  const section = GUIDE[(field ?? "").split(".")[0] ?? ""];
  if (section) links.push(h("a", { href: `guide#${section}`, target: "_blank" }, `What ${section === "films" ? "films" : "files"} can I send?`));
  // The guide explains the codes defined by the page.
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
