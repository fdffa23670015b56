// The viewer: the animated result with its controls. This module and three.js are loaded as a separate chunk.

import { isAbort } from "../api";
import { button, h, say } from "../dom";
import { Body, seenFromBehind } from "./body";
import { type Colouring, type Values, colourings, valuesFor } from "./colours";
import type { Other } from "./companion";
import { Comparison } from "./comparison";
import { choice, group, ordinal, toggle } from "./controls";
import { FilmFrames } from "./filmframes";
import { FilmPane } from "./filmpane";
import { openHelp } from "./help";
import { control, timeSlider } from "./keys";
import { showLegend } from "./legend";
import { type Picture, pictureOf } from "./picture";
import { Player, paceControls } from "./player";
import { Preview } from "./preview";
import { Probe } from "./probe";
import { Saving } from "./saving";
import { type Side, Stage } from "./stage";
import { Timeline } from "./timeline";
import { TrackDots } from "./tracks";

/** Pictures of at least this width over height are larger below each other than beside each other on a usual screen. */
const WIDE = 1.5;

/** The files that the viewer shows, and related jobs. */
export interface Sources {
  title: string;
  preview: string;
  /** Small pictures of the film's frames, if the job has a film. */
  film?: string | undefined;
  /** USDZ, which phones and headsets show in augmented reality. */
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
  private readonly scrub: HTMLInputElement;
  private readonly comparison: Comparison;
  private truth: Body | null = null;
  private colouring: Colouring = "plain";
  private dots: TrackDots | null = null;
  private pane: FilmPane | null = null;
  private following = false;
  private wired = false;
  /** What the switches ask for; an array may arrive after its switch was turned again. */
  private readonly wanted = { tracks: false, truth: false, beside: false, over: false };
  private readonly leaving = new AbortController();
  private readonly view = h("div", { class: "view" });
  private readonly panes = h("div", { class: "panes" });
  private readonly labels = h("div", { class: "view-labels", hidden: true }, h("span", {}, "result"), h("span", {}, "ground truth"));
  private readonly legend = h("div", { class: "legend", hidden: true });
  private readonly play = h("button", { type: "button", class: "play" });
  private readonly clock = h("span", { class: "clock" });
  private readonly mirrored = h("p", { class: "hint" }, "Depth is mirrored to match the ground truth; the files are not.");
  private readonly trouble = h("p", { class: "muted", role: "status" });
  private readonly incomplete = h("p", { class: "muted", role: "status" });
  private readonly themes = matchMedia("(prefers-color-scheme: dark)");

  /** Fetch a result and show it inside `holder`. */
  static async open(holder: HTMLElement, sources: Sources, signal: AbortSignal): Promise<Viewer> {
    const [preview, film] = await Promise.all([
      Preview.open(sources.preview, signal),
      // A result can be viewed without its film.
      sources.film === undefined ? null : FilmFrames.open(sources.film, signal).catch(() => null),
    ]);
    signal.throwIfAborted(); // a viewer that is opened now would never be closed
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
    this.player = new Player(preview.frames, preview.clock, () => this.moved(), () => this.showState());
    this.probe = new Probe(preview, this.leaving.signal, () => this.stage.redraw());
    this.stage.add(this.probe.marker);
    this.timeline = new Timeline(preview, (frame) => this.seek(frame));
    this.behind = preview.faces.length > 0 && seenFromBehind(preview, preview.clearest);
    this.scrub = timeSlider(preview.frames, () => this.player.time, (time) => this.seek(time));
    this.comparison = new Comparison({
      preview,
      title: sources.title,
      timeline: this.timeline,
      panes: this.panes,
      signal: this.leaving.signal,
      colours: () => this.holder.querySelector<HTMLSelectElement>(".colouring select"),
      paint: (values) => {
        this.colouring = "difference";
        this.paint(values);
      },
      repaint: this.repaint,
      guarded: (action) => this.guarded(action),
    });
    this.flip(preview.header.mirrored);
    this.player.time = preview.clearest;
    this.build();
    this.stage.look("front");
    this.stage.onDraw = () => this.place();
    this.stage.onTurn = () => this.follow(false);
    preview.onFrames = () => (preview.ready === preview.frames ? this.stage.refit() : this.stage.redraw());
    preview.loaded.catch(() => {
      if (!signal.aborted) say(this.incomplete, `Only ${preview.ready} of ${preview.frames} frames could be loaded. Reload the page to try again.`);
    });
    this.themes.addEventListener("change", this.repaint);
    signal.addEventListener("abort", () => this.dispose());
    this.repaint();
    this.moved();
    if (film) void this.beside(true);
    void this.colour(colourings(preview)[0]![0]);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.player.play();
    this.showState();
  }

  private build(): void {
    const { preview } = this;
    const { orbit } = this.stage;
    control(this.stage.canvas, {
      turn: (across, down) => orbit.turn(across, down),
      zoom: (factor) => orbit.zoom(factor),
      step: (by) => this.seek(Math.round(this.player.time) + by),
      toggle: () => this.toggle(),
      look: (side) => this.look(side),
      fit: () => this.stage.fit(),
      follow: () => this.follow(!this.following),
      fullScreen: () => void this.fullScreen(),
      help: () => openHelp(this.holder),
      pick: (x, y) => this.pick(x, y),
    });
    this.play.addEventListener("click", () => this.toggle());
    this.view.append(this.stage.canvas, this.labels);
    this.panes.append(this.view);
    const time = h(
      "div",
      { class: "timeline" },
      this.play,
      h("div", { class: "scrubbing" }, this.timeline.element, this.scrub),
      this.clock,
    );
    const full = document.fullscreenEnabled ? button("Full screen", () => void this.fullScreen()) : "";
    // Before the canvas, so that Shift+Tab leads from the player directly to the picture.
    const corner = h("div", { class: "corner" }, full, button("Help", () => openHelp(this.holder)));
    const thinned = preview.header.frame_stride > 1 ? `Every ${ordinal(preview.header.frame_stride)} frame is shown; the files contain all frames.` : "";
    const note = h("p", { class: "hint", hidden: !thinned }, thinned);
    const main = h("div", { class: "stage-main" }, corner, this.panes, this.legend, this.comparison.summary, time, note, this.mirrored, this.incomplete, this.trouble);
    this.holder.replaceChildren(main, this.tools());
  }

  private tools(): HTMLElement {
    const { preview, sources } = this;
    const aim = (words: string, side: Side): HTMLButtonElement => button(words, () => this.look(side));
    const views = [aim("Front", "front"), aim("Side", "side"), aim("Top", "top"), button("Fit", () => this.stage.fit())];
    const colours = colourings(preview);
    const saving = new Saving({
      title: sources.title,
      preview: sources.preview,
      film: this.film ? sources.film : undefined,
      usdz: sources.usdz,
      seconds: preview.clock.last,
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
      paceControls(this.player),
      group("Point", this.probe.element),
      sources.others ? this.comparison.choice(sources.others) : "",
      group("Save", saving.element),
    );
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
    this.mirrored.hidden = !(on && this.preview.header.mirrored);
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
    this.probe.hush(this.player.playing);
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

  /** Update all objects to the current time; called before each drawing. */
  private place(): void {
    const frame = Math.round(Math.min(this.player.time, this.preview.ready - 1));
    // A camera belongs to one frame, as does the film's picture.
    const time = this.following ? frame : this.player.time;
    this.body.show(time);
    this.truth?.show(time);
    this.dots?.show(time);
    this.probe.show(time);
    this.pane?.show(time);
    if (this.following) this.stage.through(frame, this.film?.frame ?? this.pane?.frame ?? null);
    this.comparison.companion?.show(time, this.stage);
  }

  private async colour(colouring: Colouring): Promise<void> {
    const { preview } = this;
    const { signal } = this.leaving;
    this.colouring = colouring;
    const values = colouring === "difference" ? this.comparison.difference() : valuesFor(colouring, preview, signal);
    await this.guarded(async () => {
      const [found, picture] = await Promise.all([values, colouring === "film" ? pictureOf(preview, signal) : null]);
      if (this.colouring === colouring) this.paint(found, picture);
    });
  }

  private paint(values: Values | null, picture: Picture | null = null): void {
    this.body.colour(values, picture);
    showLegend(this.legend, values);
    this.stage.redraw();
  }

  private wireframe(on: boolean): void {
    this.wired = on;
    this.repaint();
  }

  private async tracks(on: boolean): Promise<void> {
    this.wanted.tracks = on;
    await this.guarded(async () => {
      if (!on && this.dots) {
        this.stage.remove(this.dots.group);
        this.dots.dispose();
        this.dots = null;
      } else if (on) {
        const residuals = await this.preview.field("residuals", this.leaving.signal);
        if (!this.wanted.tracks || this.dots) return;
        this.dots = new TrackDots(this.preview, residuals);
        this.repaint();
        this.stage.add(this.dots.group);
      }
    });
  }

  private async withTruth(on: boolean): Promise<void> {
    this.wanted.truth = on;
    await this.guarded(async () => {
      const positions = on && !this.truth ? await this.preview.field("truth", this.leaving.signal) : null;
      if (this.wanted.truth !== on) return;
      if (positions && !this.truth) {
        this.truth = new Body(this.preview, positions);
        this.truth.reverse(this.behind !== this.stage.isFlipped);
        this.repaint();
        this.stage.add(this.truth.group, 1);
      }
      this.labels.hidden = !on;
      this.labels.classList.toggle("stacked", this.stage.stacked);
      this.stage.divide(on);
    });
  }

  /** Show the film, or the tracks alone, beside the mesh; beside its film, the mesh is viewed through the same camera. */
  private async beside(on: boolean): Promise<void> {
    this.wanted.beside = on;
    if (on && this.film && this.pane === null) this.follow(true);
    await this.guarded(async () => {
      if (!on) {
        this.pane?.canvas.parentElement?.remove();
        this.panes.removeAttribute("style");
        this.panes.classList.remove("wide");
        this.pane = null;
        this.wanted.over = false;
        this.check("over", false);
      } else if (this.pane === null) {
        const residuals = await this.preview.field("residuals", this.leaving.signal);
        if (!this.wanted.beside || this.pane) return;
        this.pane = new FilmPane(this.preview, residuals, this.film);
        this.panes.prepend(h("div", { class: "view film" }, this.pane.canvas));
        this.panes.style.setProperty("--shape", String(this.pane.shape));
        this.panes.classList.toggle("wide", this.pane.shape >= WIDE);
        this.repaint();
      }
      this.check("beside", on);
    });
  }

  private async meshOver(on: boolean): Promise<void> {
    this.wanted.over = on;
    if (on) await this.beside(true);
    if (this.pane === null) return;
    this.pane.showsMesh = this.wanted.over;
    this.pane.showsTracks = !this.wanted.over;
    this.stage.redraw();
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

  /** The canvases of all panes, drawn in this task. */
  private canvases(): HTMLCanvasElement[] {
    this.stage.drawNow();
    this.comparison.companion?.stage.drawNow();
    return [this.pane?.canvas, this.stage.canvas, this.comparison.companion?.stage.canvas].filter((one) => one !== undefined);
  }

  /** Set the view for a share of a recorded film: one turn around the object, or the sequence through its cameras. */
  private pose(share: number, kind: "turntable" | "camera"): HTMLCanvasElement[] {
    const { clock } = this.preview;
    this.player.time = clock.frame(share * clock.last);
    this.scrub.value = String(this.player.time);
    this.timeline.show(this.player.time);
    if (kind === "camera") this.following = true;
    else this.stage.turntable(share);
    return this.canvases();
  }

  /** Pause playback for a recording; the returned function restores the view. */
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
    for (const shown of [this.body, this.truth, this.comparison.companion]) {
      shown?.theme(colour("--clay"), colour("--wire"));
      shown?.wireframe(this.wired);
    }
    this.dots?.theme(colour("--dots"));
    this.probe.theme(colour("--dots"));
    this.pane?.theme(colour("--dots"), this.film ? "#ffffff" : colour("--wire"));
    this.stage.redraw();
  };

  /** Run an action that may load arrays; an error is shown below the picture and leaves the rest unchanged. */
  private async guarded(action: () => Promise<void>): Promise<void> {
    try {
      await action();
      say(this.trouble, "");
    } catch (error) {
      // What this page has stopped is no longer wanted.
      if (!isAbort(error)) say(this.trouble, error instanceof Error ? error.message : String(error));
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
    this.comparison.companion?.dispose();
    this.film?.close();
    this.stage.dispose();
  }
}
