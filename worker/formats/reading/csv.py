"""Tracks as a text table: one observation per line, with columns frame, point, x, y and optionally visible; or one row per frame."""

from __future__ import annotations

import codecs
import io
from collections.abc import Iterator
from typing import IO

import numpy as np
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged, too_large
from pliant.worker.formats.point_names import ARRAY, pack
from pliant.worker.formats.reading.pose_tables import (
    CONFIDENCE,
    LONGEST_ROW,
    SEPARATORS,
    cells,
    check_full_table,
    columns_of,
    deeplabcut_columns,
    not_a_table,
    number,
    read_rows,
    separator_of,
    split,
)
from pliant.worker.formats.records import Arrays, Limits

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""Byte order marks of UTF-16."""
codecs.lookup("utf-16")  # imports the decoder now: a contained process cannot open its module later

COLUMNS = ("frame", "point", "x", "y")
POINT_NAMES = ("point", "track_id", "id")
"""Names of the column with the number of the point; the first that a table has counts."""
MAX_NUMBER = 2**53
"""Largest number of a frame or point: larger ones are not exact as float64."""
WIDE = 8
"""Number of columns from which a table without names is rejected: its rows may be frames, and its columns could mean anything."""


def looks_like_csv(head: bytes) -> bool:
    """Return whether the first line has at least three cells, so that an error can show what is wrong with the table."""
    line = head.decode(_encoding(head), "replace").split("\n", 1)[0]
    return len(split(line, separator_of(line))) >= 3


def read_csv(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read one observation per line, in any order, or one row per frame, see `pose_tables`.

    The smallest frame number is the first frame; gaps are frames without observations. Points are the numbers that occur, in ascending
    order, which are their names unless they count from 0 without gaps. Missing observations are hidden. Returns `tracks (F, P, 2)` with NaN
    where there is no observation, and `visibility (F, P)` if the file has it; tables of known writers under their own names.

    Raises
    ------
    InvalidInput
        Codes damaged_file, duplicate_observation, too_large, unreadable_table.
    """
    start = stream.read(len(codecs.BOM_UTF16_LE))
    stream.seek(0)
    text = io.TextIOWrapper(stream, encoding=_encoding(start), errors="replace", newline="")
    try:
        found = _read(iter(lambda: text.readline(LONGEST_ROW), ""), field=field, limits=limits)
    finally:
        text.detach()
    return found if isinstance(found, dict) else _observations(*found, field=field, limits=limits)


def _encoding(start: bytes) -> str:
    """Return the encoding of a text by its first bytes: spreadsheet programs write "Unicode text" as UTF-16."""
    return "utf-16" if start.startswith(UTF_16) else "utf-8-sig"


def _read(lines: Iterator[str], *, field: str, limits: Limits) -> Arrays | tuple[list[str], list[list[float]]]:
    """Read the lines: arrays if a row is a frame, otherwise the names of the columns and the numbers below them."""
    first, before = next(lines, ""), 1
    while first and not first.strip(SEPARATORS + " \r\n"):
        first, before = next(lines, ""), before + 1
    first = first.removeprefix("#")  # which numpy.savetxt writes before its header
    wide = _wide(first, lines, field=field, limits=limits, before=before)
    return _columns(first, lines, field=field, limits=limits, before=before) if wide is None else wide


def _observations(columns: list[str], rows: list[list[float]], *, field: str, limits: Limits) -> Arrays:
    """Arrange observations as arrays."""
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    index = {name: column for column, name in enumerate(columns)}
    twice = next((name for name in (*COLUMNS, *CONFIDENCE) if columns.count(name) > 1), None)
    if twice is not None:
        raise InvalidInput(
            "unreadable_table", field=field, expected="each column once", got=f"two columns {twice}", hint="Rename or remove one of them."
        )  # fmt: skip
    if len(table) == 0:
        raise damaged(field, "no observations below the names of the columns")
    numbers = table[:, [index["frame"], index["point"]]]
    wrong = numbers[~((numbers == np.rint(numbers)) & (np.abs(numbers) <= MAX_NUMBER))]
    if len(wrong):
        raise InvalidInput(
            "damaged_file", field=field, expected="whole numbers in the columns frame and point", got=f"{wrong[0]:g}",
            hint="Number frames and points, as in 0, 1, 2.",
        )  # fmt: skip
    frames = (numbers[:, 0] - numbers[:, 0].min()).astype(np.int64)
    names, points = np.unique(numbers[:, 1].astype(np.int64), return_inverse=True)
    count = int(frames.max()) + 1
    check_full_table(field, (count, len(names)), size=count * len(names) * 16, rows=len(table), limits=limits)
    places = frames * len(names) + points
    ordered = np.sort(places)  # for 3 million observations 70 times as fast as `np.unique`, which hashes them
    again = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(again) > 0:
        frame, point = divmod(int(ordered[again[0]]), len(names))
        raise InvalidInput(
            "duplicate_observation", field=field, expected="each point once in a frame",
            got=f"frame {frame + int(numbers[:, 0].min())} with point {names[point]} twice",
            hint="Keep one line for each frame and point.",
        )  # fmt: skip
    tracks = np.full((count * len(names), 2), np.nan)
    tracks[places] = table[:, [index["x"], index["y"]]]
    found: Arrays = {"tracks": tracks.reshape(count, len(names), 2)}
    if names[-1] != len(names) - 1 or names[0] != 0:
        found[ARRAY] = pack([str(name) for name in names.tolist()])
    given = [name for name in CONFIDENCE if name in index]
    # Of two, the second multiplies the first.
    for array, name in zip(("visibility", "confidence"), given, strict=False):
        values = np.zeros(count * len(names))
        values[places] = table[:, index[name]]
        found[array] = values.reshape(count, len(names))
    return found


def _wide(first: str, lines: Iterator[str], *, field: str, limits: Limits, before: int) -> Arrays | None:
    """Read a table with one row per frame; return None for a table with one observation per line."""
    separator = separator_of(first)
    heads = [cells(first, separator)]
    if heads[0][0].lower() == "scorer":
        while heads[-1][0].lower() != "coords" and len(heads) < 4:
            heads.append(cells(next(lines, ""), separator))
        columns = deeplabcut_columns(heads)
        if columns is None:
            raise not_a_table(field, before, first)
    else:
        columns = None if set(COLUMNS) <= set(_headings(first, separator)) else columns_of(heads[0])
    if columns is None:
        return None
    return read_rows(
        lines, columns, separator, field=field, limits=limits, before=before + len(heads) - 1, width=len(heads[0])
    )


def _columns(
    first: str, lines: Iterator[str], *, field: str, limits: Limits, before: int
) -> tuple[list[str], list[list[float]]]:
    """Return the names of the columns and the numbers below them; a table without names has the default columns.

    `first` is line number `before` of the file.
    """
    separator = separator_of(first)
    heads = _headings(first, separator)
    named = set(COLUMNS) <= set(heads)
    columns = heads if named else [*COLUMNS, "visible", *map(str, range(len(heads)))][: len(heads)]
    if len(heads) < len(COLUMNS) or (not named and len(heads) >= WIDE):
        raise not_a_table(field, before, first)
    rows: list[list[float]] = []
    if not named:
        rows.append(_row(first, separator, len(columns), field=field, count=before))
    for count, line in enumerate(lines, before + 1):
        if not any(split(line, separator)):
            continue
        rows.append(_row(line, separator, len(columns), field=field, count=count))
        if len(rows) > limits.max_bytes // 64:
            raise too_large(field, expected=f"at most {limits.max_bytes // 64:,} observations", got="more")
    return columns, rows


def _headings(line: str, separator: str) -> list[str]:
    """Return the names of a table's columns in lower case, that of the point's number as `point`."""
    heads = split(line, separator)
    of_point = next((name for name in POINT_NAMES if name in heads), None)
    return ["point" if head == of_point else head for head in heads]


def _row(line: str, separator: str, width: int, *, field: str, count: int) -> list[float]:
    row = split(line, separator)
    if len(row) != width:
        raise not_a_table(field, count, line)
    try:
        return [number(cell, separator) for cell in row]
    except ValueError:
        raise not_a_table(field, count, line) from None
