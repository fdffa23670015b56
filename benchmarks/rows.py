"""Results files: one JSON object per line, with the machine and the commit of the measurement."""

from __future__ import annotations

import argparse
import json
import os
import platform
from pathlib import Path
from typing import Any

from benchmarks.commit import commit


def parser_of(doc: str | None, *, out: Path, points: int | None = None) -> argparse.ArgumentParser:
    """Return a parser with the options common to all line-by-line measurements."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="directory of recorded sequences")
    parser.add_argument("--only", action="append", default=[], help="names that hold this word")
    parser.add_argument("--points", type=int, default=points, help="keep at most this many points")
    parser.add_argument("--out", type=Path, default=out, help="file to which results are appended")
    return parser


def words(text: str) -> list[str]:
    """Return the words of an option's value, separated by commas."""
    return [word for word in text.split(",") if word]


def machine() -> str:
    """Return architecture and number of cores."""
    return f"{platform.machine()}, {os.cpu_count()} cores"


def rows(path: Path) -> list[dict[str, Any]]:
    """Return the measurements of a file, without truncated lines; an empty list if there is no file."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Append a measurement on a new line, even after a truncated one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as file:
        file.seek(0)
        text = file.read()
        whole = {**row, "machine": machine(), "commit": commit()}
        file.write(("" if not text or text.endswith("\n") else "\n") + json.dumps(whole, ensure_ascii=False) + "\n")
