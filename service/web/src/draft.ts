// What the form keeps in this tab for a reload: the region drawn last, and the options. Films are not stored.

import { type Region, polygon } from "./region";
import type { Options } from "./types";

const [REGION, OPTIONS] = ["pliant-region", "pliant-options"];
/** Bytes at the start of a film by which it is recognised, besides its size. */
const START = 65536;

/** A region, and the frame it was drawn on, counted from 0. */
export interface KeptRegion {
  region: Region;
  frame: number;
}

/** Return what a film is recognised by, null if it cannot be read: its content, as phones give a film another name and time whenever it is chosen. */
export async function mark(film: File): Promise<string | null> {
  const start = await film.slice(0, START).arrayBuffer().catch(() => null);
  if (start === null) return null;
  let sum = 0x811c9dc5; // FNV-1a; crypto.subtle needs a secure address
  for (const byte of new Uint8Array(start)) sum = Math.imul(sum ^ byte, 0x01000193);
  return `${film.size}-${sum >>> 0}`;
}

interface Kept extends KeptRegion {
  film: string;
  /** The film's file name. */
  name: string;
}

/** Keep the region drawn on a film, given what it is recognised by and its file name; null: none. */
export function keepRegion(film: string, name: string, drawn: KeptRegion | null): void {
  if (drawn) {
    const region: Region = drawn.region.kind === "lasso" ? { kind: "lasso", corners: polygon(drawn.region) } : drawn.region; // rounded
    sessionStorage.setItem(REGION, JSON.stringify({ film, name, region, frame: drawn.frame } satisfies Kept));
  } else if (keptRegion(film)) sessionStorage.removeItem(REGION);
}

/** Return the region last drawn if it was drawn on this film. */
export function keptRegion(film: string): KeptRegion | null {
  const found = kept();
  return found?.film === film ? found : null;
}

/** Return the name of the film whose region is kept; null: there is none. */
export function filmOfRegion(): string | null {
  return kept()?.name ?? null;
}

function kept(): Kept | null {
  return JSON.parse(sessionStorage.getItem(REGION) ?? "null") as Kept | null;
}

/** Keep the options that differ from the defaults. */
export function keepOptions(options: Options): void {
  sessionStorage.setItem(OPTIONS, JSON.stringify(options));
}

export function keptOptions(): Options {
  return JSON.parse(sessionStorage.getItem(OPTIONS) ?? "{}") as Options;
}
