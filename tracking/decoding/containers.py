"""Recognise films by their content, before any decoder sees them.

FFmpeg chooses a demuxer by probing, and some of its formats (HLS, concat, SDP, DASH) are text files that refer to other files or addresses.
Only the binary containers below are accepted, and QuickTime files only if their samples are in the same file.
"""

from __future__ import annotations

import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Literal

from pliant.tracking.errors import FilmError

Container = Literal["mp4", "matroska", "avi", "gif", "zip", "folder"]

ACCEPTED = "an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures"
MAX_BOXES = 20_000
"""Maximum number of boxes in an MP4 file. A fragmented film has two for every fragment of about a second."""

MAX_STREAMS = 16
"""Maximum number of streams in one film; a camera writes two to five (picture, sound, metadata)."""

MP4_BOXES = {b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot"}
NESTED = {b"moov", b"trak", b"edts", b"mdia", b"minf", b"dinf"}
ARRAYS = (b"\x93NUMPY", b"\x89HDF", b"MATLAB 5.0")
"""First bytes of npy, HDF5 (MATLAB 7.3, SLEAP, DeepLabCut) and MATLAB 5 files, which hold tracks."""
PICTURES = (b"\x89PNG", b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*")
"""First bytes of PNG, JPEG, BMP and TIFF pictures."""
TABLES = (".csv", ".tsv", ".json")
"""Names of text files that hold tracks."""
PHOTOS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"avif")
"""Brands of single pictures in the boxes of an MP4 file (ISO/IEC 23008-12, and AVIF)."""
MATRICES = {b"tkhd": 40, b"mvhd": 36}
"""Boxes with a display matrix, and its place in their content, bytes; 12 bytes later in version 1."""
READ = {b"hdlr", b"dref", b"elst", *MATRICES}
"""Boxes whose content is read."""
TEXTS = (b"#EXT", b"ffconcat", b"v=0", b"<?xml", b"<MPD", b"[playlist]", b"http", b"rtsp", b"file:")


def recognise(path: Path) -> Container:
    """Return the kind of film at a path.

    Raises
    ------
    FilmError
        It does not exist, is no file or folder, cannot be read, is empty, is a playlist, refers to other files, holds no picture, is
        mirrored, or is none of the accepted kinds; or its path is not valid UTF-8, which OpenCV needs.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        got = str(path).encode(errors="replace").decode()
        raise FilmError(
            "unreadable_film", field="film", expected="a path of valid UTF-8", got=got, hint="Rename the file or folder.",
        ) from None  # fmt: skip
    if _file_or_folder(path) == "folder":
        return "folder"
    with openable(path), path.open("rb") as stream:
        return _recognise_stream(stream, path.name)


def _file_or_folder(path: Path) -> Literal["file", "folder"]:
    """Return whether a path is a file or a folder.

    Raises
    ------
    FilmError
        Neither: opening a pipe or a device may wait forever. Or it does not exist, or the system does not let it be looked at.
    """
    with openable(path):
        try:
            mode = path.stat().st_mode
        except ValueError as error:  # a NUL in the name
            raise _refusal("unreadable_film", f"{path.name!r}: {error}", "Check the path.") from error
    if stat.S_ISDIR(mode):
        return "folder"
    if not stat.S_ISREG(mode):
        raise _refusal(
            "unreadable_film", f"{path.name}, a pipe or a device", "Save the film in a file and pass its path."
        )
    return "file"


@contextmanager
def openable(path: Path) -> Iterator[None]:
    """Convert the system's errors on opening or reading a film, a folder or a picture of it to `FilmError`."""
    try:
        yield
    except OSError as error:
        raise _refusal("unreadable_film", f"{path.name}: {error.strerror}", "Check the path.") from error


def _recognise_stream(stream: BinaryIO, name: str) -> Container:
    head = stream.read(4096)
    if not head:
        raise _refusal("empty_film", f"{name}, which is empty", "Copy the film again.")
    if head[4:8] == b"ftyp" and head[8:12] in PHOTOS:
        raise _refusal("unsupported_film", f"{name}, a single photograph (HEIF or AVIF)", "Pass a film of the object.")
    if head[4:8] in MP4_BOXES:
        _check_mp4(stream, name)
        return "mp4"
    if head[:4] == b"\x1aE\xdf\xa3" and (b"webm" in head[:64] or b"matroska" in head[:64]):
        return "matroska"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        _check_avi(head, name)
        return "avi"
    if head[:6] in (b"GIF87a", b"GIF89a"):
        return "gif"
    if _holds_arrays(head, name):
        raise _refusal(
            "tracks_as_film", f"{name}, a file of tracks",
            "Send it as the tracks instead (on the page: under Tracks; REST: -F tracks=@tracks.npz; Python: submit('tracks.npz'); "
            "command line: pliant solve tracks.npz).",
        )  # fmt: skip
    if head[:4] == b"PK\x03\x04":
        return "zip"
    if head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(TEXTS):
        raise _refusal(
            "playlist", f"{name}, a playlist or text that refers to other files",
            "Pass the film itself; other files and addresses are never opened.",
        )  # fmt: skip
    if (head[8:16] == b"WEBPVP8X" and int.from_bytes(head[20:21]) & 2) or (
        head.startswith(b"\x89PNG") and b"acTL" in head
    ):
        raise _refusal(
            "unsupported_film", f"{name}, an animated WebP or PNG", "Convert it to an animated GIF or an mp4 film."
        )
    if head.startswith(PICTURES) or (head[:4] == b"RIFF" and head[8:12] == b"WEBP"):
        raise _refusal(
            "unsupported_film", f"{name}, a single picture",
            "Depth comes from motion: pass a film, or a zip or folder with all its pictures.",
        )  # fmt: skip
    raise _refusal("unsupported_film", f"{name}, which is none of these", "Convert it: ffmpeg -i FILM film.mp4")


def _holds_arrays(head: bytes, name: str) -> bool:
    """Return whether a file holds arrays or a table rather than pictures, by its first bytes, its members or its name."""
    if head.startswith(ARRAYS) or head[512:].startswith(b"\x89HDF"):
        return True
    if head.startswith(b"PK\x03\x04"):
        length = int.from_bytes(head[26:28], "little")
        return head[30 : 30 + length].endswith(b".npy")  # the name of the first member
    return Path(name).suffix.lower() in TABLES and b"\0" not in head


def _check_mp4(stream: BinaryIO, name: str) -> None:
    """Check the boxes of an MP4 or QuickTime file: an index, a picture track that is not mirrored, and all samples in the same file."""
    end = os.fstat(stream.fileno()).st_size
    kinds: list[bytes] = []
    streams = 0
    for count, (kind, body) in enumerate(_boxes(stream, end)):
        if count > MAX_BOXES:
            raise _refusal(
                "unsupported_film", f"{name} with over {MAX_BOXES} boxes", "Convert it: ffmpeg -i FILM film.mp4"
            )
        kinds.append(kind)
        streams += kind == b"trak"
        if streams > MAX_STREAMS:
            raise _refusal(
                "too_many_streams",
                f"{name} with over {MAX_STREAMS} streams",
                "Keep the picture: ffmpeg -i FILM -map 0:v:0 film.mp4",
            )
        if kind == b"hdlr":
            kinds.append(b"hdlr:" + body[8:12])
        if kind in MATRICES and _mirrors(body, MATRICES[kind]):
            raise _refusal(
                "unsupported_film", f"{name}, which is to be shown mirrored", "Convert it: ffmpeg -i FILM film.mp4"
            )
        if kind == b"dref" and not _self_contained(body):
            raise _refusal(
                "external_reference", f"{name}, whose samples lie in another file",
                "Export the film with its media inside; other files and addresses are never opened.",
            )  # fmt: skip
        if kind in (b"cmov", b"rmra"):
            raise _refusal(
                "external_reference", f"{name} with a {kind.decode()} box", "Convert it: ffmpeg -i FILM film.mp4"
            )
    if b"moov" not in kinds:
        raise _refusal(
            "truncated_film", f"{name}, which has no index (moov): it was cut off before the recording ended",
            "Copy it again, or film again.",
        )  # fmt: skip
    if b"hdlr:vide" not in kinds:
        raise _refusal("no_picture", f"{name}, which holds sound but no picture", "Pass a film with a picture track.")


def edited_seconds(path: Path) -> float | None:
    """Return the length of the edit list of an MP4 or QuickTime film's picture; None without such a list.

    A film that was cut without being encoded again contains frames that its edit list leaves out (ISO/IEC 14496-12, 8.6.6).
    """
    scale, track, seconds = 0, b"", 0.0
    with openable(path), path.open("rb") as stream:
        for kind, body in _boxes(stream, os.fstat(stream.fileno()).st_size):
            wide = body[:1] == b"\1"
            if kind == b"mvhd":
                scale = int.from_bytes(body[20:24] if wide else body[12:16])
            if kind == b"hdlr" and body[4:8] != b"dhlr":  # which describes where QuickTime's data lies
                track = body[8:12]
            if kind == b"elst" and track == b"vide" and scale > 0:
                entry = struct.Struct(">Q12x" if wide else ">I8x")
                whole = len(body[8:]) // entry.size * entry.size
                seconds = sum(length for (length,) in entry.iter_unpack(body[8 : 8 + whole])) / scale
    return seconds or None


def _boxes(stream: BinaryIO, end: int) -> Iterator[tuple[bytes, bytes]]:
    """Yield the type of all boxes, descending into those of `NESTED`, with the first bytes of those of `READ`."""
    pending = [(0, end)]
    while pending:
        place, stop = pending.pop()
        while place + 8 <= stop:
            stream.seek(place)
            header = stream.read(16)
            if len(header) < 8:
                break
            size, kind = struct.unpack(">I4s", header[:8])
            inner = place + 8
            if size == 1 and len(header) == 16:
                size, inner = struct.unpack(">Q", header[8:])[0], place + 16
            size = stop - place if size == 0 else size
            if size < inner - place:
                break
            following = min(place + size, stop)
            stream.seek(inner)
            yield kind, stream.read(min(4096, following - inner)) if kind in READ else b""
            if kind in NESTED:
                pending.append((inner, following))
            place = following


def _mirrors(body: bytes, place: int) -> bool:
    """Return whether the display matrix at a place of a box's content, given for version 0, mirrors the picture.

    The first two rows are a, b, u, c, d, v: a pixel (p, q) is shown at (a p + c q, b p + d q) (ISO/IEC 14496-12, 6.2.2). OpenCV applies
    the rotation only.
    """
    place += 12 if body[:1] == b"\1" else 0
    if len(body) < place + 24:
        return False
    a, b, _, c, d, _ = struct.unpack_from(">6i", body, place)
    return bool(a * d - b * c < 0)


def _self_contained(body: bytes) -> bool:
    """Return whether all data references of a `dref` box are marked as being in the same file (flag 1)."""
    count = int.from_bytes(body[4:8], "big")
    place = 8
    for _ in range(min(count, MAX_STREAMS)):
        if len(body) < place + 12:
            return False
        size = int.from_bytes(body[place : place + 4], "big")
        if not body[place + 11] & 1 or size < 12:
            return False
        place += size
    return count <= MAX_STREAMS


def _check_avi(head: bytes, name: str) -> None:
    """Check the number of streams in the main header."""
    place = head.find(b"avih")
    if place < 0 or len(head) < place + 36:
        raise _refusal("truncated_film", f"{name} without its header (avih)", "Copy it again.")
    streams = int.from_bytes(head[place + 32 : place + 36], "little")
    if streams > MAX_STREAMS:
        raise _refusal(
            "too_many_streams", f"{name} with {streams} streams", "Keep the picture: ffmpeg -i FILM -map 0:v:0 film.mp4"
        )


def _refusal(code: str, got: str, hint: str) -> FilmError:
    return FilmError(code, field="film", expected=ACCEPTED, got=got, hint=hint)
