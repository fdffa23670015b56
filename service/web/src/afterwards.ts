// Next steps for a finished job: more files of its result, a share link, and another run with other options.

import { Refusal, createShare, getJob, listShares, makeOutputs, revokeShare } from "./api";
import { button, h, uniqueId } from "./dom";
import { refusalBox } from "./refusal";
import { saveLink } from "./results";
import { type Job, isFinal } from "./types";
import { count, standing } from "./words";

const KINDS: [string, string][] = [
  ["glb", "glTF, animated"],
  ["usd", "USD"],
  ["abc", "Alembic"],
  ["mdd", "MDD point cache"],
  ["ply", "PLY, one per frame"],
  ["obj", "OBJ, one per frame"],
  ["mat", "MATLAB"],
  ["csv", "Error tables (csv)"],
];
const DAY = 24 * 3600;

/** Event that makes the form reuse a job's inputs; `main.ts` handles it. */
export const AGAIN = "pliant-again";

export class Afterwards {
  readonly element = h("section", { class: "afterwards", "aria-label": "Next steps", hidden: true });
  private readonly files = button("More files", () => this.toggle("files", this.files), { "aria-expanded": "false" });
  private readonly share = button("Share", () => this.toggle("share", this.share), { "aria-expanded": "false" });
  private readonly body = h("div", {});
  private shown: "files" | "share" | null = null;
  private job: Job | null = null;

  constructor() {
    const again = button("Run again with other options", () => document.dispatchEvent(new CustomEvent(AGAIN, { detail: this.job })));
    this.element.append(h("div", { class: "row" }, this.files, this.share, again), this.body);
  }

  show(job: Job): void {
    this.job = job;
    this.element.hidden = !isFinal(job.status) || job.outputs_of !== null;
    this.files.hidden = this.share.hidden = job.status !== "succeeded";
  }

  private toggle(what: "files" | "share", opener: HTMLButtonElement): void {
    this.shown = this.shown === what ? null : what;
    for (const one of this.element.querySelectorAll("[aria-expanded]")) one.setAttribute("aria-expanded", String(this.shown === what && one === opener));
    if (this.shown === null || this.job === null) this.body.replaceChildren();
    else this.body.replaceChildren(what === "files" ? furtherFiles(this.job) : sharing(this.job));
  }
}

function trouble(place: HTMLElement, error: unknown): void {
  if (!(error instanceof Refusal)) throw error;
  place.replaceChildren(refusalBox(error.problem));
}

/** The form that requests more files, and the files once they exist. */
function furtherFiles(job: Job): HTMLElement {
  const boxes = KINDS.map(([kind, words]) => {
    const id = uniqueId("kind");
    const box = h("input", { type: "checkbox", id, value: kind });
    return { box, label: h("label", { for: id, class: "tick" }, box, ` ${words}`) };
  });
  const rate = h("input", { type: "number", id: uniqueId("rate"), min: 0, max: 1000, step: "any", value: Number(Number(job.options["fps"]).toPrecision(6)) });
  const axes = h(
    "select",
    { id: uniqueId("axes") },
    h("option", { value: "viewer" }, "y up, as in viewers"),
    h("option", { value: "tracks" }, "as in the tracks"),
  );
  axes.value = String(job.options["axes"]);
  const words = h("div", { class: "answer", role: "status" });
  const make = h("button", { type: "submit", class: "primary" }, "Create the files");
  const form = h(
    "form",
    { class: "after-form" },
    h("fieldset", {}, h("legend", {}, "Files"), ...boxes.map(({ label }) => label)),
    h("div", { class: "row" }, h("label", { for: rate.id }, "Frames per second"), rate, h("label", { for: axes.id }, "Axes of PLY and OBJ"), axes),
    h("div", { class: "row" }, make),
    words,
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const outputs = boxes.filter(({ box }) => box.checked).map(({ box }) => box.value);
    if (outputs.length === 0) {
      words.replaceChildren(h("p", { class: "sentence bad" }, "Choose at least one file."));
      return;
    }
    make.disabled = true;
    void write(job, { outputs, ...(rate.value !== rate.defaultValue && { fps: Number(rate.value) }), axes: axes.value }, words).finally(() => (make.disabled = false));
  });
  return form;
}

/** Request the files and follow the job that writes them, without solving again. */
async function write(job: Job, wanted: Record<string, unknown>, words: HTMLElement): Promise<void> {
  try {
    let further = await makeOutputs(job.id, wanted);
    while (!isFinal(further.status)) {
      words.textContent = further.status === "queued" ? "Waiting for a worker…" : standing(further);
      await new Promise((resolve) => setTimeout(resolve, 700));
      further = await getJob(further.id);
    }
    const made = further;
    if (made.error) words.replaceChildren(refusalBox(made.error));
    else words.replaceChildren(h("ul", { class: "files" }, ...made.artifacts.filter(({ name }) => name !== "report.json").map((one) => h("li", {}, saveLink(made, one, `Save ${one.name}`), h("span", { class: "hint" }, one.description)))));
  } catch (error) {
    trouble(words, error);
  }
}

/** The form that creates a link, and the list of valid links. */
function sharing(job: Job): HTMLElement {
  const days = h("select", { id: uniqueId("days") }, ...[1, 7, 30, 366].map((each) => h("option", { value: each }, count(each, "day"))));
  days.value = "7";
  const made = h("div", { class: "answer", role: "status" });
  const valid = h("ul", { class: "files" });
  const create = h("button", { type: "submit", class: "primary" }, "Create a link");
  const form = h(
    "form",
    { class: "after-form" },
    h("p", { class: "hint" }, "Anyone with the link can view this result and its files, but nothing else. You can revoke it at any time."),
    h("div", { class: "row" }, h("label", { for: days.id }, "Valid for"), days, create),
    made,
    valid,
  );
  const list = async (): Promise<void> => {
    const shares = await listShares(job.id);
    valid.replaceChildren(
      ...shares.map((share) => {
        const until = new Date(share.expires_at).toLocaleString();
        const revoke = button("Revoke", () => {
          revokeShare(job.id, share.id)
            .then(list)
            .then(() => create.focus())
            .catch((error: unknown) => trouble(made, error));
        });
        return h("li", {}, h("span", {}, `Link ${share.id}, valid until ${until}`), revoke);
      }),
    );
  };
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    createShare(job.id, Number(days.value) * DAY)
      .then(async (share) => {
        const link = new URL(share.path ?? "", location.href.split("#")[0]).href;
        const field = h("input", { type: "text", readonly: true, value: link, "aria-label": "Link to this result", onfocus: () => field.select() });
        made.replaceChildren(field, h("p", { class: "hint" }, "Copy the link now: it is shown only once."));
        field.focus();
        await list();
      })
      .catch((error: unknown) => trouble(made, error));
  });
  list().catch((error: unknown) => trouble(made, error));
  return form;
}
