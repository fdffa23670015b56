"""Tracks as a table of text: one observation a line, columns frame, point, x, y and optionally visible."""

from __future__ import annotations

import io
from typing import IO

import numpy as np
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged, too_large
from pliant.worker.formats.records import Arrays, Limits

COLUMNS = ("frame", "point", "x", "y")
SEEN = ("visible", "visibility")
MAX_LINE = 4096


def looks_like_csv(head: bytes) -> bool:
    """Whether the first line names the columns, or holds at least four numbers."""
    names = _cells(head.split(b"\n", 1)[0].decode("utf-8-sig", "replace"))
    return set(COLUMNS) <= set(names) or _numbers(names[:4]) == 4


def read_csv(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read observations in any order; those that are missing are hidden.

    Frames and points are numbered as in the file, in rising order: the smallest number is the first frame, gaps in
    frames are frames without observations, points are the numbers that occur.

    Returns
    -------
    dict
        `tracks (F, P, 2)` with NaN where there is no observation, and `visibility (F, P)` if the file has it.

    Raises
    ------
    InvalidInput
        Codes damaged_file, duplicate_observation, too_large.
    """
    columns, rows = _columns(stream, field=field, limits=limits)
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    index = {name: column for column, name in enumerate(columns)}
    numbers = table[:, [index["frame"], index["point"]]]
    if (
        len(table) == 0
        or not np.isfinite(numbers).all()
        or (numbers != np.rint(numbers)).any()
        or np.abs(numbers).max() > 2**31
    ):
        raise damaged(field, "frames or points that are not whole numbers")
    frames = (numbers[:, 0] - numbers[:, 0].min()).astype(np.int64)
    names, points = np.unique(numbers[:, 1].astype(np.int64), return_inverse=True)
    count = int(frames.max()) + 1
    if count * len(names) * 16 > limits.max_bytes or count > 100 * len(table):
        raise too_large(
            field,
            expected=f"at most {limits.max_bytes} bytes as a full table",
            got=f"{count} frames × {len(names)} points",
        )
    places = frames * len(names) + points
    if len(np.unique(places)) != len(places):
        raise InvalidInput(
            "duplicate_observation", field=field, expected="each point once in a frame", got="a frame and point twice",
            hint="Keep one line for each frame and point.",
        )  # fmt: skip
    tracks = np.full((count * len(names), 2), np.nan)
    tracks[places] = table[:, [index["x"], index["y"]]]
    found: Arrays = {"tracks": tracks.reshape(count, len(names), 2)}
    seen = next((index[name] for name in SEEN if name in index), None)
    if seen is not None:
        visible = np.zeros(count * len(names))
        visible[places] = table[:, seen]
        found["visibility"] = visible.reshape(count, len(names))
    return found


def _columns(stream: IO[bytes], *, field: str, limits: Limits) -> tuple[list[str], list[list[float]]]:
    lines = io.TextIOWrapper(stream, encoding="utf-8-sig", newline="")
    columns: list[str] | None = None
    rows: list[list[float]] = []
    try:
        while line := lines.readline(MAX_LINE):
            cells = _cells(line)
            if not any(cells):
                continue
            if columns is None:
                named = set(COLUMNS) <= set(cells)
                columns = cells if named else [*COLUMNS, "visible", *map(str, range(len(cells)))][: len(cells)]
                if named:
                    continue
                if len(cells) < len(COLUMNS):
                    raise damaged(field, f"{len(cells)} columns where frame, point, x and y are expected")
            if len(cells) != len(columns):
                raise damaged(field, f"a line of {len(cells)} cells where {len(columns)} are expected")
            rows.append([_number(cell) for cell in cells])
            if len(rows) > limits.max_bytes // 64:
                raise too_large(field, expected=f"at most {limits.max_bytes // 64} observations", got="more")
    except ValueError as error:
        raise damaged(field, f"line {len(rows) + 2} is not numbers") from error
    finally:
        lines.detach()
    return columns or list(COLUMNS), rows


def _number(cell: str) -> float:
    words = {"": np.nan, "true": 1.0, "false": 0.0}
    return float(words[cell]) if cell in words else float(cell)


def _numbers(cells: list[str]) -> int:
    try:
        return len([float(cell) for cell in cells])
    except ValueError:
        return 0


def _cells(line: str) -> list[str]:
    separator = max(",;\t", key=line.count)
    return [cell.strip().strip('"').lower() for cell in line.strip().split(separator)]
