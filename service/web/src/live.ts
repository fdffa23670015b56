// The job of a film while it is tracked: the film's picture immediately, and the points as the service reports them.
//
// The browser decodes the picture from the file that this tab has sent. Where it cannot, the points move over the first frame,
// which the service decoded before the job was submitted. After a reload only the points are available.

import { h, say } from "./dom";
import { firstFrame, servedFrame } from "./film";
import { sentFile } from "./sent";
import { type Job, ofFilm } from "./types";

type Followed = NonNullable<NonNullable<Job["progress"]>["followed"]>;

export class LiveTracks {
  private readonly canvas = h("canvas", { role: "img", "aria-label": "The film with its tracked points" });
  private readonly words = h("figcaption", { class: "hint" });
  readonly element = h("figure", { class: "live", hidden: true }, this.canvas, this.words);
  private picture: ImageBitmap | HTMLVideoElement | null = null;
  private video: HTMLVideoElement | null = null;
  private url = "";
  private followed: Followed | null = null;
  private started = false;
  /** Whether the picture is the first frame as the service decoded it. */
  private still = false;

  constructor(private readonly id: string) {
    new ResizeObserver(() => this.draw()).observe(this.element);
  }

  /** Update the picture from a record of the job. */
  show(job: Job): void {
    const { status, progress } = job;
    const pending = ofFilm(job) && (status === "queued" || status === "running");
    const followed = progress?.followed ?? null;
    const isTracked = progress !== null && progress.stage !== "track";
    // After a reload, nothing is left to show of a film that is tracked already.
    this.element.hidden = !pending || (isTracked && !followed && !this.followed && sentFile(this.id, "film") === undefined);
    if (!pending) return this.close();
    if (!this.started) {
      this.started = true;
      void this.begin();
    }
    if (followed && followed.frame !== this.followed?.frame) this.move(followed);
    const count = this.followed ? this.followed.points.length / 2 : 0;
    const still = this.still ? " The picture stays at the first frame: this browser cannot decode the film." : "";
    const expected = isTracked ? "The film is tracked." : "The points appear as soon as they are tracked.";
    say(this.words, count > 0 ? `Frame ${this.followed?.frame}: ${count} of the tracked points.${still}` : expected);
  }

  close(): void {
    if (this.picture instanceof ImageBitmap) this.picture.close();
    this.video?.removeAttribute("src");
    this.video?.load();
    if (this.url) URL.revokeObjectURL(this.url);
    this.picture = this.video = null;
    this.url = "";
  }

  private async begin(): Promise<void> {
    const film = sentFile(this.id, "film");
    if (film === undefined) return this.draw();
    const decoded = await firstFrame(film);
    this.picture = decoded ?? (await servedFrame(film).catch(() => null)); // not a picture after all
    this.still = decoded === null && this.picture !== null;
    this.draw();
    if (/\.(gif|zip)$/i.test(film.name) || decoded === null) return;
    const video = h("video", { muted: true, playsinline: true, preload: "auto" });
    video.muted = true;
    this.url = URL.createObjectURL(film);
    video.src = this.url;
    video.addEventListener("seeked", () => {
      this.picture = video;
      this.draw();
    });
    this.video = video;
  }

  private move(followed: Followed): void {
    this.followed = followed;
    // The points are drawn with the frame they belong to, once the browser has decoded it.
    if (this.video && this.video.readyState > 0) this.video.currentTime = followed.seconds;
    else this.draw();
  }

  private draw(): void {
    const { canvas, picture, followed } = this;
    const size = followed ?? (picture instanceof HTMLVideoElement ? { width: picture.videoWidth, height: picture.videoHeight } : picture);
    if (size === null || canvas.clientWidth === 0) return;
    const scale = Math.min(2, devicePixelRatio) * Math.min(canvas.clientWidth / size.width, canvas.clientHeight / size.height);
    Object.assign(canvas, { width: Math.round(scale * size.width), height: Math.round(scale * size.height) });
    const context = canvas.getContext("2d") as CanvasRenderingContext2D;
    if (picture) context.drawImage(picture, 0, 0, canvas.width, canvas.height);
    const dot = Math.max(3, 0.007 * canvas.width);
    const colour = getComputedStyle(canvas).getPropertyValue("--dots").trim();
    for (let i = 0; followed && i < followed.points.length; i += 2) {
      const [x, y] = [scale * ((followed.points[i] as number) + 0.5), scale * ((followed.points[i + 1] as number) + 0.5)];
      context.fillStyle = "#ffffff";
      context.fillRect(x - dot / 2 - 1, y - dot / 2 - 1, dot + 2, dot + 2);
      context.fillStyle = colour;
      context.fillRect(x - dot / 2, y - dot / 2, dot, dot);
    }
  }
}
