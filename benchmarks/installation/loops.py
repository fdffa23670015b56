"""Compare the loads on asyncio with h11 and on uvloop with httptools: `python -m benchmarks.installation.loops`.

The first installation cannot import uvloop and httptools, so uvicorn falls back as if they were not installed.
"""

from __future__ import annotations

import argparse
import io
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path

from benchmarks.installation.followers import followers
from benchmarks.installation.instance import Instance
from benchmarks.installation.load import UNLIMITED, jobs, upload

Load = Callable[[Instance], int]


def without_extensions(folder: Path) -> dict[str, str]:
    """Return environment variables with which a process can import neither uvloop nor httptools."""
    folder.mkdir()
    for name in ("uvloop", "httptools"):
        (folder / f"{name}.py").write_text("raise ImportError('left out by the benchmark')\n")
    return {"PYTHONPATH": str(folder)}


def rows_of(instance: Instance, load: Load) -> tuple[list[tuple[str, str]], int]:
    """Run a load; return the rows that it prints and the number of lost requests."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        lost = load(instance)
    cells = [line.strip("| ").split(" | ") for line in printed.getvalue().splitlines() if line.startswith("| ")]
    return [(name, value) for name, *rest in cells for value in (rest[0] if rest else "",)], lost


def main() -> int:
    """Print one table; return the exit code: 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--followers", type=int, nargs="*", default=[500, 1000])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--megabytes", type=int, default=300)
    given = parser.parse_args()
    loads: list[Load] = [partial(jobs, number=given.jobs, clients=given.clients)]
    loads += [partial(followers, number=number, seconds=given.seconds) for number in given.followers]
    loads += [partial(upload, size=given.megabytes)] if given.megabytes else []
    wrong = 0
    print("| | asyncio, h11 | uvloop, httptools |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        plain = UNLIMITED | without_extensions(folder / "none")
        with Instance(folder / "a", of_service=plain) as before, Instance(folder / "b", of_service=UNLIMITED) as after:
            for load in loads:
                (first, lost_before), (second, lost_after) = rows_of(before, load), rows_of(after, load)
                wrong += lost_before + lost_after
                for (name, value), (_, other) in zip(first, second, strict=True):
                    name = re.sub(r" \(\d+\)", "", name)  # the number of status reads differs
                    print(f"| {name} | {value} | {other} |" if value else f"| **{name}** | | |", flush=True)
            misfits = before.misfits() + after.misfits()
    print("fsck: " + (" ".join(misfits) or "the stores are consistent with the job records"))
    return 1 if wrong or misfits else 0


if __name__ == "__main__":
    sys.exit(main())
