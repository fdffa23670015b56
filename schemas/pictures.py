"""Which files of a folder are the pictures of a film."""

from __future__ import annotations

from pathlib import Path

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
"""Endings of the names of a film's pictures, in lower case."""


def is_frame(picture: Path, folder: Path) -> bool:
    """Return whether a file is one of the pictures of a folder, and so a frame of the film that the folder is."""
    return folder.is_dir() and picture.resolve() in [file.resolve() for file in pictures_in(folder)]


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures of a folder, sorted by name; hidden files and other kinds of files are left out.

    Raises
    ------
    OSError
        The folder cannot be read.
    """
    return sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and file.is_file() and not file.name.startswith(".")
    )
