"""The camera of shapes.glb, by the formulas of glTF 2.0: each vertex lands on the pixel that the result projects it to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
from khronos import assert_valid
from pliant.schemas.options import Options
from pliant.solver import Camera
from pliant.worker.artifacts import write_artifacts
from pliant.worker.artifacts.geometry import viewer_scale
from pliant.worker.artifacts.view import view_of
from results import make_result, moving_sheet
from scipy.spatial.transform import Rotation, Slerp


def turning_camera(
    frames: int, *, focal: float | None, y_up: bool, centre: tuple[float, float] = (319.5, 239.5)
) -> Camera:
    """A camera that turns by more than half a turn, so that quaternion signs would flip."""
    rotations = Rotation.from_rotvec(np.linspace(0, 4, frames)[:, None] * np.array([0.3, 0.9, 0.2])).as_matrix()
    scales = np.linspace(0.9, 1.1, frames) if focal is not None else np.ones(frames)
    shift = np.column_stack([np.linspace(-20, 20, frames), np.linspace(10, -5, frames)])
    return Camera(rotations, scales, np.array([330.0, 230.0]) + shift, focal, 0.0, np.array(centre), y_up)


def projection_matrix(lens: dict[str, object]) -> np.ndarray:
    """Section 3.10.3 of the specification: finite perspective, or orthographic projection."""
    if lens["type"] == "orthographic":
        given = lens["orthographic"]
        near, far = given["znear"], given["zfar"]  # type: ignore[index]
        matrix = np.diag([1 / given["xmag"], 1 / given["ymag"], 2 / (near - far), 1.0])  # type: ignore[index]
        matrix[2, 3] = (far + near) / (near - far)
        return matrix
    given = lens["perspective"]
    near, far, tangent = given["znear"], given["zfar"], np.tan(given["yfov"] / 2)  # type: ignore[index]
    matrix = np.diag([1 / (given["aspectRatio"] * tangent), 1 / tangent, (far + near) / (near - far), 0.0])  # type: ignore[index]
    matrix[2, 3], matrix[3, 2] = 2 * far * near / (near - far), -1.0
    return matrix


def seen_by(
    lens: dict[str, object], turns: np.ndarray, places: np.ndarray, points: np.ndarray, y_axis: str
) -> np.ndarray:
    """Pixels `(F, P, 2)` of scene points `(F, P, 3)`; they must lie between the near and far planes."""
    inside = np.einsum("fji,fpj->fpi", Rotation.from_quat(turns).as_matrix(), points - places[:, None])
    clip = np.concatenate([inside, np.ones((*inside.shape[:2], 1))], axis=2) @ projection_matrix(lens).T
    device = clip[..., :3] / clip[..., 3:]
    assert np.abs(device[..., 2]).max() < 1
    known = lens["extras"]["pliant"]  # type: ignore[index]
    down = -1.0 if y_axis == "down" else 1.0
    return np.asarray(known["view_centre"]) + device[..., :2] * [1, down] * np.asarray(known["view_size"]) / 2


@pytest.mark.parametrize("y_axis", ["down", "up"])
@pytest.mark.parametrize("focal", [700.0, None], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("centre", [(319.5, 239.5), (400.0, 180.0)], ids=["centred", "off_centre"])
@pytest.mark.parametrize("size", [(640.0, 480.0), None])
def test_a_vertex_lands_on_its_pixel(
    y_axis: str, focal: float | None, centre: tuple[float, float], size: tuple[float, float] | None
) -> None:
    shapes = moving_sheet(9, 5, 6) + np.array([3.0, -2.0, 5.0])
    camera = turning_camera(9, focal=focal, y_up=y_axis == "up", centre=centre)
    view = view_of(camera, shapes, y_axis=y_axis, scale=0.01, image_size=size)
    scene = 0.01 * shapes * ([1, -1, -1] if y_axis == "down" else [1, 1, 1])
    pixels = seen_by(view.lens, view.rotations, view.translations, scene, y_axis)
    np.testing.assert_allclose(pixels, camera.project(shapes), atol=1e-3)
    assert (np.einsum("fi,fi->f", view.rotations[1:], view.rotations[:-1]) > 0).all()


def test_the_view_equals_the_picture_if_the_principal_point_is_centred() -> None:
    view = view_of(
        turning_camera(5, focal=700.0, y_up=False), moving_sheet(5, 4, 4), y_axis="down", scale=1.0, image_size=(640.0, 480.0)
    )  # fmt: skip
    assert view.lens["extras"]["pliant"]["view_size"] == [640.0, 480.0]
    np.testing.assert_allclose(view.lens["perspective"]["aspectRatio"], 640 / 480)
    np.testing.assert_allclose(view.lens["perspective"]["yfov"], 2 * np.arctan(240 / 700))


def test_varying_scales_use_the_middle_one_and_state_their_range() -> None:
    camera = replace(turning_camera(5, focal=None, y_up=False), scales=np.geomspace(0.8, 1.25, 5))
    view = view_of(camera, moving_sheet(5, 4, 4), y_axis="down", scale=1.0, image_size=(640.0, 480.0))
    assert view.lens["extras"]["pliant"]["scale_range"] == pytest.approx([0.8, 1.25])
    assert view.lens["orthographic"]["xmag"] == pytest.approx(320)


@pytest.mark.parametrize("focal", [700.0, None], ids=["perspective", "orthographic"])
def test_the_glb_contains_a_valid_animated_camera(tmp_path: Path, focal: float | None) -> None:
    inputs, solution, _ = make_result()
    camera = turning_camera(7, focal=focal, y_up=False)
    options = Options(image_size="640x480", outputs=("glb",), glb_quantized=True)
    write_artifacts(inputs, replace(solution, camera=camera), options, {}, tmp_path)
    assert_valid(tmp_path / "shapes.glb")
    gltf = pygltflib.GLTF2.load_binary(tmp_path / "shapes.glb")
    node = gltf.nodes[1]
    assert gltf.scenes[0].nodes == [0, 1]
    assert (node.camera, node.mesh, node.scale) == (0, None, None)
    motion = gltf.animations[0]
    found = {}
    for channel in motion.channels:
        if channel.target.node == 1:
            sampler = motion.samplers[channel.sampler]
            assert sampler.input == motion.samplers[0].input
            described = gltf.accessors[sampler.output]
            view = gltf.bufferViews[described.bufferView]
            values = np.frombuffer(gltf.binary_blob(), "<f4", view.byteLength // 4, view.byteOffset)
            found[channel.target.path] = values.reshape(described.count, -1)
    np.testing.assert_allclose(np.linalg.norm(found["rotation"], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found["translation"][0], node.translation, rtol=1e-6)
    np.testing.assert_allclose(found["rotation"][0], node.rotation, rtol=1e-6)
    lens = gltf.cameras[0]
    camera_record = {"type": lens.type, "extras": lens.extras, lens.type: vars(getattr(lens, lens.type))}
    scene = viewer_scale(solution.shapes) * solution.shapes * [1, -1, -1]
    pixels = seen_by(camera_record, found["rotation"], found["translation"], scene, "down")
    np.testing.assert_allclose(pixels, camera.project(solution.shapes), atol=1e-2)
    between = Slerp([0, 1], Rotation.from_quat(found["rotation"][:2]))(0.5)
    assert between.magnitude() == pytest.approx(Rotation.from_matrix(camera.rotations[1]).magnitude() / 2, abs=1e-5)
