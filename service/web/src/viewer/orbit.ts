// Rotating, moving and zooming the camera by mouse, touch and keyboard.
//
// The OrbitControls of three.js have a fixed up direction, but the view through a frame's camera may need any roll, and on a
// phone a vertical swipe must scroll the page, not rotate the model. This class stores an orientation and lets the page scroll.

import { type OrthographicCamera, Quaternion, Vector3 } from "three";

const RADIANS_PER_PIXEL = 0.008;
const Y = new Vector3(0, 1, 0);

export class Orbit {
  readonly target = new Vector3();
  readonly orientation = new Quaternion();
  private readonly fingers = new Map<number, { x: number; y: number }>();
  private spread = 0;

  constructor(
    private readonly camera: OrthographicCamera,
    private readonly canvas: HTMLCanvasElement,
    /** Called after every change; `byHand` is true if the user made it. */
    private readonly onChange: (byHand: boolean) => void,
  ) {
    canvas.style.touchAction = "pan-y";
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"] as const) canvas.addEventListener(end, (event) => this.fingers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dragstart", (event) => event.preventDefault()); // of selected text
  }

  /** Rotate around the vertical axis and around the viewer's horizontal axis, in radians. */
  turn(sideways: number, upwards: number): void {
    const across = new Vector3(1, 0, 0).applyQuaternion(this.orientation);
    this.orientation.premultiply(new Quaternion().setFromAxisAngle(across, upwards));
    this.orientation.premultiply(new Quaternion().setFromAxisAngle(Y, sideways)).normalize();
    this.onChange(true);
  }

  zoom(factor: number): void {
    this.camera.zoom = Math.min(60, Math.max(0.2, this.camera.zoom * factor));
    this.onChange(true);
  }

  /** Place the camera according to the orientation, at `distance` from the target. */
  apply(distance: number): void {
    this.camera.quaternion.copy(this.orientation);
    this.camera.position.set(0, 0, distance).applyQuaternion(this.orientation).add(this.target);
    this.camera.updateProjectionMatrix();
  }

  private shift(dx: number, dy: number): void {
    const unit = (this.camera.top - this.camera.bottom) / this.camera.zoom / this.canvas.clientHeight;
    this.target.add(new Vector3(-dx * unit, dy * unit, 0).applyQuaternion(this.orientation));
    this.onChange(true);
  }

  private down(event: PointerEvent): void {
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this.spread = this.distance();
  }

  private move(event: PointerEvent): void {
    const last = this.fingers.get(event.pointerId);
    if (last === undefined) return;
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (this.fingers.size >= 2) {
      this.shift(dx / 2, dy / 2);
      const spread = this.distance();
      if (this.spread > 0 && spread > 0) this.zoom(spread / this.spread);
      this.spread = spread;
    } else if (event.buttons === 2 || event.shiftKey) this.shift(dx, dy);
    else this.turn(-dx * RADIANS_PER_PIXEL, -dy * RADIANS_PER_PIXEL);
  }

  private distance(): number {
    const [a, b] = [...this.fingers.values()];
    return a && b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  }

  /** The wheel scrolls the page unless the view has been clicked or Ctrl is held (as sent by a pinch on a touch pad). */
  private wheel(event: WheelEvent): void {
    if (!event.ctrlKey && document.activeElement !== this.canvas) return;
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)));
  }
}
