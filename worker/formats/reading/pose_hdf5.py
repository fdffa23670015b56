"""HDF5 files: DeepLabCut's tables, SLEAP's analysis files, and otherwise MATLAB 7.3.

DeepLabCut's tables are written by pandas, which stores the column names as a pickle, or as levels and labels. Pickles are never loaded;
only their strings are extracted. The columns are x, y, likelihood for each body part, which the values must confirm.
"""

from __future__ import annotations

from pickletools import genops
from typing import IO

import h5py
import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.point_names import names_array
from pliant.worker.formats.reading.hdf5 import UNREADABLE, check_before_reading, read_arrays, read_values
from pliant.worker.formats.records import Arrays, Limits

VALUES = "values_block_0"
FIXED = "block0_values"
MOST_LEVELS = 4
"""Maximum header rows above DeepLabCut's columns: scorer, individuals, bodyparts, coords."""

STRINGS = frozenset(
    ("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8")
)
"""Pickle opcodes that hold a string."""

_SLEAP = ("node_names", "track_names", "track_occupancy", "edge_names")


def read_hdf5(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read a pose tracker's file, or every numeric data set of a MATLAB file.

    Raises
    ------
    InvalidInput
        Codes damaged_file, missing_array, too_large, unsupported_feature, wrong_shape.
    """
    try:
        with h5py.File(stream, "r") as file:
            found = _sleap(file, field, limits) or _deeplabcut(file, field, limits)
            return found if found is not None else read_arrays(file, field=field, limits=limits)
    except UNREADABLE as error:
        raise damaged(field, f"an HDF5 file that cannot be read ({str(error)[:120]})") from error


def _sleap(file: h5py.File, field: str, limits: Limits) -> Arrays | None:
    """Read `tracks (instances, 2, nodes, frames)`; the nodes of all instances are points, NaN where they were not found."""
    item = _own(file, "tracks")
    if not isinstance(item, h5py.Dataset) or item.ndim != 4 or item.shape[1] != 2 or item.dtype.kind != "f":
        return None
    if not any(name in file for name in _SLEAP):
        return None
    values = read_values(item, "tracks", 0, field, limits)  # axes reversed: frames, nodes, 2, instances
    frames, nodes, _, instances = values.shape
    parts, animals = (_texts(file, name, field, limits) for name in ("node_names", "track_names"))
    names = [] if len(parts) != nodes else parts
    if names and instances > 1:
        whose = animals if len(animals) == instances else [str(index) for index in range(instances)]
        names = [f"{animal}/{part}" for animal in whose for part in parts]
    points = values.transpose(0, 3, 1, 2).reshape(frames, instances * nodes, 2)
    return {"sleap": points, **names_array(names)}


def _deeplabcut(file: h5py.File, field: str, limits: Limits) -> Arrays | None:
    for name in list(file)[:8]:
        group = _own(file, name)
        if not isinstance(group, h5py.Group):
            continue
        table, fixed = _own(group, "table"), _own(group, FIXED)
        if (
            isinstance(table, h5py.Dataset)
            and table.dtype.names == ("index", VALUES)
            and table.dtype[VALUES].base.kind == "f"
        ):
            check_before_reading(table, name, 0, field, limits)
            return _columns(np.asarray(table[()][VALUES], dtype=np.float64), field, _pickled_heads(group))
        if isinstance(fixed, h5py.Dataset) and fixed.ndim == 2 and fixed.dtype.kind == "f":
            values = np.asarray(read_values(fixed, name, 0, field, limits).T, dtype=np.float64)
            return _columns(values, field, _levels(group, field, limits))
    return None


def _columns(values: NDArray[np.float64], field: str, heads: list[tuple[str, ...]]) -> Arrays:
    """Split a table of x, y, likelihood for each body part; `heads` holds the header of each column, if known."""
    likelihood = values[:, 2::3] if values.ndim == 2 else values
    if (
        values.ndim != 2
        or values.shape[1] % 3
        or not ((likelihood >= 0) & (likelihood <= 1) | np.isnan(likelihood)).all()
    ):
        raise InvalidInput(
            "wrong_shape", field=field, expected="a DeepLabCut table: x, y and likelihood from 0 to 1 for each body part",
            got=f"a table of shape {values.shape}", hint="Export it as csv: deeplabcut.analyze_videos_converth5_to_csv(folder).",
        )  # fmt: skip
    points = np.stack([values[:, 0::3], values[:, 1::3]], axis=2)
    known = [head[-1] for head in heads] == ["x", "y", "likelihood"] * points.shape[1]
    names = ["/".join(head[1:-1]) for head in heads[::3]] if known else []
    return {"deeplabcut": points, "likelihood": likelihood, **names_array(names)}


def _levels(group: h5py.Group, field: str, limits: Limits) -> list[tuple[str, ...]]:
    """Return the header of each column of a table in pandas' fixed format; empty unless its levels are strings."""
    columns: list[list[str]] = []
    for level in range(MOST_LEVELS):
        words, labels = _texts(group, f"axis0_level{level}", field, limits), _own(group, f"axis0_label{level}")
        if not isinstance(labels, h5py.Dataset) or labels.ndim != 1 or labels.dtype.kind not in "iu":
            break
        places = read_values(labels, "axis0_label", 0, field, limits)
        if not words or ((places < 0) | (places >= len(words))).any():
            return []
        columns.append([words[place] for place in places.tolist()])
    return (
        list(zip(*columns, strict=True)) if len({len(column) for column in columns}) == 1 and len(columns) > 2 else []
    )


def _pickled_heads(group: h5py.Group) -> list[tuple[str, ...]]:
    """Return the header of each column of a table in pandas' table format; empty if it cannot be determined."""
    held = group.attrs.get("non_index_axes")
    strings = strings_of(held) if isinstance(held, bytes) else []
    ends = [index for index, string in enumerate(strings) if string == "likelihood"]
    levels = (ends[0] + 1) // 3 if ends else 0
    if levels < 3 or (ends[0] + 1) % 3 or len(strings) < (count := 3 * levels * len(ends)):
        return []
    return [tuple(strings[at : at + levels]) for at in range(0, count, levels)]


def strings_of(pickle: bytes) -> list[str]:
    """List the strings of a pickle in order; its opcodes are parsed but not executed."""
    found: list[str] = []
    memo: dict[int, str | None] = {}
    last: str | None = None
    try:
        for opcode, argument, _ in genops(pickle):
            place = argument if isinstance(argument, int) else len(memo)
            if opcode.name in ("MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT"):
                memo[place] = last
                continue
            last = argument if isinstance(argument, str) and opcode.name in STRINGS else None
            if opcode.name in ("GET", "BINGET", "LONG_BINGET"):
                last = memo.get(place)
            if last is not None:
                found.append(last)
    except (ValueError, OverflowError):  # truncated, or not a pickle
        return []
    return found


def _texts(group: h5py.Group, name: str, field: str, limits: Limits) -> list[str]:
    """Read strings of fixed or variable length; empty if there are none."""
    item = _own(group, name)
    if not isinstance(item, h5py.Dataset) or item.ndim != 1 or h5py.check_string_dtype(item.dtype) is None:
        return []
    check_before_reading(item, name, 0, field, limits)
    return [bytes(text).decode("utf-8", "replace") for text in item[()]]


def _own(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """Return a member that is stored in the file itself; None if there is none."""
    if name not in group or not isinstance(group.get(name, getlink=True), h5py.HardLink):
        return None
    found = group[name]
    return found if isinstance(found, h5py.Group | h5py.Dataset) else None
