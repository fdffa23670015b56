"""MATLAB .mat files of version 5, the format of non-rigid structure-from-motion data sets: W, S, Rs, possibly inside structs.

SciPy's reader trusts sizes and offsets, so a crafted file can crash it; it runs only in the sandbox (`reading.sandbox`).
"""

from __future__ import annotations

import struct
import warnings
import zlib
from typing import IO

import numpy as np
import scipy.io
from numpy.typing import NDArray
from pliant.worker.formats.errors import FULL, SAVE_MATRIX, damaged, missing_array, too_large
from pliant.worker.formats.point_names import one_line
from pliant.worker.formats.records import Arrays, Limits

UNREADABLE = (
    ValueError, TypeError, KeyError, IndexError, OSError, NotImplementedError, zlib.error, struct.error, NameError, ArithmeticError,
    EOFError, AttributeError, RecursionError, scipy.io.matlab.MatReadError,
)  # fmt: skip
"""Exceptions of SciPy's reader for damaged files; NameError for unexpected classes."""

MAX_DEPTH = 4
MAX_ARRAYS = 256


def read_matlab5(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read every real, full array; members of structs under dotted names such as `data.W`.

    Raises
    ------
    InvalidInput
        Codes damaged_file, missing_array, too_large.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            listed = scipy.io.whosmat(stream)  # type: ignore[arg-type]  # the stubs accept paths only
            stream.seek(0)
            names = [str(name) for name, _, kind in listed if kind not in ("function", "opaque", "object", "sparse")]
            _check_declared([shape for name, shape, _ in listed if name in names], field, limits)
            content = scipy.io.loadmat(
                stream,  # type: ignore[arg-type]
                variable_names=names,
                struct_as_record=False,
                squeeze_me=False,
                chars_as_strings=True,
            )
    except UNREADABLE as error:
        raise damaged(field, f"a .mat file that cannot be read ({str(error)[:120]})") from error
    found: Arrays = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _collect(name, value, found, 0)
    if not found:
        raise missing_array(
            field, expected=FULL, there={f"{kind} {one_line(str(name))}": tuple(shape) for name, shape, kind in listed},
            hint=SAVE_MATRIX,
        )  # fmt: skip
    return found


def _check_declared(shapes: list[tuple[int, ...]], field: str, limits: Limits) -> None:
    total = sum(int(np.prod([max(int(n), 0) for n in shape], dtype=np.float64)) * 8 for shape in shapes)
    if total > limits.max_bytes:
        raise too_large(field, expected=f"at most {limits.max_bytes:,} bytes", got=f"{total:,} bytes declared")


def _collect(name: str, value: object, found: Arrays, depth: int) -> None:
    if depth > MAX_DEPTH or len(found) >= MAX_ARRAYS:
        return
    if isinstance(value, scipy.io.matlab.mat_struct):
        for member in value._fieldnames:  # type: ignore[attr-defined]  # SciPy's documented way
            _collect(f"{name}.{member}", getattr(value, member), found, depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        if value.size == 1:
            _collect(name, value.reshape(-1)[0], found, depth + 1)
        else:
            _stack_cells(name, value, found)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 0:
        found[name] = value.astype(value.dtype.newbyteorder("="), copy=False)


def _stack_cells(name: str, cells: NDArray[np.object_], found: Arrays) -> None:
    """Stack cells that hold matrices of one shape, e.g. one per frame, along a new first axis; likewise each field of a struct array."""
    parts = list(cells.reshape(-1, order="F"))
    if all(isinstance(part, scipy.io.matlab.mat_struct) for part in parts):
        for member in parts[0]._fieldnames[:MAX_ARRAYS]:
            _stack(f"{name}.{member}", [getattr(part, member, None) for part in parts], found)
    else:
        _stack(name, parts, found)


def _stack(name: str, parts: list[object], found: Arrays) -> None:
    arrays = [part for part in parts if isinstance(part, np.ndarray) and part.dtype.kind in "fiub" and part.size > 0]
    if len(arrays) == len(parts) and len({part.shape for part in arrays}) == 1 and len(found) < MAX_ARRAYS:
        found[name] = np.stack(arrays)
