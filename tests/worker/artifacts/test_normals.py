"""Moving normals of `shapes.glb`: fitted to the frames, and stored for as few modes as their bound allows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
import pytest
from browsing import differing_pixels
from khronos import assert_valid
from pliant.worker.artifacts.animation import Animation, animate
from pliant.worker.artifacts.geometry import vertex_normals
from pliant.worker.artifacts.glb import write_glb
from pliant.worker.artifacts.normals import NORMAL_BOUND, fit_normals
from three_page import Played, three_page


def rippled(frames: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A 16 × 16 surface with a large bend and four ripples, each half of the one before; its triangles."""
    rows, columns = np.mgrid[0:16, 0:16] / 15 - 0.5
    time = np.linspace(0, 2 * np.pi, frames)[:, None, None]
    depth = 0.5 * np.sin(time) * columns**2
    for number in range(1, 5):
        depth = depth + 0.02 * 0.5**number * np.sin((number + 1) * time) * np.sin(2 * np.pi * number * rows)
    flat = np.stack(np.broadcast_arrays(columns, rows, depth), axis=-1).reshape(frames, -1, 3)
    corner = (np.arange(15)[:, None] * 16 + np.arange(15)).ravel()
    quads = np.stack([corner, corner + 1, corner + 17, corner + 16], axis=1)
    return flat, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def shown(animation: Animation, base: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The normals that a viewer computes."""
    blended = base + np.tensordot(animation.weights[:, : len(targets)], targets, axes=1)
    return blended / np.linalg.norm(blended, axis=2, keepdims=True)


def test_fitted_normals_are_within_their_bound_with_fewer_targets_than_modes() -> None:
    shapes, triangles = rippled()
    animation = animate(shapes)
    fitted = fit_normals(animation, triangles)
    assert 0 < len(fitted.targets) < animation.extras["targets"]
    true = np.stack([vertex_normals(shape, triangles) for shape in shapes])
    rms = np.sqrt(np.square(shown(animation, fitted.base, fitted.targets) - true).sum(axis=2).mean())
    assert rms <= 1.05 * fitted.rms <= 1.05 * NORMAL_BOUND
    np.testing.assert_allclose(np.linalg.norm(fitted.base, axis=1), 1, atol=1e-5)


def test_a_static_shape_has_static_normals() -> None:
    shapes, triangles = rippled(5)
    animation = animate(np.repeat(shapes[1:2], 5, axis=0))
    fitted = fit_normals(animation, triangles)
    np.testing.assert_allclose(fitted.base, vertex_normals(shapes[1], triangles), atol=1e-5)
    np.testing.assert_allclose(fitted.targets, 0, atol=1e-5)


def test_a_normal_that_flips_keeps_unit_length() -> None:
    """Up in half of the frames, down in the others: the constant part has length zero."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    turned = square * (1, -1, 1)
    fitted = fit_normals(animate(np.stack([square, turned] * 3)), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    np.testing.assert_allclose(np.linalg.norm(fitted.base, axis=1), 1, atol=1e-5)
    assert np.isfinite(fitted.targets).all()


def written(path: Path, *, quantized: bool) -> tuple[np.ndarray, pygltflib.GLTF2]:
    shapes, triangles = rippled()
    with path.open("wb") as file:
        write_glb(
            file,
            animate(shapes),
            triangles,
            times=np.arange(len(shapes)) / 10,
            node={},
            normals="animated",
            quantized=quantized,
        )
    return shapes, pygltflib.GLTF2.load_binary(path)


@pytest.mark.node
@pytest.mark.parametrize("motion", ["auto", "frames"])
@pytest.mark.parametrize("quantized", [False, True])
def test_no_position_is_further_off_than_the_stated_error(tmp_path: Path, motion: str, quantized: bool) -> None:
    shapes, triangles = rippled()
    animation = animate(shapes, motion=motion)
    with (tmp_path / "x.glb").open("wb") as file:
        write_glb(file, animation, triangles, times=np.arange(len(shapes)) / 10, node={}, quantized=quantized)
    gltf = pygltflib.GLTF2.load_binary(tmp_path / "x.glb")

    def positions(accessor: int) -> np.ndarray:
        described = gltf.accessors[accessor]
        view = gltf.bufferViews[described.bufferView]
        number = np.dtype(np.int16 if quantized else np.float32)
        stride = view.byteStride or 3 * number.itemsize
        start = (view.byteOffset or 0) + (described.byteOffset or 0)
        rows = np.frombuffer(gltf.binary_blob(), np.uint8, described.count * stride, start).reshape(-1, stride)
        found = rows[:, : 3 * number.itemsize].copy().view(number).astype(float)
        return found / 32767 if quantized else found

    primitive, node = gltf.meshes[0].primitives[0], gltf.nodes[0]
    targets = np.stack([positions(each["POSITION"]) for each in primitive.targets])
    seen = positions(primitive.attributes.POSITION) + np.tensordot(animation.weights, targets, axes=1)
    seen = seen * np.array(node.scale or [1, 1, 1]) + np.array(node.translation or [0, 0, 0])
    exact = np.stack([animation.frame(index) for index in range(len(shapes))])
    worst, stated = np.abs(seen - exact).max(), gltf.meshes[0].extras["pliant"]["max_error"]
    assert worst <= stated + 1e-7
    if quantized and motion == "frames":
        assert stated < 3 * worst


@pytest.mark.parametrize("quantized", [False, True])
def test_targets_without_normals_share_one_accessor_of_zeros(tmp_path: Path, quantized: bool) -> None:
    _, gltf = written(tmp_path / "x.glb", quantized=quantized)
    assert_valid(tmp_path / "x.glb")
    assert all(accessor.bufferView is not None for accessor in gltf.accessors)  # Assimp and VTK refuse others
    told = gltf.meshes[0].extras["pliant"]
    normals = [target["NORMAL"] for target in gltf.meshes[0].primitives[0].targets]
    views = [gltf.bufferViews[gltf.accessors[index].bufferView] for index in normals]
    moved = [any(gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]) for view in views]
    assert moved == [number < told["normal_targets"] for number in range(told["targets"])]
    assert len(set(normals[told["normal_targets"] :])) == 1
    assert told["normal_rms_error"] <= NORMAL_BOUND


@pytest.mark.chromium
@pytest.mark.parametrize("quantized", [False, True])
def test_three_js_shading_matches_that_of_true_normals(tmp_path: Path, quantized: bool) -> None:
    shapes, _ = written(tmp_path / "x.glb", quantized=quantized)
    with three_page() as page:
        played = Played(page, tmp_path / "x.glb")
        for frame in (5, 20, 33):
            moved = played.picture(frame / 10)
            assert differing_pixels(moved, played.plain(shapes[frame])) < 0.01
            assert differing_pixels(moved, played.plain(shapes[(frame + 12) % 40])) > 0.03
