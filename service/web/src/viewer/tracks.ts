// The input tracks over the result: each visible point at its tracked position and at the depth of the reconstructed point,
// with a line to that point. Viewed through the camera, the dots are exactly the input.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Group, LineBasicMaterial, LineSegments, Points, PointsMaterial } from "three";
import { type Preview, isHidden } from "./preview";
import { scattered } from "./scattered";

const MOST = 1500;

export class TrackDots {
  readonly group = new Group();
  private readonly some: number[];
  private readonly ends: Float32Array;
  private readonly dots: Points<BufferGeometry, PointsMaterial>;
  private readonly lines: LineSegments<BufferGeometry, LineBasicMaterial>;

  constructor(
    private readonly preview: Preview,
    private readonly residuals: Int16Array,
  ) {
    this.some = scattered(preview.points, MOST);
    const most = this.some.length;
    this.ends = new Float32Array(6 * most);
    const geometry = (): BufferGeometry => new BufferGeometry();
    this.lines = new LineSegments(geometry(), new LineBasicMaterial());
    this.lines.geometry.setAttribute("position", new BufferAttribute(this.ends, 3).setUsage(DynamicDrawUsage));
    this.dots = new Points(geometry(), new PointsMaterial({ size: 3.5, sizeAttenuation: false, depthTest: false }));
    this.dots.geometry.setAttribute("position", new BufferAttribute(new Float32Array(3 * most), 3).setUsage(DynamicDrawUsage));
    for (const object of [this.lines, this.dots]) {
      object.frustumCulled = false;
      this.group.add(object);
    }
    this.lines.material.depthTest = false;
    this.group.renderOrder = 1;
  }

  theme(colour: string): void {
    this.dots.material.color.set(colour);
    this.lines.material.color.set(colour);
  }

  /** Show the frame nearest to `time`; tracks are measurements and are not interpolated. */
  show(time: number): void {
    const { points, positions, header, ready } = this.preview;
    const frame = Math.min(Math.round(time), Math.max(0, ready - 1));
    const { rotation: r, scale } = this.preview.camera(frame);
    const back = header.residual_step / scale;
    const dots = this.dots.geometry.getAttribute("position").array as Float32Array;
    let shown = 0;
    for (const point of this.some) {
      const from = points * frame + point;
      const [u, v] = [this.residuals[2 * from] as number, this.residuals[2 * from + 1] as number];
      if (isHidden(u)) continue;
      const away = back * this.preview.distance(frame, ...this.preview.place(frame, point));
      for (let axis = 0; axis < 3; axis += 1) {
        const on = (header.origin[axis] as number) + header.step * (positions[3 * from + axis] as number);
        // An image offset (u, v) is u·(first row) + v·(second row) of the camera in the world, over the scale, times the distance.
        const seen = on + away * (u * (r[axis] as number) + v * (r[3 + axis] as number));
        this.ends[6 * shown + axis] = on;
        this.ends[6 * shown + 3 + axis] = seen;
        dots[3 * shown + axis] = seen;
      }
      shown += 1;
    }
    this.lines.geometry.setDrawRange(0, 2 * shown);
    this.dots.geometry.setDrawRange(0, shown);
    this.lines.geometry.getAttribute("position").needsUpdate = true;
    this.dots.geometry.getAttribute("position").needsUpdate = true;
  }

  dispose(): void {
    for (const object of [this.lines, this.dots]) {
      object.geometry.dispose();
      object.material.dispose();
    }
  }
}
