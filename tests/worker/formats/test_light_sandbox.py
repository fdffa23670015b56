"""The sandbox loads only its parser, for speed and for a small attack surface."""

from __future__ import annotations

import subprocess
import sys

import pliant.solver
import pliant.tracking
import pliant.worker.formats
import pytest
from pliant.worker.formats.reading.parsers import PARSERS

LISTED = """
import os, sys
import pliant.worker.formats.reading.sandbox
from pliant.worker.formats.reading.parsers import PARSERS
for name, parser in PARSERS.items():
    if os.fork() == 0:
        try:
            parser.load()
            print(name, *sys.modules, flush=True)
        finally:
            os._exit(0)
    os.wait()
"""
NEEDED = {"matlab5": {"scipy.io"}, "matlab73": {"h5py"}, "ply": {"plyfile"}, "obj": {"plyfile"}, "png": {"PIL"}}
HEAVY = {"scipy.io", "scipy.linalg", "scipy.sparse", "h5py", "PIL", "pydantic", "pliant.solver.reconstruct"}
ALSO = {"matlab5": {"scipy.sparse", "scipy.linalg"}}
"""Modules that the needed ones import."""


@pytest.fixture(scope="module")
def modules() -> dict[str, set[str]]:
    """The modules that a sandbox has loaded, for each parser."""
    ran = subprocess.run([sys.executable, "-I", "-c", LISTED], capture_output=True, text=True, check=True)
    return {name: set(loaded) for name, *loaded in map(str.split, ran.stdout.splitlines())}


@pytest.mark.parametrize("parser", PARSERS)
def test_a_sandbox_loads_only_its_parser(modules: dict[str, set[str]], parser: str) -> None:
    loaded = modules[parser]
    needed = NEEDED.get(parser, set())
    assert needed <= loaded
    assert loaded & HEAVY <= needed | ALSO.get(parser, set())


@pytest.mark.parametrize(
    "code",
    [
        "import pliant.worker.formats.read",
        "import pliant.worker.films.contained_process, pliant.tracking.region; pliant.tracking.open_film",
        "import pliant.service.app",
    ],
    ids=["reader", "film", "service"],
)
def test_reader_film_process_and_service_load_neither_scipy_nor_tracker(code: str) -> None:
    listed = f"import sys; {code}; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-I", "-c", listed], capture_output=True, text=True, check=True)
    assert not {"scipy", "pliant.tracking.track", "pliant.solver.reconstruct"} & set(ran.stdout.split())


def test_the_film_process_does_not_load_pydantic() -> None:
    listed = "import sys, pliant.worker.films.contained_process, pliant.tracking as t; t.open_film; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-I", "-c", listed], capture_output=True, text=True, check=True)
    loaded = set(ran.stdout.split())
    assert "cv2" in loaded
    assert "pydantic" not in loaded


@pytest.mark.parametrize("package", [pliant.solver, pliant.tracking, pliant.worker.formats])
def test_lazily_imported_names_exist(package: object) -> None:
    for name in package.__all__:  # type: ignore[attr-defined]
        assert getattr(package, name).__name__ in (name, "Callable")
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        package.nonsense  # type: ignore[attr-defined]  # noqa: B018
