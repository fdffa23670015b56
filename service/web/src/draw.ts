// A dialog to draw a region on the film's first frame with a mouse, a finger, a pen or the keyboard.

import { button, h, say, uniqueId } from "./dom";
import { type Point, type Region, type Size, centred, closed, described, moved, paint, polygon, resized, spanned, within } from "./region";

type Tool = "lasso" | "rectangle";

/** Minimum and maximum length of the longest side of the canvas, in its own pixels; the stylesheet fits it to the screen. */
const SIDES = [800, 1600] as const;
/** An arrow key moves a region by this share of the picture's longest side. */
const STEP = 0.01;
const ARROWS: Record<string, Point> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class RegionDialog {
  private readonly size: Size;
  private readonly canvas: HTMLCanvasElement;
  private readonly status = h("p", { role: "status" });
  private readonly dialog: HTMLDialogElement;
  private readonly tools: Record<Tool, HTMLButtonElement>;
  private readonly undoing = button("Undo", () => this.undo());
  private tool: Tool = "lasso";
  private stroke: Point[] | null = null;
  private history: (Region | null)[];

  /** `onDone` is called with the region once it is confirmed; null stands for the whole picture. */
  constructor(
    private readonly picture: ImageBitmap,
    initial: Region | null,
    private readonly onDone: (region: Region | null) => void,
  ) {
    this.size = { width: picture.width, height: picture.height };
    this.history = [initial];
    this.canvas = this.makeCanvas();
    this.tools = {
      lasso: button("Lasso", () => this.choose("lasso")),
      rectangle: button("Rectangle", () => this.choose("rectangle")),
    };
    this.dialog = this.makeDialog();
    this.choose(initial?.kind ?? "lasso");
  }

  /** Show the dialog; it is removed when it is closed. */
  open(): void {
    document.body.append(this.dialog);
    this.dialog.showModal();
    this.canvas.focus();
    this.show();
  }

  private get region(): Region | null {
    return this.history.at(-1) ?? null;
  }

  private makeCanvas(): HTMLCanvasElement {
    const longest = Math.max(this.size.width, this.size.height);
    const scale = Math.min(Math.max(longest, SIDES[0]), SIDES[1]) / longest;
    const canvas = h("canvas", {
      width: Math.round(this.size.width * scale),
      height: Math.round(this.size.height * scale),
      tabindex: 0,
      role: "application",
      "aria-label": "First frame of the film",
      "aria-describedby": "region-keys",
    });
    canvas.addEventListener("pointerdown", (event) => this.begin(event));
    canvas.addEventListener("pointermove", (event) => this.extend(event));
    canvas.addEventListener("pointerup", () => this.end());
    canvas.addEventListener("pointercancel", () => this.abandon());
    canvas.addEventListener("keydown", (event) => this.key(event));
    return canvas;
  }

  private makeDialog(): HTMLDialogElement {
    const title = uniqueId("region-title");
    const keys =
      "Keyboard: arrow keys move the region, Shift and arrow keys resize a rectangle, Enter confirms, Ctrl+Z undoes, Escape cancels.";
    const dialog = h(
      "dialog",
      { class: "region", "aria-labelledby": title },
      h("h2", { id: title }, "Draw around the object"),
      h("p", { class: "hint" }, "Only points inside the region are tracked. Draw close to the object, without background."),
      h("div", { class: "row", role: "group", "aria-label": "Tool" }, this.tools.lasso, this.tools.rectangle, this.undoing),
      this.canvas,
      this.status,
      h("p", { class: "hint", id: "region-keys" }, keys),
      h(
        "div",
        { class: "row" },
        button("Use this region", () => this.confirm(), { class: "primary" }),
        button("Cancel", () => dialog.close(), { class: "quiet" }),
      ),
    );
    dialog.addEventListener("close", () => dialog.remove());
    return dialog;
  }

  private choose(tool: Tool): void {
    this.tool = tool;
    for (const [name, made] of Object.entries(this.tools)) made.setAttribute("aria-pressed", String(name === tool));
  }

  private begin(event: PointerEvent): void {
    if (event.button !== 0 || !event.isPrimary) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.stroke = [this.at(event)];
  }

  private extend(event: PointerEvent): void {
    if (this.stroke === null || !event.isPrimary) return;
    // A finger may move faster than events are sent; the browser keeps the positions in between.
    const between = event.getCoalescedEvents?.() ?? [];
    this.stroke.push(...(between.length > 0 ? between : [event]).map((each) => this.at(each)));
    this.show();
  }

  private end(): void {
    if (this.stroke === null) return;
    const drawn = this.drawn(this.stroke);
    this.stroke = null;
    if (drawn) this.keep(drawn);
    else this.show("The region is too small. Drag to draw a larger one.");
  }

  private abandon(): void {
    this.stroke = null;
    this.show();
  }

  private drawn(stroke: Point[]): Region | null {
    const [first, last] = [stroke[0], stroke.at(-1)];
    if (first === undefined || last === undefined) return null;
    return this.tool === "lasso" ? closed(stroke, this.size) : spanned(first, last, this.size);
  }

  private key(event: KeyboardEvent): void {
    const arrow = ARROWS[event.key];
    const known = { Enter: () => this.confirm(), Escape: () => this.escape(), z: () => this.undo(), Backspace: () => this.undo() };
    const act = known[event.key as keyof typeof known];
    if (event.key === "z" && !(event.ctrlKey || event.metaKey)) return;
    if (!arrow && !act) return;
    event.preventDefault();
    if (arrow) this.shift(arrow, event.shiftKey, event.repeat);
    else act?.();
  }

  /** A key that is held down counts as one change for undo. */
  private shift([dx, dy]: Point, isResizing: boolean, isRepeated: boolean): void {
    const step = Math.max(1, Math.round(STEP * Math.max(this.size.width, this.size.height)));
    const by: Point = [dx * step, dy * step];
    const { region } = this;
    if (isRepeated && this.history.length > 1) this.history.pop();
    if (region === null) this.keep(centred(this.size));
    else this.keep(isResizing ? resized(region, by, this.size) : moved(region, by, this.size));
  }

  private escape(): void {
    if (this.stroke === null) this.dialog.close();
    else this.abandon();
  }

  private undo(): void {
    if (this.history.length > 1) this.history.pop();
    this.show();
  }

  private keep(region: Region): void {
    this.history.push(region);
    this.show();
  }

  private confirm(): void {
    this.dialog.close();
    this.onDone(this.region);
  }

  private at(event: PointerEvent): Point {
    const box = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * this.size.width;
    const y = ((event.clientY - box.top) / box.height) * this.size.height;
    return within([x, y], this.size);
  }

  private show(words = described(this.region)): void {
    const { stroke } = this;
    const rectangle = stroke && this.tool === "rectangle" ? this.drawn(stroke) : null;
    if (stroke && this.tool === "lasso") paint(this.canvas, this.picture, stroke, false);
    else if (stroke) paint(this.canvas, this.picture, rectangle ? polygon(rectangle) : []);
    else paint(this.canvas, this.picture, this.region ? polygon(this.region) : []);
    if (!stroke) say(this.status, words);
    this.undoing.disabled = this.history.length < 2;
  }
}
