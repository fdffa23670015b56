"""Result files, each read back with another library and compared point by point."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pygltflib
import pytest
import trimesh
from khronos import assert_valid
from pliant.solver.evaluation.alignment import align
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.artifacts.animation import animate, leading
from pliant.worker.artifacts.colours import linear, shade
from pliant.worker.artifacts.geometry import upright, vertex_normals, viewer_scale
from pliant.worker.artifacts.glb import write_glb
from pxr import Gf, Usd, UsdGeom
from results import disk_full, make_result, moving_sheet, write

DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def accessor(gltf: pygltflib.GLTF2, index: int) -> np.ndarray:
    """An accessor's values, decoded from the binary chunk as the JSON that pygltflib parsed describes it."""
    described = gltf.accessors[index]
    view = gltf.bufferViews[described.bufferView]
    dtype, width = np.dtype(DTYPES[described.componentType]), WIDTHS[described.type]
    stride = view.byteStride or dtype.itemsize * width
    raw = np.frombuffer(gltf.binary_blob(), np.uint8, view.byteLength, view.byteOffset)
    rows = np.lib.stride_tricks.as_strided(raw, (described.count, dtype.itemsize * width), (stride, 1))
    values = np.ascontiguousarray(rows).view(dtype).astype(float)
    if described.normalized:
        values = np.maximum(values / np.iinfo(dtype).max, -1)
    if described.min:
        top = np.iinfo(dtype).max if described.normalized else 1
        np.testing.assert_allclose(values.min(axis=0), np.array(described.min) / top, rtol=1e-6)
        np.testing.assert_allclose(values.max(axis=0), np.array(described.max) / top, rtol=1e-6)
    return values


def played(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every frame as a viewer shows it, with the node's transform; the times; the triangles."""
    gltf = pygltflib.GLTF2.load_binary(path)
    primitive = gltf.meshes[0].primitives[0]
    base = accessor(gltf, primitive.attributes.POSITION)
    targets = np.stack([accessor(gltf, target["POSITION"]) for target in primitive.targets])
    sampler = gltf.animations[0].samplers[0]
    weights = accessor(gltf, sampler.output).reshape(-1, len(targets))
    assert weights.min() >= 0
    assert weights.max() <= 1
    node = gltf.nodes[0]
    shown = base + np.tensordot(weights, targets, axes=1)
    shown = shown * np.array(node.scale) + np.array(node.translation or [0.0, 0.0, 0.0])
    faces = np.zeros((0, 3)) if primitive.indices is None else accessor(gltf, primitive.indices).reshape(-1, 3)
    return shown, accessor(gltf, sampler.input)[:, 0], faces


def test_npz_holds_the_solution_bit_for_bit(tmp_path: Path) -> None:
    made = make_result()
    files = write(tmp_path, made)
    inputs, solution, _ = made
    with np.load(files["shapes.npz"], allow_pickle=False) as got:
        np.testing.assert_array_equal(got["shapes"], solution.shapes)
        assert got["shapes"].dtype == np.float64
        np.testing.assert_array_equal(got["rotations"], solution.camera.rotations)
        np.testing.assert_array_equal(got["scales"], solution.camera.scales)
        np.testing.assert_array_equal(got["translations"], solution.camera.translations)
        assert got["focal"] == np.inf
        assert np.isnan(got["focal_std"])
        assert inputs.mesh is not None
        np.testing.assert_array_equal(got["faces"], inputs.mesh.faces)
        np.testing.assert_allclose(got["residuals"], solution.residuals, rtol=1e-6)
        np.testing.assert_array_equal(got["weights"], solution.weights)
        assert solution.shapes_std is not None
        np.testing.assert_array_equal(got["shapes_std"], solution.shapes_std.astype(np.float32))
        assert got["shapes_std"].dtype == np.float32
        assert solution.inlier_probability is not None
        np.testing.assert_array_equal(got["inlier_probability"], solution.inlier_probability.astype(np.float32))
        assert got["inlier_probability"].dtype == np.float32
        np.testing.assert_array_equal(got["trace_objective"], solution.trace.objective)
        np.testing.assert_array_equal(got["trace_residual"], solution.trace.residual)
        np.testing.assert_array_equal(got["trace_iterations"], solution.trace.iterations)


@pytest.mark.parametrize("y_axis", ["down", "up"])
@pytest.mark.parametrize("mesh", ["grid", "triangles", "none"])
def test_glb_plays_every_frame_exactly(tmp_path: Path, mesh: str, y_axis: str) -> None:
    made = make_result(mesh=mesh, y_axis=y_axis, glb_motion="frames")
    files = write(tmp_path, made)
    shown, times, faces = played(files["shapes.glb"])
    shapes = made[1].shapes * ([1, -1, -1] if y_axis == "down" else [1, 1, 1])
    scale = viewer_scale(shapes)
    np.testing.assert_allclose(shown, shapes * scale, atol=1e-6 * np.ptp(shapes) * scale)
    np.testing.assert_allclose(times, np.arange(7) / 25, rtol=1e-6)
    assert len(faces) == (0 if mesh == "none" else 2 * 4 * 5)
    report = json.loads(files["report.json"].read_text())
    assert report["artifacts"]["shapes.glb"]["encoding"] == "one target per frame"
    assert report["artifacts"]["shapes.glb"]["targets"] == 7


def test_a_long_animation_is_stored_as_modes_within_its_error_bound(tmp_path: Path) -> None:
    made = make_result(230, 4, 5)
    files = write(tmp_path, made)
    shapes = upright(made[1].shapes, "down")
    shown, _, _ = played(files["shapes.glb"])
    extras = pygltflib.GLTF2.load_binary(files["shapes.glb"]).meshes[0].extras
    error = np.linalg.norm(shown / viewer_scale(shapes) - shapes, axis=2)
    details = extras["pliant"]
    assert details["encoding"] == "modes"
    assert details["targets"] == len(extras["targetNames"]) < 20
    assert 0 < error.max() == pytest.approx(details["max_error"], rel=0.05)
    assert details["max_error"] <= details["error_bound"] < 0.0011 * np.linalg.norm(np.ptp(shapes, axis=(0, 1)))
    assert json.loads(files["report.json"].read_text())["artifacts"]["shapes.glb"]["max_error"] == details["max_error"]


def test_a_short_animation_is_stored_as_modes_if_that_is_smaller(tmp_path: Path) -> None:
    made = make_result(40, 12, 15)
    exact = make_result(40, 12, 15, glb_motion="frames")
    for folder in ("modes", "frames"):
        (tmp_path / folder).mkdir()
    small, large = (
        write(tmp_path / folder, each)["shapes.glb"] for folder, each in (("modes", made), ("frames", exact))
    )
    assert small.stat().st_size < large.stat().st_size / 3
    shapes = upright(made[1].shapes, "down")
    shown, _, _ = played(small)
    details = pygltflib.GLTF2.load_binary(small).meshes[0].extras["pliant"]
    error = np.linalg.norm(shown / viewer_scale(shapes) - shapes, axis=2).max()
    assert error == pytest.approx(details["max_error"], rel=0.05)
    assert details["max_error"] <= details["error_bound"]
    assert (details["encoding"], details["targets"] < 40) == ("modes", True)


def test_full_rank_motion_needs_one_target_fewer_than_frames() -> None:
    details = animate(np.random.default_rng(0).normal(size=(6, 30, 3))).extras
    assert details["targets"] == 5
    assert details["max_error"] < 1e-6


def test_all_formats_show_the_same_pose(tmp_path: Path) -> None:
    made = make_result(9, 6, 7, outputs="glb,ply,obj,usd,mdd", glb_motion="frames", normals="static")
    files = write(tmp_path, made)
    shown, times, _ = played(files["shapes.glb"])
    scale = viewer_scale(made[1].shapes)
    stage = Usd.Stage.Open(str(files["shapes.usdc"]))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    cache = np.frombuffer(files["shapes.mdd"].read_bytes(), ">f4", offset=8 + 4 * 9).reshape(9, 42, 3)
    tolerance = 1e-6 * np.ptp(shown)
    for frame in range(9):
        for name in ("ply", "obj"):
            with zipfile.ZipFile(files[f"shapes_{name}.zip"]) as archive:
                content = io.BytesIO(archive.read(f"frame_{frame:05d}.{name}"))
            loaded = trimesh.load(content, file_type=name, process=False, maintain_order=True)
            np.testing.assert_allclose(loaded.vertices * scale, shown[frame], atol=tolerance)
        moved = mesh.ComputeLocalToWorldTransform(frame).Transform
        placed = [list(moved(Gf.Vec3d(*map(float, point)))) for point in mesh.GetPointsAttr().Get(frame)]
        np.testing.assert_allclose(placed, shown[frame], atol=tolerance)
        np.testing.assert_allclose(cache[frame] * scale, shown[frame], atol=tolerance)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(1 / times[1])


def test_a_rigid_scene_needs_one_mode() -> None:
    assert animate(np.tile(moving_sheet(1, 4, 5), (201, 1, 1))).extras["targets"] == 1


def test_the_number_of_modes_is_minimal() -> None:
    shapes = moving_sheet(210, 4, 5)
    made = animate(shapes)
    moved = (shapes - shapes.mean(axis=0)).reshape(210, -1)
    left = np.linalg.svd(moved, full_matrices=False)[0][:, : made.extras["targets"] - 1]
    worst = np.linalg.norm((moved - left @ (left.T @ moved)).reshape(210, -1, 3), axis=2).max()
    assert worst > 0.9 * made.extras["error_bound"]


@pytest.mark.parametrize("frames", [150, 450])
def test_modes_are_the_leading_eigenvectors(frames: int) -> None:
    random = np.random.default_rng(0)
    exact = np.linalg.qr(random.standard_normal((frames, frames)))[0]
    values = 0.8 ** np.arange(frames)
    found = leading((exact * values) @ exact.T, 40)
    assert found.shape == (frames, 40)
    np.testing.assert_allclose(found.T @ found, np.eye(40), atol=1e-9)
    np.testing.assert_allclose(np.abs(np.einsum("fk,fk->k", found, exact[:, :40])), 1, atol=1e-6)


@pytest.mark.node
@pytest.mark.parametrize(("frames", "mesh"), [(7, "grid"), (7, "none"), (230, "triangles")])
def test_glb_passes_the_khronos_validator(tmp_path: Path, frames: int, mesh: str) -> None:
    assert_valid(write(tmp_path, make_result(frames, 5, 7, mesh=mesh))["shapes.glb"])


@pytest.mark.node
@pytest.mark.parametrize("quantized", [False, True])
@pytest.mark.parametrize("normals", ["none", "animated"])
def test_every_glb_variant_is_valid_and_plays_back(tmp_path: Path, quantized: bool, normals: str) -> None:
    shapes = moving_sheet(9, 5, 7)
    triangles = triangles_of(make_result(9, 5, 7)[0].mesh.faces)  # type: ignore[union-attr]
    colours = np.full((35, 4), 50_000, dtype=np.uint16)
    with (tmp_path / "x.glb").open("wb") as file:
        write_glb(
            file,
            animate(shapes, motion="frames"),
            triangles,
            times=np.arange(9) / 30,
            node={},
            normals=normals,
            quantized=quantized,
            colours=colours,
        )
    assert_valid(tmp_path / "x.glb")
    gltf = pygltflib.GLTF2.load_binary(tmp_path / "x.glb")
    node = gltf.nodes[0]
    if not quantized:
        node.scale = [1.0, 1.0, 1.0]
        gltf.save_binary(str(tmp_path / "x.glb"))
    shown, _, _ = played(tmp_path / "x.glb")
    error = np.abs(shown - shapes).max() / np.ptp(shapes)
    assert error < (1e-4 if quantized else 1e-6)
    assert not quantized or error > 1e-8
    attributes = gltf.meshes[0].primitives[0].attributes
    assert (attributes.NORMAL is not None) == (normals == "animated")
    np.testing.assert_allclose(accessor(gltf, attributes.COLOR_0), 50_000 / 65_535)
    if normals == "animated":
        base = accessor(gltf, attributes.NORMAL)
        moved = accessor(gltf, gltf.meshes[0].primitives[0].targets[4]["NORMAL"])
        expected = vertex_normals(shapes[4], triangles)
        np.testing.assert_allclose(base + moved, expected, atol=0.01 if quantized else 1e-6)


@pytest.mark.node
@pytest.mark.parametrize("frames", [7, 230])
def test_options_reach_the_glb(tmp_path: Path, frames: int) -> None:
    made = make_result(
        frames, truth=True, fps=12.5, normals="animated", colours="error", glb_quantized=True, glb_motion="frames"
    )
    inputs, solution, _ = made
    files = write(tmp_path, made)
    assert_valid(files["shapes.glb"])
    shown, times, _ = played(files["shapes.glb"])
    shapes = upright(solution.shapes, "down")
    scale = viewer_scale(shapes)
    bound = 1e-4 if frames <= 200 else 1.2e-3
    assert np.abs(shown - scale * shapes).max() < bound * np.ptp(scale * shapes)
    np.testing.assert_allclose(times, np.arange(frames) / 12.5, rtol=1e-6)
    gltf = pygltflib.GLTF2.load_binary(files["shapes.glb"])
    assert gltf.extensionsRequired == ["KHR_mesh_quantization"]
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.targets[0]["NORMAL"] is not None
    details = gltf.meshes[0].extras["pliant"]["colours"]
    assert inputs.ground_truth is not None
    mean = align(solution.shapes, inputs.ground_truth.shapes, kind="frame_scaled").distances.mean(axis=0)
    assert details["quantity"] == "distance from the truth"
    colours = accessor(gltf, primitive.attributes.COLOR_0)
    np.testing.assert_allclose(colours[:, :3], linear(shade(mean / details["top"])), atol=1e-4)
    np.testing.assert_array_equal(colours[:, 3], 1)


def test_ply_zip_holds_every_frame(tmp_path: Path) -> None:
    made = make_result(
        axes="tracks",
    )
    inputs, solution, _ = made
    with zipfile.ZipFile(write(tmp_path, made)["shapes_ply.zip"]) as archive:
        assert archive.namelist() == [f"frame_{index:05d}.ply" for index in range(7)]
        for name, shape in zip(archive.namelist(), solution.shapes, strict=True):
            content = plyfile.PlyData.read(io.BytesIO(archive.read(name)))
            points = np.column_stack([content["vertex"][axis] for axis in "xyz"])
            np.testing.assert_array_equal(points, shape.astype(np.float32))
            assert inputs.mesh is not None
            np.testing.assert_array_equal(np.stack(content["face"]["vertex_indices"]), inputs.mesh.faces)


@pytest.mark.parametrize(
    ("axes", "first", "stated"),
    [
        ("viewer", np.eye(3), "x right, y up, z towards the first camera"),
        ("tracks", np.eye(3), "x right, y down, z away from the first camera"),
        ("viewer", np.diag([1.0, -1, -1]), "world axes of the cameras, y and z reversed"),
        ("tracks", np.diag([1.0, -1, -1]), "world axes of the cameras"),
    ],
)
def test_ply_and_obj_state_their_axes(tmp_path: Path, axes: str, first: np.ndarray, stated: str) -> None:
    """Known cameras refer to a world of their own, which need not be that of the first camera."""
    inputs, solution, options = make_result(outputs="ply,obj", axes=axes)
    camera = replace(solution.camera, rotations=first @ solution.camera.rotations)
    files = write(tmp_path, (inputs, replace(solution, camera=camera), options))
    for kind, comment in (("ply", "comment"), ("obj", "#")):
        with zipfile.ZipFile(files[f"shapes_{kind}.zip"]) as archive:
            assert f"\n{comment} {stated}; unit of the tracks\n".encode() in b"\n" + archive.read(f"frame_00000.{kind}")


def test_equal_results_give_identical_files(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first, second = write(tmp_path / "a", make_result()), write(tmp_path / "b", make_result())
    for name in ("shapes.npz", "shapes.glb", "shapes_ply.zip"):
        assert first[name].read_bytes() == second[name].read_bytes()


def test_a_failed_write_keeps_the_old_file_and_no_partial_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = write(tmp_path, make_result())
    before = files["shapes.npz"].read_bytes()

    monkeypatch.setattr(np, "savez", disk_full)
    inputs, solution, options = make_result(8)
    with pytest.raises(OSError, match="No space"):
        write_artifacts(inputs, solution, options, {}, tmp_path)
    assert files["shapes.npz"].read_bytes() == before
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".part")]


def test_progress_rises_to_one(tmp_path: Path) -> None:
    inputs, solution, options = make_result()
    details: list[float] = []
    report = build_report(inputs, solution, options, metrics={})
    write_artifacts(inputs, solution, options, report, tmp_path, on_progress=details.append)
    assert details == sorted(details)
    assert details[-1] == 1.0
    assert len(details) > 10


def test_normals_have_unit_length_and_point_out_of_the_face() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5]], dtype=float)
    normals = vertex_normals(square, triangles_of(np.array([[0, 1, 2, 3]], dtype=np.int32)))
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (5, 1)))
    bent = vertex_normals(moving_sheet(1, 5, 6)[0], triangles_of(make_result()[0].mesh.faces))  # type: ignore[union-attr]
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1, rtol=1e-6)


def test_viewer_scale_gives_a_size_between_one_and_ten() -> None:
    for size in (1e-3, 0.5, 1.0, 30.0, 4e4):
        shapes = np.array([[[0.0, 0, 0], [size, 0, 0]]])
        assert 1 <= size * viewer_scale(shapes) < 10 * (1 + 1e-9)
    assert viewer_scale(np.zeros((1, 2, 3))) == 1.0
