"""Tables with one row per frame: DeepLabCut's csv, MediaPipe landmarks, and spreadsheets with named columns.

Columns are named by point and coordinate: `nose_x`, `nose y`, `x0`, `y_3`; each point may have a confidence too. DeepLabCut writes the
names in three or four rows: scorer, individuals (with several animals), bodyparts, coords.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import too_large
from pliant.worker.formats.point_names import MEDIAPIPE, names_array
from pliant.worker.formats.records import Arrays, Limits

SEPARATORS = "\t;,"
"""In order of precedence: if tabs or semicolons separate the columns, commas may be decimal."""

LONGEST_ROW = 1 << 20
"""Maximum characters of a row; a row has two numbers for each point."""

MAX_GAPS = 100
"""Maximum number of frames per row or observation of a table. With more, the numbers probably count something other than frames."""

LANDMARKS = frozenset((21, 33, 468, 478, 543))
"""Numbers of points in MediaPipe's hand, pose, face (without and with irises) and holistic models."""

EXAMPLE = "Write it as in `frame,point,x,y` and then `0,0,312.5,200.1`, or one row a frame: `frame,nose_x,nose_y,chin_x,chin_y`."

CONFIDENCE = ("v", "vis", "visible", "visibility", "likelihood", "confidence", "conf", "score", "c", "p", "presence")
"""Names of a column with the confidence or visibility of a point."""

_AXIS = "|".join(sorted(("x", "y", "z", *CONFIDENCE), key=len, reverse=True))
_NAMED = re.compile(rf"(?P<point>.*[^ _.:-])[ _.:-]+(?P<axis>{_AXIS})")
_NUMBERED = re.compile(rf"(?P<axis>{_AXIS})[ _.:-]?(?P<point>\d+)")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Columns:
    """Indices of the columns, by point."""

    x: list[int]
    y: list[int]
    confidence: list[int | None]
    writer: str
    """Name of the track array."""
    names: list[str]
    frame: int | None = None
    """The column with the number of the frame."""


def separator_of(line: str) -> str:
    """Return the column separator of a line."""
    return next((sign for sign in SEPARATORS if sign in line), ",")


def split(line: str, separator: str) -> list[str]:
    """Return the cells of a line, in lower case and without quotes."""
    return [cell.lower() for cell in cells(line, separator)]


def cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line without quotes."""
    return [cell.strip().strip('"').strip() for cell in line.rstrip("\r\n").split(separator)]


def number(cell: str, separator: str) -> float:
    """Return the number in a cell, NaN if it is empty.

    Raises
    ------
    ValueError
        The cell holds something else.
    """
    words = {"": np.nan, "nan": np.nan, "na": np.nan, "true": 1.0, "false": 0.0}
    if cell in words:
        return words[cell]
    if separator != "," and _DECIMAL_COMMA.fullmatch(cell):
        cell = cell.replace(",", ".")
    return float(cell)


def not_a_table(field: str, count: int, line: str) -> InvalidInput:
    """Return the error for an unreadable line, which it quotes."""
    return InvalidInput(
            "unreadable_table", field=field, expected="a table with the columns frame, point, x and y, or with one row a frame",
        got=f"line {count}: {line.strip()[:80]!r}", hint=EXAMPLE,
    )  # fmt: skip


def columns_of(heads: list[str]) -> Columns | None:
    """Return the columns with these headings; None unless at least two points have x and y."""
    found: dict[str, dict[str, int]] = {}
    spelled: dict[str, str] = {}
    for index, head in enumerate(heads):
        low = head.lower()
        fits = _NUMBERED.fullmatch(low) or _NAMED.fullmatch(low)
        if fits is not None:
            axis = "confidence" if fits["axis"] in CONFIDENCE else fits["axis"]
            found.setdefault(fits["point"], {}).setdefault(axis, index)
            # Some letters get longer in lower case; the name then stays in lower case.
            spelled.setdefault(fits["point"], (head if len(head) == len(low) else low)[slice(*fits.span("point"))])
    points = [held for held in found.values() if "x" in held and "y" in held]
    if len(points) < 2:
        return None
    names = [spelled[point] for point, held in found.items() if "x" in held and "y" in held]
    landmarks = len(points) in LANDMARKS and all("z" in held for held in points)
    if landmarks and all(name.isdecimal() for name in names):
        names = list(MEDIAPIPE.get(len(points), names))
    confidence = [held.get("confidence") for held in points]
    return Columns(
        [held["x"] for held in points],
        [held["y"] for held in points],
        confidence,
        "mediapipe" if landmarks else "one_row_a_frame",
        names,
        next((index for index, head in enumerate(heads) if head.lower() == "frame"), None),
    )


def deeplabcut_columns(rows: list[list[str]]) -> Columns | None:
    """Return the columns below DeepLabCut's header rows; None if the rows are no such header."""
    heads = {row[0].lower(): row for row in rows}
    if not {"bodyparts", "coords"} <= set(heads) or len({len(row) for row in rows}) != 1:
        return None
    places: dict[tuple[str, ...], dict[str, int]] = {}
    for index in range(1, len(heads["coords"])):
        point = tuple(heads[name][index] for name in ("individuals", "bodyparts") if name in heads)
        places.setdefault(point, {}).setdefault(heads["coords"][index].lower(), index)
    names = ["/".join(point) for point, held in places.items() if "x" in held and "y" in held]
    points = [held for held in places.values() if "x" in held and "y" in held]
    return Columns(
        [held["x"] for held in points],
        [held["y"] for held in points],
        [held.get("likelihood") for held in points],
        "deeplabcut",
        names,
    )


def read_rows(
    lines: Iterator[str], columns: Columns, separator: str, *, field: str, limits: Limits, before: int, width: int
) -> Arrays:
    """Read the rows below the header, each of `width` cells; `before` lines were read already.

    If every row has the number of its frame, rows may be in any order, and a frame without a row shows no point; words in that column are
    ignored. Returns the tracks `(F, P, 2)` under the writer's name, NaN where a cell is empty, `likelihood (F, P)` if there are
    confidences, 1 for points without, and `point_names` if the points have names.

    Raises
    ------
    InvalidInput
        Codes duplicate_observation, too_large, unreadable_table.
    """
    rows: list[list[float]] = []
    frames: list[float] = []
    seen = {point: column for point, column in enumerate(columns.confidence) if column is not None}
    wanted = [*columns.x, *columns.y, *seen.values()]
    for count, line in enumerate(lines, before + 1):
        if not line.strip():
            continue
        if len(line) >= LONGEST_ROW:
            raise too_large(field, expected=f"rows of at most {LONGEST_ROW:,} characters", got="longer ones")
        row = split(line, separator)
        try:
            if len(row) != width:
                raise ValueError(f"{len(row)} cells")
            rows.append([number(row[index], separator) for index in wanted])
        except ValueError:
            raise not_a_table(field, count, line) from None
        frames.append(np.nan if columns.frame is None else _number_or_nan(row[columns.frame], separator))
        if len(rows) * len(wanted) * 8 > limits.max_bytes:
            raise too_large(field, expected=f"at most {limits.max_bytes:,} bytes as a table", got="more")
    points = len(columns.x)
    places = np.arange(len(rows))
    if rows and np.isfinite(frames).all():
        places = _places(np.array(frames), field)
    count = int(places.max(initial=-1)) + 1
    check_full_table(field, (count, points), size=count * len(wanted) * 8, rows=len(rows), limits=limits)
    table = np.full((count, len(wanted)), np.nan)
    table[places] = np.array(rows, dtype=np.float64).reshape(len(rows), len(wanted))
    found: Arrays = {columns.writer: np.stack([table[:, :points], table[:, points : 2 * points]], axis=2)}
    if seen:
        found["likelihood"] = np.ones((count, points))
        found["likelihood"][:, list(seen)] = table[:, 2 * points :]
        found["likelihood"][np.setdiff1d(np.arange(count), places)] = 0.0
    return {**found, **names_array(columns.names)}


def check_full_table(field: str, shape: tuple[int, int], *, size: int, rows: int, limits: Limits) -> None:
    """Check a table of `rows` lines, which takes `size` bytes with all frames and points of its shape.

    Raises
    ------
    InvalidInput
        Code too_large.
    """
    if size > limits.max_bytes or shape[0] > MAX_GAPS * rows:
        raise too_large(
            field,
            expected=f"at most {limits.max_bytes:,} bytes as a full table",
            got=f"{shape[0]:,} frames × {shape[1]:,} points",
        )


def _number_or_nan(cell: str, separator: str) -> float:
    try:
        return number(cell, separator)
    except ValueError:
        return np.nan


def _places(frames: NDArray[np.float64], field: str) -> NDArray[np.intp]:
    """Return the index of each row's frame; if whole numbers have a common step, such as 0, 5, 10, the step counts as one frame."""
    order = np.argsort(frames)
    again = np.flatnonzero(np.diff(frames[order]) == 0)
    if len(again):
        raise InvalidInput(
            "duplicate_observation", field=field, expected="one row for each frame", got=f"frame {frames[order[again[0]]]:g} twice",
            hint="Keep one row for each frame, with the columns of all points.",
        )  # fmt: skip
    after = frames - frames.min()
    if (frames == np.rint(frames)).all() and np.abs(frames).max() <= 2**53:
        steps = after.astype(np.int64)
        return np.asarray(steps // max(1, int(np.gcd.reduce(steps))), dtype=np.intp)
    places = np.zeros(len(frames), dtype=np.intp)
    places[order] = np.arange(len(frames))
    return places
