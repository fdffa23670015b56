// The page: the form, the job list, and the job in the address (#job=…), so that a reload shows it again.

import { AGAIN } from "./afterwards";
import { Refusal, hasToken, setSingle, setToken } from "./api";
import { Compose } from "./compose";
import { Detail } from "./detail";
import { button, fill, h } from "./dom";
import { Hero } from "./hero";
import { JobList } from "./list";
import { refusalBox } from "./refusal";
import { openShared, sharedToken } from "./shared";
import type { Job } from "./types";
import { title } from "./words";

const trouble = document.getElementById("trouble") as HTMLElement;
const side = document.getElementById("side") as HTMLElement;
const main = document.getElementById("main") as HTMLElement;
const welcome = document.getElementById("welcome") as HTMLElement;
/** An error that affects the whole page, and the token form, which outlasts other errors: it may be half filled in. */
const [said, gate] = [h("div", {}), h("div", {})];
trouble.append(said, gate);

/** Opens the token form, since a token can be accepted and still lack the scope for what one wants to do. */
const another = button("Token", () => void askForToken(), { class: "quiet", title: "Use another token" });
another.hidden = !hasToken();
document.querySelector("header nav")?.append(another);
/** Whether the user opened the token form, which then stays although the service answers. */
let asked = false;

const list = new JobList();
const compose = new Compose((job: Job) => {
  list.update(job);
  location.hash = `job=${encodeURIComponent(job.id)}`;
});
side.append(compose.element, list.element);

document.getElementById("hero")?.append(new Hero().canvas);

let detail: Detail | null = null;

function show(id: string | null, byPerson: boolean): void {
  detail?.close();
  detail?.element.remove();
  detail = null;
  list.select(id);
  welcome.hidden = id !== null;
  // Showing a job collapses the form; on narrow screens, also the list.
  compose.element.open = id === null;
  list.element.open = id === null || !matchMedia("(max-width: 56rem)").matches;
  if (id === null) return;
  detail = new Detail(id, {
    onJob: (job) => list.update(job),
    onDeleted: (deleted) => {
      list.remove(deleted);
      if (detail?.id !== deleted) return; // another job was opened before the answer
      location.hash = "";
      compose.focus();
    },
  });
  main.append(detail.element);
  if (byPerson) detail.focus();
}

function named(): string | null {
  return new URLSearchParams(location.hash.slice(1)).get("job") || null;
}

/** Show an error that affects the whole page at the top, with a token form if a token is missing. */
function report(error: unknown): void {
  if (!(error instanceof Refusal)) return reportError(error); // the page keeps refreshing
  const { problem } = error;
  fill(said, JSON.stringify(problem), () => [refusalBox(problem)]);
  if (problem.status === 401 && gate.childElementCount === 0) gate.append(tokenForm());
}

/** Remove the error and the token form: the service has answered, or has a new token to judge. */
function clear(): void {
  fill(said, "", () => []);
  if (!asked) gate.replaceChildren();
}

function askForToken(): void {
  asked = true;
  gate.replaceChildren(tokenForm());
  gate.querySelector("input")?.focus();
}

/** Characters that a header can carry; with any other, every request would fail before it is sent. */
const TOKEN = /^[\x21-\x7e]+$/;

function tokenForm(): HTMLElement {
  const input = h("input", { type: "password", id: "token", autocomplete: "off", required: true });
  const form = h("form", { class: "row" }, h("label", { for: "token" }, "Token"), input, h("button", { type: "submit" }, "Use"));
  const use = (token: string): void => {
    setToken(token);
    asked = false;
    another.hidden = !hasToken();
    clear();
    show(named(), false);
    void start();
  };
  if (hasToken()) form.append(button(asked ? "Forget the token" : "Forget the rejected token", () => use(""), { class: "quiet" }));
  input.addEventListener("input", () => input.setCustomValidity(""));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const token = input.value.trim();
    if (TOKEN.test(token)) return use(token);
    input.setCustomValidity("A token has only ASCII letters, digits and signs. Copy it again.");
    input.reportValidity();
  });
  return form;
}

/** Offer the available examples. */
function offer(): void {
  const place = document.getElementById("try") as HTMLElement;
  const [tracks, film] = [compose.hasExample("tracks"), compose.hasExample("film")];
  place.hidden = !tracks && !film;
  place.replaceChildren(
    ...(tracks ? [button("Try it with a synthetic face", () => void compose.tryOut("tracks"), { class: "primary large" })] : []),
    ...(film ? [button("Try it with a film", () => void compose.tryOut("film"), { class: "large" })] : []),
  );
}

let loaded = false;

async function start(): Promise<void> {
  try {
    if (!loaded) await compose.load();
    loaded = true;
    offer();
    const jobs = await list.refresh();
    for (const job of jobs) if (job.id === detail?.id) detail.learn(job);
    if (detail && !list.has(detail.id)) void detail.check();
    clear();
  } catch (error) {
    report(error);
  }
}

/** Refresh the list: often while a job runs, rarely otherwise, never while the page is hidden. */
async function watch(): Promise<void> {
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, list.busy ? 2000 : 8000));
    if (!document.hidden) await start();
  }
}

document.addEventListener(AGAIN, (event) => compose.again((event as CustomEvent<Job>).detail));

/** Hide the form, the job list and the welcome section. */
function alone(): void {
  setSingle();
  document.body.classList.add("shared");
  another.hidden = true;
  welcome.hidden = true;
}

/** Show one result, read-only. */
function showAlone(id: string, note: HTMLElement): void {
  detail = new Detail(id, { onJob: (job) => (document.title = `${title(job)} – Pliant`), onDeleted: () => undefined });
  main.append(note, detail.element);
}

/** The result opened by `pliant view`. */
function viewed(): string | null {
  return new URLSearchParams(location.hash.slice(1)).get("view");
}

const token = sharedToken();
const local = viewed();
if (token === null && local === null) {
  addEventListener("hashchange", () => (sharedToken() === null && viewed() === null ? show(named(), true) : location.reload()));
  show(named(), false);
  await start();
  void watch();
} else {
  addEventListener("hashchange", () => location.reload());
  alone();
  if (token !== null) await openShared(token, main, showAlone);
  else if (local !== null) showAlone(local, h("p", { class: "shared-note" }, "This result is read from a folder on this computer."));
}
