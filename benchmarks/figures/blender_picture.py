"""Import a result into Blender and render some of its frames side by side.

    pip install bpy          # in an environment of its own; Blender as a Python module, 350 MB
    python benchmarks/figures/blender_picture.py RESULT/shapes.glb PICTURE [--frames 3] [--height 240] [--side 35]

Does not import Pliant. Follows the tutorial: set the frame rate, import, play.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector
from PIL import Image

SAMPLES = 24
"""Light paths per pixel: enough for matt surfaces, with or without a denoiser."""


def main() -> None:
    """Import, light, render."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("glb", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--fps", type=int, default=30)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--side", type=float, default=35.0, help="degrees beside the front")
    given = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = given.fps
    bpy.ops.import_scene.gltf(filepath=str(given.glb))
    shape = next(each for each in scene.objects if each.type == "MESH")
    for polygon in shape.data.polygons:
        polygon.use_smooth = True
    last = int(max(action.frame_range[1] for action in bpy.data.actions))
    print(
        f"{shape.name}: {len(shape.data.vertices)} vertices, {len(shape.data.shape_keys.key_blocks)} shape keys, {last} frames"
    )
    prepare(scene, shape, given)
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for number, frame in enumerate(np.linspace(1, last - 1, given.frames).round().astype(int)):
            scene.frame_set(int(frame))
            scene.render.filepath = f"{folder}/{number}.png"
            bpy.ops.render.render(write_still=True)
            pictures.append(Image.open(scene.render.filepath).convert("RGB"))
        joined = Image.fromarray(np.hstack([np.asarray(each) for each in pictures]))
    joined.save(given.picture, optimize=True)


def prepare(scene: bpy.types.Scene, shape: bpy.types.Object, given: argparse.Namespace) -> None:
    """Put a camera, a key light and a grey world around the object."""
    corners = [shape.matrix_world @ Vector(corner) for corner in shape.bound_box]
    middle = sum(corners, Vector()) / 8
    radius = max((corner - middle).length for corner in corners)
    angle = math.radians(given.side)
    towards = Vector((math.sin(angle), -math.cos(angle), 0.1))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = middle + 3.2 * radius * towards
    camera.rotation_euler = (-towards).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens = 62
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 2.5
    sun.rotation_euler = (math.radians(50), 0, math.radians(-35))
    for each in (camera, sun):
        scene.collection.objects.link(each)
    scene.camera = camera
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.75, 0.77, 0.8, 1)
    world.node_tree.nodes["Background"].inputs[1].default_value = 0.6
    scene.world = world
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", SAMPLES
    scene.render.resolution_x, scene.render.resolution_y = given.height, given.height
    scene.view_settings.view_transform = "Standard"


if __name__ == "__main__":
    main()
