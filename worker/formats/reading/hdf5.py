"""MATLAB .mat files of version 7.3, which are HDF5, and HDF5 of other programs. Only plain data sets inside the file itself are read.

HDF5 can refer to other files (external storage, virtual data sets, external links) and can declare terabytes in a kilobyte. Both are
rejected before a value is read. MATLAB stores columns first, so the axes in HDF5 are reversed, and are reversed back here; those of other
programs, whose data sets lack MATLAB's attribute, are left as they are. Cells and the fields of struct arrays are references to data sets
of the same file, which are followed one step.
"""

from __future__ import annotations

import h5py
import numpy as np
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import FULL, SAVE_MATRIX, missing_array, too_large
from pliant.worker.formats.point_names import one_line
from pliant.worker.formats.records import Arrays, Limits

UNREADABLE = (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError, OverflowError, IndexError)
"""Exceptions of h5py for damaged files."""

DEFLATE = 1032
"""Maximum expansion of a byte by deflate."""

SMALL = 16 << 20
"""Bytes up to which a data set or chunk is read without checking how it is stored."""

CHUNK_EXCESS = 4
"""Maximum size of a chunk relative to its data set: writers round chunks up along every axis."""

CLASS, SPARSE = "MATLAB_class", "MATLAB_sparse"
"""Attributes that MATLAB gives to its data sets, and to the groups of sparse matrices."""

MAX_OBJECTS = 512
MAX_DEPTH = 4
MAX_CELLS = 20_000


def read_arrays(file: h5py.File, *, field: str, limits: Limits) -> Arrays:
    """Read every numeric data set; members of structs (groups) under dotted names.

    Raises
    ------
    InvalidInput
        Codes missing_array, too_large, unsupported_feature.
    """
    found: Arrays = {}
    _collect(file, "", found, field=field, limits=limits, depth=0)
    if not found:
        there = {
            ("sparse " if SPARSE in file[name].attrs else "") + one_line(name): getattr(file[name], "shape", None)
            for name in file
            if not name.startswith("#")
        }
        raise missing_array(field, expected=FULL, there=there, hint=SAVE_MATRIX)
    return found


def _collect(group: h5py.Group, prefix: str, found: Arrays, *, field: str, limits: Limits, depth: int) -> None:
    if depth > MAX_DEPTH or len(group) > MAX_OBJECTS or len(found) > MAX_OBJECTS:
        raise too_large(field, expected=f"at most {MAX_OBJECTS} variables, {MAX_DEPTH} levels deep", got="more")
    for name in group:
        if name.startswith("#"):
            continue
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise _elsewhere(field, f"{prefix}{name}, a soft or external link")
        item = group[name]
        if isinstance(item, h5py.Group) and SPARSE in item.attrs:
            continue
        if isinstance(item, h5py.Group):
            _collect(item, f"{prefix}{name}.", found, field=field, limits=limits, depth=depth + 1)
        elif isinstance(item, h5py.Dataset) and _is_numeric(item):
            values = read_values(item, f"{prefix}{name}", _bytes(found), field, limits)
            found[f"{prefix}{name}"] = values if CLASS in item.attrs else values.T
        elif isinstance(item, h5py.Dataset) and h5py.check_ref_dtype(item.dtype) is h5py.Reference and item.size:
            stacked = _cells(item, f"{prefix}{name}", _bytes(found), field, limits)
            if stacked is not None:
                found[f"{prefix}{name}"] = stacked


def _is_numeric(item: h5py.Dataset) -> bool:
    """Return whether a data set is a non-empty numeric or logical array in MATLAB."""
    kind = item.attrs.get(CLASS, b"double")
    return item.dtype.kind in "fiub" and bool(item.size) and kind != b"char" and "MATLAB_empty" not in item.attrs


def _bytes(found: Arrays) -> int:
    return sum(array.nbytes for array in found.values())


def _cells(item: h5py.Dataset, name: str, so_far: int, field: str, limits: Limits) -> np.ndarray | None:
    """Stack the referenced matrices, if all have one shape, e.g. one per frame, along a new first axis; otherwise return None."""
    _check_within(item, name, field)
    if item.size > MAX_CELLS:
        raise too_large(field, expected=f"at most {MAX_CELLS:,} cells", got=f"{name} of {item.size:,}")
    parts: list[np.ndarray] = []
    for reference in item[()].T.reshape(-1, order="F"):
        target = item.file[reference] if reference else None
        if not isinstance(target, h5py.Dataset) or not _is_numeric(target):
            return None
        parts.append(
            read_values(target, name, so_far + sum(part.nbytes for part in parts[:1]) * len(parts), field, limits)
        )
        if parts[-1].shape != parts[0].shape:
            return None
    return parts[0] if len(parts) == 1 else np.stack(parts)


def _check_within(item: h5py.Dataset, name: str, field: str) -> None:
    if item.is_virtual or item.external:
        raise _elsewhere(field, f"{name}, which lies in another file")


def check_before_reading(item: h5py.Dataset, name: str, so_far: int, field: str, limits: Limits) -> None:
    """Reject, before reading, a data set outside the file, above the limit with `so_far` bytes read, or larger than its storage allows.

    Raises
    ------
    InvalidInput
        Codes too_large, unsupported_feature.
    """
    _check_within(item, name, field)
    declared = int(np.prod(item.shape, dtype=np.float64)) * item.dtype.itemsize
    if so_far + declared > limits.max_bytes:
        raise too_large(
            field, expected=f"at most {limits.max_bytes:,} bytes", got=f"{name}, which declares {declared:,}"
        )
    _check_stored(item, name, declared, field, limits)


def read_values(item: h5py.Dataset, name: str, so_far: int, field: str, limits: Limits) -> np.ndarray:
    """Read a data set with its axes reversed to MATLAB's order; raises as `check_before_reading`."""
    check_before_reading(item, name, so_far, field, limits)
    values = np.asarray(item[()])
    return np.ascontiguousarray(values.T.astype(values.dtype.newbyteorder("="), copy=False))


def _check_stored(item: h5py.Dataset, name: str, declared: int, field: str, limits: Limits) -> None:
    """Reject, before decompression, a data set that its stored bytes cannot expand to.

    Deflate expands one byte to at most 1032. A chunk is always decompressed as a whole.
    """
    stored = item.id.get_storage_size()
    if declared > SMALL and declared > DEFLATE * stored:
        raise too_large(
            field, expected=f"at most {DEFLATE:,} bytes of data for each stored byte", got=f"{name}: {declared:,} of {stored:,} bytes"
        )  # fmt: skip
    chunk = 0 if item.chunks is None else int(np.prod(item.chunks, dtype=np.float64)) * item.dtype.itemsize
    if chunk > max(SMALL, CHUNK_EXCESS * declared) or chunk > limits.max_bytes:
        raise too_large(
            field, expected="chunks no larger than their data set", got=f"{name} in chunks of {chunk:,} bytes"
        )


def _elsewhere(field: str, what: str) -> Exception:
    return InvalidInput(
        "unsupported_feature", field=field, expected="data inside the file itself", got=what,
        hint="Save the matrix itself: save('tracks.mat', 'W', '-v7').",
    )  # fmt: skip
