"""Animated glTF files played by three.js, the most used 3-D library of the web, in a headless Chromium."""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from browsing import ROOT, Browsing, executable
from playwright.sync_api import Page, Route

THREE = ROOT / "service" / "web" / "node_modules" / "three"
ORIGIN = "http://three.invalid"
TYPES = {".js": "text/javascript", ".glb": "model/gltf-binary"}
HTML = """<!doctype html><style>body{margin:0}</style><canvas width=480 height=360></canvas>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>
<script type="module" src="/page.js"></script>"""

SCRIPT = """
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
const canvas = document.querySelector("canvas");
const renderer = new THREE.WebGLRenderer({ canvas, preserveDrawingBuffer: true, antialias: true });
const floats = (array) => {
  const bytes = new Uint8Array(array.buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
};
const unpacked = (text) => new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
let shown, mixer, action, duration, scene, camera;

const look = (aside) => {
  scene = new THREE.Scene();
  scene.background = new THREE.Color("#ffffff");
  scene.add(new THREE.HemisphereLight("#ffffff", "#8899aa", 1.4));
  const key = new THREE.DirectionalLight("#ffffff", 2.2);
  key.position.set(-1, 1.2, 1.5);
  scene.add(key);
  const box = new THREE.Box3().setFromObject(shown, true);
  const centre = box.getCenter(new THREE.Vector3());
  const radius = box.getSize(new THREE.Vector3()).length() / 2;
  camera = new THREE.OrthographicCamera(-radius * 4 / 3, radius * 4 / 3, radius, -radius, 0, 10 * radius);
  const angle = aside * Math.PI / 180;
  camera.position.copy(centre).add(new THREE.Vector3(Math.sin(angle), 0.15, Math.cos(angle)).multiplyScalar(4 * radius));
  camera.lookAt(centre);
};
const draw = (thing) => {
  scene.add(thing);
  renderer.render(scene, camera);
  scene.remove(thing);
  return canvas.toDataURL("image/png").split(",")[1];
};

window.open_glb = async (url) => {
  const gltf = await new GLTFLoader().loadAsync(url);
  gltf.scene.traverse((one) => { if (one.isMesh || one.isPoints) shown = one; });
  shown.removeFromParent();
  mixer = new THREE.AnimationMixer(shown);
  action = mixer.clipAction(gltf.animations[0]);
  action.setLoop(THREE.LoopOnce);
  action.clampWhenFinished = true;
  action.play();
  duration = gltf.animations[0].duration;
  return { targets: shown.morphTargetInfluences.length, duration, kind: shown.type };
};
/** Where three.js computes every vertex to be, in the scene. */
window.positions = (time) => {
  mixer.setTime(time);
  shown.updateMatrixWorld(true);
  const count = shown.geometry.attributes.position.count, found = new Float32Array(3 * count);
  const place = new THREE.Vector3();
  const at = shown.getVertexPosition ?? THREE.Mesh.prototype.getVertexPosition;
  for (let i = 0; i < count; i += 1) at.call(shown, i, place).applyMatrix4(shown.matrixWorld).toArray(found, 3 * i);
  return floats(found);
};
/** A picture of the animation, which the graphics card's shader moves. */
window.picture = (time, aside) => {
  mixer.setTime(0);
  look(aside);
  mixer.setTime(time);
  return draw(shown);
};
/** The same view of points given one by one, with no animation in it. */
window.plain = (points, aside) => {
  mixer.setTime(0);
  look(aside);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(unpacked(points), 3));
  geometry.setIndex(shown.geometry.index);
  geometry.computeVertexNormals();
  const colours = shown.geometry.attributes.color;
  if (colours) geometry.setAttribute("color", colours);
  return draw(new THREE.Mesh(geometry, shown.material));
};
window.ready = true;
"""


def why_not() -> str | None:
    """Return why three.js cannot be run here, or None."""
    if executable() is None:
        return "no Chromium found; install it, or set PLIANT_CHROMIUM to its path"
    if not THREE.is_dir():
        return "three.js is not there; say `make page`"
    return None


class Played:
    """A file open in three.js."""

    def __init__(self, page: Page, path: Path) -> None:
        self._page = page
        page.route(f"{ORIGIN}/shapes.glb", lambda route: route.fulfill(path=path, content_type=TYPES[".glb"]))
        opened = page.evaluate("open_glb('/shapes.glb')")
        self.targets: int = opened["targets"]
        self.duration: float = opened["duration"]
        self.kind: str = opened["kind"]

    def positions(self, time: float) -> np.ndarray:
        """Every vertex `(P, 3)` at a time in seconds, in the scene."""
        return np.frombuffer(base64.b64decode(self._page.evaluate("t => positions(t)", time)), "<f4").reshape(-1, 3)

    def picture(self, time: float, *, aside: float = 30) -> bytes:
        """A PNG at a time, from `aside` degrees."""
        return base64.b64decode(self._page.evaluate("([t, a]) => picture(t, a)", [time, aside]))

    def plain(self, points: np.ndarray, *, aside: float = 30) -> bytes:
        """A PNG of points `(P, 3)` in the scene, drawn without animation, with the file's faces and material."""
        packed = base64.b64encode(points.astype("<f4").tobytes()).decode()
        return base64.b64decode(self._page.evaluate("([p, a]) => plain(p, a)", [packed, aside]))


@contextmanager
def three_page() -> Iterator[Page]:
    """Open a page with three.js; where it is missing, skip, or fail in continuous integration."""
    reason = why_not()
    if reason is not None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)

    def answer(route: Route) -> None:
        path = route.request.url.removeprefix(ORIGIN)
        if path == "/":
            route.fulfill(body=HTML, content_type="text/html")
        elif path == "/page.js":
            route.fulfill(body=SCRIPT, content_type=TYPES[".js"])
        elif path.startswith("/three/"):
            route.fulfill(path=THREE / path.removeprefix("/three/"), content_type=TYPES[".js"])
        else:
            route.fulfill(status=404)

    with Browsing() as browser:
        page = browser.new_page(viewport={"width": 480, "height": 360})
        page.route("**/*", answer)
        page.goto(ORIGIN + "/")
        page.wait_for_function("window.ready === true")
        yield page
