// Film files: recognising them, and decoding the first frame in the browser.

import { type Entry, listing, unpacked } from "./peek";
import type { Inspection } from "./types";

const FILMS = /\.(mp4|m4v|mov|webm|mkv|avi|gif|3gp)$/i;
const TRACKS = /\.(npz|npy|mat|csv|tsv|h5|json)$/i;
const PICTURES: [RegExp, string][] = [
  [/\.png$/i, "image/png"],
  [/\.jpe?g$/i, "image/jpeg"],
  [/\.webp$/i, "image/webp"],
  [/\.bmp$/i, "image/bmp"],
];
/** Timeout for decoding the first frame, milliseconds; after it, the browser is assumed unable to decode the film. */
const PATIENCE = 25_000;

/** Return true for a media type or name of a film, and for a zip without arrays. */
export function looksLikeFilm(file: File, entries: Entry[]): boolean {
  if (file.type.startsWith("video/") || FILMS.test(file.name)) return true;
  return /\.zip$/i.test(file.name) && entries.length === 0;
}

/** Return true for a file with arrays and for a name of a track file. */
export function looksLikeTracks(file: File, entries: Entry[]): boolean {
  return !looksLikeFilm(file, entries) && (entries.length > 0 || TRACKS.test(file.name));
}

/** Return the first frame at the film's resolution, or null if this browser cannot decode it. */
export async function firstFrame(file: File): Promise<ImageBitmap | null> {
  try {
    if (/\.gif$/i.test(file.name)) return await createImageBitmap(file);
    if (/\.zip$/i.test(file.name)) return await firstPicture(file);
    return await decoded(file);
  } catch (error) {
    // The file is truncated or not in the format of its name: the service will report the error.
    if (error instanceof DOMException || error instanceof RangeError || error instanceof TypeError) return null;
    throw error;
  }
}

/** Return the first frame as the service decoded it, enlarged to the film's resolution, or null if the response has none. */
export async function servedFrame({ first_frame, image_size }: Inspection): Promise<ImageBitmap | null> {
  const [width, height] = (image_size ?? "").split("x").map(Number);
  if (!first_frame || !width || !height) return null;
  const jpeg = Uint8Array.from(atob(first_frame), (letter) => letter.charCodeAt(0));
  const picture = new Blob([jpeg], { type: "image/jpeg" });
  return createImageBitmap(picture, { resizeWidth: width, resizeHeight: height, resizeQuality: "high" });
}

async function firstPicture(file: File): Promise<ImageBitmap | null> {
  const members = (await listing(file)).filter(({ name }) => !/(^|\/)(__MACOSX\/|\.)/.test(name));
  const pictures = members.filter(({ name }) => PICTURES.some(([pattern]) => pattern.test(name)));
  const [first] = pictures.sort((one, other) => one.name.localeCompare(other.name, "en", { numeric: true }));
  if (first === undefined) return null;
  const type = PICTURES.find(([pattern]) => pattern.test(first.name))?.[1] ?? "";
  const picture = await unpacked(file, first, type);
  return picture && createImageBitmap(picture);
}

async function decoded(file: File): Promise<ImageBitmap | null> {
  const video = document.createElement("video");
  video.muted = true;
  video.playsInline = true;
  video.preload = "auto";
  const url = URL.createObjectURL(file);
  try {
    const shown = await new Promise<boolean>((resolve) => {
      const timer = setTimeout(() => resolve(false), PATIENCE);
      const settle = (answer: boolean): void => {
        clearTimeout(timer);
        resolve(answer);
      };
      video.addEventListener("loadeddata", () => settle(video.videoWidth > 0));
      video.addEventListener("error", () => settle(false));
      video.src = url;
    });
    return shown ? await createImageBitmap(video) : null;
  } finally {
    video.removeAttribute("src");
    video.load();
    URL.revokeObjectURL(url);
  }
}
