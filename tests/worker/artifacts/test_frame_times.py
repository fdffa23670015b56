"""Animations follow the uneven times of a film, unless the job sets a rate of its own."""

from __future__ import annotations

import csv
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pliant.worker.artifacts import build_report, write_artifacts
from results import make_result

TIMES = np.array([0.0, 1.0, 2.0, 3.0, 7.0, 8.0, 9.0]) / 12 + 5.25
RATE = 6 / (TIMES[-1] - TIMES[0])


def write(folder: Path, *, times: np.ndarray | None, fps: float, outputs: str) -> Path:
    if outputs == "abc":
        pytest.importorskip("alembic3d", reason="no wheel for this Python")
    # The preview is written whatever the outputs.
    inputs, solution, options = make_result(outputs="csv" if outputs == "preview" else outputs, fps=fps)
    inputs = replace(inputs, frame_times=times)
    report = build_report(inputs, solution, options, metrics={}, seconds={})
    folder.mkdir(exist_ok=True)
    write_artifacts(inputs, solution, options, report, folder)
    return folder


def seconds_of(folder: Path, kind: str) -> np.ndarray:
    """The time of every frame in seconds, as an independent reader finds it."""
    return np.asarray(READERS[kind](folder))


def _glb(folder: Path) -> Any:
    content = (folder / "shapes.glb").read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + length])
    found = []
    for sampler in document["animations"][0]["samplers"]:
        accessor = document["accessors"][sampler["input"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"] + 28 + length
        found.append(np.frombuffer(content, "<f4", accessor["count"], start))
    assert len(found) == 3  # shape, and rotation and position of the camera
    assert all(np.array_equal(times, found[0]) for times in found)
    return found[0]


def _usd(folder: Path) -> Any:
    from pxr import Usd

    stage = Usd.Stage.Open(str(folder / "shapes.usdc"))
    codes = stage.GetDefaultPrim().GetAttribute("points").GetTimeSamples()
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (codes[0], codes[-1])
    assert codes == stage.GetDefaultPrim().GetAttribute("normals").GetTimeSamples()
    return np.array(codes) / stage.GetTimeCodesPerSecond()


def _abc(folder: Path) -> Any:
    import alembic3d

    archive = alembic3d.Abc.IArchive(str(folder / "shapes.abc"))
    schema = alembic3d.AbcGeom.IPolyMesh(alembic3d.AbcGeom.IXform(archive.getTop(), "shape"), "mesh").getSchema()
    sampling = schema.getTimeSampling()
    return [sampling.getSampleTime(frame) for frame in range(schema.getNumSamples())]


def _mdd(folder: Path) -> Any:
    content = (folder / "shapes.mdd").read_bytes()
    return struct.unpack_from(f">{struct.unpack_from('>i', content)[0]}f", content, 8)


def _csv(folder: Path) -> Any:
    with (folder / "metrics_frames.csv").open() as file:
        return [float(row["seconds"]) for row in csv.DictReader(file)]


def _preview(folder: Path) -> Any:
    content = (folder / "preview.bin").read_bytes()
    header = json.loads(content[16 : 16 + struct.unpack_from("<I", content, 12)[0]])
    if "times" not in header["sections"]:  # then the page plays at the rate
        return np.arange(header["num_frames"]) / header["fps"]
    return np.frombuffer(content, "<f4", header["num_frames"], header["sections"]["times"]["offset"])


READERS = {"glb": _glb, "usd": _usd, "abc": _abc, "mdd": _mdd, "csv": _csv, "preview": _preview}


@pytest.mark.parametrize("kind", READERS)
def test_uneven_times_of_a_film_are_those_of_the_animation(tmp_path: Path, kind: str) -> None:
    folder = write(tmp_path, times=TIMES, fps=RATE, outputs=kind)
    np.testing.assert_allclose(seconds_of(folder, kind), TIMES - TIMES[0], atol=1e-6)


@pytest.mark.parametrize("kind", READERS)
def test_another_rate_than_the_films_is_constant(tmp_path: Path, kind: str) -> None:
    folder = write(tmp_path, times=TIMES, fps=30, outputs=kind)
    np.testing.assert_allclose(seconds_of(folder, kind), np.arange(7) / 30, atol=1e-6)


@pytest.mark.parametrize("kind", READERS)
def test_times_within_half_a_frame_of_a_constant_rate_leave_the_files_unchanged(tmp_path: Path, kind: str) -> None:
    nearly = np.round(np.arange(7) / 30, 3)  # rounded to milliseconds, as in Matroska files
    rate = 6 / (nearly[-1] - nearly[0])
    first = write(tmp_path / "a", times=nearly, fps=rate, outputs=kind)
    second = write(tmp_path / "b", times=None, fps=rate, outputs=kind)
    for path in set(first.iterdir()) - {first / "report.json"}:
        assert path.read_bytes() == (second / path.name).read_bytes(), path.name
