// Building elements without a framework and without HTML strings: text can never become markup.

type Child = Node | string | null | undefined | false;
type Attributes = Record<string, string | number | boolean | ((event: never) => void) | null | undefined>;

/** Make an element. Attributes named on… are listeners; true sets an empty attribute; false and null omit it. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  decorate(element, attributes);
  element.append(...children.filter((child): child is Node | string => Boolean(child)));
  return element;
}

/** Make an SVG element. */
export function svg(tag: string, attributes: Attributes = {}, ...children: Node[]): SVGElement {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  decorate(element, attributes);
  element.append(...children);
  return element;
}

function decorate(element: Element, attributes: Attributes): void {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(name.slice(2), value as EventListener);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
}

/** Replace an element's children only if `key` has changed, so that focus and selection survive an update without changes. */
export function fill(element: Element, key: string, make: () => Child[]): void {
  if (element.getAttribute("data-shows") === key) return;
  element.setAttribute("data-shows", key);
  element.replaceChildren(...make().filter((child): child is Node | string => Boolean(child)));
}

/** Set text only if it differs, so that screen readers do not announce it twice. */
export function say(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

/** A button. */
export function button(label: string, onclick: () => void, attributes: Attributes = {}): HTMLButtonElement {
  return h("button", { type: "button", onclick, ...attributes }, label);
}

let made = 0;

/** Return an id that is unique on the page. */
export function uniqueId(stem: string): string {
  made += 1;
  return `${stem}-${made}`;
}
