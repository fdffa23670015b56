"""Positions of a result's points as Blender imports them; run by `benchmarks.imports` with an interpreter that has `bpy`.

    python benchmarks/figures/blender_points.py FOLDER OUT.npz FPS FRAME [FRAME …]

`FOLDER` holds `shapes.glb`, `shapes.usdc`, and `ply/` and `obj/` with the files of those frames. Coordinates are Blender's, z up.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np


def main() -> None:
    folder, out, fps, frames = (
        Path(sys.argv[1]),
        Path(sys.argv[2]),
        float(sys.argv[3]),
        [int(one) for one in sys.argv[4:]],
    )
    found: dict[str, np.ndarray] = {}
    empty(fps)
    bpy.ops.import_scene.gltf(filepath=str(folder / "shapes.glb"))
    found["shapes.glb"] = animated(frames)
    if (folder / "shapes.usdc").exists():
        empty(fps)
        bpy.ops.wm.usd_import(filepath=str(folder / "shapes.usdc"))
        found["shapes.usdc"] = animated(frames)
    for name in ("ply", "obj"):
        operator = bpy.ops.wm.ply_import if name == "ply" else bpy.ops.wm.obj_import
        stills = []
        for frame in frames:
            empty(fps)
            operator(filepath=str(folder / name / f"frame_{frame:05d}.{name}"), forward_axis="NEGATIVE_Z", up_axis="Y")
            stills.append(animated([0])[0])
        found[f"shapes_{name}.zip"] = np.stack(stills)
    np.savez(out, blender=bpy.app.version_string, **found)


def empty(fps: float) -> None:
    """Start an empty scene at the job's frame rate: Blender counts in frames, glTF in seconds."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = round(fps)
    bpy.context.scene.render.fps_base = round(fps) / fps


def animated(frames: list[int]) -> np.ndarray:
    """Return world positions `(len(frames), P, 3)` of the only mesh; glTF's first frame is frame 0 on Blender's timeline."""
    made = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        there = next(one for one in bpy.context.scene.objects if one.type == "MESH")
        evaluated = there.evaluated_get(bpy.context.evaluated_depsgraph_get())
        points = np.zeros(3 * len(evaluated.data.vertices), dtype=np.float32)
        evaluated.data.vertices.foreach_get("co", points)
        matrix = np.array(evaluated.matrix_world)
        made.append(points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
    return np.stack(made)


if __name__ == "__main__":
    main()
