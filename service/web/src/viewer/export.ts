// Files created in the browser: a picture or a film of the view, and a self-contained page with the result.

import { call, headers } from "../api";
import { h } from "../dom";

/** Save content as a download. */
export function save(content: Blob, name: string): void {
  const url = URL.createObjectURL(content);
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/** Return a file name derived from a job's name. */
export function fileName(name: string, end: string): string {
  const plain = name.trim().replace(/[^\p{L}\p{N}._-]+/gu, "-").replace(/^-+|-+$/g, "");
  return `${plain || "pliant"}${end}`;
}

/** Draw canvases side by side on a background colour, each at its own size. */
export function compose(canvases: HTMLCanvasElement[], background: string, into = document.createElement("canvas")): HTMLCanvasElement {
  const width = canvases.reduce((sum, canvas) => sum + canvas.width, 0);
  const height = Math.max(...canvases.map((canvas) => canvas.height));
  // Video encoders need even sides.
  const [wide, tall] = [width - (width % 2), height - (height % 2)];
  if (into.width !== wide || into.height !== tall) Object.assign(into, { width: wide, height: tall });
  const context = into.getContext("2d") as CanvasRenderingContext2D;
  context.fillStyle = background;
  context.fillRect(0, 0, into.width, into.height);
  let left = 0;
  for (const canvas of canvases) {
    context.drawImage(canvas, left, 0);
    left += canvas.width;
  }
  return into;
}

export function png(canvas: HTMLCanvasElement): Promise<Blob> {
  return new Promise((resolve, reject) => {
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The browser could not encode the picture."))), "image/png");
  });
}

const FORMATS: [type: string, end: string][] = [
  ["video/mp4;codecs=avc1.640028", ".mp4"],
  ["video/mp4", ".mp4"],
  ["video/webm;codecs=vp9", ".webm"],
  ["video/webm", ".webm"],
];

/** Return the best film format that this browser can encode, or null. */
export function filmFormat(): { type: string; end: string } | null {
  if (typeof MediaRecorder === "undefined" || !("captureStream" in HTMLCanvasElement.prototype)) return null;
  const found = FORMATS.find(([type]) => MediaRecorder.isTypeSupported(type));
  return found ? { type: found[0], end: found[1] } : null;
}

export interface Recording {
  seconds: number;
  fps: number;
  /** Draw the view at a share of the recording, 0 … 1, and return the canvases to record. */
  draw: (share: number) => HTMLCanvasElement[];
  background: string;
  onShare: (share: number) => void;
}

/** Record a film in real time, as MediaRecorder requires; it ends early when `signal` fires. */
export async function record(what: Recording, type: string, signal: AbortSignal): Promise<Blob> {
  const canvas = compose(what.draw(0), what.background);
  const stream = canvas.captureStream(what.fps);
  const recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: 8_000_000 });
  const parts: Blob[] = [];
  recorder.addEventListener("dataavailable", (event) => parts.push(event.data));
  const stopped = new Promise<void>((resolve) => recorder.addEventListener("stop", () => resolve()));
  recorder.start();
  const began = performance.now();
  await new Promise<void>((resolve) => {
    const tick = (): void => {
      const share = (performance.now() - began) / 1000 / what.seconds;
      if (share >= 1 || signal.aborted) return resolve();
      compose(what.draw(share), what.background, canvas);
      what.onShare(share);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  });
  recorder.stop();
  await stopped;
  for (const track of stream.getTracks()) track.stop();
  if (signal.aborted) throw new DOMException("The recording was stopped.", "AbortError");
  return new Blob(parts, { type });
}

/** Return a page that shows a result without a service: script, style and files are embedded. */
export async function standalonePage(title: string, files: { preview: string; film: string | null }): Promise<Blob> {
  const linked = (name: string): string => {
    const address = document.querySelector<HTMLMetaElement>(`meta[name="pliant-standalone-${name}"]`)?.content;
    if (!address) throw new Error("This page cannot be saved again; save it from the service.");
    return address;
  };
  const text = async (address: string): Promise<string> => (await call(address)).text();
  const bytes = async (address: string): Promise<string> => base64(await (await call(address, { headers: headers() })).arrayBuffer());
  const [script, style, preview, film] = await Promise.all([
    text(linked("script")),
    text(linked("style")),
    bytes(files.preview),
    files.film === null ? null : bytes(files.film),
  ]);
  const escape = (words: string): string => words.replace(/&/g, "&amp;").replace(/</g, "&lt;");
  const data = (id: string, content: string): string => `<script type="text/plain" id="${id}">${content}</script>\n`;
  const page = [
    '<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">',
    `<meta name="color-scheme" content="light dark"><title>${escape(title)}</title>\n<style>${style}</style></head>\n`,
    `<body class="standalone"><main><h1>${escape(title)}</h1><div id="stage" class="stage"></div>`,
    '<p class="hint">Made with Pliant. This file works offline.</p></main>\n',
    data("preview", preview),
    film === null ? "" : data("film", film),
    // The string "</script" would end the script.
    `<script>${script.replace(/<\/script/gi, "<\\/script")}</script></body></html>\n`,
  ];
  return new Blob(page, { type: "text/html" });
}

function base64(raw: ArrayBuffer): string {
  const all = new Uint8Array(raw);
  const parts: string[] = [];
  const length = 3 * 8192; // whole triples, so that the parts can be joined
  for (let at = 0; at < all.length; at += length) parts.push(btoa(String.fromCharCode(...all.subarray(at, at + length))));
  return parts.join("");
}
