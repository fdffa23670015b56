"""Generate the synchronous client (client/_sync) from the asynchronous one (client/_async): `make client`.

`unasync` rewrites the names and removes `async` and `await`; ruff sorts the imports and formats. The result is committed, and
tests/client/test_generated.py compares it with a new run. Needs the extras `test` and `check`.
"""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent
SOURCE = ROOT / "client" / "_async"
TARGET = ROOT / "client" / "_sync"
HEADER = "# Generated from client/_async/{} by `make client`. Edit that file instead.\n"

NAMES = {
    "AsyncClient": "Client",
    "AsyncConnection": "Connection",
    "AsyncRemoteJob": "RemoteJob",
    "AsyncResult": "Result",
    "AsyncBaseTransport": "BaseTransport",
    "AsyncGenerator": "Generator",
    "_async": "_sync",
    "aclosing": "closing",
    "aclose": "close",
    "aiter_bytes": "iter_bytes",
    "async_sleep": "sleep",
    "in_thread": "in_place",
}
"""Replacements of names in the asynchronous source, in addition to unasync's own."""

PATTERNS = (
    (r"\bAsync(Client|Connection|RemoteJob|Result|BaseTransport)\b", r"\1"),
    (r"\bawait \((await [^()]+\([^()]*\))\)", r"\1"),
    (r"\bawait ", ""),
    (r"\bGenerator\[(\w+), None\]", r"Generator[\1, None, None]"),
)
"""Replacements in docstrings, which unasync does not change, and the third type parameter of `Generator`."""


def generate(folder: Path) -> None:
    """Write the synchronous modules into a folder.

    Raises
    ------
    subprocess.CalledProcessError
        ruff cannot format a module.
    """
    import unasync

    rule = unasync.Rule(fromdir=f"{SOURCE}/", todir=f"{folder}/", additional_replacements=NAMES)
    unasync.unasync_files([str(path) for path in sorted(SOURCE.glob("*.py"))], [rule])
    for path in sorted(folder.glob("*.py")):
        text = path.read_text()
        for pattern, replacement in PATTERNS:
            text = re.sub(pattern, replacement, text)
        path.write_text(HEADER.format(path.name) + text)
    ruff = Path(sys.executable).parent / "ruff"
    command = [str(ruff if ruff.exists() else Path(sysconfig.get_path("scripts")) / "ruff")]
    config = ["--quiet", "--config", str(ROOT / "pyproject.toml"), "--no-cache"]
    subprocess.run([*command, "check", "--fix", "--select", "I", *config, str(folder)], check=True)
    subprocess.run([*command, "format", *config, str(folder)], check=True)


if __name__ == "__main__":
    for path in TARGET.glob("*.py"):
        path.unlink()
    with tempfile.TemporaryDirectory() as scratch:
        generated = Path(scratch) / "client" / "_sync"
        generated.mkdir(parents=True)
        generate(generated)
        TARGET.mkdir(exist_ok=True)
        for path in sorted(generated.glob("*.py")):
            (TARGET / path.name).write_text(path.read_text())
