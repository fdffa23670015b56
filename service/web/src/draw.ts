// A dialog to draw a region on a frame of the film with a mouse, a finger, a pen or the keyboard.

import { button, h, say, uniqueId } from "./dom";
import type { Frames } from "./frames";
import { type Point, type Region, type Size, centred, closed, described, moved, paint, polygon, resized, spanned, within } from "./region";

type Tool = "lasso" | "rectangle";

/** Minimum and maximum length of the longest side of the canvas, in its own pixels; the stylesheet fits it to the screen. */
const SIDES = [800, 1600] as const;
/** An arrow key moves a region by this share of the picture's longest side. */
const STEP = 0.01;
const ARROWS: Record<string, Point> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** A region, and the frame that it is drawn on, counted from 0. */
export interface Drawing<Kind = Region> {
  region: Kind;
  frame: number;
  picture: ImageBitmap;
}

export class RegionDialog {
  private readonly size: Size;
  private readonly canvas: HTMLCanvasElement;
  private readonly status = h("p", { role: "status" });
  private readonly dialog: HTMLDialogElement;
  private readonly tools: Record<Tool, HTMLButtonElement>;
  private readonly undoing = button("Undo", () => this.undo());
  private readonly using = button("Use this region", () => void this.confirm(), { class: "primary" });
  private readonly slider = h("input", { type: "range", id: uniqueId("region-frame"), min: 0, max: 0, step: 1, value: 0 });
  private readonly number = h("output", { for: this.slider.id, class: "clock" });
  private readonly turning = h(
    "div",
    { class: "frame-choice", hidden: true },
    h("label", { for: this.slider.id }, "Frame to draw on"),
    this.slider,
    this.number,
  );
  private readonly closed = new AbortController();
  private isDone = false;
  private frames: Frames | null = null;
  private frame: number;
  private picture: ImageBitmap;
  /** Ends when the frame of the slider is shown. */
  private turned: Promise<void> | null = null;
  private tool: Tool = "lasso";
  private stroke: Point[] | null = null;
  private history: (Region | null)[];

  /**
   * `frames` are the film's frames, null if only `initial.picture` can be drawn on. `onDone` is called with the region once it is confirmed, and
   * then owns its picture.
   */
  constructor(
    private readonly initial: Drawing<Region | null>,
    frames: Promise<Frames | null>,
    private readonly onDone: (done: Drawing) => void,
  ) {
    this.picture = initial.picture;
    this.frame = initial.frame;
    this.size = { width: this.picture.width, height: this.picture.height };
    this.history = [initial.region];
    this.canvas = this.makeCanvas();
    this.tools = {
      lasso: button("Lasso", () => this.choose("lasso")),
      rectangle: button("Rectangle", () => this.choose("rectangle")),
    };
    this.dialog = this.makeDialog();
    this.choose(initial.region?.kind ?? "lasso");
    this.slider.addEventListener("input", () => (this.turned ??= this.turn()));
    void frames.then((found) => this.offer(found));
  }

  /** Show the dialog; it is removed when it is closed. */
  open(): void {
    document.body.append(this.dialog);
    // Not of the dialog: a focused button that is disabled, such as Undo, passes keys to the document.
    document.addEventListener("keydown", (event) => this.key(event), { signal: this.closed.signal });
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
      "aria-label": this.frame > 0 ? `Frame ${this.frame} of the film` : "First frame of the film",
      "aria-describedby": "region-keys",
    });
    canvas.addEventListener("pointerdown", (event) => this.begin(event));
    canvas.addEventListener("pointermove", (event) => this.extend(event));
    canvas.addEventListener("pointerup", () => this.end());
    canvas.addEventListener("pointercancel", () => this.abandon());
    canvas.addEventListener("dragstart", (event) => event.preventDefault()); // of selected text, which would cancel the stroke
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
      this.turning,
      this.status,
      h("p", { class: "hint keys", id: "region-keys" }, keys),
      h(
        "div",
        { class: "row" },
        this.using,
        button("Cancel", () => dialog.close(), { class: "quiet" }),
      ),
    );
    dialog.addEventListener("close", () => this.leave());
    return dialog;
  }

  private leave(): void {
    this.dialog.remove();
    this.closed.abort();
    this.frames?.close();
    if (!this.isDone && this.picture !== this.initial.picture) this.picture.close();
  }

  /** Let the user choose a frame, if there are several. */
  private offer(frames: Frames | null): void {
    if (this.closed.signal.aborted || frames === null || frames.count < 2) return frames?.close();
    this.frames = frames;
    this.slider.max = String(frames.count - 1);
    this.slider.value = this.number.textContent = String(this.frame);
    this.turning.hidden = false;
  }

  /** Show the frame of the slider; while one is decoded, the slider may move on. */
  private async turn(): Promise<void> {
    const wanted = Number(this.slider.value);
    this.number.textContent = String(wanted);
    const picture = (await this.frames?.picture(wanted).catch(() => null)) ?? null;
    this.turned = null;
    if (this.closed.signal.aborted) return picture?.close();
    if (picture === null) {
      this.slider.value = this.number.textContent = String(this.frame);
      return this.show(`The browser cannot decode frame ${wanted}.`);
    }
    if (this.picture !== this.initial.picture) this.picture.close();
    this.picture = picture;
    this.frame = wanted;
    this.canvas.setAttribute("aria-label", `Frame ${wanted} of the film`);
    this.show();
    if (Number(this.slider.value) !== wanted) await (this.turned = this.turn());
  }

  private choose(tool: Tool): void {
    this.tool = tool;
    for (const [name, made] of Object.entries(this.tools)) made.setAttribute("aria-pressed", String(name === tool));
  }

  private begin(event: PointerEvent): void {
    if (!event.isPrimary) return this.abandon(); // two fingers pinch or scroll
    if (event.button !== 0) return;
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
    const { target } = event;
    if (target === this.slider && event.key !== "z" && event.key !== "Escape") return;
    if (target instanceof HTMLButtonElement && event.key === "Enter") return;
    const arrow = ARROWS[event.key];
    const known = { Enter: () => void this.confirm(), Escape: () => this.escape(), z: () => this.undo(), Backspace: () => this.undo() };
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
    this.choose(this.region?.kind ?? this.tool); // keys turn a lasso into a rectangle, or begin with one
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

  private async confirm(): Promise<void> {
    while (this.turned) await this.turned;
    const { region, frame, picture } = this;
    if (region === null || this.closed.signal.aborted) return;
    this.isDone = true;
    this.closed.abort();
    this.dialog.close();
    this.onDone({ region, frame, picture });
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
    this.using.disabled = this.region === null;
  }
}
