"""The files and fields of a submission, made from arrays, dictionaries of trackers, or paths."""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.client.errors import BadArgument
from pliant.schemas.options import Options
from pliant.schemas.problems import ProblemCode
from pliant.schemas.validation import expectation
from pydantic import ValidationError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

OnBytes = Callable[[int, int], None]
"""Called with the bytes transferred so far and the total."""

Source = ArrayLike | Mapping[str, Any] | Path | str
"""An array, a dictionary of arrays as a tracker returns it, or the path of a file."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """A multipart body that can be sent again: text fields, and paths of files."""

    fields: Mapping[str, str]
    files: Mapping[str, Path]
    on_upload: OnBytes | None = None
    before: int = 0
    """Bytes of the submission that have already been uploaded."""

    @property
    def size(self) -> int:
        """Bytes of the files."""
        return sum(path.stat().st_size for path in self.files.values())

    @contextmanager
    def open(self) -> Iterator[dict[str, tuple[str, IO[bytes], str]]]:
        """Open the files in the form that httpx accepts; reading them reports progress."""
        count = Count(self.before + self.size, self.on_upload)
        count.add(self.before)
        with ExitStack() as stack:
            opened = {}
            for name, path in self.files.items():
                file = CountedFile(stack.enter_context(path.open("rb")), count)
                file_name = path.name.encode("utf-8", "replace").decode()  # file names need not be valid UTF-8
                opened[name] = (file_name, cast(IO[bytes], file), "application/octet-stream")
            yield opened


@dataclass(frozen=True, kw_only=True)
class Remainder:
    """The bytes of a file from an offset on: a body that can be sent again."""

    path: Path
    offset: int
    report: Callable[[int], None]
    """Called with the offset in the file up to which bytes were handed to the connection."""

    def pieces(self) -> Iterator[bytes]:
        """Yield the bytes, at most `PIECE` at a time."""
        with self.path.open("rb") as file:
            file.seek(self.offset)
            while piece := file.read(PIECE):
                yield piece
                self.report(file.tell())


PIECE = 1 << 18
"""Bytes of a raw body read at a time."""

RESUMABLE_BYTES = 32 * 2**20
"""Total size of a submission's files above which they are uploaded before the job, bytes."""

SMALL = 2**20
"""Size up to which a file is always sent with the job, bytes."""

LONGEST_NAME = 200
"""Maximum length of a job's name, characters."""


class Count:
    """Counter of the bytes read from all files of a form."""

    def __init__(self, total: int, report: OnBytes | None) -> None:
        self.total = total
        self.done = 0
        self._report = report

    def add(self, number: int) -> None:
        """Count bytes and report the sum."""
        self.done += number
        if self._report is not None and number > 0:
            self._report(self.done, self.total)


class CountedFile:
    """A file whose reads are counted; httpx streams it in pieces."""

    def __init__(self, file: IO[bytes], count: Count) -> None:
        self._file = file
        self._count = count

    def read(self, size: int = -1) -> bytes:
        """Read and count."""
        data = self._file.read(size)
        self._count.add(len(data))
        return data

    def fileno(self) -> int:
        """Return the file descriptor, from which httpx reads the file's length."""
        return self._file.fileno()


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The inputs of a job as the caller gave them."""

    tracks: Source | None
    film: Path | str | None = None
    region: Path | str | None = None
    visible: ArrayLike | None = None
    mesh: Source | tuple[int, int] | None = None
    ground_truth: Source | None = None
    rotations: Source | None = None
    inputs_of: str | None = None

    def form(self, folder: Path, fields: Mapping[str, str], on_upload: OnBytes | None) -> Form:
        """Return the form with these inputs; arrays are written to files in `folder`.

        Raises
        ------
        BadArgument
            An input is missing, conflicts with another one, or cannot be sent.
        """
        texts = dict(fields)
        if self.inputs_of is not None:
            return Form(fields=texts | {"inputs_of": self._alone()}, files={}, on_upload=on_upload)
        if (self.tracks is None) == (self.film is None):
            raise BadArgument(
                f"tracks, film: expected one of them, got {'both' if self.film is not None else 'neither'}."
            )
        if self.film is not None:
            _alone(self.visible)
            files = {"film": existing_file(self.film, "film")}
        elif self.tracks is not None:
            files = {"tracks": tracks_file(self.tracks, self.visible, folder)}
        if self.region is not None:
            files["region"] = existing_file(self.region, "region")
        if self.mesh is not None:
            part = mesh_part(self.mesh, folder)
            if isinstance(part, str):
                texts["mesh"] = part
            else:
                files["mesh"] = part
        if self.ground_truth is not None:
            files["ground_truth"] = array_part(self.ground_truth, "ground_truth", "shapes", folder)
        if self.rotations is not None:
            files["rotations"] = array_part(self.rotations, "rotations", "rotations", folder)
        return Form(fields=texts, files=files, on_upload=on_upload)

    def _alone(self) -> str:
        """Return the id of the job whose inputs are reused; raise if another input was given."""
        others = [
            each.name
            for each in dataclass_fields(self)
            if each.name != "inputs_of" and getattr(self, each.name) is not None
        ]
        if others:
            raise BadArgument(f"inputs_of: expected no other inputs, got {', '.join(others)} as well.")
        assert self.inputs_of is not None
        return self.inputs_of


def tracks_file(tracks: Source, visible: ArrayLike | None, folder: Path) -> Path:
    """Write the tracks to a file that the service reads; a path is used as it is.

    Dictionaries are stored key by key: the service recognises the formats of trackers.

    Raises
    ------
    BadArgument
        `visible` was given with a file or dictionary, which have their own visibility; or a value is not an array.
    """
    if isinstance(tracks, str | Path):
        _alone(visible)
        return existing_file(tracks, "tracks")
    if isinstance(tracks, Mapping):
        _alone(visible)
        return _npz(folder / "tracks.npz", {str(key): _array(value, str(key)) for key, value in tracks.items()})
    hidden: NDArray[np.bool] | None = None
    if isinstance(tracks, np.ma.MaskedArray):
        hidden = np.asarray(np.ma.getmaskarray(tracks).any(axis=-1))
    points = _array(np.ma.getdata(tracks) if hidden is not None else tracks, "tracks")
    arrays = {"tracks": points}
    if visible is not None:
        arrays["visibility"] = _array(visible, "visible")
    elif hidden is not None:
        arrays["visibility"] = ~hidden
    return _npz(folder / "tracks.npz", arrays)


def mesh_part(mesh: Source | tuple[int, int], folder: Path) -> Path | str:
    """Return a file of faces, or a text: a grid size such as ``"12x20"``, or ``"none"``.

    Raises
    ------
    BadArgument
        The mesh is neither faces, nor a file, nor such a text.
    """
    if isinstance(mesh, str) and re.fullmatch(r"none|\s*\d{1,6}\s*x\s*\d{1,6}\s*", mesh.lower()) is not None:
        return mesh.lower().replace(" ", "")
    if isinstance(mesh, str | Path):
        return existing_file(mesh, "mesh")
    if isinstance(mesh, tuple) and len(mesh) == 2 and all(isinstance(size, int) for size in mesh):
        return f"{mesh[0]}x{mesh[1]}"
    if isinstance(mesh, Mapping):
        return _npz(folder / "mesh.npz", {str(key): _array(value, str(key)) for key, value in mesh.items()})
    return _npz(folder / "mesh.npz", {"faces": _array(mesh, "mesh")})


def array_part(value: Source, name: str, key: str, folder: Path) -> Path:
    """Return the file of the ground truth or of the rotations."""
    if isinstance(value, str | Path):
        return existing_file(value, name)
    arrays = value if isinstance(value, Mapping) else {key: value}
    return _npz(folder / f"{name}.npz", {str(k): _array(v, f"{name}.{k}") for k, v in arrays.items()})


def checked_options(options: Options | Mapping[str, Any] | None) -> Options:
    """Validate options locally, before anything is sent or solved.

    Raises
    ------
    BadArgument
        An option is unknown or invalid; the message lists each such option with its allowed values.
    """
    if isinstance(options, Options):
        return options
    try:
        return Options.model_validate(dict(options or {}))
    except ValidationError as fault:
        faults = "; ".join(map(_option_fault, fault.errors()))
        raise BadArgument(
            f"options: {faults}. `pliant options` lists every option.", code=ProblemCode.INVALID_OPTION.value
        ) from fault


def option_fields(options: Options | Mapping[str, Any] | None) -> dict[str, str]:
    """Return the form fields of a job's options. Raises as `checked_options`."""
    return {"options": checked_options(options).model_dump_json(exclude_unset=True)}


def _alone(visible: ArrayLike | None) -> None:
    if visible is not None:
        raise BadArgument(
            "visible: only valid with an array of tracks. A file or dictionary contains its own visibility."
        )


def expanded(path: Path | str, name: str) -> Path:
    """Return a path with ``~`` or ``~user`` at its beginning expanded.

    Raises
    ------
    BadArgument
        There is no such user, or the user has no home directory.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise BadArgument(
            f"{name}: expected a path, got {path}, and {Path(path).parts[0]} is no user's home directory. "
            "Write out the whole path."
        ) from None


def job_name(of_file: str) -> str:
    """Return the name of a job for a file name: valid UTF-8, truncated to `LONGEST_NAME` characters."""
    return of_file.encode("utf-8", "replace").decode()[:LONGEST_NAME]


def existing_file(path: Path | str, name: str) -> Path:
    """Return the path of an input, with ``~`` expanded.

    Raises
    ------
    BadArgument
        The file is missing, a folder, or not readable.
    """
    found = expanded(path, name)
    if found.is_dir():
        raise BadArgument(f"{name}: expected a file, got the folder {found}. Give the path of a file in it.")
    if not found.is_file():
        raise BadArgument(f"{name}: expected a file, an array or a dictionary of arrays, got no file at {found}.")
    if not os.access(found, os.R_OK):
        raise BadArgument(f"{name}: the file {found} cannot be read. Change its permissions.")
    return found


def _option_fault(error: ErrorDetails) -> str:
    """Describe one invalid option, with the closest name if the option does not exist."""
    name = ".".join(map(str, error["loc"]))
    if error["type"] != "extra_forbidden":
        return f"{name}: expected {expectation(error)}, got {error['input']!r}"
    close = difflib.get_close_matches(name, Options.model_fields, n=1)
    return f"{name}: there is no such option" + (f" (did you mean {close[0]}?)" if close else "")


def _array(value: Any, name: str) -> NDArray[np.generic]:
    """Convert anything that NumPy accepts, and PyTorch and JAX tensors on any device."""
    for step in ("detach", "cpu"):
        if hasattr(value, step):
            value = getattr(value, step)()
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise BadArgument(
            f"{name}: expected an array of numbers or booleans, got dtype {array.dtype}. "
            "Pad ragged lists with NaN and omit entries that are not arrays."
        )
    return array


def _npz(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> Path:
    """Write without compression: equal arrays give equal bytes, so the service recognises a repeated submission."""
    with path.open("wb") as file:
        np.savez(file, **dict(arrays))  # type: ignore[arg-type]
    return path


def sha256(path: Path) -> str:
    """Hash a file without loading it into memory."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
