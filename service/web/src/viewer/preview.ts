// Reading preview.bin, the compact copy of a result that the worker writes for this page (worker/artifacts/preview.py).
//
// Positions are int16 on a uniform grid, frame after frame, so the first frame can be drawn while the last is still on its way;
// residuals and ground truth are fetched by byte range when they are first asked for.

import { Refusal, call, headers } from "../api";

const MAGIC = "PLIANTPV";
const PREFIX = 16;
const HIDDEN = -32768;

interface Section {
  offset: number;
  bytes: number;
}

interface Header {
  version: number;
  num_frames: number;
  num_points: number;
  num_faces: number;
  fps: number;
  frame_stride: number;
  y_axis: string;
  /** Ground truth says that the result's depth has the other sign, which the tracks alone cannot tell. */
  mirrored: boolean;
  origin: [number, number, number];
  step: number;
  residual_step: number;
  sections: { faces: Section; cameras: Section; positions: Section; residuals: Section; truth?: Section };
}

export type Field = "residuals" | "truth";

export class Preview {
  /** Int16, 3 a point, frame after frame; world = origin + step · value. */
  readonly positions: Int16Array;
  /** Frames that have arrived. */
  ready = 0;
  /** Called when more frames have arrived. */
  onFrames: () => void = () => undefined;
  private readonly fields = new Map<Field, Promise<Int16Array>>();

  private constructor(
    private readonly url: string,
    readonly header: Header,
    /** Triangles, 3 indices each. */
    readonly faces: Uint32Array,
    /** 10 a frame: rotation row by row, camera from world, then the scale. */
    readonly cameras: Float32Array,
  ) {
    this.positions = new Int16Array(3 * header.num_points * header.num_frames);
  }

  get frames(): number {
    return this.header.num_frames;
  }

  get points(): number {
    return this.header.num_points;
  }

  has(field: Field): boolean {
    return this.header.sections[field] !== undefined;
  }

  /** Read header, faces and cameras; positions go on arriving after this has returned. */
  static async open(url: string, signal: AbortSignal): Promise<Preview> {
    const start = await range(url, 0, 4096, signal);
    if (new TextDecoder().decode(start.subarray(0, 8)) !== MAGIC) throw new Error("This is not a preview file.");
    const length = new DataView(start.buffer, start.byteOffset).getUint32(12, true);
    const header = JSON.parse(new TextDecoder().decode(start.subarray(PREFIX, PREFIX + length))) as Header;
    if (header.version !== 1) throw new Error("The preview was written by a newer version; reload the page.");
    const { faces, cameras } = header.sections;
    const tables = await range(url, faces.offset, cameras.offset + cameras.bytes - faces.offset, signal);
    const preview = new Preview(
      url,
      header,
      new Uint32Array(aligned(tables, 0, faces.bytes)),
      new Float32Array(aligned(tables, cameras.offset - faces.offset, cameras.bytes)),
    );
    void preview.stream(signal);
    return preview;
  }

  /** Fetch a further array once: residuals (2 a point) or ground truth (3 a point). */
  field(name: Field, signal: AbortSignal): Promise<Int16Array> {
    const section = this.header.sections[name];
    if (section === undefined) return Promise.reject(new Error(`The preview has no ${name}.`));
    let asked = this.fields.get(name);
    if (asked === undefined) {
      asked = range(this.url, section.offset, section.bytes, signal).then((raw) => new Int16Array(aligned(raw, 0, section.bytes)));
      asked.catch(() => this.fields.delete(name));
      this.fields.set(name, asked);
    }
    return asked;
  }

  /** Rotation (9 numbers, row by row) and scale of a frame's camera. */
  camera(frame: number): { rotation: Float32Array; scale: number } {
    const at = 10 * frame;
    return { rotation: this.cameras.subarray(at, at + 9), scale: this.cameras[at + 9] as number };
  }

  private async stream(signal: AbortSignal): Promise<void> {
    const { offset, bytes } = this.header.sections.positions;
    const raw = new Uint8Array(this.positions.buffer);
    const perFrame = 6 * this.points;
    let filled = 0;
    let failures = 0;
    while (filled < bytes && !signal.aborted) {
      try {
        const answer = await ask(this.url, offset + filled, bytes - filled, signal);
        const reader = (answer.body as ReadableStream<Uint8Array>).getReader();
        let skip = answer.status === 206 ? 0 : offset + filled;
        while (filled < bytes) {
          const { done, value } = await reader.read();
          if (done) break;
          const part = value.subarray(Math.min(skip, value.length));
          skip -= value.length - part.length;
          raw.set(part.subarray(0, bytes - filled), filled);
          filled = Math.min(bytes, filled + part.length);
          failures = 0;
          if (Math.floor(filled / perFrame) > this.ready) {
            this.ready = Math.floor(filled / perFrame);
            this.onFrames();
          }
        }
        void reader.cancel().catch(() => undefined);
      } catch (error) {
        failures += 1;
        if (signal.aborted || failures > 5) return;
        if (error instanceof Refusal && error.problem.status !== 0) return;
        await new Promise((resolve) => setTimeout(resolve, 1000 * failures));
      }
    }
  }
}

export const isHidden = (value: number): boolean => value === HIDDEN;

function aligned(raw: Uint8Array, from: number, length: number): ArrayBuffer {
  return raw.slice(from, from + length).buffer as ArrayBuffer;
}

function ask(url: string, offset: number, length: number, signal: AbortSignal): Promise<Response> {
  return call(url, { headers: { ...headers(), Range: `bytes=${offset}-${offset + length - 1}` }, signal });
}

async function range(url: string, offset: number, length: number, signal: AbortSignal): Promise<Uint8Array> {
  const answer = await ask(url, offset, length, signal);
  const raw = new Uint8Array(await answer.arrayBuffer());
  return answer.status === 206 ? raw : raw.subarray(offset, offset + length);
}
