"""Alembic files, read back by Alembic's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.solver.errors import InvalidInput
from pliant.worker.artifacts import build_report, kinds_for, write_artifacts
from pliant.worker.artifacts.geometry import upright, viewer_scale
from results import make_result

alembic3d = pytest.importorskip("alembic3d", reason="no wheel for this Python")

FPS = 12.5


def write(folder: Path, made: tuple[Any, Any, Any]) -> Path:
    folder.mkdir(exist_ok=True)
    inputs, solution, options = made
    report = build_report(inputs, solution, options, metrics={}, seconds={})
    write_artifacts(inputs, solution, options, report, folder)
    return folder / "shapes.abc"


def child(path: Path, kind: str) -> Any:
    """The object below `/shape`, its scale, and the archive that holds it open."""
    archive = alembic3d.Abc.IArchive(str(path))
    shape = alembic3d.AbcGeom.IXform(archive.getTop(), "shape")
    scale = shape.getSchema().getValue().getScale()
    reader = {"mesh": alembic3d.AbcGeom.IPolyMesh, "points": alembic3d.AbcGeom.IPoints}[kind]
    return reader(shape, kind).getSchema(), np.array([scale.x, scale.y, scale.z]), archive


def floats(array: Any, width: int) -> np.ndarray:
    return np.array([[each[axis] for axis in range(width)] for each in array])


@pytest.mark.parametrize("y_axis", ["down", "up"])
@pytest.mark.parametrize("mesh", ["grid", "triangles"])
def test_every_frame_has_its_points(tmp_path: Path, mesh: str, y_axis: str) -> None:
    made = make_result(mesh=mesh, y_axis=y_axis, outputs="abc", fps=FPS)
    schema, scale, _archive = child(write(tmp_path, made), "mesh")
    assert schema.getNumSamples() == 7
    sampling = schema.getTimeSampling()
    np.testing.assert_allclose([sampling.getSampleTime(frame) for frame in range(7)], np.arange(7) / FPS)
    np.testing.assert_allclose(scale, viewer_scale(made[1].shapes))
    expected = upright(made[1].shapes, y_axis)
    for frame in range(7):
        sample = schema.getValue(alembic3d.Abc.ISampleSelector(sampling.getSampleTime(frame)))
        np.testing.assert_array_equal(floats(sample.getPositions(), 3), expected[frame].astype(np.float32))
    faces = made[0].mesh.faces
    sample = schema.getValue(alembic3d.Abc.ISampleSelector(6 / FPS))
    assert list(sample.getFaceCounts()) == [faces.shape[1]] * len(faces)
    np.testing.assert_array_equal(np.reshape(list(sample.getFaceIndices()), faces.shape)[:, ::-1], faces)


def test_texture_coordinates_start_at_the_bottom_left(tmp_path: Path) -> None:
    made = make_result(texture=True, outputs="abc")
    schema, _, _archive = child(write(tmp_path, made), "mesh")
    found = schema.getUVsParam().getExpandedValue().getVals()
    corners = made[0].mesh.faces[:, ::-1].reshape(-1)
    expected = made[0].texture.uv[corners] * (1, -1) + (0, 1)
    np.testing.assert_allclose(floats(found, 2), expected, atol=1e-6)


def test_points_without_a_mesh_stay_points(tmp_path: Path) -> None:
    made = make_result(mesh="none", outputs="abc")
    schema, _, _archive = child(write(tmp_path, made), "points")
    assert schema.getNumSamples() == 7
    sample = schema.getValue(alembic3d.Abc.ISampleSelector(3 / made[2].fps))
    np.testing.assert_array_equal(
        floats(sample.getPositions(), 3), upright(made[1].shapes, "down")[3].astype(np.float32)
    )
    assert list(sample.getIds()) == list(range(30))


def test_equal_results_give_identical_files(tmp_path: Path) -> None:
    first, second = (write(tmp_path / name, make_result(texture=True, outputs="abc")) for name in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()
    assert sorted(path.name for path in first.parent.iterdir()) == [
        "preview.bin",
        "report.json",
        "shapes.abc",
        "shapes.npz",
    ]


def test_alembic_output_is_refused_without_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.worker.artifacts.scenes.alembic.available", lambda: False)
    with pytest.raises(InvalidInput, match=r"\.\[alembic\]") as refused:
        kinds_for(Options(outputs=("abc",)))
    assert (refused.value.code, refused.value.field) == ("output_unavailable", "options.outputs")
