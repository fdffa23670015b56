"""The files and fields of a submission, as a form that can be sent again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import IO, Any, cast

from numpy.typing import ArrayLike
from pliant.client.errors import BadArgument
from pliant.client.input_files import (
    Region,
    Source,
    array_part,
    film_file,
    kind_of,
    mesh_part,
    refuse_visible,
    region_part,
    tracks_file,
)
from pliant.client.result import job_path
from pliant.schemas.option_faults import option_fault
from pliant.schemas.options import Options
from pliant.schemas.problems import ProblemCode
from pydantic import ValidationError

OnBytes = Callable[[int, int], None]
"""Called with the bytes transferred so far and the total."""


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
    region: Region | None = None
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
            refuse_visible(self.visible)
            files = {"film": film_file(self.film, folder)}
        elif self.tracks is not None:
            files = {"tracks": tracks_file(self.tracks, self.visible, folder)}
        if self.region is not None:
            files["region"] = region_part(self.region, folder, film=self.film)
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
        job_path(self.inputs_of)  # refuses what is no id
        return self.inputs_of


def checked_options(options: Options | Mapping[str, Any] | None) -> Options:
    """Validate options locally, before anything is sent or solved.

    Raises
    ------
    BadArgument
        An option is unknown or invalid; the message lists each such option with its allowed values.
    """
    if isinstance(options, Options):
        return options
    if options is not None and not isinstance(options, Mapping):
        raise BadArgument(
            f'options: expected a mapping such as {{"loss": "huber"}} or Options, got {kind_of(options)}.',
            code=ProblemCode.INVALID_OPTION.value,
        )
    try:
        return Options.model_validate(dict(options or {}))
    except ValidationError as fault:
        faults = [option_fault(each) for each in fault.errors()]
        sentences = " ".join(str(each).strip() for each in faults)
        raise BadArgument(f"{sentences} `pliant options` lists every option.", code=str(faults[0].code)) from fault


def option_fields(options: Options | Mapping[str, Any] | None) -> dict[str, str]:
    """Return the form fields of a job's options. Raises as `checked_options`."""
    return {"options": checked_options(options).model_dump_json(exclude_unset=True)}
