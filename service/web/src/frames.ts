// The frames of a film by their numbers, as far as this browser can decode them and tell which is which.

import { pictureAt, pictures } from "./film";
import { unreadable } from "./peek";

/** Frames numbered as the service counts them: in the complete film, from 0. */
export interface Frames {
  readonly count: number;
  /** Return a frame at the film's resolution, or null if it cannot be decoded. */
  picture: (index: number) => Promise<ImageBitmap | null>;
  close: () => void;
}

/** Timeouts for finding another position of a video, and for showing the frame there, milliseconds. A frame that is shown already is not shown again. */
const PATIENCE = { find: 10_000, show: 1000 };
/** Frames that are compared with evenly spaced ones, as shares of the film. A film whose frames are not evenly spaced differs in some of them. */
const SAMPLES = [0.25, 0.37, 0.5, 0.62, 0.8];
/** Maximum distance from the even spacing, in frames; the times in a file are rounded to milliseconds. */
const TOLERANCE = 0.2;

/** Return the frames of a film, or null if only its first one can be chosen. `counted` is their number according to the service; 0: unknown. */
export async function openFrames(film: File, counted: Promise<number>): Promise<Frames | null> {
  try {
    if (/\.gif$/i.test(film.name)) return await ofAnimation(film);
    if (/\.zip$/i.test(film.name)) return await ofPictures(film);
    return await ofVideo(film, await counted);
  } catch (error) {
    if (unreadable(error)) return null;
    throw error;
  }
}

async function ofAnimation(film: File): Promise<Frames | null> {
  if (!("ImageDecoder" in globalThis)) return null;
  const decoder = new ImageDecoder({ data: await film.arrayBuffer(), type: "image/gif" });
  await decoder.tracks.ready;
  await decoder.completed;
  const count = decoder.tracks.selectedTrack?.frameCount ?? 0;
  const picture = async (frameIndex: number): Promise<ImageBitmap> => {
    const { image } = await decoder.decode({ frameIndex });
    try {
      return await createImageBitmap(image);
    } finally {
      image.close();
    }
  };
  return { count, picture, close: () => decoder.close() };
}

async function ofPictures(film: File): Promise<Frames> {
  const found = await pictures(film);
  return { count: found.length, picture: (index) => pictureAt(film, found[index]), close: () => undefined };
}

/** A video has times, not numbers: its frames have known numbers if they are evenly spaced. */
async function ofVideo(film: File, stated: number): Promise<Frames | null> {
  if (stated < 2 || !("requestVideoFrameCallback" in HTMLVideoElement.prototype)) return null;
  const video = new Seekable(film);
  const first = await video.start();
  const span = first === null ? 0 : ((await video.seek(video.duration)) ?? 0) - first;
  const spacing = span / (stated - 1);
  const hasFrame = async (index: number): Promise<boolean> => {
    const time = await video.seek((first ?? 0) + (index + 0.5) * spacing);
    return time !== null && Math.abs((time - (first ?? 0)) / spacing - index) < TOLERANCE;
  };
  let isEven = span > 0;
  for (const share of SAMPLES) isEven &&= await hasFrame(Math.floor(share * stated));
  const picture = async (index: number): Promise<ImageBitmap | null> => ((await hasFrame(index)) ? video.picture() : null);
  if (isEven) return { count: stated, picture, close: () => video.close() };
  video.close();
  return null;
}

/** A video that shows the frame at a given time. */
class Seekable {
  private readonly video = document.createElement("video");
  private readonly url: string;
  /** Time of the frame that is shown, in seconds; null: none yet. */
  private time: number | null = null;

  constructor(film: File) {
    this.video.muted = true;
    this.video.playsInline = true;
    this.video.preload = "auto";
    this.url = URL.createObjectURL(film);
  }

  get duration(): number {
    return Number.isFinite(this.video.duration) ? this.video.duration : 0;
  }

  /** Show the first frame and return its time in seconds, or null if it cannot be decoded. */
  start(): Promise<number | null> {
    return this.shown(() => (this.video.src = this.url));
  }

  /** Show the frame at a time and return the time at which that frame begins, both in seconds. */
  seek(to: number): Promise<number | null> {
    return this.shown(() => (this.video.currentTime = to));
  }

  picture(): Promise<ImageBitmap> {
    return createImageBitmap(this.video);
  }

  close(): void {
    this.video.removeAttribute("src");
    this.video.load();
    URL.revokeObjectURL(this.url);
  }

  private shown(change: () => void): Promise<number | null> {
    const { video } = this;
    return new Promise((resolve) => {
      let timer = setTimeout(() => resolve(this.time), PATIENCE.find);
      video.requestVideoFrameCallback((_, { mediaTime }) => {
        clearTimeout(timer);
        resolve((this.time = mediaTime));
      });
      const found = (): void => {
        clearTimeout(timer);
        timer = setTimeout(() => resolve(this.time), PATIENCE.show);
      };
      video.addEventListener("seeked", found, { once: true });
      video.addEventListener("error", () => resolve(null), { once: true });
      change();
    });
  }
}
