// Film files: recognising them, and decoding the first frame in the browser.

import { type Entry, type Member, listing, unpacked, unreadable } from "./peek";
import type { Inspection } from "./types";

/** Includes films that the service refuses, with advice for films. */
const FILMS = /\.(mp4|m4v|mov|webm|mkv|avi|gif|3gp|ts|mts|m2ts|mpe?g|wmv|flv|ogv)$/i;
const TRACKS = /\.(npz|npy|mat|csv|tsv|h5|json)$/i;
const PICTURES: [RegExp, string][] = [
  [/\.png$/i, "image/png"],
  [/\.jpe?g$/i, "image/jpeg"],
  [/\.webp$/i, "image/webp"],
  [/\.bmp$/i, "image/bmp"],
];
/** Timeout for decoding the first frame, milliseconds; after it, the browser is assumed unable to decode the film. */
const PATIENCE = 25_000;
/** Attempts at decoding the first frame. On a busy machine, Chromium fails for one film in a hundred that it can decode. */
const ATTEMPTS = 3;

/** Return true for a media type or name of a film, and for a zip without arrays. */
export function looksLikeFilm(file: File, entries: Entry[]): boolean {
  if (file.type.startsWith("video/") || FILMS.test(file.name)) return true;
  return /\.zip$/i.test(file.name) && entries.length === 0;
}

/** Return true for a file with arrays and for a name of a track file. */
export function looksLikeTracks(file: File, entries: Entry[]): boolean {
  return !looksLikeFilm(file, entries) && (entries.length > 0 || TRACKS.test(file.name));
}

/** Return true for the name of a picture, which may be a mask. */
export function looksLikePicture(file: File): boolean {
  return PICTURES.some(([pattern]) => pattern.test(file.name));
}

/** Return the first frame at the film's resolution, or null if this browser cannot decode it. */
export async function firstFrame(file: File): Promise<ImageBitmap | null> {
  try {
    if (/\.gif$/i.test(file.name)) return await createImageBitmap(file);
    if (/\.zip$/i.test(file.name)) return await pictureAt(file, (await pictures(file))[0]);
  } catch (error) {
    if (unreadable(error)) return null;
    throw error;
  }
  const end = performance.now() + PATIENCE;
  for (let attempt = 0; attempt < ATTEMPTS; attempt += 1) {
    const picture = await decoded(file, end - performance.now());
    if (picture !== null) return picture;
  }
  return null;
}

/** The inspections of films, kept for those that this browser cannot decode. */
const inspections = new WeakMap<File, Inspection>();

/** Keep the first frame in the inspection of a film for `servedFrame`. */
export function keepServed(film: File, seen: Inspection): void {
  inspections.set(film, seen);
}

/** Return the first frame as the service decoded it, enlarged to the film's resolution, or null if the service has not sent one. */
export async function servedFrame(film: File): Promise<ImageBitmap | null> {
  const { first_frame, image_size } = inspections.get(film) ?? {};
  const [width, height] = (image_size ?? "").split("x").map(Number);
  if (!first_frame || !width || !height) return null;
  const jpeg = Uint8Array.from(atob(first_frame), (letter) => letter.charCodeAt(0));
  const picture = new Blob([jpeg], { type: "image/jpeg" });
  return createImageBitmap(picture, { resizeWidth: width, resizeHeight: height, resizeQuality: "high" });
}

/** Return the pictures in a zip in the order of their numbers. */
export async function pictures(file: File): Promise<Member[]> {
  const members = (await listing(file)).filter(({ name }) => !/(^|\/)(__MACOSX\/|\.)/.test(name));
  const found = members.filter(({ name }) => PICTURES.some(([pattern]) => pattern.test(name)));
  return found.sort((one, other) => one.name.localeCompare(other.name, "en", { numeric: true }));
}

/** Return one picture in a zip, or null if there is none or the browser cannot decompress it. */
export async function pictureAt(file: File, member: Member | undefined): Promise<ImageBitmap | null> {
  if (member === undefined) return null;
  const type = PICTURES.find(([pattern]) => pattern.test(member.name))?.[1] ?? "";
  const picture = await unpacked(file, member, type);
  return picture && createImageBitmap(picture);
}

/** Return the first frame of a video, or null if it is not decoded within so many milliseconds. */
async function decoded(file: File, patience: number): Promise<ImageBitmap | null> {
  if (patience <= 0) return null;
  const video = document.createElement("video");
  video.muted = true;
  video.playsInline = true;
  video.preload = "auto";
  const url = URL.createObjectURL(file);
  try {
    const shown = await new Promise<boolean>((resolve) => {
      const timer = setTimeout(() => resolve(false), patience);
      const settle = (answer: boolean): void => {
        clearTimeout(timer);
        resolve(answer);
      };
      video.addEventListener("loadeddata", () => settle(video.videoWidth > 0));
      video.addEventListener("error", () => settle(false));
      video.src = url;
    });
    return shown ? await createImageBitmap(video).catch(() => null) : null;
  } finally {
    video.removeAttribute("src");
    video.load();
    URL.revokeObjectURL(url);
  }
}
