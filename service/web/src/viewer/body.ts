// One moving surface or point cloud: two frames on the graphics card, interpolated by the shader.
//
// Only the two frames around the current time are uploaded, 16 bytes per point and frame: for 99 frames of 29,000 points, 1 MB
// instead of 46 MB for 99 morph targets, and drawing takes one interpolation instead of a loop over the targets.

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DynamicDrawUsage,
  Group,
  LineSegments,
  Mesh,
  Points,
  ShaderMaterial,
  type Texture,
  Vector3,
} from "three";
import { SCALE, type Values } from "./colours";
import type { Picture } from "./picture";
import type { Preview } from "./preview";

const VERTEX = `
attribute vec4 a; attribute vec4 b; attribute vec4 na; attribute vec4 nb; attribute vec2 spot;
uniform float mixing; uniform vec3 origin; uniform float unit; uniform float dot_size;
varying vec3 normal_; varying float value; varying float unknown; varying vec2 spot_;
void main() {
  spot_ = spot;
  vec4 p = mix(a, b, mixing);
  unknown = p.w < 0.0 ? 1.0 : 0.0;
  value = max(p.w, 0.0) / 32767.0;
  normal_ = normalMatrix * mix(na.xyz, nb.xyz, mixing);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(origin + unit * p.xyz, 1.0);
  gl_PointSize = dot_size;
}`;

// A warm light from the upper left, a weak cool one from the right, ambient light brighter from above, and a rim: all fixed to
// the viewer. Both sides of a surface are lit, the back less. Positions without a value are grey; the colours of their
// neighbours fade directly to grey, not through the dark end of the scale. The film's picture already contains lighting and is
// shaded only slightly.
const FRAGMENT = `
uniform vec3 plain; uniform vec3 scale[6]; uniform float coloured; uniform float lit; uniform float reversed;
uniform sampler2D picture; uniform float pictured;
varying vec3 normal_; varying float value; varying float unknown; varying vec2 spot_;
void main() {
  float at = clamp(value / max(1.0 - unknown, 0.001), 0.0, 1.0) * 5.0;
  vec3 shade = scale[0];
  for (int i = 0; i < 5; i++) shade = mix(shade, scale[i + 1], clamp(at - float(i), 0.0, 1.0));
  shade = mix(shade, vec3(0.214), unknown);
  vec3 base = mix(mix(plain, shade, coloured), texture2D(picture, spot_).rgb, pictured);
  bool back = gl_FrontFacing == (reversed > 0.5);
  vec3 n = normalize(normal_ + vec3(1e-9));
  if (n.z < 0.0) n = -n;
  float key = max(dot(n, normalize(vec3(-0.5, 0.62, 0.6))), 0.0);
  float fill = max(dot(n, normalize(vec3(0.75, -0.1, 0.55))), 0.0);
  float edge = pow(1.0 - clamp(n.z, 0.0, 1.0), 3.0);
  float shine = pow(max(dot(n, normalize(vec3(-0.27, 0.34, 0.9))), 0.0), 32.0) * 0.11;
  vec3 sky = mix(vec3(0.23, 0.25, 0.28), vec3(0.42, 0.41, 0.40), 0.5 + 0.5 * n.y);
  vec3 light = sky + 0.72 * key * vec3(1.0, 0.97, 0.93) + 0.20 * fill * vec3(0.86, 0.93, 1.0);
  light = mix(light, vec3(1.0), 0.6 * pictured);
  shine *= 1.0 - pictured;
  vec3 c = mix(base, base * light + shine + 0.10 * edge * vec3(0.9, 0.95, 1.0), lit);
  if (lit > 0.5 && back) c *= 0.55;
  gl_FragColor = vec4(c, 1.0);
  #include <colorspace_fragment>
}`;

interface Slot {
  frame: number;
  place: BufferAttribute;
  normal: BufferAttribute;
}

export class Body {
  readonly group = new Group();
  private readonly geometry = new BufferGeometry();
  private readonly slots: [Slot, Slot];
  private readonly materials: ShaderMaterial[] = [];
  private readonly wire: LineSegments<BufferGeometry, ShaderMaterial>;
  private values: Values | null = null;
  private texture: Texture | null = null;
  private readonly accumulated: Float32Array;

  constructor(
    private readonly preview: Preview,
    private readonly source: Int16Array,
  ) {
    const { points, faces } = preview;
    this.accumulated = new Float32Array(3 * points);
    const slot = (): Slot => ({
      frame: -1,
      place: new BufferAttribute(new Int16Array(4 * points), 4).setUsage(DynamicDrawUsage),
      normal: new BufferAttribute(new Int8Array(4 * points), 4, true).setUsage(DynamicDrawUsage),
    });
    this.slots = [slot(), slot()];
    if (faces.length > 0) {
      this.geometry.setIndex(new BufferAttribute(faces, 1));
      const surface = new Mesh(this.geometry, this.material({ lit: 1 }));
      surface.frustumCulled = false;
      this.group.add(surface);
    } else {
      const cloud = new Points(this.geometry, this.material({ lit: 0, dot_size: points > 5000 ? 2 : 5 }));
      cloud.frustumCulled = false;
      this.group.add(cloud);
    }
    this.wire = new LineSegments(new BufferGeometry(), this.material({ lit: 0 }));
    this.wire.frustumCulled = false;
    this.wire.visible = false;
    this.group.add(this.wire);
  }

  /** Show the time `time`, in frames, between 0 and F − 1. */
  show(time: number): void {
    const last = Math.max(0, this.preview.ready - 1);
    const first = Math.min(Math.floor(time), last);
    const second = Math.min(first + 1, last);
    let [a, b] = this.slots;
    if (a.frame !== first && b.frame === first) [a, b] = [b, a];
    this.load(a, first);
    this.load(b, second);
    this.slots[0] = a;
    this.slots[1] = b;
    for (const geometry of [this.geometry, this.wire.geometry]) {
      geometry.setAttribute("a", a.place);
      geometry.setAttribute("b", b.place);
      geometry.setAttribute("na", a.normal);
      geometry.setAttribute("nb", b.normal);
      // three.js counts vertices by this name; the shader reads a and b.
      geometry.setAttribute("position", a.place);
    }
    for (const material of this.materials) material.uniforms["mixing"]!.value = second > first ? time - first : 0;
  }

  /** Colour by values, by the film's picture, or with the plain colour. */
  colour(values: Values | null, picture: Picture | null = null): void {
    this.values = values;
    this.texture?.dispose();
    this.texture = picture?.texture ?? null;
    if (picture) this.geometry.setAttribute("spot", new BufferAttribute(picture.places, 2));
    for (const slot of this.slots) slot.frame = -1;
    for (const material of this.materials) {
      material.uniforms["coloured"]!.value = values === null ? 0 : 1;
      material.uniforms["scale"]!.value = (values?.scale ?? SCALE).map((hex) => new Color(hex));
      material.uniforms["picture"]!.value = this.texture;
      material.uniforms["pictured"]!.value = picture === null ? 0 : 1;
    }
    for (const name of ["coloured", "pictured"]) this.wire.material.uniforms[name]!.value = 0;
  }

  /** Set the colours of the surface and of the wireframe from the page's theme. */
  theme(plain: string, wire: string): void {
    for (const material of this.materials) (material.uniforms["plain"]!.value as Color).set(plain);
    (this.wire.material.uniforms["plain"]!.value as Color).set(wire);
  }

  /** Set whether the front and back of the faces are swapped. */
  reverse(reversed: boolean): void {
    for (const material of this.materials) material.uniforms["reversed"]!.value = reversed ? 1 : 0;
  }

  /** Draw the mesh's edges over the surface. */
  wireframe(on: boolean): void {
    if (on && this.wire.geometry.index === null && this.preview.faces.length > 0) {
      this.wire.geometry.setIndex(new BufferAttribute(edges(this.preview.faces, this.preview.points), 1));
    }
    this.wire.visible = on && this.preview.faces.length > 0;
  }

  dispose(): void {
    this.texture?.dispose();
    this.geometry.dispose();
    this.wire.geometry.dispose();
    for (const material of this.materials) material.dispose();
  }

  private material(options: { lit: number; dot_size?: number }): ShaderMaterial {
    const { header } = this.preview;
    const surface = options.lit === 1;
    const made = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: 2,
      // The surface is drawn slightly further away, so that it does not hide the wireframe.
      polygonOffset: surface,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 1,
      uniforms: {
        mixing: { value: 0 },
        origin: { value: new Vector3(...header.origin) },
        unit: { value: header.step },
        dot_size: { value: (options.dot_size ?? 1) * globalThis.devicePixelRatio },
        plain: { value: new Color() },
        scale: { value: SCALE.map((hex) => new Color(hex)) },
        coloured: { value: 0 },
        lit: { value: options.lit },
        reversed: { value: 0 },
        picture: { value: null as Texture | null },
        pictured: { value: 0 },
      },
    });
    this.materials.push(made);
    return made;
  }

  private load(slot: Slot, frame: number): void {
    if (slot.frame === frame) return;
    const { points } = this.preview;
    const from = this.source.subarray(3 * points * frame, 3 * points * (frame + 1));
    const into = slot.place.array as Int16Array;
    for (let i = 0, j = 0; j < from.length; i += 4, j += 3) {
      into[i] = from[j] as number;
      into[i + 1] = from[j + 1] as number;
      into[i + 2] = from[j + 2] as number;
    }
    this.values?.write(frame, into, 4, 3);
    this.normals(from, slot.normal.array as Int8Array);
    slot.place.needsUpdate = true;
    slot.normal.needsUpdate = true;
    slot.frame = frame;
  }

  /** Area-weighted vertex normals: the sum of the cross products of the faces around each point. */
  private normals(at: Int16Array, into: Int8Array): void {
    const { faces } = this.preview;
    const sum = this.accumulated.fill(0);
    for (let i = 0; i < faces.length; i += 3) {
      const p = 3 * (faces[i] as number);
      const q = 3 * (faces[i + 1] as number);
      const r = 3 * (faces[i + 2] as number);
      const ux = at[q]! - at[p]!;
      const uy = at[q + 1]! - at[p + 1]!;
      const uz = at[q + 2]! - at[p + 2]!;
      const vx = at[r]! - at[p]!;
      const vy = at[r + 1]! - at[p + 1]!;
      const vz = at[r + 2]! - at[p + 2]!;
      const x = uy * vz - uz * vy;
      const y = uz * vx - ux * vz;
      const z = ux * vy - uy * vx;
      sum[p]! += x;
      sum[p + 1]! += y;
      sum[p + 2]! += z;
      sum[q]! += x;
      sum[q + 1]! += y;
      sum[q + 2]! += z;
      sum[r]! += x;
      sum[r + 1]! += y;
      sum[r + 2]! += z;
    }
    for (let i = 0, j = 0; j < sum.length; i += 4, j += 3) {
      const length = Math.hypot(sum[j]!, sum[j + 1]!, sum[j + 2]!) || 1;
      into[i] = (127 * sum[j]!) / length;
      into[i + 1] = (127 * sum[j + 1]!) / length;
      into[i + 2] = (127 * sum[j + 2]!) / length;
    }
  }
}

/** Return true if a frame's camera sees most of the mesh from behind, according to the winding order of its faces. */
export function seenFromBehind(preview: Preview, frame: number): boolean {
  const { faces } = preview;
  let area = 0;
  const corner = (index: number): [number, number] => preview.project(frame, ...preview.place(frame, faces[index] as number));
  const stride = 3 * Math.max(1, Math.floor(faces.length / 3 / 20_000));
  for (let i = 0; i < faces.length; i += stride) {
    const [[ax, ay], [bx, by], [cx, cy]] = [corner(i), corner(i + 1), corner(i + 2)];
    area += (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
  }
  // A counter-clockwise face has a positive area where y runs up, a negative one where it runs down.
  return preview.header.y_axis === "up" ? area < 0 : area > 0;
}

/** Each undirected edge of the triangles once, as pairs of points. */
export function edges(faces: Uint32Array, points: number): Uint32Array {
  const seen = new Set<number>();
  for (let i = 0; i < faces.length; i += 3) {
    for (let k = 0; k < 3; k += 1) {
      const p = faces[i + k] as number;
      const q = faces[i + ((k + 1) % 3)] as number;
      seen.add(Math.min(p, q) * points + Math.max(p, q));
    }
  }
  const pairs = new Uint32Array(2 * seen.size);
  let at = 0;
  for (const edge of seen) {
    pairs[at] = Math.floor(edge / points);
    pairs[at + 1] = edge % points;
    at += 2;
  }
  return pairs;
}
