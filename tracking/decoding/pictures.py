"""Films made of pictures: an animated GIF, a zip, or a folder."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from pliant.schemas.film_limits import FilmLimits
from pliant.schemas.pictures import SUFFIXES, pictures_in
from pliant.tracking.decoding.containers import openable
from pliant.tracking.errors import FilmError

FORMATS = ("PNG", "JPEG", "WEBP", "BMP")
DEFAULT_DURATION = 100
"""Display time, ms, of a GIF frame without a duration, as in browsers."""

LARGEST_DIRECTORY = 4 << 20
"""Maximum bytes of a zip's directory: 40,000 files with names of 50 letters."""

Colour = NDArray[np.uint8]

Listed = list[tuple[str, Callable[[], bytes]]]
"""Names of pictures, each with a function that reads it."""

NO_MEMORY = "Error -4 "
"""Start of zlib's message for Z_MEM_ERROR: `zlib.error` has no error number."""


@contextmanager
def readable(name: str, *, hint: str = "Save it again as PNG or JPEG.") -> Iterator[None]:
    """Convert errors of Pillow, zipfile and decompressors on broken files to `FilmError`, and zlib's lack of memory to `MemoryError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `checked` applies the film's own limit
            yield
    except (FilmError, MemoryError):
        raise
    except Exception as error:  # the decompressors' errors have no common class, and not every Python has all of them
        if str(error).startswith(NO_MEMORY):
            raise MemoryError(str(error)) from error
        fault = "its format is not recognised" if isinstance(error, UnidentifiedImageError) else error
        raise FilmError(
            "broken_picture", field="film", expected="pictures that can be decoded", got=f"{name}: {fault}",
            hint=hint,
        ) from error  # fmt: skip


def natural(name: str) -> tuple[tuple[int, str], ...]:
    """Return a sort key that places frame 10 after frame 9."""
    parts = re.findall(r"\d+|\D+", name.lower())
    return tuple((int(part[:18]), "") if part.isdecimal() else (-1, part) for part in parts)


def read_picture(data: bytes | Path, name: str, limits: FilmLimits) -> Colour:
    """Decode a picture upright, shape `(H, W, 3)`, RGB; its size is checked first.

    Raises
    ------
    FilmError
        Not a picture of an accepted format, broken, or of too many pixels.
    """
    with readable(name), Image.open(io.BytesIO(data) if isinstance(data, bytes) else data, formats=FORMATS) as picture:
        checked(picture.size, name, limits)
        return np.asarray(upright(picture).convert("RGB"))


def upright(picture: Image.Image) -> Image.Image:
    """Decode a picture, turned by its EXIF orientation; grey levels of 16 bits are reduced to 8, where Pillow would clip them."""
    turned = ImageOps.exif_transpose(picture)
    if turned.mode.startswith("I"):
        return Image.fromarray((np.asarray(turned) >> 8).astype(np.uint8))
    return turned


def checked(size: tuple[int, int], name: str, limits: FilmLimits) -> tuple[int, int]:
    """Return a size after checking that it is at least 16×16 and within the pixel limit.

    Raises
    ------
    FilmError
        Too small or too large.
    """
    width, height = size
    if width * height > limits.pixels:
        raise FilmError(
            "too_many_pixels", field="film", expected=f"at most {limits.pixels:,} pixels a frame",
            got=f"{name} of {width}×{height}", hint="Scale the film down: ffmpeg -i FILM -vf scale=1280:-2 film.mp4",
        )  # fmt: skip
    if min(width, height) < 16:
        raise FilmError(
            "too_small", field="film", expected="frames of at least 16×16 pixels", got=f"{name} of {width}×{height}",
            hint="Film at 640×480 or more.",
        )  # fmt: skip
    return width, height


def gif_frames(path: Path, limits: FilmLimits) -> Iterator[tuple[float, Colour]]:
    """Yield the frames of a GIF as time in seconds and picture."""
    hint = "Copy it again, or convert the frames that it has: ffmpeg -i FILM film.mp4"
    with readable(path.name, hint=hint), Image.open(path, formats=("GIF",)) as film:
        checked(film.size, path.name, limits)
        time, index = 0.0, 0
        while True:
            try:
                film.seek(index)
            except EOFError:
                return
            yield time / 1000, np.asarray(film.convert("RGB"))
            time += film.info.get("duration", 0) or DEFAULT_DURATION
            index += 1


def gif_length(path: Path) -> int:
    """Return the number of frames of a GIF, whose header states none, without decoding them."""
    with readable(path.name), Image.open(path, formats=("GIF",)) as film:
        return int(film.n_frames)  # type: ignore[attr-defined]


@contextmanager
def folder_pictures(path: Path, limits: FilmLimits) -> Iterator[Listed]:
    """List the pictures of a folder in natural order.

    Raises
    ------
    FilmError
        Not readable, no pictures, or more bytes than the limit.
    """
    with openable(path):
        files = sorted(pictures_in(path), key=lambda file: natural(file.name))
        size = sum(file.stat().st_size for file in files)
    _check_list(path.name, len(files), size, limits)
    yield [(file.name, partial(_read, file)) for file in files]


def _read(file: Path) -> bytes:
    with openable(file):
        return file.read_bytes()


@contextmanager
def zip_pictures(path: Path, limits: FilmLimits) -> Iterator[Listed]:
    """List the pictures of a zip in natural order; they can be read inside the `with` block.

    Raises
    ------
    FilmError
        Broken, encrypted, no pictures, or pictures that unpack to more bytes than the limit.
    """
    with readable(path.name):
        _check_directory(path)
        archive = zipfile.ZipFile(path)
    with archive:  # open throughout, because opening it again for every picture would parse its directory every time
        entries = [
            entry
            for entry in archive.infolist()
            if entry.filename.lower().endswith(SUFFIXES) and not re.search(r"(^|/)(\.|__MACOSX/)", entry.filename)
        ]
        entries.sort(key=lambda entry: natural(entry.filename))
        _check_list(path.name, len(entries), sum(entry.file_size for entry in entries), limits)
        yield [(entry.filename, partial(_unpack, archive, entry)) for entry in entries]


def _unpack(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Read one picture of a zip, at most as many bytes as its directory entry gives, which the limit covers."""
    with readable(entry.filename), archive.open(entry) as stream:
        return stream.read(entry.file_size)


def _check_directory(path: Path) -> None:
    """Reject a zip whose directory would fill the memory before its entries can be counted."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(max(0, size - 65_557))
        tail = stream.read()
    end = tail.rfind(b"PK\x05\x06")
    directory = int.from_bytes(tail[end + 12 : end + 16], "little") if end >= 0 else 0
    if directory > LARGEST_DIRECTORY:
        raise FilmError(
            "too_many_pictures", field="film", expected=f"a zip directory of at most {LARGEST_DIRECTORY:,} bytes",
            got=f"{directory:,} in {path.name}", hint="Put fewer pictures in the zip.",
        )  # fmt: skip


def _check_list(name: str, count: int, size: int, limits: FilmLimits) -> None:
    if count == 0:
        raise FilmError(
            "no_picture", field="film", expected=f"pictures ({', '.join(SUFFIXES)})", got=f"none in {name}",
            hint="Export the film's frames as PNG or JPEG, numbered in order.",
        )  # fmt: skip
    if size > limits.bytes:
        raise FilmError(
            "too_many_bytes", field="film", expected=f"pictures of at most {limits.bytes:,} bytes together",
            got=f"{size:,} in {name}", hint="Use fewer or smaller pictures.",
        )  # fmt: skip
