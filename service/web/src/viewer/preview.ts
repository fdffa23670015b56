// Reading preview.bin, the compact copy of a result that the worker writes for this page (worker/artifacts/preview.py).
//
// Positions are int16 on a uniform grid, frame after frame, so the first frame can be drawn while later ones are loading;
// residuals and ground truth are fetched by byte range when first needed.

import { Refusal, call, headers, reached } from "../api";
import { Clock } from "./clock";

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
  /** True if the ground truth has the opposite sign of depth, which tracks alone do not determine. */
  mirrored: boolean;
  origin: [number, number, number];
  step: number;
  residual_step: number;
  /** Standard deviation of one step of the section `spread`. */
  spread_step?: number;
  /** Root mean square distance of the points from the centre of their frame: the size to which errors are relative. */
  size?: number;
  /** Number of frames of the job, of which every `frame_stride`-th is included. */
  all_frames?: number;
  /** Focal length, the tracks' unit; null for orthographic cameras. */
  focal?: number | null;
  principal_point?: [number, number];
  image_size?: [number, number] | null;
  sections: {
    faces: Section;
    cameras: Section;
    positions: Section;
    residuals: Section;
    truth?: Section;
    frames?: Section;
    points?: Section;
    spread?: Section;
    rejected?: Section;
    times?: Section;
    names?: Section;
    places?: Section;
    picture?: Section;
  };
}

/** Arrays that are fetched when first needed. */
interface Fields {
  residuals: Int16Array;
  truth: Int16Array;
  spread: Uint16Array;
  rejected: Uint8Array;
  /** Name of every point. */
  names: string[];
  /** Positions of the points in the picture, 2 per point, 0 … 1: u right, v down. */
  places: Float32Array;
  /** The film's template frame, JPEG. */
  picture: ArrayBuffer;
}
export type Field = keyof Fields;

const READ: { [Name in Field]: (raw: ArrayBuffer) => Fields[Name] } = {
  residuals: (raw) => new Int16Array(raw),
  truth: (raw) => new Int16Array(raw),
  spread: (raw) => new Uint16Array(raw),
  rejected: (raw) => new Uint8Array(raw),
  names: (raw) => new TextDecoder().decode(raw).split("\n"),
  places: (raw) => new Float32Array(raw),
  picture: (raw) => raw,
};

/** Values of one frame; null if unknown. */
export interface FrameFacts {
  /** Share of the points that are hidden. */
  hidden: number | null;
  /** Expected error, a share of the object's size. */
  expected: number | null;
  /** `e3d_frame_scaled`, if ground truth was given. */
  error: number | null;
  translation: [number, number];
}

const FRAME_COLUMNS = 6;

export class Preview {
  /** Int16, 3 per point, frame after frame; world = origin + step · value. */
  readonly positions: Int16Array;
  /** Number of frames loaded. */
  ready = 0;
  /** Called when more frames have loaded. */
  onFrames: () => void = () => undefined;
  /** Settles when all frames have loaded or no more will. */
  readonly loaded: Promise<void>;
  private readonly fields = new Map<Field, Promise<unknown>>();

  private constructor(
    private readonly url: string,
    readonly header: Header,
    /** Triangles, 3 indices each. */
    readonly faces: Uint32Array,
    /** 10 per frame: rotation row by row, camera from world, then the scale. */
    readonly cameras: Float32Array,
    /** 6 per frame, see worker/artifacts/preview.py; empty in files of older services. */
    private readonly frameTable: Float32Array,
    /** 2 per point: number of frames in which it is visible, and in which it is rejected; empty in files of older services. */
    private readonly pointTable: Uint32Array,
    /** When each frame is shown. */
    readonly clock: Clock,
    signal: AbortSignal,
  ) {
    this.positions = new Int16Array(3 * header.num_points * header.num_frames);
    this.loaded = this.stream(signal);
    this.loaded.catch(() => undefined); // `first` and the viewer report it
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

  /** Read header, faces, cameras and the first frame; positions continue to load afterwards. */
  static async open(url: string, signal: AbortSignal): Promise<Preview> {
    const start = await range(url, 0, 4096, signal);
    if (new TextDecoder().decode(start.subarray(0, 8)) !== MAGIC) throw new Error("This is not a preview file.");
    const length = new DataView(start.buffer, start.byteOffset).getUint32(12, true);
    const header = JSON.parse(new TextDecoder().decode(start.subarray(PREFIX, PREFIX + length))) as Header;
    if (header.version !== 1) throw new Error("The preview was written by a newer version; reload the page.");
    const { faces, cameras } = header.sections;
    const none = { offset: faces.offset, bytes: 0 };
    const { frames = none, points = none, times = none } = header.sections;
    const [tables, frameTable, pointTable, timeTable] = await Promise.all([
      range(url, faces.offset, cameras.offset + cameras.bytes - faces.offset, signal),
      frames.bytes > 0 ? range(url, frames.offset, frames.bytes, signal) : new Uint8Array(),
      points.bytes > 0 ? range(url, points.offset, points.bytes, signal) : new Uint8Array(),
      times.bytes > 0 ? range(url, times.offset, times.bytes, signal) : new Uint8Array(),
    ]);
    const preview = new Preview(
      url,
      header,
      new Uint32Array(aligned(tables, 0, faces.bytes)),
      new Float32Array(aligned(tables, cameras.offset - faces.offset, cameras.bytes)),
      new Float32Array(aligned(frameTable, 0, frames.bytes)),
      new Uint32Array(aligned(pointTable, 0, points.bytes)),
      times.bytes > 0 ? new Clock(new Float32Array(aligned(timeTable, 0, times.bytes))) : Clock.even(header.num_frames, header.fps),
      signal,
    );
    const first = new Promise<void>((resolve) => (preview.onFrames = resolve));
    await Promise.race([first, preview.loaded]);
    return preview;
  }

  /** Fetch another section, once. */
  field<Name extends Field>(name: Name, signal: AbortSignal): Promise<Fields[Name]> {
    const section = this.header.sections[name];
    if (section === undefined) return Promise.reject(new Error(`The preview has no ${name}.`));
    let asked = this.fields.get(name) as Promise<Fields[Name]> | undefined;
    if (asked === undefined) {
      asked = range(this.url, section.offset, section.bytes, signal).then((raw) => READ[name](aligned(raw, 0, section.bytes)));
      asked.catch(() => this.fields.delete(name));
      this.fields.set(name, asked);
    }
    return asked;
  }

  /** The object's size in the tracks' unit, to which errors are relative. */
  get size(): number {
    return this.header.size ?? 1;
  }

  /** Number of frames of the job. */
  get allFrames(): number {
    return this.header.all_frames ?? this.frames * this.header.frame_stride;
  }

  /** Return the values of a frame. */
  facts(frame: number): FrameFacts {
    const at = (column: number): number | null => {
      const value = this.frameTable[FRAME_COLUMNS * frame + column];
      return value === undefined || Number.isNaN(value) ? null : value;
    };
    return { hidden: at(2), expected: at(3), error: at(4), translation: [at(0) ?? 0, at(1) ?? 0] };
  }

  /** Return the number of frames in which a point is visible, and in which it is rejected; null in files of older services. */
  counts(point: number): { seen: number; rejected: number } | null {
    const seen = this.pointTable[2 * point];
    return seen === undefined ? null : { seen, rejected: this.pointTable[2 * point + 1] ?? 0 };
  }

  /** The frame with the most visible points. */
  get clearest(): number {
    let best = 0;
    for (let frame = 1; frame < this.frames; frame += 1) {
      if ((this.facts(frame).hidden ?? 0) < (this.facts(best).hidden ?? 0)) best = frame;
    }
    return best;
  }

  /** Project a world point `(x, y, z)` into a frame's picture, in the tracks' unit. */
  project(frame: number, x: number, y: number, z: number): [number, number] {
    const { rotation: r, scale } = this.camera(frame);
    const [tx, ty] = this.facts(frame).translation;
    const across = (row: number): number => scale * (r[3 * row]! * x + r[3 * row + 1]! * y + r[3 * row + 2]! * z);
    const [u, v] = [across(0) + tx, across(1) + ty];
    const centre = this.header.principal_point;
    if (!this.header.focal || !centre) return [u, v];
    const distance = this.distance(frame, x, y, z);
    return [centre[0] + (u - centre[0]) / distance, centre[1] + (v - centre[1]) / distance];
  }

  /** Return a world point's distance from a frame's camera along its axis, relative to that of the world's origin; 1 without perspective. */
  distance(frame: number, x: number, y: number, z: number): number {
    const { rotation: r, scale } = this.camera(frame);
    const { focal, y_axis: upright } = this.header;
    return focal ? 1 + ((upright === "up" ? -1 : 1) * scale * (r[6]! * x + r[7]! * y + r[8]! * z)) / focal : 1;
  }

  /** Return a point's position in the world. */
  place(frame: number, point: number): [number, number, number] {
    const at = 3 * (this.points * frame + point);
    const axis = (k: number): number => (this.header.origin[k] as number) + this.header.step * (this.positions[at + k] as number);
    return [axis(0), axis(1), axis(2)];
  }

  /** Return rotation (9 numbers, row by row) and scale of a frame's camera. */
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
    while (filled < bytes) {
      const before = filled;
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
          if (Math.floor(filled / perFrame) > this.ready) {
            this.ready = Math.floor(filled / perFrame);
            this.onFrames();
          }
        }
        void reader.cancel().catch(() => undefined);
        if (filled === before) throw new Error("The service sent no more of the mesh.");
        failures = 0;
      } catch (error) {
        failures = filled > before ? 1 : failures + 1;
        if (signal.aborted || failures > 5) throw error;
        if (error instanceof Refusal && !error.problem.retryable) throw error;
        await new Promise((resolve) => setTimeout(resolve, 1000 * failures));
      }
    }
  }
}

export const isHidden = (value: number): boolean => value === HIDDEN;

/** Whether the solver rejected an observation as an outlier; `bits` is the section `rejected`. */
export function isRejected(bits: Uint8Array, points: number, frame: number, point: number): boolean {
  return ((bits[Math.ceil(points / 8) * frame + (point >> 3)] as number) & (1 << (point & 7))) !== 0;
}

function aligned(raw: Uint8Array, from: number, length: number): ArrayBuffer {
  return raw.slice(from, from + length).buffer as ArrayBuffer;
}

function ask(url: string, offset: number, length: number, signal: AbortSignal): Promise<Response> {
  return call(url, { headers: { ...headers(), Range: `bytes=${offset}-${offset + length - 1}` }, signal });
}

async function range(url: string, offset: number, length: number, signal: AbortSignal): Promise<Uint8Array> {
  const answer = await ask(url, offset, length, signal);
  const raw = new Uint8Array(await reached(answer.arrayBuffer()));
  return answer.status === 206 ? raw : raw.subarray(offset, offset + length);
}
