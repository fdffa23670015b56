"""The job's name in the result files, read back by the formats' own readers."""

from __future__ import annotations

import csv
import io
import json
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import alembic3d
import numpy as np
import plyfile
import pytest
import scipy.io
import trimesh
from khronos import assert_valid
from pliant.schemas.options import Options
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.artifacts.names import MAX_OBJECT_NAME
from pliant.worker.execution import pipeline
from pliant.worker.execution.further_outputs import read_solution
from pxr import Usd
from results import make_result

LONG = "a b " * 50
NAMES = {
    # name: as written in glTF, in USD and Alembic, in the PLY header, in OBJ
    "": ("shape", "shape", "shape", "shape"),
    "face": ("face", "face", "face", "face"),
    "my face/left": ("my face/left", "my_face_left", "my face/left", "my_face_left"),
    "3 takes": ("3 takes", "_3_takes", "3 takes", "3_takes"),
    "Gesicht Büro": ("Gesicht Büro", "Gesicht_Buro", "Gesicht Buro", "Gesicht_Büro"),
    "顔": ("顔", "shape", "shape", "顔"),
    "🙂": ("🙂", "shape", "shape", "shape"),
    "/\\:*?\"<>|": ("/\\:*?\"<>|", "shape", "/\\:*?\"<>|", "shape"),
    " two\nlines\t\x00 ": ("two lines", "two_lines", "two lines", "two_lines"),
    "end_header": ("end_header", "end_header", "end header", "end_header"),
    "a\udcffb": ("a?b", "a_b", "a?b", "a_b"),
    LONG: (LONG.strip(), LONG.strip().replace(" ", "_"), LONG.strip(), LONG.strip().replace(" ", "_")),
}  # fmt: skip


def write(folder: Path, name: str, **made: object) -> Path:
    inputs, solution, options = make_result(frames=3, outputs="glb,ply,obj,usd,abc", **made)  # type: ignore[arg-type]
    report = build_report(inputs, solution, options, metrics={}, name=name)
    write_artifacts(inputs, solution, options, report, folder, name=name)
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_every_file_contains_the_name_of_the_job(tmp_path: Path, name: str) -> None:
    folder = write(tmp_path, name)
    gltf, usd, ply, obj = NAMES[name]

    assert_valid(folder / "shapes.glb")
    scene = trimesh.load(folder / "shapes.glb", process=False)
    assert list(scene.geometry) == [gltf]
    assert gltf in scene.graph.nodes_geometry

    stage = Usd.Stage.Open(str(folder / "shapes.usdc"))
    assert str(stage.GetDefaultPrim().GetPath()) == f"/{usd}"
    assert stage.GetDefaultPrim().GetDisplayName() in (gltf, "" if gltf == usd else gltf)
    archive = alembic3d.Abc.IArchive(str(folder / "shapes.abc"))
    assert archive.getTop().getChildHeader(0).getName() == usd
    assert alembic3d.AbcGeom.IPolyMesh(alembic3d.AbcGeom.IXform(archive.getTop(), usd), "mesh").valid()

    with zipfile.ZipFile(folder / "shapes_ply.zip") as frames:
        content = frames.read("frame_00001.ply")
    assert f"name: {ply}" in plyfile.PlyData.read(io.BytesIO(content)).comments
    assert len(trimesh.load(io.BytesIO(content), file_type="ply", process=False).vertices) == 30
    with zipfile.ZipFile(folder / "shapes_obj.zip") as frames:
        text = frames.read("frame_00001.obj").decode()
    assert [line for line in text.splitlines() if line.startswith("o ")] == [f"o {obj}"]
    mesh = trimesh.load(io.BytesIO(text.encode()), file_type="obj", process=False, split_object=True)
    assert list(getattr(mesh, "geometry", {obj: None})) == [obj]


def test_the_camera_of_the_film_has_another_name_than_the_object(tmp_path: Path) -> None:
    for name, camera in (("face", "camera"), ("camera", "film camera")):
        file = (write(tmp_path, name) / "shapes.glb").read_bytes()
        document = json.loads(file[20 : 20 + struct.unpack("<I", file[12:16])[0]])
        assert [node["name"] for node in document["nodes"]] == [name, camera]


def test_point_names_are_in_the_arrays_the_table_and_the_preview(tmp_path: Path) -> None:
    inputs, solution, options = make_result(outputs="mat,csv", truth=True)
    names = tuple(f"Teil {number} ü" for number in range(30))
    inputs = replace(inputs, point_names=names)
    write_artifacts(inputs, solution, options, {}, tmp_path)
    with np.load(tmp_path / "shapes.npz", allow_pickle=False) as held:
        assert tuple(held["point_names"].tolist()) == names
    cells = scipy.io.loadmat(tmp_path / "shapes.mat")["point_names"]
    assert cells.shape == (30, 1)
    assert tuple(cell[0] for cell in cells[:, 0]) == names
    with (tmp_path / "metrics_points.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:2] == ["point", "name"]
    assert tuple(row["name"] for row in rows) == names
    content = (tmp_path / "preview.bin").read_bytes()
    place = json.loads(content[16 : 16 + struct.unpack("<I", content[12:16])[0]])["sections"]["names"]
    assert tuple(content[place["offset"] :][: place["bytes"]].decode().split("\n")) == names
    assert read_solution(tmp_path / "shapes.npz", y_up=False).shapes.shape == solution.shapes.shape

    write_artifacts(replace(inputs, point_names=None), solution, options, {}, tmp_path)
    with np.load(tmp_path / "shapes.npz") as held:
        assert "point_names" not in held
    assert "point_names" not in scipy.io.loadmat(tmp_path / "shapes.mat")
    assert "name" not in (tmp_path / "metrics_points.csv").read_text().splitlines()[0].split(",")


def test_usd_materials_are_nested_under_the_job_name(tmp_path: Path) -> None:
    write(tmp_path, "left half", texture=True)
    stage = Usd.Stage.Open(str(tmp_path / "shapes.usdz"))
    assert {str(prim.GetPath()) for prim in stage.Traverse()} >= {"/left_half", "/left_half/film/surface"}


def test_a_long_name_is_whole_in_the_report_and_truncated_in_the_glb(tmp_path: Path) -> None:
    write(tmp_path, "x" * 300)
    assert json.loads((tmp_path / "report.json").read_text())["name"] == "x" * 300
    assert list(trimesh.load(tmp_path / "shapes.glb", process=False).geometry) == ["x" * MAX_OBJECT_NAME]


def test_reconstruct_writes_the_given_name_to_the_files(tmp_path: Path) -> None:
    inputs, solution, _ = make_result()
    pipeline.reconstruct(inputs, Options(), tmp_path, name="take 1", solver=lambda *_, **__: solution)
    assert list(trimesh.load(tmp_path / "shapes.glb", process=False).geometry) == ["take 1"]
    assert json.loads((tmp_path / "report.json").read_text())["name"] == "take 1"
