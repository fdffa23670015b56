"""Containers: detect the format of a file by its first bytes and read its arrays, in the sandbox unless it is plain NumPy."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from pliant.solver import InvalidInput
from pliant.worker.formats.errors import too_large
from pliant.worker.formats.point_names import ARRAY as NAMES
from pliant.worker.formats.point_names import one_line
from pliant.worker.formats.reading.arrays import NPY_MAGIC, read_file, shapes_of_members
from pliant.worker.formats.reading.parsers import recognise
from pliant.worker.formats.reading.sandbox import parse_in_sandbox
from pliant.worker.formats.records import Arrays, Limits
from pliant.worker.formats.tracker_warnings import ARRAY as WARNINGS

ZIP = (b"PK\x03\x04", b"PK\x05\x06")


def read_arrays(path: Path, *, field: str, limits: Limits, wanted: Collection[str]) -> Arrays:
    """Read the named arrays of a file in any known container format.

    Raises
    ------
    InvalidInput
        Codes empty_file and too_large, and those of `recognise` and the container's reader.
    """
    size = path.stat().st_size
    if size > limits.max_bytes:
        raise too_large(field, expected=f"a file of at most {limits.max_bytes:,} bytes", got=f"{size:,} bytes")
    with path.open("rb") as file:
        head = file.read(1024)
    if not head:
        raise InvalidInput(
            "empty_file", field=field, expected="a file with content", got="0 bytes", hint="Send the file again."
        )
    if head.startswith((NPY_MAGIC, *ZIP)):
        return read_file(path, field=field, limits=limits, wanted=wanted, texts=(NAMES, WARNINGS))
    return parse_in_sandbox(recognise(head, field), path, field=field, limits=limits)


def shapes_in(path: Path | None, arrays: Arrays) -> dict[str, tuple[int, ...] | None]:
    """Return names and shapes for an error that lists what a file has: the arrays read, and the other members of an npz."""
    shapes: dict[str, tuple[int, ...] | None] = {one_line(name): array.shape for name, array in arrays.items()}
    if path is None:
        return shapes
    with path.open("rb") as file:
        is_zip = file.read(4).startswith(ZIP)
    return shapes_of_members(path) | shapes if is_zip else shapes
