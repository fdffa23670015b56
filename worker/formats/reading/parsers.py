"""The parsers that run in the sandbox, by name, and the detection of their formats."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import IO

from pliant.solver import InvalidInput
from pliant.worker.formats.errors import too_large
from pliant.worker.formats.reading.arrays import (
    ARRAY_FILES,
    FILES,
    film_as_tracks,
    pickle_refusal,
    spreadsheet_refusal,
)
from pliant.worker.formats.reading.csv import UTF_16, looks_like_csv
from pliant.worker.formats.records import Arrays, Limits


@dataclass(frozen=True, slots=True)
class Parser:
    """A parser by module and name, so that the sandbox imports only the libraries of the parser it runs."""

    module: str
    function: str

    def load(self) -> Callable[..., Arrays]:
        """Return the function; the sandbox process calls this before it gives up the right to open files."""
        found: Callable[..., Arrays] = getattr(
            import_module(f"pliant.worker.formats.reading.{self.module}"), self.function
        )
        return found

    def __call__(self, stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
        """Parse."""
        return self.load()(stream, field=field, limits=limits)


PARSERS = {
    "matlab5": Parser("matlab", "read_matlab5"),
    "matlab73": Parser("pose_hdf5", "read_hdf5"),
    "csv": Parser("csv", "read_csv"),
    "json": Parser("pose_json", "read_landmarks"),
    "obj": Parser("meshes", "read_obj"),
    "ply": Parser("meshes", "read_ply"),
    "glb": Parser("gltf", "read_glb"),
    "gltf": Parser("gltf", "read_gltf"),
    "png": Parser("mask", "read_png"),
}
MATLAB_5, HDF5 = b"MATLAB 5.0", b"\x89HDF\r\n\x1a\n"
PICTURES = {b"\x89PNG\r\n": "png", b"\xff\xd8\xff": "jpeg", b"BM": "bmp", b"II*\0": "tiff", b"MM\0*": "tiff"}
OFFICE = b"\xd0\xcf\x11\xe0"
DOCUMENTS = {
    b"%PDF": "a PDF document", b"PK\x03\x04": "a zip archive", OFFICE: "an Office document (xls, doc)",
    b"\x1f\x8b": "a gzip archive", b"7z\xbc\xaf": "a 7z archive", b"Rar!": "a RAR archive", b"\xfd7zXZ": "an xz archive",
    b"ID3": "a sound recording (mp3)", b"\0asm": "a program", b"\x7fELF": "a program", b"MZ": "a program",
    b"SQLite format 3": "an SQLite database", HDF5: "an HDF5 file",
}  # fmt: skip
VERSION_4 = {1000 * order + 10 * numbers + matrix for order in range(5) for numbers in range(6) for matrix in range(3)}
"""Kinds of matrices in MATLAB files of version 4."""
OCTAVE = (b"# Created by Octave", b"Octave-1-")
EXAMPLES = {
    "tracks": "numpy.savez('tracks.npz', tracks=points, visibility=visible)",
    "mesh": "numpy.savez('mesh.npz', faces=faces), with indices from 0",
    "ground_truth": "numpy.savez('truth.npz', shapes=shapes)",
    "rotations": "numpy.savez('rotations.npz', rotations=rotations)",
}
"""How to write a file for each field."""
PICKLE = tuple(bytes([0x80, version]) for version in range(2, 6))


def recognise(head: bytes, field: str) -> str:
    """Return the name of the parser for a file, from its first kilobyte.

    Raises
    ------
    InvalidInput
        Codes film_as_tracks, pickle_refused, picture_as_tracks, unknown_format.
    """
    if head.startswith(PICKLE):
        raise pickle_refusal(field)
    if field == "tracks":
        _refuse_pictures(head)
    starts = {MATLAB_5: "matlab5", b"ply\n": "ply", b"ply\r": "ply", b"glTF": "glb", b"\x89PNG\r\n": "png"}
    for start, name in starts.items():
        if head.startswith(start) and not (field == "mesh" and name == "matlab5"):
            return name
    if field != "mesh" and (head.startswith(HDF5) or head[512:].startswith(HDF5)):
        return "matlab73"
    if _is_text(head):
        if field == "mesh":
            return "gltf" if head.lstrip().startswith(b"{") else "obj"
        if field == "tracks" and head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"[", b"{")):
            return "json"
    if field == "tracks" and (_is_text(head) or head.startswith(UTF_16)) and looks_like_csv(head):
        return "csv"
    raise unknown_format(field, head)


def parse(parser: Callable[..., Arrays], stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Run a parser; arrays above the limit and a MemoryError become input errors, since the limits are sufficient for valid files."""
    try:
        arrays = parser(stream, field=field, limits=limits)
    except MemoryError as error:
        raise too_large(field, expected="a file that fits into memory", got="one that does not") from error
    size = sum(array.nbytes for array in arrays.values())
    if size > limits.max_bytes:
        raise too_large(field, expected=f"at most {limits.max_bytes:,} bytes of arrays", got=f"{size:,} bytes")
    return arrays


def unknown_format(field: str, head: bytes) -> InvalidInput:
    """Return the error for a file of an unknown format."""
    if head.startswith(OFFICE):
        return spreadsheet_refusal(field, DOCUMENTS[OFFICE])
    kinds, example = FILES.get(field, ARRAY_FILES), EXAMPLES.get(field, EXAMPLES["tracks"])
    matlab = _matlab_kind(head)
    hint = f"Convert it, e.g. {example}."
    if matlab is not None and field != "mesh":
        hint = "Save it in MATLAB's version 7, e.g. save('tracks.mat', 'W', '-v7')."
    return InvalidInput(
        "unknown_format", field=field, expected=f"{kinds}, recognised by content", got=matlab or _in_words(head), hint=hint,
    )  # fmt: skip


def _matlab_kind(head: bytes) -> str | None:
    """Return the kind of file of MATLAB or Octave; None if it is none.

    Version 4 has no signature. It begins with five integers: kind (decimal digits for byte order, 0, numbers and matrix), rows, columns,
    whether there is an imaginary part, and the length of the name with the zero at its end.
    """
    if head.startswith(OCTAVE):
        return "a file in Octave's own format"
    if head.startswith(b"MATLAB "):
        return "a MATLAB file"
    for order in "<>" if len(head) > 20 else "":
        kind, _, _, imaginary, length = struct.unpack_from(f"{order}5i", head)
        name, zero = head[20 : 19 + length], head[19 + length : 20 + length]
        if kind in VERSION_4 and imaginary in (0, 1) and name.replace(b"_", b"").isalnum() and zero == b"\0":
            return "a MATLAB file of version 4"
    return None


def _in_words(head: bytes) -> str:
    """Describe a file of unknown format by its first bytes."""
    if _is_text(head) and not head.startswith(b"%PDF"):
        start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
        if start.startswith(b"<"):
            return "a web page or XML"
        begins = start.decode("utf-8", "replace").splitlines()[0][:40] if start else ""
        if begins.count("\ufffd") <= len(begins) // 4:  # text with a few letters in another encoding
            return f"text that begins {begins!r}" if begins else "blank text"
    if head.startswith(UTF_16):
        begins = next(iter(head.decode("utf-16", "replace").strip().splitlines()), "")[:40]
        if begins.isprintable():
            return f"UTF-16 text that begins {begins!r}" if begins else "blank UTF-16 text"
    pictures = {start: f"a picture ({name})" for start, name in PICTURES.items()}
    unknown = f"a file of an unknown kind, which begins with the bytes {head[:8].hex(' ')}"
    return next((name for start, name in (pictures | DOCUMENTS).items() if head.startswith(start)), unknown)


def _refuse_pictures(head: bytes) -> None:
    """Reject films and pictures that were sent as tracks, with a hint on how to send them."""
    kind = film_kind(head)
    if kind is not None:
        raise film_as_tracks(f"a film ({kind})")
    kind = next((name for start, name in PICTURES.items() if head.startswith(start)), None)
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        kind = "webp"
    if kind is not None:
        raise InvalidInput(
            "picture_as_tracks", field="tracks", expected="point tracks over several frames", got=f"a single picture ({kind})",
            hint="Depth comes from motion: send a film, or a zip of all its pictures, as the film.",
        )  # fmt: skip


def film_kind(head: bytes) -> str | None:
    """Return the kind of film that starts with these bytes; None if it is none."""
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide"):
        return "mp4 or mov"
    if head.startswith(b"\x1aE\xdf\xa3"):
        return "webm or mkv"
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return "avi"
    return "gif" if head.startswith(b"GIF8") else None


def _is_text(head: bytes) -> bool:
    return b"\0" not in head and sum(byte < 9 or 13 < byte < 32 for byte in head) == 0
