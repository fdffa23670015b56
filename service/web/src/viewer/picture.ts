// The film's picture on the surface: its template frame as a texture.

import { LinearFilter, SRGBColorSpace, Texture } from "three";
import type { Preview } from "./preview";

export interface Picture {
  texture: Texture;
  /** 2 per point, 0 … 1: u right, v down. */
  places: Float32Array;
}

/** Fetch and decode the picture of a result. */
export async function pictureOf(preview: Preview, signal: AbortSignal): Promise<Picture> {
  const [jpeg, places] = await Promise.all([preview.field("picture", signal), preview.field("places", signal)]);
  const texture = new Texture(await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })));
  texture.colorSpace = SRGBColorSpace;
  texture.flipY = false; // the first row of a bitmap is at v = 0
  texture.minFilter = LinearFilter;
  texture.generateMipmaps = false;
  texture.needsUpdate = true;
  return { texture, places };
}
