"""The files and fields of a submission, made from what users have: arrays, trackers' dictionaries, paths."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.client.errors import BadArgument
from pliant.schemas.options import Options
from pydantic import ValidationError

OnBytes = Callable[[int, int], None]
"""Told the bytes moved so far and the bytes there are."""

Source = ArrayLike | Mapping[str, Any] | Path | str
"""An array, a dictionary of arrays as a tracker returns it, or the path of a file."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """A multipart body that can be sent again: fields, and paths of files."""

    fields: Mapping[str, str]
    files: Mapping[str, Path]
    on_upload: OnBytes | None = None
    before: int = 0
    """Bytes of the submission that went before, as uploads."""

    @property
    def size(self) -> int:
        """Bytes of the files."""
        return sum(path.stat().st_size for path in self.files.values())

    @contextmanager
    def open(self) -> Iterator[dict[str, tuple[str, IO[bytes], str]]]:
        """Open the files in the form that httpx takes, counting what is read."""
        count = Count(self.before + self.size, self.on_upload)
        count.add(self.before)
        with ExitStack() as stack:
            opened = {}
            for name, path in self.files.items():
                file = CountedFile(stack.enter_context(path.open("rb")), count)
                opened[name] = (path.name, cast(IO[bytes], file), "application/octet-stream")
            yield opened


@dataclass(frozen=True, kw_only=True)
class Rest:
    """The bytes of a file from some offset on, as a body that can be sent again."""

    path: Path
    offset: int
    tell: Callable[[int], None]
    """Told the bytes of the file that are on their way so far."""

    def pieces(self) -> Iterator[bytes]:
        """Read them."""
        with self.path.open("rb") as file:
            file.seek(self.offset)
            while piece := file.read(PIECE):
                yield piece
                self.tell(file.tell())


PIECE = 1 << 18
"""Bytes of a raw body that are read at a time."""


class Count:
    """Bytes of all files of a form together."""

    def __init__(self, total: int, tell: OnBytes | None) -> None:
        self.total = total
        self.done = 0
        self._tell = tell

    def add(self, number: int) -> None:
        """Note bytes that were read."""
        self.done += number
        if self._tell is not None and number > 0:
            self._tell(self.done, self.total)


class CountedFile:
    """A file that tells what is read of it; httpx streams it in pieces."""

    def __init__(self, file: IO[bytes], count: Count) -> None:
        self._file = file
        self._count = count

    def read(self, size: int = -1) -> bytes:
        """Read, and count."""
        data = self._file.read(size)
        self._count.add(len(data))
        return data

    def fileno(self) -> int:
        """Let httpx ask for the length."""
        return self._file.fileno()


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What a user hands over to be reconstructed, as it is."""

    tracks: Source
    visible: ArrayLike | None = None
    mesh: Source | tuple[int, int] | None = None
    ground_truth: Source | None = None
    rotations: Source | None = None

    def form(self, folder: Path, fields: Mapping[str, str], on_upload: OnBytes | None) -> Form:
        """Return the form that carries it; what is not a file yet is written into `folder`.

        Raises
        ------
        BadArgument
            Something cannot be sent.
        """
        texts = dict(fields)
        files = {"tracks": tracks_file(self.tracks, self.visible, folder)}
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


def tracks_file(tracks: Source, visible: ArrayLike | None, folder: Path) -> Path:
    """Write the tracks into a file the service reads; a path is used as it is.

    Dictionaries go as they are, key by key: the service has the one table of trackers' formats.

    Raises
    ------
    BadArgument
        `visible` beside something that has its own visibility, or values that are not arrays.
    """
    if isinstance(tracks, str | Path):
        _alone(visible)
        return _existing(tracks, "tracks")
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
        Neither faces, nor a file, nor such a text.
    """
    if isinstance(mesh, str) and re.fullmatch(r"none|\s*\d{1,6}\s*x\s*\d{1,6}\s*", mesh.lower()) is not None:
        return mesh.lower().replace(" ", "")
    if isinstance(mesh, str | Path):
        return _existing(mesh, "mesh")
    if isinstance(mesh, tuple) and len(mesh) == 2 and all(isinstance(size, int) for size in mesh):
        return f"{mesh[0]}x{mesh[1]}"
    if isinstance(mesh, Mapping):
        return _npz(folder / "mesh.npz", {str(key): _array(value, str(key)) for key, value in mesh.items()})
    return _npz(folder / "mesh.npz", {"faces": _array(mesh, "mesh")})


def array_part(value: Source, name: str, key: str, folder: Path) -> Path:
    """Return a file for the ground truth or the rotations."""
    if isinstance(value, str | Path):
        return _existing(value, name)
    arrays = value if isinstance(value, Mapping) else {key: value}
    return _npz(folder / f"{name}.npz", {str(k): _array(v, f"{name}.{k}") for k, v in arrays.items()})


def checked_options(options: Options | Mapping[str, Any] | None) -> Options:
    """Check options before anything is sent or solved.

    Raises
    ------
    BadArgument
        With the names at fault and what is allowed.
    """
    if isinstance(options, Options):
        return options
    try:
        return Options.model_validate(dict(options or {}))
    except ValidationError as fault:
        said = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}, got {e['input']!r}" for e in fault.errors())
        raise BadArgument(f"options: {said}. `pliant options` lists every option.") from fault


def _alone(visible: ArrayLike | None) -> None:
    if visible is not None:
        raise BadArgument("visible goes with an array of tracks; a file or dictionary brings its own visibility.")


def _existing(path: Path | str, name: str) -> Path:
    found = Path(path).expanduser()
    if not found.is_file():
        raise BadArgument(f"{name}: expected a file, an array or a dictionary of arrays, got no file at {found}.")
    return found


def _array(value: Any, name: str) -> NDArray[np.generic]:
    """Take whatever NumPy understands, and tensors of PyTorch and JAX wherever they live."""
    for step in ("detach", "cpu"):
        if hasattr(value, step):
            value = getattr(value, step)()
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise BadArgument(
            f"{name}: expected an array of numbers or booleans, got dtype {array.dtype}. "
            "Ragged lists must be filled up with NaN first; leave out what is not an array."
        )
    return array


def _npz(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> Path:
    """Write uncompressed: the bytes are the same every time, so a repeated submission is recognised."""
    with path.open("wb") as file:
        np.savez(file, **dict(arrays))  # type: ignore[arg-type]
    return path
