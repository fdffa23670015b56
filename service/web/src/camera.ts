// Recording a film with the camera, if the browser provides one.

import { button, h, say, uniqueId } from "./dom";

/** Maximum length of a recording in seconds: enough for a slow turn, and tracked within a minute or two. */
const LONGEST = 20;
/** Interval at which the recorder delivers data, milliseconds. */
const PIECE = 250;
const FORMATS: [type: string, name: string][] = [
  ["video/mp4;codecs=avc1.640028", "recording.mp4"],
  ["video/webm;codecs=vp8", "recording.webm"],
  ["video/webm", "recording.webm"],
  ["video/mp4", "recording.mp4"],
];

/** True if this page may request a camera: the address is secure, and the browser supports recording. */
export function canRecord(): boolean {
  return isSecureContext && typeof MediaRecorder !== "undefined" && Boolean(navigator.mediaDevices?.getUserMedia);
}

export class CameraDialog {
  private readonly video = h("video", { playsinline: true, "aria-label": "Camera preview" });
  private readonly words = h("span", { role: "status" });
  /** Outside the status, which would be announced every second. */
  private readonly left = h("span", {});
  private readonly start = button("Record", () => this.record(), { class: "primary", disabled: true });
  private readonly stop = button("Stop", () => this.recorder?.stop(), { class: "primary", hidden: true, disabled: true });
  private readonly dialog: HTMLDialogElement;
  private stream: MediaStream | null = null;
  private recorder: MediaRecorder | null = null;
  private timer = 0;
  private closed = false;

  /** `onFilm` gets the recorded film. */
  constructor(private readonly onFilm: (film: File) => void) {
    const id = uniqueId("camera");
    this.video.muted = true;
    this.dialog = h(
      "dialog",
      { class: "region", "aria-labelledby": id },
      h("h2", { id }, "Record a film"),
      h("p", { class: "hint" }, "Keep the object large, sharp and well lit, and turn it slowly by 30° or more. The film stays in this browser until you press Reconstruct."),
      this.video,
      h("p", {}, this.words, this.left),
      h("div", { class: "row" }, this.start, this.stop, button("Cancel", () => this.dialog.close(), { class: "quiet" })),
    );
    this.dialog.addEventListener("close", () => this.close());
  }

  /** Show the dialog and request the camera. */
  async open(): Promise<void> {
    document.body.append(this.dialog);
    this.dialog.showModal();
    say(this.words, "Waiting for the camera…");
    try {
      const stream = await navigator.mediaDevices.getUserMedia({ video: { width: { ideal: 1280 }, facingMode: "environment" }, audio: false });
      this.stream = stream;
      if (this.closed) return this.release();
      this.video.srcObject = stream;
      await this.video.play();
      say(this.words, `Recording stops after ${LONGEST} seconds.`);
      this.start.disabled = false;
      this.start.focus();
    } catch (error) {
      say(this.words, refusal(error));
    }
  }

  private record(): void {
    const format = FORMATS.find(([type]) => MediaRecorder.isTypeSupported(type));
    if (this.stream === null || format === undefined) return say(this.words, "This browser cannot record films. Choose a file instead.");
    const [type, name] = format;
    const recorder = new MediaRecorder(this.stream, { mimeType: type, videoBitsPerSecond: 8_000_000 });
    const parts: Blob[] = [];
    recorder.addEventListener("dataavailable", ({ data }) => {
      if (data.size === 0) return;
      parts.push(data);
      // A slow encoder takes a while for its first frame; a recording without a frame is not a film.
      if (!this.stop.disabled) return;
      this.stop.disabled = false;
      this.stop.focus();
    });
    recorder.addEventListener("stop", () => {
      if (this.closed) return;
      say(this.left, "");
      if (parts.length === 0) return say(this.words, "The camera delivered no picture. Cancel, check the camera and record again.");
      this.dialog.close();
      this.onFilm(new File(parts, name, { type: type.split(";")[0] as string }));
    });
    recorder.start(PIECE);
    this.recorder = recorder;
    this.start.hidden = true;
    this.stop.hidden = false;
    this.count(LONGEST);
  }

  private count(left: number): void {
    say(this.words, "Recording");
    say(this.left, `, ${left} s left.`);
    if (left === 0) return this.recorder?.stop();
    this.timer = setTimeout(() => this.count(left - 1), 1000);
  }

  private close(): void {
    this.closed = true;
    clearTimeout(this.timer);
    if (this.recorder?.state === "recording") this.recorder.stop();
    this.release();
    this.dialog.remove();
  }

  private release(): void {
    for (const track of this.stream?.getTracks() ?? []) track.stop();
    this.stream = null;
  }
}

function refusal(error: unknown): string {
  const name = error instanceof DOMException ? error.name : "";
  if (name === "NotAllowedError") return "The browser does not allow this page to use the camera. Allow it in the address bar, or choose a file.";
  if (name === "NotFoundError") return "No camera was found. Connect one, or choose a file.";
  return `The camera cannot be used (${error instanceof Error ? error.message : String(error)}). Choose a file instead.`;
}
