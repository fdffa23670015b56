"""Safe reading of .npy and .npz files: headers are validated before anything is inflated, and nothing is unpickled.

`numpy.load` inflates any declared size (a megabyte can become a gigabyte), takes the last of two members of the same name, and
unpickles object arrays if allowed. Here the zip directory and every header are read first; then exactly as many bytes as the header
declares are read, into memory that the system allocates as it is filled.
"""

from __future__ import annotations

import ast
import errno
import math
import os
import re
import struct
import threading
import zipfile
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged, too_large
from pliant.worker.formats.reading.pose_tables import EXAMPLE
from pliant.worker.formats.records import Arrays, Limits

NPY_MAGIC = b"\x93NUMPY"
MAX_HEADER = 4096
MAX_DIMENSIONS = 8
MAX_DIRECTORY = 1 << 20
CHUNK = 1 << 20
MEMBER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,120}\.npy")
_ONE_AT_A_TIME = threading.Lock()
"""Python 3.11's parser of literals now and then raises SystemError while several threads use it."""
UNREADABLE_ZIP = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, OverflowError, struct.error, UnicodeDecodeError,
)  # fmt: skip
"""Exceptions of Python's zip reader for invalid files."""

TRACK_FILES = "npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports"
MESH_FILES = "npz, npy, OBJ, PLY, glTF, GLB or a PNG mask"
ARRAY_FILES = "npz, npy or MATLAB .mat"
"""Supported files of tracks, of meshes, and of true shapes and rotations, as named in error messages."""

FILES = {"tracks": TRACK_FILES, "mesh": MESH_FILES}

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
"""Names of pictures. Not all of these formats are accepted as a film."""

END_OF_DIRECTORY = b"PK\x05\x06"
ZIP64_LOCATOR = b"PK\x06\x07"


@dataclass(frozen=True, slots=True)
class Header:
    """The header of a .npy file."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[np.generic]
    bytes: int
    """Bytes of the data that must follow."""


def read_npy(stream: IO[bytes], size: int, *, field: str, limits: Limits, texts: bool = False) -> NDArray[np.generic]:
    """Read one array of numbers, or of strings with `texts`, from a stream that holds `size` bytes.

    Raises
    ------
    InvalidInput
        Codes damaged_file, object_array, wrong_type, too_large.
    """
    header, used = read_header(stream, field=field, limits=limits, texts=texts)
    if header.bytes != size - used:
        raise damaged(field, f"a header that declares {header.bytes:,} bytes before {size - used:,} bytes of data")
    flat = np.zeros(header.bytes, dtype=np.uint8)
    view = flat.data
    filled = 0
    while filled < header.bytes:
        got = stream.read(min(CHUNK, header.bytes - filled))
        if not got:
            raise damaged(field, f"{filled:,} of {header.bytes:,} bytes")
        view[filled : filled + len(got)] = got
        filled += len(got)
    array = flat.view(header.dtype).reshape(header.shape, order="F" if header.fortran else "C")
    return array.astype(header.dtype.newbyteorder("="), copy=False)


def read_header(stream: IO[bytes], *, field: str, limits: Limits, texts: bool = False) -> tuple[Header, int]:
    """Read and check only the header; return it and its length in bytes. With `texts`, the array must hold strings, otherwise numbers."""
    start = stream.read(8)
    if start[:6] != NPY_MAGIC or len(start) < 8:
        raise damaged(field, "no NumPy header")
    wide = start[6] >= 2
    length_bytes = stream.read(4 if wide else 2)
    length = int.from_bytes(length_bytes, "little")
    if start[6] not in (1, 2, 3) or length > MAX_HEADER:
        raise damaged(field, f"a NumPy header of version {start[6]} and {length:,} bytes")
    text = stream.read(length)
    if len(text) != length:
        raise damaged(field, "a header that is cut off")
    described = _header_dictionary(text, field)
    return _checked(described, field, limits, texts=texts), 8 + len(length_bytes) + length


def read_npz(
    path: Path, *, field: str, limits: Limits, wanted: Collection[str] | None = None, texts: Collection[str] = ()
) -> tuple[Arrays, dict[str, str]]:
    """Read the wanted members of a zip of arrays; those named in `texts` hold strings, the others numbers.

    Returns the arrays by name, without `.npy`, and the skipped members with the reason.

    Raises
    ------
    InvalidInput
        Codes damaged_file, duplicate_member, film_as_tracks, member_name, object_array, pickle_refused, too_large, unknown_format,
        unsupported_feature, wrong_type.
    """
    check_directory(path, field=field)
    arrays: Arrays = {}
    passed_over: dict[str, str] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = checked_members(archive, field=field, limits=limits, wanted=wanted)
            for name, member in members.items():
                if wanted is not None and name not in wanted:
                    passed_over[name] = "not known"
                    continue
                with archive.open(member) as stream:
                    arrays[name] = read_npy(
                        stream, member.file_size, field=f"{field}.{name}", limits=limits, texts=name in texts
                    )
    except UNREADABLE_ZIP as error:
        # A directory may point before the file (EINVAL); otherwise the disk failed.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise damaged(field, f"a zip file that cannot be read ({error})") from error
    return arrays, passed_over


def shapes_of_members(path: Path) -> dict[str, tuple[int, ...] | None]:
    """Return names and shapes of the arrays of an npz that `read_npz` accepted; None for one that is not of numbers."""
    shapes: dict[str, tuple[int, ...] | None] = {}
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            try:
                with archive.open(info) as stream:
                    shapes[name] = read_header(stream, field=name, limits=Limits())[0].shape
            except (*UNREADABLE_ZIP, InvalidInput):
                shapes[name] = None
    return shapes


def check_directory(path: Path, *, field: str) -> None:
    """Check the size of a zip's directory before the library builds an object for each of its entries."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - (1 << 16) - 22))
        tail = file.read()
    at = tail.rfind(END_OF_DIRECTORY)
    if at < 0 or len(tail) - at < 22:
        raise damaged(field, "a zip file without its directory, probably cut off")
    directory = struct.unpack("<4s4H2LH", tail[at : at + 22])[5]
    if directory > MAX_DIRECTORY or tail[max(0, at - 20) : at].startswith(ZIP64_LOCATOR):
        raise too_large(field, expected="a zip directory below 1 MiB", got=f"{directory} bytes or a 64-bit directory")


def checked_members(
    archive: zipfile.ZipFile, *, field: str, limits: Limits, wanted: Collection[str] | None = None
) -> dict[str, zipfile.ZipInfo]:
    """Return the members by array name after checking names, number, compression, and the declared size of the wanted ones."""
    infos = archive.infolist()
    spreadsheet = spreadsheet_kind([info.filename for info in infos])
    if spreadsheet is not None:
        raise spreadsheet_refusal(field, spreadsheet)
    if len(infos) > limits.max_members:
        raise too_large(field, expected=f"at most {limits.max_members:,} members", got=f"{len(infos)}")
    if any(info.filename.endswith("data.pkl") for info in infos):
        raise pickle_refusal(field)
    if (
        field == "tracks"
        and infos
        and all(info.filename.lower().endswith(PICTURE_SUFFIXES) or info.is_dir() for info in infos)
    ):
        raise film_as_tracks("a zip of pictures")
    members: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        if MEMBER.fullmatch(info.filename) is None or ".." in info.filename:
            raise InvalidInput(
                "member_name", field=field, expected="members named like tracks.npy", got=repr(info.filename[:80]),
                hint="Write the file with numpy.savez and plain names.",
            )  # fmt: skip
        name = info.filename.removesuffix(".npy")
        if name in members:
            raise InvalidInput(
                "duplicate_member", field=field, expected="each member once", got=f"{name!r} twice",
                hint="Write the file again with numpy.savez.",
            )  # fmt: skip
        if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InvalidInput(
                "unsupported_feature", field=field, expected="stored or deflated members",
                got=f"{name!r} encrypted or compressed with another method",
                hint="Write the file with numpy.savez or numpy.savez_compressed.",
            )  # fmt: skip
        members[name] = info
    declared = sum(info.file_size for name, info in members.items() if wanted is None or name in wanted)
    if declared > limits.max_bytes:
        raise too_large(field, expected=f"at most {limits.max_bytes:,} bytes inflated", got=f"{declared:,} bytes")
    return members


def film_as_tracks(got: str) -> InvalidInput:
    """Return the error for a film that was sent as tracks."""
    return InvalidInput(
            "film_as_tracks", field="tracks", expected="point tracks", got=got,
        hint="Send it as the film instead (on the page: under Film; REST: -F film=@film.mp4; Python: submit(film=…)): its points are "
        "tracked for you.",
    )  # fmt: skip


def spreadsheet_refusal(field: str, got: str) -> InvalidInput:
    """Return the error for a spreadsheet program's own file, with a hint on how to save it."""
    kinds = FILES.get(field, ARRAY_FILES)
    hint = (
        f"Save it as CSV in the spreadsheet program. {EXAMPLE}"
        if field == "tracks"
        else "Write the arrays with numpy.savez."
    )
    return InvalidInput("unknown_format", field=field, expected=f"{kinds}, recognised by content", got=got, hint=hint)


def spreadsheet_kind(members: Collection[str]) -> str | None:
    """Return the kind of spreadsheet that a zip with these members is; None if it is none."""
    if "[Content_Types].xml" in members and any(name.startswith("xl/") for name in members):
        return "a spreadsheet (xlsx)"
    return "an OpenDocument file (ods)" if "mimetype" in members and "content.xml" in members else None


def pickle_refusal(field: str) -> InvalidInput:
    """Return the error for pickles, which run code when they are read."""
    return InvalidInput(
        "pickle_refused", field=field, expected="arrays that can be read without running code", got="a Python pickle",
        hint="Convert it where it was made: numpy.savez('tracks.npz', tracks=..., visibility=...); for a torch tensor use .cpu().numpy().",
    )  # fmt: skip


def read_file(
    path: Path, *, field: str, limits: Limits, wanted: Collection[str] | None = None, texts: Collection[str] = ()
) -> Arrays:
    """Read a .npy file (as `array`) or a zip of them; the arrays named in `texts` hold strings."""
    size = path.stat().st_size
    if size > limits.max_bytes:
        raise too_large(field, expected=f"a file of at most {limits.max_bytes:,} bytes", got=f"{size:,} bytes")
    with path.open("rb") as file:
        if file.read(6) == NPY_MAGIC:
            file.seek(0, os.SEEK_SET)
            return {"array": read_npy(file, size, field=field, limits=limits)}
    return read_npz(path, field=field, limits=limits, wanted=wanted, texts=texts)[0]


def _header_dictionary(text: bytes, field: str) -> dict[str, object]:
    try:
        with _ONE_AT_A_TIME:
            described = ast.literal_eval(text.decode("utf-8"))
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        raise damaged(field, "a NumPy header that is not a Python dictionary") from error
    if not isinstance(described, dict) or set(described) != {"descr", "fortran_order", "shape"}:
        raise damaged(field, "a NumPy header with other entries than descr, fortran_order and shape")
    return described


def _checked(described: dict[str, object], field: str, limits: Limits, *, texts: bool) -> Header:
    shape, fortran, spelled = described["shape"], described["fortran_order"], described["descr"]
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise damaged(field, "a NumPy header whose shape is not a tuple of whole numbers")
    if len(shape) > MAX_DIMENSIONS or not isinstance(fortran, bool):
        raise damaged(field, f"a NumPy header of {len(shape)} dimensions, fortran_order {fortran!r}")
    if not isinstance(spelled, str) or re.fullmatch(r"[<>|=][a-zA-Z]\d{0,4}", spelled) is None:
        raise InvalidInput(
            "wrong_type", field=field, expected="an array of numbers or bool", got=f"dtype {str(spelled)[:60]}",
            hint="Give one plain array for each name.",
        )  # fmt: skip
    if spelled[1] == "O":
        plain = "numpy.array(x, dtype=str)" if texts else "numpy.asarray(x, dtype=float)"
        raise InvalidInput(
            "object_array", field=field, expected=f"an array of {'texts' if texts else 'numbers'}", got="an array of Python objects",
            hint=f"Reading objects can run code, so they are refused: save plain arrays, e.g. {plain}.",
        )  # fmt: skip
    try:
        dtype: np.dtype[np.generic] = np.dtype(spelled)
    except TypeError as error:
        raise damaged(field, f"an unknown dtype {spelled}") from error
    if texts:
        if dtype.kind not in "US" or dtype.itemsize == 0:
            raise InvalidInput(
                "wrong_type", field=field, expected="an array of texts", got=f"dtype {dtype}", hint="Save numpy.array(names, dtype=str).",
            )  # fmt: skip
    elif dtype.kind not in "fiub" or dtype.itemsize > 8:
        raise InvalidInput(
            "wrong_type", field=field, expected="real numbers or bool of at most 64 bits", got=f"dtype {dtype}",
            hint="Convert the array to float64.",
        )  # fmt: skip
    count = math.prod(shape) * dtype.itemsize
    if count > limits.max_bytes:
        raise too_large(
            field, expected=f"at most {limits.max_bytes:,} bytes", got=f"{shape} of {dtype}: {count:,} bytes"
        )
    return Header(shape, fortran, dtype, count)
