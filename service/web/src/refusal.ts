// A refusal as a sentence, with what was expected, what came, and the ways on.

import { button, h } from "./dom";
import type { Problem } from "./types";

/** Make the box that shows a problem; `choose` is called with the reading a person picks where several fit. */
export function refusalBox(problem: Problem, choose?: (choice: Record<string, unknown>) => void): HTMLElement {
  const facts: [string, string | null | undefined][] = [
    ["Where", problem.field],
    ["Expected", problem.expected],
    ["Got", problem.got],
  ];
  const shown = facts.filter(([, value]) => value);
  const hint = problem.hint && !problem.detail.includes(problem.hint) ? h("p", {}, problem.hint) : null;
  const list = h("dl", { class: "facts" }, ...shown.flatMap(([term, value]) => [h("dt", {}, term), h("dd", {}, value as string)]));
  const choices = choose ? (problem.choices ?? []).map((choice) => choiceButton(choice, choose)) : [];
  return h(
    "div",
    { class: "refusal", role: "alert" },
    h("p", { class: "sentence" }, problem.detail),
    shown.length > 0 && list,
    hint,
    choices.length > 0 && h("div", { class: "row", role: "group", "aria-label": "Possible interpretations" }, ...choices),
    h("p", { class: "code" }, problem.code),
  );
}

function choiceButton(choice: Record<string, unknown>, choose: (choice: Record<string, unknown>) => void): HTMLElement {
  const { layout, evidence, options } = choice;
  const values = (options ?? {}) as Record<string, unknown>;
  const words = layout ?? Object.entries(values).map(([name, value]) => `${name}: ${String(value)}`).join(", ");
  return button(String(words), () => choose(values), { title: evidence === undefined ? null : String(evidence) });
}
