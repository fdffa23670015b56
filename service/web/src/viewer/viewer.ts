// The viewer: the moving result with its controls. This module and three.js arrive as a chunk of their own.

import { button, fill, h, say, uniqueId } from "../dom";
import { number } from "../words";
import { Body } from "./body";
import { type Colouring, valuesFor } from "./colours";
import { type Ending, Player } from "./player";
import { Preview } from "./preview";
import { Stage } from "./stage";
import { TrackDots } from "./tracks";

const TURN = Math.PI / 24;

export class Viewer {
  private readonly stage: Stage;
  private readonly body: Body;
  private readonly player: Player;
  private truth: Body | null = null;
  private dots: TrackDots | null = null;
  private following = false;
  private readonly leaving = new AbortController();
  private readonly view = h("div", { class: "view" });
  private readonly labels = h("div", { class: "view-labels", hidden: true }, h("span", {}, "result"), h("span", {}, "ground truth"));
  private readonly legend = h("div", { class: "legend", hidden: true });
  private readonly play = h("button", { type: "button", class: "play" });
  private readonly scrub = h("input", { type: "range", min: 0, step: "any", "aria-label": "Frame" });
  private readonly clock = h("output", { class: "clock" });
  private readonly trouble = h("p", { class: "muted", role: "status" });
  private readonly themes = matchMedia("(prefers-color-scheme: dark)");

  /** Fetch a preview and show it inside `holder`. */
  static async open(holder: HTMLElement, url: string, signal: AbortSignal): Promise<Viewer> {
    const preview = await Preview.open(url, signal);
    if (preview.ready === 0) await new Promise<void>((resolve) => (preview.onFrames = resolve));
    return new Viewer(holder, preview, signal);
  }

  private constructor(
    holder: HTMLElement,
    private readonly preview: Preview,
    signal: AbortSignal,
  ) {
    this.stage = new Stage(this.view, preview);
    this.body = new Body(preview, preview.positions);
    this.stage.add(this.body.group);
    this.player = new Player(preview.frames, preview.header.fps, () => this.moved(), () => this.showState());
    this.scrub.max = String(preview.frames - 1);
    this.stage.flip(preview.header.mirrored);
    this.stage.reset();
    this.build(holder);
    this.stage.onDraw = () => this.place();
    this.stage.onTurn = () => this.follow(false);
    preview.onFrames = () => this.stage.redraw();
    this.themes.addEventListener("change", this.repaint);
    signal.addEventListener("abort", () => this.dispose());
    this.repaint();
    this.moved();
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.player.play();
    this.showState();
  }

  private build(holder: HTMLElement): void {
    const { preview } = this;
    const { canvas } = this.stage;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-label", "3-D view: arrow keys turn it, plus and minus zoom, space plays and pauses, comma and full stop step");
    canvas.addEventListener("keydown", (event) => this.key(event));
    this.play.addEventListener("click", () => this.toggle());
    this.scrub.addEventListener("input", () => {
      this.player.pause();
      this.player.seek(Number(this.scrub.value));
    });
    this.view.append(canvas, this.labels, this.legend);
    const speeds: [string, string][] = [["1", "1 ×"], ["0.5", "½ ×"], ["0.25", "¼ ×"], ["2", "2 ×"], ["4", "4 ×"]];
    const endings: [string, string][] = [["loop", "loop"], ["back and forth", "back and forth"], ["once", "stop"]];
    const time = h(
      "div",
      { class: "timeline" },
      this.play,
      this.scrub,
      this.clock,
      choice("Speed", speeds, (value) => (this.player.speed = Number(value))),
      choice("At the end", endings, (value) => (this.player.ending = value as Ending)),
    );
    const thinned = preview.header.frame_stride > 1 ? `Every ${ordinal(preview.header.frame_stride)} frame is shown; the files contain all frames.` : "";
    holder.replaceChildren(this.view, time, this.tools(), h("p", { class: "hint", hidden: !thinned }, thinned), this.trouble);
  }

  private tools(): HTMLElement {
    const { preview } = this;
    const colours: [Colouring, string][] = [["plain", "plain"], ["displacement", "displacement"], ["residual", "residual"]];
    if (preview.has("truth")) colours.push(["error", "3-D error"]);
    const tools = h(
      "div",
      { class: "tools" },
      choice("Colour", colours, (value) => void this.colour(value as Colouring)),
      preview.faces.length > 0 && toggle("Wireframe", (on) => this.wireframe(on)),
      toggle("Input tracks", (on) => void this.tracks(on)),
      preview.has("truth") && toggle("Ground truth", (on) => void this.beside(on)),
      toggle("Camera's view", (on) => this.follow(on), "follow"),
      toggle("Flip depth", (on) => this.stage.flip(on), "flip", preview.header.mirrored),
      button("Reset view", () => this.reset(), { class: "quiet" }),
    );
    return tools;
  }

  private reset(): void {
    this.follow(false);
    this.stage.reset();
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = (by: number): void => {
      this.player.pause();
      this.player.seek(Math.round(this.player.time) + by);
    };
    const actions: Record<string, () => void> = {
      ArrowLeft: () => this.stage.orbit.turn(-TURN, 0),
      ArrowRight: () => this.stage.orbit.turn(TURN, 0),
      ArrowUp: () => this.stage.orbit.turn(0, -TURN),
      ArrowDown: () => this.stage.orbit.turn(0, TURN),
      "+": () => this.stage.orbit.zoom(1.2),
      "=": () => this.stage.orbit.zoom(1.2),
      "-": () => this.stage.orbit.zoom(1 / 1.2),
      ",": () => step(-1),
      ".": () => step(1),
      " ": () => this.toggle(),
    };
    const action = actions[event.key];
    if (action === undefined) return;
    event.preventDefault();
    action();
  }

  private toggle(): void {
    if (this.player.playing) this.player.pause();
    else this.player.play();
    this.showState();
  }

  private showState(): void {
    this.play.setAttribute("aria-label", this.player.playing ? "Pause" : "Play");
    this.play.dataset["playing"] = String(this.player.playing);
  }

  private moved(): void {
    this.scrub.value = String(this.player.time);
    const frame = Math.round(this.player.time) + 1;
    this.scrub.setAttribute("aria-valuetext", `frame ${frame} of ${this.preview.frames}`);
    say(this.clock, `${frame} / ${this.preview.frames}`);
    this.stage.redraw();
  }

  /** Bring every body to the present moment; called before each picture. */
  private place(): void {
    const { time } = this.player;
    this.body.show(time);
    this.truth?.show(time);
    this.dots?.show(time);
    if (this.following) this.stage.through(this.preview.camera(Math.round(Math.min(time, this.preview.ready - 1))).rotation);
  }

  private async colour(colouring: Colouring): Promise<void> {
    await this.guarded(async () => {
      const values = await valuesFor(colouring, this.preview, this.leaving.signal);
      this.body.colour(values);
      this.legend.hidden = values === null;
      fill(this.legend, `${colouring} ${values?.top}`, () => [
        h("span", {}, `${LEGENDS[colouring]}: 0`),
        h("span", { class: "ramp" }),
        h("span", {}, number(values?.top)),
      ]);
      this.stage.redraw();
    });
  }

  private wireframe(on: boolean): void {
    this.body.wireframe(on);
    this.truth?.wireframe(on);
    this.stage.redraw();
  }

  private async tracks(on: boolean): Promise<void> {
    await this.guarded(async () => {
      if (!on && this.dots) {
        this.stage.remove(this.dots.group);
        this.dots.dispose();
        this.dots = null;
      } else if (on && !this.dots) {
        this.dots = new TrackDots(this.preview, await this.preview.field("residuals", this.leaving.signal));
        this.repaint();
        this.stage.add(this.dots.group);
      }
    });
  }

  private async beside(on: boolean): Promise<void> {
    await this.guarded(async () => {
      if (on && !this.truth) {
        this.truth = new Body(this.preview, await this.preview.field("truth", this.leaving.signal));
        this.repaint();
        this.stage.add(this.truth.group, 1);
      }
      this.labels.hidden = !on;
      this.labels.classList.toggle("stacked", this.stage.stacked);
      this.stage.divide(on);
    });
  }

  private follow(on: boolean): void {
    const wasOn = this.following;
    this.following = on;
    const box = this.view.parentElement?.querySelector<HTMLInputElement>("input[data-tool=follow]");
    if (box) box.checked = on;
    if (on !== wasOn) this.stage.redraw();
  }

  private readonly repaint = (): void => {
    const style = getComputedStyle(this.view);
    const colour = (name: string): string => style.getPropertyValue(name).trim();
    for (const body of [this.body, this.truth]) body?.theme(colour("--clay"), colour("--wire"));
    this.dots?.theme(colour("--dots"));
    this.stage.redraw();
  };

  /** Further arrays come over the network: a failure is said beside the controls and leaves the rest as it was. */
  private async guarded(action: () => Promise<void>): Promise<void> {
    try {
      await action();
      say(this.trouble, "");
    } catch (error) {
      if (!this.leaving.signal.aborted) say(this.trouble, error instanceof Error ? error.message : String(error));
    }
  }

  private dispose(): void {
    this.leaving.abort();
    this.player.pause();
    this.themes.removeEventListener("change", this.repaint);
    this.body.dispose();
    this.truth?.dispose();
    this.dots?.dispose();
    this.stage.dispose();
  }
}

const LEGENDS: Record<Colouring, string> = {
  plain: "",
  displacement: "From its mean position",
  error: "From ground truth",
  residual: "From track to projection",
};

function ordinal(value: number): string {
  return `${value}${value === 2 ? "nd" : value === 3 ? "rd" : "th"}`;
}

function choice(label: string, values: [string, string][], onValue: (value: string) => void): HTMLElement {
  const id = uniqueId("tool");
  const select = h("select", { id }, ...values.map(([value, words]) => h("option", { value }, words)));
  select.addEventListener("change", () => onValue(select.value));
  return h("span", { class: "tool" }, h("label", { for: id }, label), select);
}

function toggle(label: string, onChange: (on: boolean) => void, name = "", on = false): HTMLElement {
  const box = h("input", { type: "checkbox", "data-tool": name || null });
  box.checked = on;
  box.addEventListener("change", () => onChange(box.checked));
  return h("label", { class: "chip" }, box, label);
}
