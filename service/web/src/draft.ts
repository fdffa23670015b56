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

/** Keep the region drawn on a film; null: none. */
export function keepRegion(film: string, drawn: KeptRegion | null): void {
  if (drawn) {
    const region: Region = drawn.region.kind === "lasso" ? { kind: "lasso", corners: polygon(drawn.region) } : drawn.region; // rounded
    sessionStorage.setItem(REGION, JSON.stringify({ film, region, frame: drawn.frame }));
  } else if (keptRegion(film)) sessionStorage.removeItem(REGION);
}

/** Return the region last drawn if it was drawn on this film. */
export function keptRegion(film: string): KeptRegion | null {
  const kept = JSON.parse(sessionStorage.getItem(REGION) ?? "null") as (KeptRegion & { film: string }) | null;
  return kept?.film === film ? kept : null;
}

/** Keep the options that differ from the defaults. */
export function keepOptions(options: Options): void {
  sessionStorage.setItem(OPTIONS, JSON.stringify(options));
}

export function keptOptions(): Options {
  return JSON.parse(sessionStorage.getItem(OPTIONS) ?? "{}") as Options;
}
