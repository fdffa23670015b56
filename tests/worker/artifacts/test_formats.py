"""Optional result files, each read back with another library and compared point by point."""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import plyfile
import pytest
import scipy.io
import trimesh
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.solver.evaluation.alignment import align
from pliant.solver.evaluation.metrics import evaluate
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts import build_report, kinds_for, matlab, write_artifacts
from pliant.worker.artifacts.colours import STOPS, Painting, linear, shade
from pliant.worker.artifacts.geometry import upright, vertex_normals, viewer_scale
from pliant.worker.artifacts.scenes import usd
from pliant.worker.execution import pipeline
from pliant.worker.formats.records import Selection
from results import disk_full, make_result

ALWAYS = {"shapes.npz", "preview.bin", "report.json"}


def write(directory: Path, made) -> dict[str, Path]:
    inputs, solution, options = made
    written = write_artifacts(inputs, solution, options, build_report(inputs, solution, options, metrics={}), directory)
    assert {path.name for path in directory.iterdir()} == {artifact.name for artifact in written}
    return {artifact.name: directory / artifact.name for artifact in written}


def description(files: dict[str, Path], name: str) -> dict[str, object]:
    return json.loads(files["report.json"].read_text())["artifacts"][name]


def rows_of(path: Path) -> dict[str, np.ndarray]:
    """Columns of a table; empty cells are NaN."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def members(path: Path) -> list[bytes]:
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        return [archive.read(name) for name in archive.namelist()]


@pytest.mark.parametrize(
    ("outputs", "names"),
    [
        ([], set()),
        ("glb,mat", {"shapes.glb", "shapes.mat"}),
        (["usd", "obj", "usd"], {"shapes.usdc", "shapes_obj.zip"}),
        (("csv", "ply"), {"metrics_frames.csv", "metrics_points.csv", "shapes_ply.zip"}),
    ],
)
def test_only_requested_files_are_written(tmp_path: Path, outputs: object, names: set[str]) -> None:
    assert set(write(tmp_path, make_result(outputs=outputs))) == ALWAYS | names


@pytest.mark.filterwarnings(
    "ignore::RuntimeWarning"
)  # trimesh looks for texture coordinates and warns that there are none
@pytest.mark.parametrize("normals", ["static", "animated"])
@pytest.mark.parametrize("mesh", ["grid", "triangles"])
def test_obj_zip_holds_every_frame(tmp_path: Path, mesh: str, normals: str) -> None:
    made = make_result(mesh=mesh, outputs="obj", normals=normals, axes="tracks")
    inputs, solution, _ = made
    contents = members(write(tmp_path, made)["shapes_obj.zip"])
    assert len(contents) == 7
    triangles = triangles_of(inputs.mesh.faces)
    for content, shape in zip(contents, solution.shapes, strict=True):
        read = trimesh.load(io.BytesIO(content), file_type="obj", process=False, maintain_order=True)
        np.testing.assert_array_equal(read.vertices.astype(np.float32), shape.astype(np.float32))
        assert {tuple(sorted(face)) for face in read.faces.tolist()} == {tuple(sorted(f)) for f in triangles.tolist()}
        given = [line for line in content.decode().splitlines() if line.startswith("vn ")]
        assert len(given) == (len(shape) if normals == "animated" else 0)
        if normals == "animated":
            expected = vertex_normals(shape.astype(np.float32), triangles)
            np.testing.assert_allclose(np.array([line.split()[1:] for line in given], float), expected, atol=2e-6)
    faces = [line.split()[1:] for line in contents[0].decode().splitlines() if line.startswith("f ")]
    assert [[int(corner.split("//")[0]) - 1 for corner in face] for face in faces] == inputs.mesh.faces.tolist()


def test_obj_without_a_mesh_is_points(tmp_path: Path) -> None:
    made = make_result(mesh="none", outputs="obj", normals="animated", axes="tracks")
    content = members(write(tmp_path, made)["shapes_obj.zip"])[3]
    read = trimesh.load(io.BytesIO(content), file_type="obj", process=False, maintain_order=True)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), made[1].shapes[3].astype(np.float32))
    assert content.decode().splitlines()[-1] == "p 30"


@pytest.mark.parametrize("mesh", ["grid", "none"])
@pytest.mark.parametrize("y_axis", ["down", "up"])
def test_usd_has_a_time_sample_for_every_frame(tmp_path: Path, mesh: str, y_axis: str) -> None:
    from pxr import Usd, UsdGeom

    made = make_result(
        mesh=mesh, y_axis=y_axis, outputs="usd", fps=12.5, normals="animated", colours="error", truth=True
    )
    inputs, solution, _ = made
    stage = Usd.Stage.Open(str(write(tmp_path, made)["shapes.usdc"]))
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (12.5, 0, 6)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    shape = stage.GetDefaultPrim()
    assert shape.GetTypeName() == ("Points" if mesh == "none" else "Mesh")
    points = shape.GetAttribute("points")
    assert points.GetTimeSamples() == list(range(7))
    standing = upright(solution.shapes, y_axis)
    np.testing.assert_array_equal(np.stack([points.Get(f) for f in range(7)]), standing.astype(np.float32))
    box = UsdGeom.BBoxCache(3, ["default"]).ComputeWorldBound(shape).ComputeAlignedRange()
    scale = viewer_scale(solution.shapes)
    np.testing.assert_allclose(
        [box.GetMin(), box.GetMax()], [scale * standing[3].min(0), scale * standing[3].max(0)], rtol=1e-5
    )
    colours = UsdGeom.PrimvarsAPI(shape).GetPrimvar("displayColor").Get(6)
    np.testing.assert_allclose(
        colours,
        linear(
            Painting.of("", align(solution.shapes, inputs.ground_truth.shapes, kind="frame_scaled").distances).frame(6)
        ),
        atol=1e-6,
    )
    if mesh == "grid":
        assert set(shape.GetAttribute("faceVertexCounts").Get()) == {4}
        np.testing.assert_array_equal(
            np.reshape(shape.GetAttribute("faceVertexIndices").Get(), (-1, 4)), inputs.mesh.faces
        )
        assert shape.GetAttribute("subdivisionScheme").Get() == "none"
        normals = shape.GetAttribute("normals").Get(4)
        np.testing.assert_allclose(normals, vertex_normals(standing[4], triangles_of(inputs.mesh.faces)), atol=1e-6)


@pytest.mark.parametrize("mesh", ["grid", "triangles", "none"])
def test_usd_passes_its_own_validators(tmp_path: Path, mesh: str) -> None:
    from pxr import Usd, UsdValidation

    files = write(tmp_path, make_result(mesh=mesh, outputs="usd", normals="animated", colours="error"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(files["shapes.usdc"])))
    assert [error.GetMessage() for error in found] == []


@pytest.mark.parametrize("mesh", ["grid", "none"])
def test_mat_holds_the_arrays_of_the_npz(tmp_path: Path, mesh: str) -> None:
    made = make_result(mesh=mesh, outputs="mat")
    if mesh == "none":  # some frames and points of the files
        chosen = Selection(np.arange(0, 14, 2), np.arange(5, 35), (14, 40))
        made = (dataclasses.replace(made[0], selection=chosen), *made[1:])
    files = write(tmp_path, made)
    read = scipy.io.loadmat(files["shapes.mat"])
    with np.load(files["shapes.npz"]) as arrays:
        for name, array in arrays.items():
            counted = ("faces", "source_frames", "source_points")
            expected = array + 1 if name in counted else array
            expected = expected.reshape(-1, 1) if array.ndim == 1 else expected
            np.testing.assert_array_equal(read[name], expected, err_msg=name)
            assert read[name].dtype == array.dtype
        assert {name for name in read if not name.startswith("__")} == set(arrays)
    assert scipy.io.whosmat(files["shapes.mat"])[0] == ("shapes", (7, 30, 3), "double")


def test_csv_tables_agree_with_the_metrics(tmp_path: Path) -> None:
    made = make_result(truth=True, outputs="csv", fps=12.5)
    inputs, solution, _ = made
    files = write(tmp_path, made)
    frames, points = rows_of(files["metrics_frames.csv"]), rows_of(files["metrics_points.csv"])
    metrics = evaluate(solution, inputs.tracks, inputs.ground_truth.shapes)
    for name in ("e3d_sequence", "e3d_frame", "e3d_frame_scaled", "e3d_frame_similarity"):
        assert 0 < frames[name].mean() == pytest.approx(metrics[name], rel=1e-12)
    np.testing.assert_array_equal(frames["seconds"], np.arange(7) / 12.5)
    np.testing.assert_array_equal(points["point"], np.arange(30))
    distances = align(solution.shapes, inputs.ground_truth.shapes, kind="frame_scaled").distances
    np.testing.assert_allclose(frames["distance_mean"], distances.mean(axis=1), rtol=1e-14)
    np.testing.assert_array_equal(points["distance_max"], distances.max(axis=0))
    np.testing.assert_array_equal(frames["reprojection_median"], np.median(solution.residuals, axis=1))
    np.testing.assert_allclose(points["reprojection_rms"], np.sqrt(np.square(solution.residuals).mean(axis=0)))


def test_csv_tables_of_a_selection_name_the_frames_and_points_of_the_input(tmp_path: Path) -> None:
    inputs, solution, options = make_result(outputs="csv")
    whole = write(tmp_path, (inputs, solution, options))
    assert not [name for name in rows_of(whole["metrics_frames.csv"]) if name.startswith("source")]
    chosen = Selection(np.arange(0, 14, 2), np.arange(5, 35), (14, 40))
    files = write(tmp_path, (dataclasses.replace(inputs, selection=chosen), solution, options))
    np.testing.assert_array_equal(rows_of(files["metrics_frames.csv"])["source_frame"], chosen.frames)
    np.testing.assert_array_equal(rows_of(files["metrics_points.csv"])["source_point"], chosen.points)


def test_csv_tables_exclude_hidden_observations(tmp_path: Path) -> None:
    made = make_result(hidden=True, outputs="csv")
    inputs, solution, _ = made
    files = write(tmp_path, made)
    frames, points = rows_of(files["metrics_frames.csv"]), rows_of(files["metrics_points.csv"])
    assert not [name for name in frames if name.startswith(("e3d", "distance"))]
    seen = inputs.tracks.visible
    np.testing.assert_array_equal(frames["visible"], (seen > 0).sum(axis=1))
    assert np.isnan(frames["reprojection_median"][2])
    assert np.isnan(points["weight_mean"][3])
    some = seen[:, 7]
    expected = np.sqrt(np.average(np.square(solution.residuals[:, 7]), weights=some))
    assert points["reprojection_rms"][7] == pytest.approx(expected)
    assert points["reprojection_median"][7] == np.median(solution.residuals[some > 0, 7])


def test_each_ply_frame_has_its_own_normals_and_colours(tmp_path: Path) -> None:
    made = make_result(truth=True, outputs="ply", normals="animated", colours="error", axes="tracks")
    inputs, solution, _ = made
    files = write(tmp_path, made)
    distances = align(solution.shapes, inputs.ground_truth.shapes, kind="frame_scaled").distances
    top = np.quantile(distances, 0.99)
    assert description(files, "shapes_ply.zip")["colours"]["quantity"] == "distance from the truth"
    assert description(files, "shapes_ply.zip")["colours"]["top"] == pytest.approx(top)
    for frame, content in enumerate(members(files["shapes_ply.zip"])):
        vertex = plyfile.PlyData.read(io.BytesIO(content))["vertex"]
        np.testing.assert_array_equal(
            np.column_stack([vertex[a] for a in "xyz"]), solution.shapes[frame].astype(np.float32)
        )
        normals = np.column_stack([vertex[a] for a in ("nx", "ny", "nz")])
        np.testing.assert_allclose(
            normals, vertex_normals(solution.shapes[frame], triangles_of(inputs.mesh.faces)), atol=1e-5
        )
        colours = np.column_stack([vertex[a] for a in ("red", "green", "blue")])
        np.testing.assert_array_equal(colours, np.rint(255 * shade(distances[frame] / top)))
    assert b"colour: distance from the truth, dark at 0" in members(files["shapes_ply.zip"])[0]


@pytest.mark.parametrize(
    ("axes", "y_axis", "turned"), [("viewer", "down", True), ("viewer", "up", False), ("tracks", "down", False)]
)
def test_ply_and_obj_use_the_requested_axes(tmp_path: Path, axes: str, y_axis: str, turned: bool) -> None:
    made = make_result(outputs="ply,obj", axes=axes, y_axis=y_axis)
    files = write(tmp_path, made)
    expected = (made[1].shapes[2] * ([1, -1, -1] if turned else [1, 1, 1])).astype(np.float32)
    vertex = plyfile.PlyData.read(io.BytesIO(members(files["shapes_ply.zip"])[2]))["vertex"]
    np.testing.assert_array_equal(np.column_stack([vertex[axis] for axis in "xyz"]), expected)
    lines = members(files["shapes_obj.zip"])[2].decode().splitlines()
    rows = [line.split()[1:] for line in lines if line.startswith("v ")]
    np.testing.assert_array_equal(np.array(rows, dtype=np.float32), expected)
    up = axes == "viewer" or y_axis == "up"
    assert lines[0].startswith(f"# x right, y {'up' if up else 'down'}, z {'towards' if up else 'away from'}")


def test_obj_vertex_colours_are_read_by_trimesh(tmp_path: Path) -> None:
    made = make_result(outputs="obj", axes="tracks", normals="static", colours="error", hidden=True)
    inputs, solution, _ = made
    files = write(tmp_path, made)
    read = trimesh.load(
        io.BytesIO(members(files["shapes_obj.zip"])[6]), file_type="obj", process=False, maintain_order=True
    )
    seen = inputs.tracks.visible[6] > 0
    top = np.quantile(solution.residuals[inputs.tracks.visible > 0], 0.99)
    expected = np.where(seen[:, None], shade(solution.residuals[6] / top), 0.5)
    np.testing.assert_allclose(read.visual.vertex_colors[:, :3], 255 * expected, atol=1)
    assert description(files, "shapes_obj.zip")["colours"]["quantity"] == "reprojection residual"


def test_expected_error_colours_are_in_percent_and_hidden_points_are_grey(tmp_path: Path) -> None:
    made = make_result(outputs="ply,glb", colours="expected_error", hidden=True, truth=True)
    inputs, solution, _ = made
    files = write(tmp_path, made)
    seen = inputs.tracks.visible > 0
    share = 100 * solution.shapes_std / np.sqrt(np.square(solution.shapes).sum(axis=2).mean())
    top = np.quantile(share[seen], 0.99)
    for name in ("shapes_ply.zip", "shapes.glb"):
        described = description(files, name)["colours"]
        assert (described["quantity"], described["unit"]) == ("expected error", "percent of the object's size")
        assert described["top"] == pytest.approx(top)
    for frame, content in enumerate(members(files["shapes_ply.zip"])):
        vertex = plyfile.PlyData.read(io.BytesIO(content))["vertex"]
        colours = np.column_stack([vertex[a] for a in ("red", "green", "blue")])
        expected = np.where(seen[frame, :, None], shade(share[frame] / top), 0.5)
        np.testing.assert_array_equal(colours, np.rint(255 * expected))
    assert b"(percent of the object's size) and above" in members(files["shapes_ply.zip"])[0]


def test_only_files_with_colours_have_a_legend(tmp_path: Path) -> None:
    files = write(tmp_path, make_result(outputs="ply,mdd", colours="error"))
    assert "colours" in description(files, "shapes_ply.zip")
    assert "colours" not in description(files, "shapes.mdd")
    assert description(files, "shapes_ply.zip")["colours"]["unit"] == "the tracks' unit"


def test_the_legend_of_the_distance_from_the_truth_has_its_unit(tmp_path: Path) -> None:
    files = write(tmp_path, make_result(outputs="ply", colours="error", truth=True))
    assert description(files, "shapes_ply.zip")["colours"]["unit"] == "the ground truth's unit"


def test_mean_colours_use_only_visible_observations() -> None:
    values = np.array([[1.0, 2.0, 9.0], [3.0, 9.0, 9.0]])
    known = np.array([[True, True, False], [True, False, False]])
    painting = Painting.of("x", values, known)
    np.testing.assert_allclose(painting.mean()[:2], shade(np.array([2.0, 2.0]) / painting.top))
    np.testing.assert_allclose(painting.mean()[2], 0.5)
    np.testing.assert_allclose(Painting.of("x", values).mean(), shade(values.mean(axis=0) / 9), atol=0.02)
    assert Painting.of("x", np.zeros((2, 3))).top == 1.0


def test_the_colour_map_rises_in_lightness_and_clamps_at_its_ends() -> None:
    light = linear(shade(np.linspace(0, 1, 50))) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) > 0).all()
    np.testing.assert_array_equal(shade(np.array([0.0, 1.0, 7.0])), STOPS[[0, -1, -1]])
    np.testing.assert_allclose(linear(np.array([0.0, 0.02, 0.5, 1.0])), [0, 0.02 / 12.92, 0.21404, 1], atol=1e-5)


def test_equal_results_give_identical_files_in_every_format(tmp_path: Path) -> None:
    wanted = {"outputs": "glb,ply,obj,usd,mat,csv", "colours": "error", "normals": "animated", "truth": True}
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    first, second = (write(tmp_path / name, make_result(**wanted)) for name in ("a", "b"))
    for name in set(first) - {"report.json"}:
        assert first[name].read_bytes() == second[name].read_bytes(), name


def test_usd_is_rejected_before_computing_without_usd_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "pxr" else find(name, *rest))
    with pytest.raises(InvalidInput, match="usd-core") as refused:
        kinds_for(Options(outputs=("usd",)))
    assert (refused.value.code, refused.value.field) == ("output_unavailable", "options.outputs")
    assert "pip install '.[usd]'" in refused.value.hint
    monkeypatch.setattr(pipeline, "solve", lambda *_, **__: pytest.fail("it was computed all the same"))
    inputs, _, options = make_result(outputs="usd")
    with pytest.raises(InvalidInput, match="usd-core"):
        pipeline.reconstruct(inputs, options, tmp_path)
    assert kinds_for(Options())


def test_mat_files_above_2_gib_are_rejected_before_computing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, _, options = make_result(outputs="mat")
    assert kinds_for(options, size=(99, 900_000))
    with pytest.raises(InvalidInput, match="less than 2 GiB") as refused:
        kinds_for(options, size=(100, 900_000))
    assert refused.value.got == "100 frames of 900000 points"
    monkeypatch.setattr(matlab, "MOST_BYTES", 24 * 7 * 30)
    monkeypatch.setattr(pipeline, "solve", lambda *_, **__: pytest.fail("it was computed all the same"))
    with pytest.raises(InvalidInput, match="Leave mat out"):
        pipeline.reconstruct(inputs, options, tmp_path)


def test_a_failed_usd_write_leaves_no_partial_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usd.shutil, "copyfileobj", disk_full)
    with pytest.raises(OSError, match="No space"):
        write(tmp_path, make_result(outputs="usd"))
    assert {path.name for path in tmp_path.iterdir()} == {"shapes.npz"}
