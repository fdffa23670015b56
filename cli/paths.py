"""Checks of paths on the command line, before anything is sent, solved or overwritten."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.schemas.job import Job
    from pliant.worker.settings import Settings

RESULT_FILES = ("shapes.npz", "report.json")
"""Files of every result; a folder with one of them contains a result."""


def input_file(path: Path | None, name: str) -> None:
    """Check that a file given on the command line can be read. Expanding ``~`` is up to the shell, as for other commands.

    Raises
    ------
    BadArgument
        The file is missing, a folder, or not readable.
    """
    from pliant.client.errors import BadArgument
    from pliant.client.input_files import existing_file

    if path is None:
        return
    if not path.exists():
        raise BadArgument(f"{name}: expected a file, got no file at {path}. Check the path.")
    existing_file(path, name)


def mesh_file(mesh: str | None) -> None:
    """Check that a mesh is a grid size, `none`, or a file that can be read.

    Raises
    ------
    BadArgument
        The text is none of these.
    """
    from pliant.client.errors import BadArgument
    from pliant.client.input_files import mesh_text

    if mesh is None or mesh_text(mesh) is not None:
        return
    if not Path(mesh).exists():
        raise BadArgument(
            f"mesh: expected a mesh file, ROWSxCOLUMNS or none, got no file at {mesh}. "
            "Check the path, or give a grid size such as 48x64."
        )
    input_file(Path(mesh), "mesh")


def tracks_or_film(path: Path) -> None:
    """Check that a path is a file that can be read, or a folder with the pictures of a film.

    Raises
    ------
    BadArgument
        The path is missing, not readable, or a folder without pictures.
    """
    from pliant.client.errors import BadArgument
    from pliant.schemas.pictures import SUFFIXES, pictures_in

    if not path.is_dir():
        input_file(path, "tracks")
    elif not pictures_in(path):
        raise BadArgument(
            f"tracks: expected a file or a folder of pictures ({', '.join(SUFFIXES)}), got the folder {path}, which has none. "
            "Give the path of a file in it."
        )


def check_inputs(
    tracks: Path | None, *, mesh: str | None, ground_truth: Path | None, rotations: Path | None, region: Path | None
) -> None:
    """Check the paths of all inputs of a job; None stands for an input that was not given.

    Raises
    ------
    BadArgument
        An input cannot be read.
    """
    if tracks is not None:
        tracks_or_film(tracks)
    mesh_file(mesh)
    for path, name in ((ground_truth, "ground_truth"), (rotations, "rotations"), (region, "region")):
        input_file(path, name)


def installation(settings: Settings) -> None:
    """Check that a service has used the data directory, before anything is created in it. Not checked with a Redis server.

    Raises
    ------
    BadArgument
        The directory is missing, or has none of an installation's folders.
    """
    from pliant.client.errors import BadArgument
    from pliant.worker.paths import FOLDERS

    data = settings.data
    if settings.redis_url is None and not any((data / name).is_dir() for name in FOLDERS):
        what = "which has none of its folders" if data.exists() else "which does not exist"
        raise BadArgument(
            f"--data: expected the directory of an installation, got {data}, {what}. Give the one that `pliant up` uses."
        )


def readable_installation(settings: Settings) -> None:
    """Check that this user can read the folders of the data directory: one that it cannot read would look empty.

    Raises
    ------
    BadArgument
        A folder belongs to another user.
    """
    from pliant.client.errors import BadArgument
    from pliant.worker.paths import FOLDERS

    for folder in (settings.data / name for name in FOLDERS):
        if folder.exists() and not os.access(folder, os.R_OK | os.X_OK):
            raise BadArgument(
                f"--data: expected folders that this user can read, got {folder}, which it cannot. Run the command as the user that "
                "runs Pliant, for example with `sudo -u pliant`."
            )


def output_file(
    path: Path | None, option: str, *, force: bool, suffixes: tuple[str, ...] = (), others: Iterable[Path | None] = ()
) -> None:
    """Check that a file can be written, before starting the work that produces it. `others` are the command's other files.

    Raises
    ------
    BadArgument
        The path is a folder, a device, one of `others` or, without `force`, an existing file; its name ends in none of `suffixes`; or its
        folder is missing or not writable.
    OSError
        The system allows no such name.
    """
    from pliant.client.errors import BadArgument
    from pliant.schemas.validation import alternatives

    if path is None:
        return
    with suppress(FileNotFoundError, NotADirectoryError):
        path.lstat()
    if path.is_dir():
        raise BadArgument(f"{option}: expected a file, got the folder {path}. Give a file in it.")
    if path.exists() and not path.is_file():
        raise BadArgument(f"{option}: expected a file, got {path}, a device or a pipe. Choose another name.")
    if not path.parent.is_dir():
        raise BadArgument(f"{option}: there is no folder {path.parent}. Create it, or choose another.")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise BadArgument(f"{option}: the folder {path.parent} is not writable. Choose another folder.")
    if path.exists() and not force:
        raise BadArgument(f"{option}: {path} exists already. Choose another name, or replace it with --force.")
    if any(other is not None and other.resolve() == path.resolve() for other in others):
        raise BadArgument(f"{option}: {path} is also another file of this command. Choose another name.")
    if suffixes and path.suffix.lower() not in suffixes:
        raise BadArgument(
            f"{option}: expected a name that ends in {alternatives(suffixes)}, got {path}. Choose another name."
        )


@contextmanager
def write_aside(path: Path) -> Iterator[Path]:
    """Yield the path of a hidden file to write, and move it to `path` at the end; after an error `path` is unchanged.

    Its name is short, whatever the length of the other.
    """
    aside = path.with_name(f".{secrets.token_hex(4)}.part")
    try:
        yield aside
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def make_folder(folder: Path, option: str) -> None:
    """Create a folder, unless it exists, and check that it is writable.

    Raises
    ------
    BadArgument
        The path is a file or below one, or the folder cannot be created or written.
    """
    from pliant.client.errors import BadArgument

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise BadArgument(f"{option}: expected a folder, got the file {folder}. Choose another folder.") from None
    except NotADirectoryError:
        raise BadArgument(f"{option}: {folder} is below a file. Choose another folder.") from None
    except OSError as fault:
        raise BadArgument(f"{option}: cannot create {folder}: {fault.strerror}. Choose another folder.") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadArgument(f"{option}: the folder {folder} is not writable. Choose another folder.")


def output_folder(folder: Path, *, force: bool, files: Iterable[str] = RESULT_FILES) -> None:
    """Create the output folder and check that it is writable and, without `force`, contains none of `files`.

    Raises
    ------
    BadArgument
        The path is a file, the folder is not writable, or it contains one of the files.
    """
    from pliant.client.errors import BadArgument

    make_folder(folder, "--output")
    existing = [name for name in files if (folder / name).exists()]
    if existing and not force:
        raise BadArgument(
            f"--output: {folder} already holds {', '.join(existing)}. Choose another folder, or replace the files with --force."
        )


def different_files(job: Job, folder: Path, only: list[str] | None = None) -> list[str]:
    """Return the files of a job that a folder contains with different content, which a download would replace."""
    from pliant.schemas.digests import sha256

    wanted = [artifact for artifact in job.artifacts if only is None or artifact.name in only]
    return [
        artifact.name
        for artifact in wanted
        if (folder / artifact.name).is_file() and sha256(folder / artifact.name) != artifact.sha256
    ]


@contextmanager
def results_folder(folder: Path, *, force: bool, files: Iterable[str] = RESULT_FILES) -> Iterator[None]:
    """Prepare a folder with `output_folder` for the block; afterwards remove it if it is new and still empty."""
    new = not folder.exists()
    output_folder(folder, force=force, files=files)
    try:
        yield
    finally:
        if new:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
