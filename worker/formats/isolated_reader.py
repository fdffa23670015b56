"""Read large inputs in a process of their own, so that a server that takes them in stays as small as it was.

A gigabyte of tracks needs several while it is checked and converted; freed memory seldom goes back to the system, and what a crafted
file announces may be a hundred times its size. So inputs that announce much are read, checked and stored by a process that lives as long
as that takes, under limits of its own; the server gets the interpretation, or the refusal. What is small is read at once.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import subprocess
import sys
import zipfile
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats.canonical import save_inputs
from pliant.worker.formats.errors import AmbiguousInput, too_large
from pliant.worker.formats.read import read_inputs
from pliant.worker.formats.reading.arrays import NPY_MAGIC, UNREADABLE_ZIP, check_directory, read_header
from pliant.worker.formats.reading.parsers import HDF5
from pliant.worker.formats.reading.sandbox import die_with
from pliant.worker.formats.records import Limits

LARGE = 16 << 20
"""Bytes of arrays, by what the files announce, above which they are read apart."""

GROWTH = {b"MATLAB": 1032, b"\x89PNG": 8 * 1032}
"""What a byte may become: deflate makes at most 1032 of it, and a pixel's point number has 8."""

TEXT = 8
"""A byte of text or of a mesh file becomes at most this many."""

NUMBER = 8
"""Bytes of a number while it is worked on, however it is stored."""

WITHOUT_BOUND = 1 << 62
"""HDF5 says in a kilobyte that there are gigabytes of zeros."""

MEMBERS = 256
"""Members of a zip file that are looked at; more are refused."""

REFUSED = 3
OWN_ERRORS = 4096
KEPT = ("code", "field", "expected", "got", "hint")


def store_inputs(
    *,
    tracks: Path,
    mesh: Path | str | None = None,
    ground_truth: Path | None = None,
    rotations: Path | None = None,
    options: Options,
    limits: Limits = Limits(),  # noqa: B008 - frozen
    target: Path | None,
) -> Interpretation:
    """Read, check and interpret the files of one job as `read_inputs` does, and store them in canonical form.

    Parameters
    ----------
    tracks, mesh, ground_truth, rotations, options, limits
        As in `read_inputs`.
    target : Path, optional
        Where to write the canonical inputs; None: nowhere, the interpretation is all that is wanted.

    Raises
    ------
    InvalidInput, AmbiguousInput
        As `read_inputs`; too_large also when reading needs more memory or time than the limits allow.
    """
    parts: dict[str, Any] = {"tracks": tracks, "mesh": mesh, "ground_truth": ground_truth, "rotations": rotations}
    files = {name: part for name, part in parts.items() if isinstance(part, Path)}
    if sum(announced(path, field=name) for name, path in files.items()) > LARGE:
        return _in_process(parts, options, limits, target)
    return _here(parts, options, limits, target)


def _here(parts: dict[str, Any], options: Options, limits: Limits, target: Path | None) -> Interpretation:
    inputs = read_inputs(**parts, options=options, limits=limits)
    if target is not None:
        save_inputs(inputs, target)
    return inputs.interpretation


def announced(path: Path, *, field: str) -> int:
    """Bytes that a file may become when it is read, by what it says or by what its kind allows.

    Raises
    ------
    InvalidInput
        It is a zip file without an orderly directory.
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
    """Bytes of an array as numbers of 8 bytes; of what is no orderly array, as many as there are."""
    try:
        header, _ = read_header(file, field=field, limits=Limits())
    except InvalidInput:
        return size
    return max(size, math.prod(header.shape) * NUMBER)


def _in_process(parts: dict[str, Any], options: Options, limits: Limits, target: Path | None) -> Interpretation:
    request = {
        "parts": {name: {"path": str(part)} if isinstance(part, Path) else part for name, part in parts.items()},
        "options": options.model_dump(mode="json"), "limits": asdict(limits),
        "target": None if target is None else str(target.absolute()),
    }  # fmt: skip
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    passed = {name: os.environ[name] for name in ("TMPDIR",) if name in os.environ}
    with subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-I", "-m", "pliant.worker.formats.isolated_reader", str(os.getpid())], env={**passed, **threads},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            answer, errors = process.communicate(json.dumps(request).encode(), timeout=limits.read_seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            raise too_large(
                "tracks", expected=f"inputs that are read within {limits.read_seconds:g} s", got="more"
            ) from None
        except BaseException:
            process.kill()
            raise
    return _told(process.returncode, answer, errors, limits)


def _told(code: int, answer: bytes, errors: bytes, limits: Limits) -> Interpretation:
    if code == 0:
        return Interpretation.model_validate_json(answer)
    if code == REFUSED:
        said = json.loads(answer)
        choices = said.pop("choices")
        if choices is not None:
            raise AmbiguousInput(**said, choices=choices)
        raise InvalidInput(said.pop("code"), **said)
    if code in (-signal.SIGKILL, -signal.SIGXCPU):
        raise too_large("tracks", expected=f"inputs that are read within {limits.read_memory} bytes", got="more")
    raise RuntimeError(f"reading inputs ended with {code}: {errors[-OWN_ERRORS:].decode(errors='replace')}")


def main() -> int:
    """Do what the request on standard input says, and answer on standard output; the process's whole life."""
    die_with(int(sys.argv[1]))
    request = json.load(sys.stdin)
    limits = Limits(**request["limits"])
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    with suppress(ValueError, OSError):  # macOS does not know an address-space limit
        resource.setrlimit(resource.RLIMIT_AS, (limits.read_memory, hard))
    parts = {name: Path(part["path"]) if isinstance(part, dict) else part for name, part in request["parts"].items()}
    try:
        try:
            target = None if request["target"] is None else Path(request["target"])
            interpretation = _here(parts, Options.model_validate(request["options"]), limits, target)
        except MemoryError as error:
            raise too_large(
                "tracks", expected=f"inputs that are read within {limits.read_memory} bytes", got="more"
            ) from error
    except InvalidInput as error:
        said = {name: getattr(error, name) for name in KEPT}
        sys.stdout.write(json.dumps({**said, "choices": getattr(error, "choices", None)}))
        return REFUSED
    sys.stdout.write(interpretation.model_dump_json())
    return 0


if __name__ == "__main__":
    sys.exit(main())
