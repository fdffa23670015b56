// The form for a new job: files, their interpretation, options, and errors.

import { type Example, Refusal, exampleFile, getOptions, isAbort, listExamples, newKey, submit } from "./api";
import { button, h } from "./dom";
import { keepOptions, keptOptions } from "./draft";
import { OptionsForm, chosen, drawn, nameOf, statedBy } from "./options";
import { refusalBox } from "./refusal";
import { remember, rememberSame, rememberTime } from "./sent";
import { PLACES, Slots } from "./slots";
import { type Interpretation, type Job, PARTS, type Part } from "./types";
import { Inspection } from "./understood";
import { percent, title } from "./words";

export class Compose {
  readonly element: HTMLDetailsElement;
  private readonly options = new OptionsForm();
  private readonly slots = new Slots(() => {
    if (this.kept) this.keep(null); // files given after all
    this.changed();
  });
  private readonly inspection = new Inspection(
    () => this.form(),
    (refusal) => (refusal ? this.refuse(refusal, "Not read", () => undefined) : this.clear()),
    (seen) => {
      this.seen = seen;
      this.options.state(statedBy(seen));
      void this.slots.seen(seen);
    },
  );
  private readonly label = h("input", { type: "text", id: "job-name", maxlength: 200, autocomplete: "off" });
  private readonly send = h("button", { type: "submit", class: "primary" }, "Reconstruct");
  private readonly stop = button("Stop", () => this.sending?.abort(), { hidden: true });
  private readonly answer = h("div", { class: "answer", "aria-live": "assertive" });
  private readonly examples = h("p", { class: "examples" });
  private sending: AbortController | null = null;
  /** A submission and its idempotency key, kept while it is unknown whether the service received it: a retry must not create a second job. */
  private unsure: { form: FormData; key: string } | null = null;
  private offered: Example[] = [];
  /** The job whose inputs are reused; null: the files in the form. */
  private kept: Job | null = null;
  private readonly keeping = h("div", { class: "keeping", hidden: true });
  /** Names the options that were restored after a reload. */
  private readonly restored = h("div", { class: "row hint", hidden: true });
  /** The automatically filled-in name; a name typed by the user is not overwritten. */
  private filledIn = "";
  /** How the service reads the files and options in the form; null: not known yet, or not any more. */
  private seen: Interpretation | null = null;
  /** The file or job that the filled-in name is of. */
  private named: File | Job | null = null;

  constructor(private readonly onJob: (job: Job) => void) {
    const form = h(
      "form",
      { class: "compose", onsubmit: (event: SubmitEvent) => void this.submit(event), "aria-labelledby": "compose-title" },
      this.keeping,
      this.slots.element,
      this.examples,
      this.inspection.element,
      h("div", { class: "option" }, h("label", { for: "job-name" }, "Name (optional)"), this.label),
      this.restored,
      this.options.element,
      h("div", { class: "send" }, this.answer, h("div", { class: "row" }, this.send, this.stop)),
    );
    const summary = h("summary", {}, h("h2", { id: "compose-title" }, "New reconstruction"));
    // The browser shows what is wrong with a field only if the field is visible. This event does not bubble.
    const unfold = (event: Event): void => {
      const fold = (event.target as HTMLElement).closest("details");
      if (fold) fold.open = true;
    };
    form.addEventListener("invalid", unfold, true);
    this.options.element.addEventListener("change", () => {
      const given = this.options.values();
      if (!this.kept) keepOptions(given);
      if (Object.keys(given).length === 0) this.restored.hidden = true;
      this.changed();
    });
    this.element = h("details", { class: "card", open: true }, summary, form);
    document.addEventListener("drop", () => (this.element.open = true));
  }

  /** The files, or the options for reading them, have changed. */
  private changed(): void {
    const { main } = this.slots;
    if (!this.kept && main !== this.named) {
      this.named = main;
      this.options.state(this.slots.file("film") ? statedBy(null) : {});
      const stem = main?.name.replace(/\.[^.]*$/, "").slice(0, 200) ?? "";
      if (this.label.value === this.filledIn) this.label.value = this.filledIn = stem;
    }
    this.offerExamples();
    this.guard();
    this.seen = null;
    if (!this.sending) this.inspection.changed();
  }

  focus(): void {
    this.element.querySelector("summary")?.focus();
  }

  /** Offer examples until files are chosen; the interpretation of the files then takes their place. */
  private offerExamples(): void {
    this.examples.hidden = this.kept !== null || this.slots.main !== null;
  }

  /** Load options and examples. */
  async load(): Promise<void> {
    const schema = await getOptions();
    this.options.load(schema);
    this.restore();
    if (schema.properties && "region_polygon" in schema.properties) this.slots.acceptFilms();
    try {
      const { examples } = await listExamples();
      this.offered = examples;
      this.examples.replaceChildren(...this.exampleButtons(examples));
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      this.examples.replaceChildren(); // the examples are optional
    }
  }

  /** Fill in the options that were chosen before the page was reloaded, and say so. */
  private restore(): void {
    const kept = keptOptions();
    if (Object.keys(kept).length === 0) return;
    this.options.restore(kept);
    const names = Object.keys(this.options.values()).map(nameOf);
    const reset = button("Use the defaults", () => {
      this.options.reset();
      this.options.focus();
    }, { class: "link" });
    this.restored.replaceChildren(h("span", {}, `Options from before the page was reloaded: ${names.join(", ")}.`), reset);
    this.restored.hidden = names.length === 0;
  }

  private exampleButtons(examples: Example[]): (Node | string)[] {
    if (examples.length === 0) return [];
    const buttons = examples.flatMap((example, index) => [
      index > 0 ? ", " : "",
      button(example.title, () => void this.takeExample(example), { class: "link" }),
    ]);
    return ["No files at hand? Try the example ", ...buttons, "."];
  }

  /** Fill the form with the options of a job, to run its inputs again with different ones. */
  again(job: Job): void {
    this.keep(job);
    this.options.state(statedBy(job.interpretation));
    this.options.fill(chosen(job));
    this.named = job;
    this.label.value = this.filledIn = job.name;
    this.element.open = true;
    this.element.scrollIntoView({ block: "start" });
    this.options.focus();
  }

  private keep(job: Job | null): void {
    this.kept = job;
    if (job) this.restored.hidden = true; // the options are the job's
    this.inspection.stop();
    this.clear();
    this.keeping.hidden = job === null;
    this.slots.element.hidden = this.inspection.element.hidden = job !== null;
    this.offerExamples();
    if (job === null) this.keeping.replaceChildren();
    else {
      const other = button("Use other files", () => this.useFiles(), { class: "link" });
      this.keeping.replaceChildren(h("p", {}, `This job reuses the inputs of “${title(job)}”. Change the options below. `, other));
    }
  }

  private useFiles(): void {
    this.keep(null);
    this.changed();
    this.slots.focus(this.slots.hasFilms ? "film" : "tracks");
  }

  /** Remove all error messages. */
  private clear(): void {
    this.answer.replaceChildren();
    this.slots.clear();
    this.options.clear();
  }

  /** Submit the first example of this kind: the shortest way to a moving mesh. */
  async tryOut(kind: "tracks" | "film"): Promise<void> {
    const example = this.offered.find(({ files }) => files.some(({ part }) => part === kind));
    if (example === undefined) return;
    this.element.open = true;
    await this.takeExample(example);
    if (this.slots.file(kind)) this.send.form?.requestSubmit();
  }

  /** True if the service has an example of this kind. */
  hasExample(kind: "tracks" | "film"): boolean {
    return this.offered.some(({ files }) => files.some(({ part }) => part === kind));
  }

  private async takeExample(example: Example): Promise<void> {
    this.answer.replaceChildren(h("p", { class: "muted" }, "Loading the example…"));
    try {
      const known = example.files.filter(({ part }) => (PARTS as readonly string[]).includes(part));
      const files = await Promise.all(
        known.map(async ({ part, file }): Promise<[Part, File]> => [part as Part, await exampleFile(example.name, file)]),
      );
      this.answer.replaceChildren();
      await this.slots.fill(files);
      if (example.region_polygon) await this.slots.outline(example.region_polygon);
      this.label.value = this.filledIn = example.title;
      this.send.focus();
    } catch (error) {
      this.refuse(error);
    }
  }

  private async submit(event: SubmitEvent): Promise<void> {
    event.preventDefault();
    await this.slots.read; // a file that was just chosen
    const changed = this.kept ? [] : await this.slots.removeChanged();
    if (this.sending) return;
    if (changed.length > 0) {
      this.answer.replaceChildren(h("p", { class: "sentence bad" }, `Not submitted. Changed or deleted since you chose it: ${changed.join(", ")}. Choose it again.`));
      return;
    }
    const form = this.kept ? this.keptForm(this.kept) : this.form();
    this.clear();
    if (form === null) {
      const what = this.slots.hasFilms ? "film or track file" : "track file";
      const help = h("a", { href: "guide#start", target: "_blank" }, "What can I send?");
      this.answer.replaceChildren(h("p", { class: "sentence bad" }, `Choose a ${what} first, or try an example. `, help));
      this.slots.focus("tracks");
      return;
    }
    this.inspection.stop();
    const { files } = this.slots.given;
    this.sending = new AbortController();
    this.busy(true);
    const meter = h("progress", { max: 1, value: 0, "aria-label": "Upload" });
    const words = h("span", { class: "muted" }, "Sending…");
    this.answer.replaceChildren(h("p", { class: "sending" }, meter, words));
    let sent = false;
    const onSent = (fraction: number): void => {
      sent = fraction >= 1;
      meter.value = fraction;
      words.textContent = fraction < 1 ? `Sending, ${percent(fraction)}` : "Sent; the service is reading the files…";
    };
    try {
      if (!this.unsure || !isSame(form, this.unsure.form)) this.unsure = { form, key: newKey() };
      const job = await submit(form, this.unsure.key, onSent, this.sending.signal);
      this.unsure = null;
      this.answer.replaceChildren();
      if (this.kept) rememberSame(job.id, this.kept.id);
      else {
        remember(job.id, files);
        rememberTime(job.id, this.seen?.estimate ?? null);
        this.slots.saved();
      }
      this.onJob(job);
    } catch (error) {
      const unknown = isAbort(error) ? sent : error instanceof Refusal && error.problem.retryable;
      if (!unknown) this.unsure = null;
      if (isAbort(error)) {
        const words = sent ? "The service already has the files; the job may appear in the list." : "Nothing was submitted.";
        this.answer.replaceChildren(h("p", { class: "muted" }, `Stopped. ${words}`));
      } else this.refuse(error);
    } finally {
      this.sending = null;
      this.busy(false);
    }
  }

  private keptForm(job: Job): FormData {
    const form = new FormData();
    form.append("inputs_of", job.id);
    form.append("options", JSON.stringify({ ...this.options.values(), ...drawn(job.options) }));
    if (this.label.value.trim()) form.append("name", this.label.value.trim());
    return form;
  }

  private form(): FormData | null {
    if (this.kept) return null;
    const form = new FormData();
    form.append("options", JSON.stringify({ ...this.options.values(), ...this.slots.region }));
    if (this.label.value.trim()) form.append("name", this.label.value.trim());
    const { files, grid } = this.slots.given;
    if (!files.some(([part]) => part === "tracks" || part === "film")) return null;
    if (grid) form.append("mesh", grid);
    for (const [part, file] of files) form.append(part, file);
    return form;
  }

  private readonly stay = (event: BeforeUnloadEvent): void => event.preventDefault();

  /** Ask before the page is left while that ends an upload or loses a recording. */
  private guard(): void {
    if (this.sending || this.slots.isUnsaved) addEventListener("beforeunload", this.stay);
    else removeEventListener("beforeunload", this.stay);
  }

  private busy(busy: boolean): void {
    this.send.disabled = busy;
    this.stop.hidden = !busy;
    this.guard();
  }

  /** Show an error; `outcome` is what has become of the files, and `again` is called when the user has chosen one of several interpretations. */
  private refuse(error: unknown, outcome = "Not submitted", again = (): void => this.send.form?.requestSubmit()): void {
    if (error instanceof Refusal) {
      const choose = (choice: Record<string, unknown>): void => {
        for (const [name, value] of Object.entries(choice)) this.options.set(name, value);
        again();
      };
      this.clear();
      const [part = "", option = ""] = (error.problem.field ?? "").split(".");
      const placed = refusalBox(error.problem, choose, true);
      const shown = part === "options" ? this.options.refuse(option, placed) : !this.kept && this.slots.refuse(part, placed);
      this.answer.replaceChildren(shown ? h("p", { class: "sentence bad" }, `${outcome}: see “${placeOf(part, option)}” above.`) : refusalBox(error.problem, choose));
    } else throw error;
  }
}

/** True if both forms hold the same texts and files. */
function isSame(one: FormData, other: FormData): boolean {
  const [entries, others] = [[...one], [...other]];
  return entries.length === others.length && entries.every(([name, value], index) => name === others[index]?.[0] && value === others[index]?.[1]);
}

function placeOf(part: string, option: string): string {
  if (part === "options") return nameOf(option);
  return PLACES[part as Part]?.label ?? "Film";
}
