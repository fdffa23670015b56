// The viewer: the moving result with its controls. This module and three.js arrive as a chunk of their own.

import { button, fill, h, say } from "../dom";
import { Body, seenFromBehind } from "./body";
import { type Colouring, type Values, colourings, errorDifference, percent, valuesFor } from "./colours";
import { Companion, type Other, meanError } from "./companion";
import { choice, group, ordinal, toggle } from "./controls";
import { FilmFrames } from "./filmframes";
import { FilmPane } from "./filmpane";
import { openHelp } from "./help";
import { type Ending, Player } from "./player";
import { Preview } from "./preview";
import { Probe } from "./probe";
import { Saving } from "./saving";
import { type Side, Stage } from "./stage";
import { Timeline } from "./timeline";
import { TrackDots } from "./tracks";

const TURN = Math.PI / 24;
/** A pointer that moved further than this between down and up, CSS pixels, turned the view and chose no point. */
const STILL = 5;

/** What the viewer shows, and where it finds more. */
export interface Sources {
  title: string;
  preview: string;
  /** Small pictures of the film's frames, where the job had a film. */
  film?: string | undefined;
  /** USDZ, which phones and headsets show in the room. */
  usdz?: string | undefined;
  /** Jobs to compare with. */
  others?: () => Promise<Other[]>;
}

export class Viewer {
  private readonly stage: Stage;
  private readonly body: Body;
  private readonly player: Player;
  private readonly probe: Probe;
  private readonly timeline: Timeline;
  private readonly behind: boolean;
  private truth: Body | null = null;
  private dots: TrackDots | null = null;
  private pane: FilmPane | null = null;
  private companion: Companion | null = null;
  private following = false;
  private readonly leaving = new AbortController();
  private readonly view = h("div", { class: "view" });
  private readonly panes = h("div", { class: "panes" });
  private readonly labels = h("div", { class: "view-labels", hidden: true }, h("span", {}, "result"), h("span", {}, "ground truth"));
  private readonly legend = h("div", { class: "legend", hidden: true });
  private readonly compared = h("p", { class: "hint", role: "status" });
  private readonly play = h("button", { type: "button", class: "play" });
  private readonly scrub = h("input", { type: "range", min: 0, step: "any", "aria-label": "Frame" });
  private readonly clock = h("output", { class: "clock" });
  private readonly trouble = h("p", { class: "muted", role: "status" });
  private readonly themes = matchMedia("(prefers-color-scheme: dark)");

  /** Fetch a result and show it inside `holder`. */
  static async open(holder: HTMLElement, sources: Sources, signal: AbortSignal): Promise<Viewer> {
    const [preview, film] = await Promise.all([
      Preview.open(sources.preview, signal),
      // Without its film a result can still be looked at.
      sources.film === undefined ? null : FilmFrames.open(sources.film, signal).catch(() => null),
    ]);
    if (preview.ready === 0) await new Promise<void>((resolve) => (preview.onFrames = resolve));
    return new Viewer(holder, sources, preview, film, signal);
  }

  private constructor(
    private readonly holder: HTMLElement,
    private readonly sources: Sources,
    private readonly preview: Preview,
    private readonly film: FilmFrames | null,
    signal: AbortSignal,
  ) {
    this.stage = new Stage(this.view, preview);
    this.body = new Body(preview, preview.positions);
    this.stage.add(this.body.group);
    this.player = new Player(preview.frames, preview.header.fps, () => this.moved(), () => this.showState());
    this.probe = new Probe(preview, this.leaving.signal, () => this.stage.redraw());
    this.stage.add(this.probe.marker);
    this.timeline = new Timeline(preview, (frame) => this.seek(frame));
    this.behind = preview.faces.length > 0 && seenFromBehind(preview, preview.clearest);
    this.scrub.max = String(preview.frames - 1);
    this.flip(preview.header.mirrored);
    this.player.time = preview.clearest;
    this.build();
    this.stage.look("front");
    this.stage.onDraw = () => this.place();
    this.stage.onTurn = () => this.follow(false);
    preview.onFrames = () => (preview.ready === preview.frames ? this.stage.refit() : this.stage.redraw());
    this.themes.addEventListener("change", this.repaint);
    signal.addEventListener("abort", () => this.dispose());
    this.repaint();
    this.moved();
    if (film) void this.beside(true);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.player.play();
    this.showState();
  }

  private build(): void {
    const { preview } = this;
    this.prepareCanvas();
    this.play.addEventListener("click", () => this.toggle());
    this.scrub.addEventListener("input", () => this.seek(Number(this.scrub.value)));
    this.scrub.addEventListener("keydown", (event) => this.slide(event));
    this.view.append(this.stage.canvas, this.labels);
    this.panes.append(this.view);
    const speeds: [string, string][] = [["1", "1 ×"], ["0.5", "½ ×"], ["0.25", "¼ ×"], ["2", "2 ×"], ["4", "4 ×"]];
    const endings: [string, string][] = [["loop", "loop"], ["back and forth", "back and forth"], ["once", "stop"]];
    const time = h(
      "div",
      { class: "timeline" },
      this.play,
      h("div", { class: "scrubbing" }, this.timeline.element, this.scrub),
      this.clock,
    );
    const pace = group(
      "Pace",
      h("div", { class: "row pace" }, choice("Speed", speeds, (value) => (this.player.speed = Number(value))), choice("At the end", endings, (value) => (this.player.ending = value as Ending))),
    );
    const full = document.fullscreenEnabled ? button("Full screen", () => void this.fullScreen()) : "";
    // Before the canvas, so that Shift+Tab leads from the player to the picture itself.
    this.view.prepend(h("div", { class: "corner" }, full, button("Help", () => openHelp(this.holder))));
    const thinned = preview.header.frame_stride > 1 ? `Every ${ordinal(preview.header.frame_stride)} frame is shown; the files contain all frames.` : "";
    const notes = [h("p", { class: "hint", hidden: !thinned }, thinned), this.trouble];
    const main = h("div", { class: "stage-main" }, this.panes, this.legend, this.compared, time, ...notes);
    this.holder.replaceChildren(main, this.tools(pace));
  }

  private prepareCanvas(): void {
    const { canvas } = this.stage;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-label", "3-D view: arrow keys turn it, plus and minus zoom, space plays and pauses, Enter shows a point's values, question mark lists all keys");
    canvas.addEventListener("keydown", (event) => this.key(event));
    let down: [number, number] | null = null;
    canvas.addEventListener("pointerdown", (event) => (down = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null));
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < STILL) this.pick(event.clientX, event.clientY);
      down = null;
    });
  }

  private tools(pace: HTMLElement): HTMLElement {
    const { preview, sources } = this;
    const aim = (words: string, side: Side): HTMLButtonElement => button(words, () => this.look(side));
    const views = [aim("Front", "front"), aim("Side", "side"), aim("Top", "top"), button("Fit", () => this.stage.fit())];
    const colours = colourings(preview);
    const saving = new Saving({
      title: sources.title,
      preview: sources.preview,
      film: this.film ? sources.film : undefined,
      usdz: sources.usdz,
      seconds: preview.frames / preview.header.fps,
      background: () => getComputedStyle(this.view).getPropertyValue("--back-1").trim(),
      canvases: () => this.canvases(),
      pose: (share, kind) => this.pose(share, kind),
      begin: () => this.hold(),
      signal: this.leaving.signal,
    });
    return h(
      "div",
      { class: "tools" },
      group("View", h("div", { class: "row" }, ...views)),
      group(
        "Show",
        h("div", { class: "colouring" }, choice("Colour", colours, (value) => void this.colour(value as Colouring))),
        h(
          "div",
          { class: "row" },
          preview.faces.length > 0 && toggle("Wireframe", (on) => this.wireframe(on)),
          toggle("Input tracks", (on) => void this.tracks(on)),
          preview.has("truth") && toggle("Ground truth", (on) => void this.withTruth(on)),
          toggle("Camera's view", (on) => this.follow(on), "follow"),
          toggle("Flip depth", (on) => this.flip(on), "flip", preview.header.mirrored),
          toggle(this.film ? "Film beside" : "Tracks beside", (on) => void this.beside(on), "beside", this.film !== null),
          preview.faces.length > 0 && toggle("Mesh over it", (on) => void this.meshOver(on), "over"),
        ),
      ),
      pace,
      group("Point", this.probe.element),
      sources.others ? this.comparing(sources.others) : "",
      group("Save", saving.element),
    );
  }

  /** The choice of a job to compare with; the jobs are fetched when the list is first opened. */
  private comparing(others: () => Promise<Other[]>): HTMLElement {
    let known: Other[] = [];
    const made = choice("Compare with", [["", "no other job"]], (id) => void this.compare(known.find((one) => one.id === id) ?? null));
    const select = made.querySelector("select") as HTMLSelectElement;
    const load = (): void => {
      void this.guarded(async () => {
        known = await others();
        const have = new Set([...select.options].map(({ value }) => value));
        select.append(...known.filter(({ id }) => !have.has(id)).map(({ id, title }) => h("option", { value: id }, title)));
      });
    };
    load();
    select.addEventListener("focus", load);
    return group("Compare", made);
  }

  private look(side: Side): void {
    this.follow(false);
    this.stage.look(side);
  }

  private async fullScreen(): Promise<void> {
    await this.guarded(async () => {
      if (document.fullscreenElement) await document.exitFullscreen();
      else await this.holder.requestFullscreen();
    });
  }

  private flip(on: boolean): void {
    this.stage.flip(on);
    for (const body of [this.body, this.truth]) body?.reverse(this.behind !== on);
  }

  private pick(x: number | null, y: number | null): void {
    const box = this.stage.canvas.getBoundingClientRect();
    const frame = Math.min(Math.round(this.player.time), this.preview.ready - 1);
    const [left, top] = [x === null ? box.width / 2 : x - box.left, y === null ? box.height / 2 : y - box.top];
    const point = this.stage.pick(left, top, frame);
    if (point !== null || x !== null) this.probe.choose(point);
    else say(this.trouble, "No point is near the middle of the picture.");
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const actions: Record<string, () => void> = {
      ArrowLeft: () => this.stage.orbit.turn(-TURN, 0),
      ArrowRight: () => this.stage.orbit.turn(TURN, 0),
      ArrowUp: () => this.stage.orbit.turn(0, -TURN),
      ArrowDown: () => this.stage.orbit.turn(0, TURN),
      "+": () => this.stage.orbit.zoom(1.2),
      "=": () => this.stage.orbit.zoom(1.2),
      "-": () => this.stage.orbit.zoom(1 / 1.2),
      ",": () => this.step(-1),
      ".": () => this.step(1),
      " ": () => this.toggle(),
      "1": () => this.look("front"),
      "2": () => this.look("side"),
      "3": () => this.look("top"),
      "0": () => this.stage.fit(),
      c: () => this.follow(!this.following),
      f: () => void this.fullScreen(),
      "?": () => openHelp(this.holder),
      Enter: () => this.pick(null, null),
    };
    const action = actions[event.key];
    if (action === undefined) return;
    event.preventDefault();
    action();
  }

  /** Keys of the slider: whole frames. */
  private slide(event: KeyboardEvent): void {
    const last = this.preview.frames - 1;
    const now = Math.round(this.player.time);
    const places: Record<string, number> = {
      ArrowLeft: now - 1, ArrowDown: now - 1, ArrowRight: now + 1, ArrowUp: now + 1, PageUp: now + 10, PageDown: now - 10, Home: 0, End: last,
    };
    const place = places[event.key];
    if (place === undefined) return;
    event.preventDefault();
    this.seek(place);
  }

  private step(by: number): void {
    this.seek(Math.round(this.player.time) + by);
  }

  private seek(time: number): void {
    this.player.pause();
    this.player.seek(time);
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
    const { time } = this.player;
    this.scrub.value = String(time);
    const frame = Math.round(time) + 1;
    const said = this.timeline.show(time);
    this.scrub.setAttribute("aria-valuetext", [`frame ${frame} of ${this.preview.frames}`, said].filter(Boolean).join(", "));
    say(this.clock, `${frame} / ${this.preview.frames}`);
    this.stage.redraw();
  }

  /** Bring every body to the present moment; called before each picture. */
  private place(): void {
    const { time } = this.player;
    this.body.show(time);
    this.truth?.show(time);
    this.dots?.show(time);
    this.probe.show(time);
    this.pane?.show(time);
    if (this.following) this.stage.through(this.preview.camera(Math.round(Math.min(time, this.preview.ready - 1))).rotation);
    this.companion?.show(time, this.stage);
  }

  private async colour(colouring: Colouring): Promise<void> {
    const { preview, companion } = this;
    const { signal } = this.leaving;
    const values = colouring === "difference" && companion ? errorDifference(preview, companion.preview, signal) : valuesFor(colouring, preview, signal);
    await this.guarded(async () => this.paint(await values));
  }

  private paint(values: Values | null): void {
    this.body.colour(values);
    this.legend.hidden = values === null;
    fill(this.legend, JSON.stringify(values), () =>
      values === null
        ? []
        : [
            h("span", {}, `${values.words}: ${values.low}`),
            h("span", { class: values.low === "0" ? "ramp" : "ramp diverging" }),
            h("span", {}, values.high),
            values.hasUnknown && h("span", { class: "key-unknown" }, "grey: not seen"),
          ],
    );
    this.stage.redraw();
  }

  private wireframe(on: boolean): void {
    this.body.wireframe(on);
    this.truth?.wireframe(on);
    this.companion?.wireframe(on);
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

  private async withTruth(on: boolean): Promise<void> {
    await this.guarded(async () => {
      if (on && !this.truth) {
        this.truth = new Body(this.preview, await this.preview.field("truth", this.leaving.signal));
        this.truth.reverse(this.behind !== this.stage.isFlipped);
        this.repaint();
        this.stage.add(this.truth.group, 1);
      }
      this.labels.hidden = !on;
      this.labels.classList.toggle("stacked", this.stage.stacked);
      this.stage.divide(on);
    });
  }

  /** Show the film, or the tracks alone, beside the mesh. */
  private async beside(on: boolean): Promise<void> {
    await this.guarded(async () => {
      if (!on) {
        this.pane?.canvas.parentElement?.remove();
        this.pane = null;
        this.check("over", false);
      } else if (this.pane === null) {
        this.pane = new FilmPane(this.preview, await this.preview.field("residuals", this.leaving.signal), this.film);
        this.panes.prepend(h("div", { class: "view film" }, this.pane.canvas));
        this.repaint();
      }
      this.check("beside", on);
    });
  }

  private async meshOver(on: boolean): Promise<void> {
    if (on) await this.beside(true);
    if (this.pane === null) return;
    this.pane.showsMesh = on;
    this.pane.showsTracks = !on;
    this.stage.redraw();
  }

  private async compare(other: Other | null): Promise<void> {
    await this.guarded(async () => {
      this.companion?.dispose();
      this.companion = null;
      this.timeline.compare(null);
      say(this.compared, "");
      if (this.offerDifference(false)) this.paint(null);
      if (other === null) return;
      const companion = await Companion.open(other, this.leaving.signal);
      this.companion = companion;
      companion.element.append(h("span", { class: "view-name" }, other.title));
      this.panes.append(companion.element);
      this.timeline.compare(companion.preview, other.title);
      const values = await errorDifference(this.preview, companion.preview, this.leaving.signal);
      if (values) {
        this.offerDifference(true);
        this.paint(values);
      }
      say(this.compared, this.difference(other, companion.preview, values !== null));
      this.repaint();
    });
  }

  /** Add the difference of errors to the colours, chosen, or remove it; returns true if it was the one shown. */
  private offerDifference(on: boolean): boolean {
    const select = this.holder.querySelector<HTMLSelectElement>(".colouring select");
    if (select === null) return false;
    const shown = select.value === "difference";
    select.querySelector("option[value=difference]")?.remove();
    if (on) select.append(h("option", { value: "difference", selected: true }, "error difference"));
    if (on) select.value = "difference";
    else if (shown) select.value = "plain";
    return shown;
  }

  private difference(other: Other, theirs: Preview, sharesPoints: boolean): string {
    const name = [this.preview, theirs].every((one) => meanError(one, "error") !== null) ? "error" : "expected";
    const [here, there] = [meanError(this.preview, name), meanError(theirs, name)];
    const words = name === "error" ? "3-D error" : "Expected error";
    const figures = here !== null && there !== null ? `${words}: this job ${percent(here)}, ${other.title} ${percent(there)}.` : "";
    const shares = sharesPoints ? "The colours show where this job's error is larger (red) or smaller (blue)." : "The two jobs do not have the same points, so errors are not compared point by point.";
    return `${figures} ${shares}`.trim();
  }

  private follow(on: boolean): void {
    const wasOn = this.following;
    this.following = on;
    this.check("follow", on);
    if (on !== wasOn) this.stage.redraw();
  }

  private check(tool: string, on: boolean): void {
    const box = this.holder.querySelector<HTMLInputElement>(`input[data-tool=${tool}]`);
    if (box) box.checked = on;
  }

  /** The canvases of all panes at this moment, drawn in this task. */
  private canvases(): HTMLCanvasElement[] {
    this.stage.drawNow();
    this.companion?.stage.drawNow();
    return [this.pane?.canvas, this.stage.canvas, this.companion?.stage.canvas].filter((one) => one !== undefined);
  }

  /** Pose the view for a share of a recorded film: one turn around, or the sequence through its own cameras. */
  private pose(share: number, kind: "turntable" | "camera"): HTMLCanvasElement[] {
    const { frames } = this.preview;
    this.player.time = Math.min(frames - 1, share * (frames - 1));
    this.scrub.value = String(this.player.time);
    this.timeline.show(this.player.time);
    if (kind === "camera") this.following = true;
    else this.stage.turntable(share);
    return this.canvases();
  }

  /** Stop playing for a recording; the function returned restores what was shown. */
  private hold(): () => void {
    const [following, time] = [this.following, this.player.time];
    const restore = this.stage.remember();
    this.player.pause();
    this.following = false;
    return () => {
      this.following = following;
      restore();
      this.player.seek(time);
    };
  }

  private readonly repaint = (): void => {
    const style = getComputedStyle(this.view);
    const colour = (name: string): string => style.getPropertyValue(name).trim();
    for (const body of [this.body, this.truth]) body?.theme(colour("--clay"), colour("--wire"));
    this.companion?.theme(colour("--clay"), colour("--wire"));
    this.dots?.theme(colour("--dots"));
    this.probe.theme(colour("--dots"));
    this.pane?.theme(colour("--dots"), this.film ? "#ffffff" : colour("--wire"));
    this.stage.redraw();
  };

  /** Further arrays come over the network: a failure is shown beside the controls and leaves the rest as it was. */
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
    this.probe.dispose();
    this.companion?.dispose();
    this.film?.close();
    this.stage.dispose();
  }
}
