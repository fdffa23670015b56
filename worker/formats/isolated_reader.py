"""The isolated reader: read large inputs in a separate process, so that the server's memory does not grow.

Validating and converting a gigabyte of tracks takes several gigabytes, freed memory rarely returns to the system, and a crafted file
may expand to a hundred times its size and more. Inputs that declare more than `LARGE` bytes are therefore read, validated and stored by a
process with its own limits; the server receives the interpretation or the error. Smaller inputs are read in the server, unless a file
expands to more than `LARGE` bytes after all, such as a table of few observations in many frames.
"""

from __future__ import annotations

import math
import resource
import signal
import sys
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats.canonical import load_inputs, save_inputs
from pliant.worker.formats.errors import refusal_in, too_large
from pliant.worker.formats.read import check_options, read_inputs
from pliant.worker.formats.reading.arrays import NPY_MAGIC, UNREADABLE_ZIP, check_directory, read_header
from pliant.worker.formats.reading.parsers import HDF5
from pliant.worker.formats.records import Limits
from pliant.worker.processes.contained import DONE, REFUSED, limit_process, run_contained, serve

LARGE = 16 << 20
"""Bytes of arrays, as the files declare them, above which the isolated reader is used."""

GROWTH = {b"MATLAB": 1032, b"\x89PNG": 8 * 1032}
"""Maximum expansion of a byte: 1032 by deflate, for masks times 8 bytes for a pixel's point index."""

TEXT = 8
"""Usual expansion of a byte of text or of a mesh file."""

NUMBER = 8
"""Bytes of a number in memory, however it is stored."""

WITHOUT_BOUND = 1 << 62
"""Maximum expansion of an HDF5 file, which can declare gigabytes of zeros in a kilobyte."""

MEMBERS = 256
"""Maximum number of members of a zip file."""

STORED = "stored"
"""Part of a request that names inputs in canonical form."""

MODULE = "pliant.worker.formats.isolated_reader"


def store_inputs(
    *,
    tracks: Path,
    mesh: Path | str | None = None,
    ground_truth: Path | None = None,
    rotations: Path | None = None,
    options: Options,
    limits: Limits = Limits(),  # noqa: B008 - frozen
    target: Path,
) -> Interpretation:
    """Read, check and interpret the files of one job as `read_inputs` does; store them in canonical form in the file `target`.

    Raises
    ------
    InvalidInput, AmbiguousInput
        As `read_inputs`; too_large also when reading needs more memory or time than the limits allow.
    """
    parts: dict[str, Any] = {"tracks": tracks, "mesh": mesh, "ground_truth": ground_truth, "rotations": rotations}
    files = {name: part for name, part in parts.items() if isinstance(part, Path)}
    if sum(declared_bytes(path, field=name) for name, path in files.items()) <= LARGE:
        try:
            return _here(parts, options, replace(limits, max_bytes=min(limits.max_bytes, LARGE)), target)
        except InvalidInput as error:
            if error.code != "too_large":
                raise
    return Interpretation.model_validate_json(_in_process(parts, options, limits, target))


def check_stored(path: Path, options: Options, limits: Limits) -> None:
    """Check that options agree with inputs in canonical form, as `store_inputs` checks them.

    Raises
    ------
    InvalidInput
        They contradict each other; too_large when reading needs more memory or time than the limits allow.
    """
    if declared_bytes(path, field="inputs_of") <= LARGE:
        _check_here(path, options)
    else:
        _in_process({STORED: path}, options, limits, None)


def _check_here(path: Path, options: Options) -> None:
    inputs = load_inputs(path)
    check_options(inputs.tracks, inputs.mesh, inputs.cameras, options, y_axis=inputs.interpretation.y_axis)


def _here(parts: dict[str, Any], options: Options, limits: Limits, target: Path) -> Interpretation:
    inputs = read_inputs(**parts, options=options, limits=limits)
    save_inputs(inputs, target)
    return inputs.interpretation


def declared_bytes(path: Path, *, field: str) -> int:
    """Return the size of a file in memory, from its declared sizes or the expansion of its format.

    Raises
    ------
    InvalidInput
        A zip file with an invalid directory.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(1024)
        if head.startswith(NPY_MAGIC):
            file.seek(0)
            return _numbers(file, size, field)
    if HDF5 in head:
        return WITHOUT_BOUND
    if head.startswith(b"PK"):
        check_directory(path, field=field)
        with suppress(*UNREADABLE_ZIP), zipfile.ZipFile(path) as archive:
            return sum(_member(archive, info, field) for info in archive.infolist()[:MEMBERS])
        return size
    return size * next((growth for start, growth in GROWTH.items() if head.startswith(start)), TEXT)


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, field: str) -> int:
    with suppress(RuntimeError, *UNREADABLE_ZIP), archive.open(info) as member:  # RuntimeError: encrypted
        return _numbers(member, info.file_size, field)
    return info.file_size


def _numbers(file: IO[bytes], size: int, field: str) -> int:
    """Return the size of an array with 8 bytes per number; of an invalid array, its stored size."""
    try:
        header, _ = read_header(file, field=field, limits=Limits())
    except InvalidInput:
        return size
    return max(size, math.prod(header.shape) * NUMBER)


def _in_process(parts: dict[str, Any], options: Options, limits: Limits, target: Path | None) -> bytes:
    request = {
        "parts": {name: {"path": str(part)} if isinstance(part, Path) else part for name, part in parts.items()},
        "options": options.model_dump(mode="json", exclude_unset=True), "limits": asdict(limits),
        "target": None if target is None else str(target.absolute()),
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="pliant-read-") as scratch:  # also removes what a killed process leaves
        ended = run_contained(MODULE, request, seconds=limits.read_seconds, environment={"TMPDIR": scratch})
    if ended.code == DONE:
        return ended.answer
    if ended.overdue:
        raise too_large("tracks", expected=f"inputs that are read within {limits.read_seconds:g} s", got="more")
    if ended.code in (-signal.SIGKILL, -signal.SIGXCPU):
        raise _too_much_memory(limits)
    refusal = refusal_in(ended.answer, with_choices=True) if ended.code == REFUSED else None
    raise refusal or RuntimeError(f"the isolated reader ended with {ended.code}: {ended.errors}")


def _too_much_memory(limits: Limits) -> InvalidInput:
    return too_large("tracks", expected=f"inputs that are read within {limits.read_memory:,} bytes", got="more")


def main() -> int:
    """Read the files of the request on standard input; answer with the interpretation on standard output."""
    return serve(_answer)


def _answer(request: dict[str, Any]) -> str:
    limits = Limits(**request["limits"])
    limit_process({resource.RLIMIT_AS: limits.read_memory})
    parts = {name: Path(part["path"]) if isinstance(part, dict) else part for name, part in request["parts"].items()}
    options = Options.model_validate(request["options"])
    try:
        if STORED in parts:
            _check_here(parts[STORED], options)
            return ""
        return _here(parts, options, limits, Path(request["target"])).model_dump_json()
    except MemoryError as error:
        raise _too_much_memory(limits) from error


if __name__ == "__main__":
    sys.exit(main())
