"""What a stranger installs: source archive → wheel → a working `pliant`, with every folder under its import name."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]


def run(*command: str, cwd: Path) -> str:
    ran = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the source archive and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT), cwd=folder)
    (source,) = folder.glob("*.tar.gz")
    (wheel,) = folder.glob("*.whl")
    return source, wheel


def test_the_wheel_holds_every_package_under_pliant_and_nothing_else(archives: tuple[Path, Path]) -> None:
    names = zipfile.ZipFile(archives[1]).namelist()
    packages = {".".join(name.split("/")[:-1]) for name in names if name.endswith(".py")}
    assert packages == set(DECLARED)
    top = {name.split("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"pliant"}
    assert "pliant/solver/py.typed" in names


def test_the_source_archive_holds_no_leftovers(archives: tuple[Path, Path]) -> None:
    with tarfile.open(archives[0]) as archive:
        names = archive.getnames()
    assert not [name for name in names if "node_modules" in name or "__pycache__" in name or ".venv" in name]
    assert [name for name in names if name.endswith("/LICENSE")]


def test_the_installed_wheel_gives_a_working_command(archives: tuple[Path, Path], tmp_path: Path) -> None:
    """Installed into a folder of its own, beside the dependencies that this environment has."""
    target = tmp_path / "installed"
    run(
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        str(target),
        str(archives[1]),
        cwd=tmp_path,
    )
    program = (
        f"import sys; sys.path.insert(0, {str(target)!r}); import pliant.cli, pliant.solver as s, pliant.service;"
        f"assert s.__file__.startswith({str(target)!r}), s.__file__; sys.argv = ['pliant', '--version']; pliant.cli.main()"
    )
    # -S and the dependencies by hand keep the editable installation's import hook out.
    sites = [path for path in sys.path if path.endswith("site-packages")]
    said = run(sys.executable, "-S", "-c", f"import sys; sys.path += {sites!r}; {program}", cwd=tmp_path)
    assert said.startswith("pliant ")
