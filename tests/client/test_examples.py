"""Every script in examples/ runs against a real service and does what its first line states."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image
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


def test_every_example_script_is_tested() -> None:
    scripts = {path.name for path in EXAMPLES.glob("*.py")}
    assert scripts == {
        "from_cotracker.py", "from_tapnext.py", "from_alltracker.py", "from_mat.py", "batch.py", "many_at_once.py", "evaluate.py",
    }  # fmt: skip
    assert all(f'run("{script}"' in Path(__file__).read_text() for script in scripts)


@pytest.mark.parametrize("script", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_an_example_without_arguments_prints_its_usage(script: str) -> None:
    ran = subprocess.run([sys.executable, EXAMPLES / script], capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 1
    assert f"python examples/{script} " in ran.stderr
    assert "Traceback" not in ran.stderr


@pytest.mark.slow
def test_from_cotracker(run, tmp_path: Path) -> None:
    points = SEQUENCE.tracks.points[None].astype(np.float32)
    np.savez(tmp_path / "tracks.npz", pred_tracks=points, pred_visibility=np.ones(points.shape[:3], bool))
    printed = run("from_cotracker.py", "tracks.npz", "face.glb")
    assert f"shapes (5, {points.shape[2]}, 3)" in printed
    assert (tmp_path / "face.glb").read_bytes()[:4] == b"glTF"


def in_model(points: np.ndarray) -> np.ndarray:
    """Scale points of a 640 × 480 picture to the 256 × 256 input of TAPNext and TAPIR, measured from its corner."""
    return ((points + 0.5) * (256 / 640, 256 / 480)).astype(np.float32)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param("TAPNext", marks=pytest.mark.slow),
        pytest.param("TAPIR", marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_from_tapnext(run, tmp_path: Path, model: str) -> None:
    points = in_model(SEQUENCE.tracks.points)[None]
    shape = points.shape[:3]
    if model == "TAPNext":
        np.savez(
            tmp_path / "tracks.npz", tracks=points[..., ::-1], visible_logits=np.full((*shape, 1), 4.0, np.float32)
        )
    else:
        turned = points.transpose(0, 2, 1, 3)
        low = np.full(turned.shape[:3], -4.0, np.float32)
        np.savez(tmp_path / "tracks.npz", tracks=turned, occlusion=low, expected_dist=low)
    printed = run("from_tapnext.py", "tracks.npz", "640x480", "face.glb")
    assert f"read as: {model}" in printed
    assert f"shapes ({shape[1]}, {shape[2]}, 3)" in printed
    assert (tmp_path / "face.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.long
@pytest.mark.slow
def test_from_alltracker(run, tmp_path: Path) -> None:
    frames, height, width = 5, 24, 32
    row, column = np.mgrid[:height, :width].astype(np.float32)
    centred = np.stack([column - width / 2, row - height / 2])
    bulge = 6 - (centred**2).sum(axis=0) / 40
    angle = np.radians(np.linspace(-20, 20, frames)).astype(np.float32)[:, None, None]
    maps = np.stack(
        [width / 2 + np.cos(angle) * centred[0] + np.sin(angle) * bulge, np.broadcast_to(row, (frames, height, width))],
        axis=1,
    )
    certain = np.full((frames, 2, height, width), 0.95, np.float32)
    certain[3, 0, 12, 16] = 0.1
    np.savez(tmp_path / "tracks.npz", traj_maps_e=maps[None], visconf_maps_e=certain[None])
    mask = np.zeros((2 * height, 2 * width), np.uint8)
    mask[16:36, 16:44] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    printed = run("from_alltracker.py", "tracks.npz", "mask.png", "face.glb")
    assert "points: 140 one pixel in 1" in printed
    assert f"shapes ({frames}, 140, 3)" in printed
    assert (tmp_path / "face.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.long
@pytest.mark.slow
def test_from_mat(run, tmp_path: Path) -> None:
    frames, points, _ = SEQUENCE.tracks.points.shape
    scipy.io.savemat(
        tmp_path / "face.mat", {"W": SEQUENCE.tracks.points.transpose(0, 2, 1).reshape(2 * frames, points)}
    )
    assert "interleaved" in run("from_mat.py", "face.mat", "out.npz")
    assert np.load(tmp_path / "out.npz")["shapes"].shape == (frames, points, 3)


@pytest.mark.slow
def test_batch_resumes_where_it_stopped(run, tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    np.savez(tmp_path / "clips" / "right.npz", tracks=SEQUENCE.tracks.points)
    np.savez(tmp_path / "clips" / "wrong.npz", tracks=np.ones((2, 9, 2)))
    for _ in range(2):
        printed = run("batch.py", "clips", "out")
        assert "wrong.npz: " in printed
        assert printed.count("files in") == 1
    assert (tmp_path / "out" / "right" / "report.json").read_text()


@pytest.mark.long
@pytest.mark.slow
def test_many_at_once(run, tmp_path: Path) -> None:
    for name in ("a", "b"):
        np.savez(tmp_path / f"{name}.npz", tracks=SEQUENCE.tracks.points)
    printed = run("many_at_once.py", "a.npz", "b.npz")
    assert printed.count("shapes (5, ") == 2
    assert "a.npz: succeeded" in printed


@pytest.mark.slow
def test_evaluate(run, tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=SEQUENCE.tracks.points)
    np.savez(tmp_path / "truth.npz", shapes=SEQUENCE.shapes)
    printed = run("evaluate.py", "tracks.npz", "truth.npz", "error.png")
    assert "e3d_sequence" in printed
    assert (tmp_path / "error.png").read_bytes()[:4] == b"\x89PNG"
