"""Every script in examples/ runs, against a real service, and does what its first line says."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from pliant.solver.gallery import face

EXAMPLES = Path(__file__).parents[2] / "examples"
SEQUENCE = face(5, 20)


@pytest.fixture
def run(service_url: str, tmp_path: Path):
    def run(script: str, *arguments: object) -> str:
        command = [sys.executable, str(EXAMPLES / script), *map(str, arguments)]
        env = {**os.environ, "PLIANT_URL": service_url, "MPLCONFIGDIR": str(tmp_path)}
        ran = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env, timeout=120, check=False)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    return run


def test_there_are_five_and_each_is_run_here() -> None:
    scripts = {path.name for path in EXAMPLES.glob("*.py")}
    assert scripts == {"from_cotracker.py", "from_mat.py", "batch.py", "many_at_once.py", "evaluate.py"}
    assert all(f'run("{script}"' in Path(__file__).read_text() for script in scripts)


def test_from_cotracker(run, tmp_path: Path) -> None:
    points = SEQUENCE.tracks.points[None].astype(np.float32)
    np.savez(tmp_path / "tracks.npz", pred_tracks=points, pred_visibility=np.ones(points.shape[:3], bool))
    said = run("from_cotracker.py", "tracks.npz", "face.glb")
    assert f"shapes (5, {points.shape[2]}, 3)" in said
    assert (tmp_path / "face.glb").read_bytes()[:4] == b"glTF"


def test_from_mat(run, tmp_path: Path) -> None:
    frames, points, _ = SEQUENCE.tracks.points.shape
    scipy.io.savemat(
        tmp_path / "face.mat", {"W": SEQUENCE.tracks.points.transpose(0, 2, 1).reshape(2 * frames, points)}
    )
    assert "interleaved" in run("from_mat.py", "face.mat", "out.npz")
    assert np.load(tmp_path / "out.npz")["shapes"].shape == (frames, points, 3)


def test_batch_goes_on_where_it_stopped(run, tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    for name in ("a", "b"):
        np.savez(tmp_path / "clips" / f"{name}.npz", tracks=SEQUENCE.tracks.points)
    np.savez(tmp_path / "clips" / "wrong.npz", tracks=np.ones((2, 9, 2)))
    for _ in range(2):
        said = run("batch.py", "clips", "out")
        assert "wrong.npz: " in said
        assert said.count("files in") == 2
    held = [(tmp_path / "out" / name / "report.json").read_text() for name in ("a", "b")]
    assert all(held)


def test_many_at_once(run, tmp_path: Path) -> None:
    for name in ("a", "b"):
        np.savez(tmp_path / f"{name}.npz", tracks=SEQUENCE.tracks.points)
    said = run("many_at_once.py", "a.npz", "b.npz")
    assert said.count("shapes (5, ") == 2
    assert "a.npz: succeeded" in said


def test_evaluate(run, tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=SEQUENCE.tracks.points)
    np.savez(tmp_path / "truth.npz", shapes=SEQUENCE.shapes)
    said = run("evaluate.py", "tracks.npz", "truth.npz", "error.png")
    assert "e3d_sequence" in said
    assert (tmp_path / "error.png").read_bytes()[:4] == b"\x89PNG"
