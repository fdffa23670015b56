"""A film and the region to track, as separate files or stored together as the inputs of a job."""

from __future__ import annotations

import json
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path

from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.reading.arrays import PICTURE_SUFFIXES, spreadsheet_kind
from pliant.worker.formats.reading.parsers import film_kind

VERSION = 1
_MARK, _FILM, _REGION = "film.json", "film", "region"
"""Members of a stored source: version and file names, the film, the mask picture."""

SUFFIXES = (
    ".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".gif", ".m3u8", ".3gp",
    ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".flv", ".ogv", ".webp",
)  # fmt: skip
"""Names of films; those in the second row are refused, with advice for films."""


@dataclass(frozen=True, slots=True)
class FilmSource:
    """A film and the region to track."""

    film: Path
    """A film, a zip of pictures, or (on the command line) a folder of pictures."""

    region: Path | None = None
    """Mask picture of the film's size; None: the option `region_polygon`, or the complete frame."""

    film_name: str = ""
    """The user's file name of the film, for messages; empty: the name in its path."""

    region_name: str = ""
    """The same for the mask picture."""

    own_rate: bool = False
    """Whether the job sets the frame rate (`fps`) itself; otherwise it is that of the tracked frames."""

    def has_region(self, options: Options) -> bool:
        """Return whether a region was given, as a picture or in the options."""
        return self.region is not None or options.region_polygon is not None

    @property
    def names(self) -> dict[str, str]:
        """Name of each file in messages."""
        region = "" if self.region is None else self.region_name or self.region.name
        return {"film": self.film_name or self.film.name, "region": region}


def looks_like_film(path: Path) -> bool:
    """Return whether a command-line argument is a film rather than tracks, by content, then by name."""
    if path.is_dir():
        return True
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError:
        return path.suffix.lower() in SUFFIXES
    animated = head.startswith(b"\x89PNG") and b"acTL" in head  # refused, with advice for films
    if film_kind(head) is not None or animated:
        return True
    if head.startswith(b"PK") and path.suffix.lower() != ".npz":
        return _holds_pictures(path)
    return path.suffix.lower() in SUFFIXES


def _holds_pictures(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return False
    return spreadsheet_kind(names) is None and any(name.lower().endswith(PICTURE_SUFFIXES) for name in names)


def save_source(source: FilmSource, interpretation: Interpretation, target: Path) -> None:
    """Store film and region in one file, uncompressed; `open_source` restores them byte for byte."""
    stated = {
        "version": VERSION,
        "film": source.film.suffix.lower(),
        "region": None if source.region is None else source.region.suffix.lower(),
        "names": source.names,
        "own_rate": source.own_rate,
        "interpretation": interpretation.model_dump(mode="json"),
    }
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(_MARK, json.dumps(stated))
        archive.write(source.film, _FILM)
        if source.region is not None:
            archive.write(source.region, _REGION)


def is_source(path: Path) -> bool:
    """Return whether `save_source` wrote this file; False for other inputs of a job."""
    try:
        with zipfile.ZipFile(path) as archive:
            return _MARK in archive.namelist()
    except zipfile.BadZipFile:
        return False


def open_source(path: Path, folder: Path) -> FilmSource:
    """Unpack a stored source into a new folder.

    Raises
    ------
    InvalidInput
        Code damaged_file: `save_source` did not write this file, or it is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with zipfile.ZipFile(path) as archive:
            stated = json.loads(archive.read(_MARK))
            if stated["version"] != VERSION:
                raise damaged("inputs", f"a stored film of version {stated['version']} instead of {VERSION}")
            film = _unpacked(archive, _FILM, folder / f"film{stated['film']}")
            region = stated["region"]
            names = stated.get("names", {})  # sources stored by earlier versions have none
            return FilmSource(
                film, None if region is None else _unpacked(archive, _REGION, folder / f"region{region}"),
                film_name=str(names.get("film", "")), region_name=str(names.get("region", "")),
                own_rate=bool(stated.get("own_rate", True)),  # earlier versions took the rate that the file states
            )  # fmt: skip
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, AttributeError) as error:
        raise damaged("inputs", "a stored film that cannot be read back") from error


def _unpacked(archive: zipfile.ZipFile, member: str, target: Path) -> Path:
    with archive.open(member) as source, target.open("wb") as file:
        shutil.copyfileobj(source, file, 1 << 20)
    return target
