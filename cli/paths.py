"""Checks of paths on the command line, before anything is sent, solved or overwritten."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

RESULT_FILES = ("shapes.npz", "report.json")
"""Files of every result: a folder that has one of them holds a result."""


def input_file(path: Path | None, name: str) -> None:
    """Check that a file given on the command line can be read.

    Raises
    ------
    BadArgument
        It is missing, a folder, or not readable.
    """
    from pliant.client.multipart import existing_file

    if path is not None:
        existing_file(path, name)


def output_folder(folder: Path, *, force: bool, files: Iterable[str] = RESULT_FILES) -> None:
    """Create the folder of the results and check that it can take them.

    Parameters
    ----------
    folder : Path
        Created if it does not exist.
    force : bool
        Whether existing files may be replaced.
    files : iterable of str
        Names that are refused if they exist already.

    Raises
    ------
    BadArgument
        The path is a file, the folder is not writable, or it holds one of the files.
    """
    from pliant.client.errors import BadArgument

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise BadArgument(f"--output: expected a folder, got the file {folder}. Choose another folder.") from None
    except NotADirectoryError:
        raise BadArgument(f"--output: {folder} is below a file. Choose another folder.") from None
    except OSError as fault:
        raise BadArgument(f"--output: cannot create {folder}: {fault.strerror}. Choose another folder.") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadArgument(f"--output: the folder {folder} is not writable. Choose another folder.")
    existing = [name for name in files if (folder / name).exists()]
    if existing and not force:
        raise BadArgument(
            f"--output: {folder} already holds {', '.join(existing)}. Choose another folder, or replace the files with --force."
        )
