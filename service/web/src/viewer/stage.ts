// The renderer and its camera: one view, or two side by side with the same camera.
//
// The camera is orthographic, like the scaled orthographic model of the solver; through the camera of a frame, the projection is that
// of the result. The view is drawn only when something has changed.

import { Group, Matrix4, type Object3D, OrthographicCamera, Quaternion, Scene, Vector3, Vector4, WebGLRenderer } from "three";
import { Orbit } from "./orbit";
import type { Preview } from "./preview";

/** Viewing directions, relative to the camera of the frame with the most visible points. */
export type Side = "front" | "side" | "top";

/** A part of the picture plane, in the tracks' unit. */
export interface Crop {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** Share of a view that the fitted mesh fills. */
const FILLED = 0.9;
/** Maximum distance of a click from the point that it chooses, CSS pixels. */
const NEAR = 22;

export class Stage {
  readonly canvas: HTMLCanvasElement;
  readonly orbit: Orbit;
  /** Called before each drawing. */
  onDraw: () => void = () => undefined;
  /** Called when the user moves the camera. */
  onTurn: () => void = () => undefined;
  private readonly renderer: WebGLRenderer;
  private readonly camera = new OrthographicCamera();
  private readonly scenes: [Scene, Scene] = [new Scene(), new Scene()];
  /** Parents of the objects: rotated by 180° around x if y points down in the data, so that up is up on the screen. */
  private readonly worlds: [Group, Group] = [new Group(), new Group()];
  private readonly centre = new Vector3();
  private readonly resizing = new ResizeObserver(() => this.resize());
  private readonly down: boolean;
  private flipped = false;
  private radius = 1;
  private requested = 0;
  private divided = false;
  /** True until the user moves the camera: the mesh is fitted again when the size of the view changes. */
  private fitted = true;
  /** What the current drawing shows through the camera of a frame; null: what the orbit shows. */
  private seen: { frame: number; crop: Crop } | null = null;

  /** Throws if the browser does not support WebGL 2. */
  constructor(
    private readonly holder: HTMLElement,
    private readonly preview: Preview,
  ) {
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setScissorTest(true);
    this.canvas = this.renderer.domElement;
    this.orbit = new Orbit(this.camera, this.canvas, (byHand) => {
      if (byHand) {
        this.fitted = false;
        this.onTurn();
      }
      this.redraw();
    });
    this.down = preview.header.y_axis !== "up";
    this.worlds.forEach((world, index) => {
      if (this.down) world.rotation.x = Math.PI;
      (this.scenes[index] as Scene).add(world);
    });
    this.frameOn();
    this.canvas.addEventListener("webglcontextrestored", () => this.redraw());
    this.resizing.observe(holder);
  }

  /** Add an object to the first or the second view. */
  add(object: Object3D, view: 0 | 1 = 0): void {
    this.worlds[view].add(object);
    this.redraw();
  }

  remove(object: Object3D): void {
    object.removeFromParent();
    this.redraw();
  }

  /** Show one view or two. */
  divide(divided: boolean): void {
    this.divided = divided;
    this.resize();
  }

  /** True if two views are stacked vertically. */
  get stacked(): boolean {
    return this.holder.clientWidth < this.holder.clientHeight * 1.1;
  }

  /** Mirror the depth: orthographic tracks do not determine its sign. */
  flip(flipped: boolean): void {
    if (flipped === this.flipped) return;
    this.flipped = flipped;
    for (const world of this.worlds) world.scale.z = flipped ? -1 : 1;
    this.centre.z *= -1;
    this.orbit.target.z *= -1;
    this.redraw();
  }

  get isFlipped(): boolean {
    return this.flipped;
  }

  /** Look from the camera of the frame with the most visible points, from its right or from above, and fit the mesh. */
  look(side: Side): void {
    this.orbit.orientation.copy(this.front());
    const turned = { front: [0, 0], side: [Math.PI / 2, 0], top: [0, -Math.PI / 2] }[side] as [number, number];
    const about = (x: number, y: number, angle: number): Quaternion =>
      new Quaternion().setFromAxisAngle(new Vector3(x, y, 0), angle);
    this.orbit.orientation.multiply(about(0, 1, turned[0])).multiply(about(1, 0, turned[1]));
    this.fit();
  }

  /** Zoom and move so that the mesh of all loaded frames just fills the view. */
  fit(): void {
    this.fitted = true;
    const inverse = this.orbit.orientation.clone().invert();
    const [low, high] = [new Vector3(Infinity, Infinity, Infinity), new Vector3(-Infinity, -Infinity, -Infinity)];
    this.sample((point) => {
      this.onScreen(point).applyQuaternion(inverse);
      low.min(point);
      high.max(point);
    });
    this.orbit.target.copy(low.clone().add(high).multiplyScalar(0.5).applyQuaternion(this.orbit.orientation));
    this.aspect();
    const room = Math.min((this.camera.right - this.camera.left) / (high.x - low.x || 1), (this.camera.top - this.camera.bottom) / (high.y - low.y || 1));
    this.camera.zoom = Math.min(60, Math.max(0.2, FILLED * room));
    this.redraw();
  }

  /** Fit again after more frames have loaded, unless the user has moved the camera. */
  refit(): void {
    if (this.fitted) this.fit();
    else this.redraw();
  }

  /** Rotate the view by a share of one turn around the vertical axis, starting at the front. */
  turntable(share: number): void {
    const upright = new Quaternion().setFromAxisAngle(new Vector3(0, 1, 0), 2 * Math.PI * share);
    this.orbit.orientation.copy(this.front().multiply(upright));
  }

  /** Return a function that restores the current camera. */
  remember(): () => void {
    const [orientation, target, zoom, fitted] = [this.orbit.orientation.clone(), this.orbit.target.clone(), this.camera.zoom, this.fitted];
    return () => {
      this.orbit.orientation.copy(orientation);
      this.orbit.target.copy(target);
      this.camera.zoom = zoom;
      this.fitted = fitted;
      this.redraw();
    };
  }

  /** Return the point at a position in the canvas, in CSS pixels from its upper left corner; null if none is near. */
  pick(x: number, y: number, frame: number): number | null {
    this.draw();
    const view = this.views()[0] as Vector4;
    const [width, height] = [view.z, view.w];
    const top = this.holder.clientHeight - view.y - view.w;
    let best: { point: number; depth: number; away: number } | null = null;
    for (let point = 0; point < this.preview.points; point += 1) {
      const at = this.onScreen(new Vector3(...this.preview.place(frame, point))).project(this.camera);
      const away = Math.hypot(view.x + ((at.x + 1) / 2) * width - x, top + ((1 - at.y) / 2) * height - y);
      if (away > NEAR) continue;
      // Of several candidates, the nearest in the picture wins, unless it is behind the surface.
      const score = away / NEAR + (at.z + 1) * 4;
      if (best === null || score < best.away / NEAR + (best.depth + 1) * 4) best = { point, depth: at.z, away };
    }
    return best?.point ?? null;
  }

  /** Draw immediately, so that the canvas can be copied in the same task. */
  drawNow(): void {
    this.draw();
  }

  /** Show the scene from the same side as another stage, relative to the cameras of one frame. */
  mirror(other: Stage): void {
    const frame = Math.min(other.preview.clearest, this.preview.frames - 1);
    const [mine, theirs] = [this, other].map((one) => one.orientationOf(one.preview.camera(frame).rotation)) as [Quaternion, Quaternion];
    const turned = theirs.clone().invert().multiply(other.orbit.orientation);
    this.orbit.orientation.copy(mine.multiply(turned));
    this.camera.zoom = other.camera.zoom;
    this.redraw();
  }

  /** Look through the camera of a frame, at a part of its picture or, without one, at the fitted mesh. Called by `onDraw`. */
  through(frame: number, crop: Crop | null): void {
    this.orbit.orientation.copy(this.orientationOf(this.preview.camera(frame).rotation));
    this.seen = crop && { frame, crop };
  }

  /** The orientation of the camera of the frame with the most visible points. */
  private front(): Quaternion {
    return this.orientationOf(this.preview.camera(this.preview.clearest).rotation);
  }

  private orientationOf(rotation: Float32Array): Quaternion {
    const row = (index: number, sign: number): Vector3 => {
      const axis = new Vector3(rotation[3 * index], rotation[3 * index + 1], rotation[3 * index + 2]).multiplyScalar(sign);
      // With the mirror J = diag(1, 1, −1), the camera R that saw S sees J S as J R J.
      if (this.flipped) axis.set(axis.x, axis.y, -axis.z).multiplyScalar(index === 2 ? -1 : 1);
      return this.down ? axis.set(axis.x, -axis.y, -axis.z) : axis;
    };
    // The rows of the camera are right, down and away if y points down; right, up and towards the viewer if it points up.
    const sign = this.down ? -1 : 1;
    const basis = new Matrix4().makeBasis(row(0, 1), row(1, sign), row(2, sign));
    return new Quaternion().setFromRotationMatrix(basis);
  }

  /** Schedule a drawing; repeated calls are combined. */
  redraw(): void {
    this.requested ||= requestAnimationFrame(() => {
      this.requested = 0;
      this.draw();
    });
  }

  dispose(): void {
    cancelAnimationFrame(this.requested);
    this.resizing.disconnect();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.canvas.remove();
  }

  /** Convert from the data's axes to those of the scene. */
  private onScreen(point: Vector3): Vector3 {
    if (this.flipped) point.z *= -1;
    return this.down ? point.set(point.x, -point.y, -point.z) : point;
  }

  /** Call `use` with points of the loaded frames, at most about 100,000. */
  private sample(use: (point: Vector3) => void): void {
    const { points, ready } = this.preview;
    const total = points * Math.max(1, ready);
    const stride = Math.max(1, Math.floor(total / 100_000)) | 1;
    const point = new Vector3();
    for (let i = 0; i < total; i += stride) use(point.set(...this.preview.place(Math.floor(i / points), i % points)));
  }

  /** Compute the centre and the radius of all loaded frames. */
  private frameOn(): void {
    const [low, high] = [new Vector3(Infinity, Infinity, Infinity), new Vector3(-Infinity, -Infinity, -Infinity)];
    this.sample((point) => {
      low.min(this.onScreen(point));
      high.max(point);
    });
    this.centre.copy(low).add(high).multiplyScalar(0.5);
    this.radius = high.distanceTo(low) / 2 || 1;
  }

  /** Set the aspect ratio of the camera to that of a view. */
  private aspect(): void {
    const view = this.views()[0] as Vector4;
    if (view.z === 0 || view.w === 0) return;
    const wide = this.radius * Math.max(1, view.z / view.w);
    const tall = this.radius * Math.max(1, view.w / view.z);
    Object.assign(this.camera, { left: -wide, right: wide, top: tall, bottom: -tall });
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    if (this.fitted) this.fit();
    else this.aspect();
    this.draw();
  }

  /** Left, bottom, width and height of each view. */
  private views(): Vector4[] {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (!this.divided) return [new Vector4(0, 0, width, height)];
    if (this.stacked) return [new Vector4(0, height / 2, width, height / 2), new Vector4(0, 0, width, height / 2)];
    return [new Vector4(0, 0, width / 2, height), new Vector4(width / 2, 0, width / 2, height)];
  }

  private draw(): void {
    this.seen = null;
    this.onDraw();
    Object.assign(this.camera, { near: 0, far: 40 * this.radius });
    this.orbit.apply(20 * this.radius);
    this.camera.updateMatrixWorld();
    this.views().forEach((view, index) => {
      if (this.seen) this.project(view, this.seen);
      this.renderer.setViewport(view);
      this.renderer.setScissor(view);
      this.renderer.render(this.scenes[index] as Scene, this.camera);
    });
  }

  /** Project as the camera of a frame does, so that a part of its picture just fits into a view; `Preview.project` as a matrix. */
  private project({ z: width, w: height }: Vector4, { frame, crop }: { frame: number; crop: Crop }): void {
    const { focal, principal_point: centre } = this.preview.header;
    const { rotation: r, scale } = this.preview.camera(frame);
    const { translation } = this.preview.facts(frame);
    const away = this.down ? scale : -scale;
    const perspective = focal && centre ? away / focal : 0;
    const unit = Math.max(crop.width / width, crop.height / height);
    // Rows of the matrix from the data's axes to clip coordinates; the last one is 1 + distance / focal length.
    const row = (axis: 0 | 1, middle: number, size: number): [number, number, number, number] => {
      const bend = perspective * ((focal && centre ? centre[axis] : 0) - middle);
      const at = (k: number): number => (size * (scale * (r[3 * axis + k] as number) + bend * (r[6 + k] as number)));
      return [at(0), at(1), at(2), size * ((translation[axis] as number) - middle)];
    };
    const [x, y, z] = [r[6], r[7], r[8]] as unknown as [number, number, number];
    const depth = (Math.sign(away) * (this.flipped ? -1 : 1)) / (20 * this.radius);
    const matrix = new Matrix4().set(
      ...row(0, crop.left + crop.width / 2, 2 / (unit * width)),
      ...row(1, crop.top + crop.height / 2, (this.down ? -2 : 2) / (unit * height)),
      ...[depth * x, depth * y, depth * z, 0] as const,
      ...[perspective * x, perspective * y, perspective * z, 1] as const,
    );
    const sign = this.down ? -1 : 1;
    const world = new Matrix4().makeScale(1, sign, this.flipped ? -sign : sign); // its own inverse
    this.camera.projectionMatrix.copy(matrix.multiply(world).multiply(this.camera.matrixWorld));
  }
}
