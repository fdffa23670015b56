"""Compare the view of Blender's imported camera with the pixel positions of the result.

    pip install bpy          # in an environment of its own; Blender as a Python module, 350 MB
    python benchmarks/figures/blender_camera.py RESULT/shapes.glb RESULT/shapes.npz [--fps 30] [--y-up]

Imports the mesh and its animated camera, projects every vertex of every frame with `bpy_extras.object_utils.world_to_camera_view`, and
prints the largest distance, in pixels, from its projection by the cameras in `shapes.npz`. Exits with 1 above `--limit`. Does not import
Pliant.
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.object_utils import world_to_camera_view


def main() -> None:
    """Import, project, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("glb", type=Path)
    parser.add_argument("arrays", type=Path)
    parser.add_argument("--fps", type=int, default=30)
    parser.add_argument("--y-up", action="store_true", help="y of the tracks points up")
    parser.add_argument("--limit", type=float, default=0.5, help="pixels")
    given = parser.parse_args()
    pixels = projected(given.arrays, y_up=given.y_up)
    centre, size = view_of(given.glb)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = given.fps
    bpy.ops.import_scene.gltf(filepath=str(given.glb))
    shape = next(each for each in scene.objects if each.type == "MESH")
    camera = next(each for each in scene.objects if each.type == "CAMERA")
    scene.render.resolution_x, scene.render.resolution_y = (round(1000 * float(each) / size.max()) for each in size)
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = 1.0, 1.0
    first = min(curve_start(action) for action in bpy.data.actions)
    worst, moved = 0.0, []
    for frame, expected in enumerate(pixels):
        scene.frame_set(int(first) + frame)
        moved.append(np.array(camera.matrix_world))
        seen = seen_in(scene, camera, shape)
        flip = 1.0 if given.y_up else -1.0
        found = centre + (seen - 0.5) * [1.0, flip] * size
        worst = max(worst, nearest_distances(found, expected))
    turn = np.ptp(np.array(moved), axis=0).max()
    print(
        f"{len(pixels)} frames, {pixels.shape[1]} points: at most {worst:.4f} px apart; the camera's matrix moves by {turn:.3g}"
    )
    sys.exit(worst > given.limit)


def curve_start(action: bpy.types.Action) -> float:
    """Return the first frame of an animation."""
    return float(action.frame_range[0])


def seen_in(scene: bpy.types.Scene, camera: bpy.types.Object, shape: bpy.types.Object) -> np.ndarray:
    """Return view coordinates of the deformed mesh's vertices, 0 to 1 from the lower left corner, shape `(V, 2)`."""
    graph = bpy.context.evaluated_depsgraph_get()
    posed = shape.evaluated_get(graph)
    mesh = posed.to_mesh()
    places = [posed.matrix_world @ vertex.co for vertex in mesh.vertices]
    posed.to_mesh_clear()
    return np.array([world_to_camera_view(scene, camera, place)[:2] for place in places])


def nearest_distances(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest distance from an expected position to its vertex, or to the nearest vertex if the numbers differ."""
    if len(found) == len(expected):
        return float(np.hypot(*(found - expected).T).max())
    return float(np.hypot(*(found[:, None] - expected[None]).T).min(axis=0).max())


def projected(path: Path, *, y_up: bool) -> np.ndarray:
    """Project every point of every frame with the cameras of `shapes.npz`; return pixels, shape `(F, P, 2)`."""
    with np.load(path) as file:
        shapes, rotations, scales = file["shapes"], file["rotations"], file["scales"]
        translations, focal, point = file["translations"], float(file["focal"]), file["principal_point"]
    inside = scales[:, None, None] * np.einsum("fij,fpj->fpi", rotations, shapes)
    away = -inside[..., 2:] if y_up else inside[..., 2:]
    offset = (translations - point)[:, None]
    return point + (inside[..., :2] + offset) / (1 + away / focal)


def view_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and size of the view in pixels, from the camera's `extras`."""
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    stated = json.loads(data[20 : 20 + length])["cameras"][0]["extras"]["pliant"]
    return np.array(stated["view_centre"]), np.array(stated["view_size"])


if __name__ == "__main__":
    main()
