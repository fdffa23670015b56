// The renderer and the camera around the bodies: one view, or two side by side under the same camera.
//
// The camera is orthographic, like the model that the shapes were solved with. A picture is drawn only when something changed.

import { Group, Matrix4, type Object3D, OrthographicCamera, Quaternion, Scene, Vector3, Vector4, WebGLRenderer } from "three";
import { Orbit } from "./orbit";
import type { Preview } from "./preview";

export class Stage {
  readonly canvas: HTMLCanvasElement;
  readonly orbit: Orbit;
  /** Called before a picture is drawn. */
  onDraw: () => void = () => undefined;
  /** Called when a person takes the camera in hand. */
  onTurn: () => void = () => undefined;
  private readonly renderer: WebGLRenderer;
  private readonly camera = new OrthographicCamera();
  private readonly scenes: [Scene, Scene] = [new Scene(), new Scene()];
  /** Where the data lives: turned by half a turn around x where the data's y runs down, so that up is up on the screen. */
  private readonly worlds: [Group, Group] = [new Group(), new Group()];
  private readonly centre = new Vector3();
  private readonly resizing = new ResizeObserver(() => this.resize());
  private readonly down: boolean;
  private flipped = false;
  private radius = 1;
  private requested = 0;
  private divided = false;

  /** Throws when the browser has no WebGL 2. */
  constructor(
    private readonly holder: HTMLElement,
    preview: Preview,
  ) {
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setScissorTest(true);
    this.canvas = this.renderer.domElement;
    this.orbit = new Orbit(this.camera, this.canvas, (byHand) => {
      if (byHand) this.onTurn();
      this.redraw();
    });
    this.down = preview.header.y_axis !== "up";
    this.worlds.forEach((world, index) => {
      if (this.down) world.rotation.x = Math.PI;
      (this.scenes[index] as Scene).add(world);
    });
    this.frameOn(preview);
    this.reset();
    this.canvas.addEventListener("webglcontextrestored", () => this.redraw());
    this.resizing.observe(holder);
  }

  /** Put something into the first view, or the second. */
  add(object: Object3D, view: 0 | 1 = 0): void {
    this.worlds[view].add(object);
    this.redraw();
  }

  remove(object: Object3D): void {
    object.removeFromParent();
    this.redraw();
  }

  /** One view or two. */
  divide(divided: boolean): void {
    this.divided = divided;
    this.resize();
  }

  /** True where two views stand one above the other. */
  get stacked(): boolean {
    return this.holder.clientWidth < this.holder.clientHeight * 1.1;
  }

  /** Show the other of the two depths that explain the same orthographic tracks. */
  flip(flipped: boolean): void {
    if (flipped === this.flipped) return;
    this.flipped = flipped;
    for (const world of this.worlds) world.scale.z = flipped ? -1 : 1;
    this.centre.z *= -1;
    this.orbit.target.z *= -1;
    this.redraw();
  }

  /** Look along the first frame's camera, a little from the side, so that depth shows at once. */
  reset(): void {
    this.orbit.target.copy(this.centre);
    this.orbit.orientation.identity();
    this.camera.zoom = 1;
    this.orbit.turn(0.42, -0.1);
  }

  /** Look through a frame's own camera; `rotation` is camera from world, row by row. */
  through(rotation: Float32Array): void {
    const row = (index: number, sign: number): Vector3 => {
      const axis = new Vector3(rotation[3 * index], rotation[3 * index + 1], rotation[3 * index + 2]).multiplyScalar(sign);
      // With the mirror J = diag(1, 1, −1), the camera R that saw S sees J S as J R J.
      if (this.flipped) axis.set(axis.x, axis.y, -axis.z).multiplyScalar(index === 2 ? -1 : 1);
      return this.down ? axis.set(axis.x, -axis.y, -axis.z) : axis;
    };
    // The camera's rows are right, down and away where y runs down; right, up and towards the viewer where it runs up.
    const sign = this.down ? -1 : 1;
    const basis = new Matrix4().makeBasis(row(0, 1), row(1, sign), row(2, sign));
    this.orbit.orientation.copy(new Quaternion().setFromRotationMatrix(basis));
  }

  /** Draw soon; many calls before then make one picture. */
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

  /** Find the middle and the size of all frames that have arrived. */
  private frameOn(preview: Preview): void {
    const { header, positions, points, ready } = preview;
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    const total = points * Math.max(1, ready);
    const stride = Math.max(1, Math.floor(total / 200_000));
    for (let i = 0; i < total; i += stride) {
      for (let axis = 0; axis < 3; axis += 1) {
        const value = positions[3 * i + axis] as number;
        low[axis] = Math.min(low[axis] as number, value);
        high[axis] = Math.max(high[axis] as number, value);
      }
    }
    const middle = header.origin.map((at, axis) => at + (header.step * ((low[axis] as number) + (high[axis] as number))) / 2);
    this.centre.fromArray(middle);
    if (this.down) this.centre.set(this.centre.x, -this.centre.y, -this.centre.z);
    this.radius = (header.step * Math.hypot(...low.map((value, axis) => (high[axis] as number) - value))) / 2 || 1;
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    const view = this.views()[0] as Vector4;
    const half = 0.84 * this.radius;
    const wide = half * Math.max(1, view.z / view.w);
    const tall = half * Math.max(1, view.w / view.z);
    Object.assign(this.camera, { left: -wide, right: wide, top: tall, bottom: -tall });
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
    this.onDraw();
    Object.assign(this.camera, { near: 0, far: 40 * this.radius });
    this.orbit.apply(20 * this.radius);
    this.views().forEach((view, index) => {
      this.renderer.setViewport(view);
      this.renderer.setScissor(view);
      this.renderer.render(this.scenes[index] as Scene, this.camera);
    });
  }
}
