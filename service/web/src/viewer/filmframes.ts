// Reading film_frames.bin, the small pictures of every tracked frame of a film (worker/films/frame_strip.py).

import { call, headers } from "../api";
import type { Crop } from "./stage";

const MAGIC = "PLIANTFF";
const PREFIX = 16;
/** Number of decoded pictures to keep. */
const KEPT = 48;

interface Header {
  version: number;
  /** Size of the film in pixels. */
  width: number;
  height: number;
  /** Start of each picture and end of the last one, in bytes from the start of the file. */
  offsets: number[];
}

export class FilmFrames {
  private readonly decoded = new Map<number, ImageBitmap | Promise<ImageBitmap | null>>();

  private constructor(
    private readonly raw: Uint8Array<ArrayBuffer>,
    private readonly header: Header,
  ) {}

  /** The film's picture, in its pixels: the first one's centre is (0, 0). */
  get frame(): Crop {
    return { left: -0.5, top: -0.5, width: this.header.width, height: this.header.height };
  }

  get frames(): number {
    return this.header.offsets.length - 1;
  }

  static async open(url: string, signal: AbortSignal): Promise<FilmFrames> {
    const raw = new Uint8Array(await (await call(url, { headers: headers(), signal })).arrayBuffer());
    if (new TextDecoder().decode(raw.subarray(0, 8)) !== MAGIC) throw new Error("This is not a film frames file.");
    const length = new DataView(raw.buffer).getUint32(12, true);
    return new FilmFrames(raw, JSON.parse(new TextDecoder().decode(raw.subarray(PREFIX, PREFIX + length))) as Header);
  }

  /** Return a frame's picture if it is decoded; otherwise return null, decode it and call `onReady`. */
  picture(frame: number, onReady: () => void): ImageBitmap | null {
    const known = this.decoded.get(frame);
    if (known instanceof ImageBitmap) return known;
    if (known === undefined) {
      const [from, to] = [this.header.offsets[frame] as number, this.header.offsets[frame + 1] as number];
      const promise = createImageBitmap(new Blob([this.raw.subarray(from, to)], { type: "image/jpeg" })).catch(() => null);
      this.decoded.set(frame, promise);
      void promise.then((picture) => {
        if (picture === null) return;
        this.decoded.set(frame, picture);
        this.forget();
        onReady();
      });
    }
    return null;
  }

  close(): void {
    for (const one of this.decoded.values()) if (one instanceof ImageBitmap) one.close();
    this.decoded.clear();
  }

  private forget(): void {
    for (const [frame, one] of this.decoded) {
      if (this.decoded.size <= KEPT) return;
      if (one instanceof ImageBitmap) {
        one.close();
        this.decoded.delete(frame);
      }
    }
  }
}
