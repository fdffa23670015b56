// Small controls of the viewer: labelled selectors and checkboxes.

import { h, uniqueId } from "../dom";

export function choice(label: string, values: [string, string][], onValue: (value: string) => void): HTMLElement {
  const id = uniqueId("tool");
  const select = h("select", { id }, ...values.map(([value, words]) => h("option", { value }, words)));
  select.addEventListener("change", () => onValue(select.value));
  return h("span", { class: "tool" }, h("label", { for: id }, label), select);
}

export function toggle(label: string, onChange: (on: boolean) => void, name = "", on = false): HTMLElement {
  const box = h("input", { type: "checkbox", "data-tool": name || null });
  box.checked = on;
  box.addEventListener("change", () => onChange(box.checked));
  return h("label", { class: "chip" }, box, label);
}

/** A group of controls, labelled for screen readers. */
export function group(label: string, ...controls: (Node | false)[]): HTMLElement {
  return h("div", { class: "tool-group", role: "group", "aria-label": label }, ...controls);
}

export function ordinal(value: number): string {
  return `${value}${value === 2 ? "nd" : value === 3 ? "rd" : "th"}`;
}
