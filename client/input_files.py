"""The files of a submission, written from arrays and the dictionaries of trackers, or found at a path."""

from __future__ import annotations

import os
import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.client.errors import BadArgument
from pliant.schemas.job import LONGEST_NAME
from pliant.schemas.pictures import SUFFIXES, is_frame, pictures_in

Source = ArrayLike | Mapping[str, Any] | Path | str
"""An array, a dictionary of arrays as a tracker returns it, or the path of a file."""

Region = NDArray[np.bool] | NDArray[np.uint8] | Path | str
"""A mask of a film's size: an array (H, W) of bool, or of uint8 with 128 and above inside, or the path of a picture."""

POINT_NAMES = "point_names"
"""Key of a dictionary of tracks whose array is text: the names of the points."""

EXPECTED = {
    "film": "the path of a film or of a folder of pictures",
    "region": "the path of a mask picture, or an array (H, W)",
}
"""What an input may be that is no array or dictionary of arrays."""


def tracks_file(tracks: Source, visible: ArrayLike | None, folder: Path) -> Path:
    """Write the tracks to a file that the service reads; a path is used as it is.

    Dictionaries are stored key by key: the service recognises the formats of trackers.

    Raises
    ------
    BadArgument
        `visible` was given with a file or dictionary, which have their own visibility; or a value is not an array.
    """
    if isinstance(tracks, str | Path):
        refuse_visible(visible)
        return existing_file(tracks, "tracks")
    if isinstance(tracks, Mapping):
        refuse_visible(visible)
        arrays = {str(key): _array(value, str(key), text=key == POINT_NAMES) for key, value in tracks.items()}
        return _npz(folder / "tracks.npz", arrays)
    arrays = {"tracks": _array(tracks, "tracks")}
    if visible is not None:
        arrays["visibility"] = _array(visible, "visible")
    return _npz(folder / "tracks.npz", arrays)


def film_file(film: Path | str, folder: Path) -> Path:
    """Return the file of a film; a folder of pictures is packed into a zip, whose bytes depend only on the pictures and their names.

    Raises
    ------
    BadArgument
        There is no such film, or the folder has no pictures.
    """
    if not isinstance(film, str | Path) or not (given := expanded(film, "film")).is_dir():
        return existing_file(film, "film")
    try:
        pictures = pictures_in(given)
    except OSError as fault:
        raise BadArgument(
            f"film: the folder {given} cannot be read: {fault.strerror}. Change its permissions."
        ) from None
    if not pictures:
        raise BadArgument(
            f"film: expected a film or a folder of pictures ({', '.join(SUFFIXES)}), got the folder {given}, which has none. "
            "Export the film's frames as PNG or JPEG, numbered in order."
        )
    packed = folder / "pictures.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for picture in pictures:
            with (
                existing_file(picture, "film").open("rb") as source,
                archive.open(zipfile.ZipInfo(picture.name), "w") as member,
            ):
                shutil.copyfileobj(source, member)
    return packed


def mesh_part(mesh: Source | tuple[int, int], folder: Path) -> Path | str:
    """Return a file of faces, or a text: a grid size such as ``"12x20"``, or ``"none"``.

    Raises
    ------
    BadArgument
        The mesh is neither faces, nor a file, nor such a text.
    """
    if isinstance(mesh, str) and (text := mesh_text(mesh)) is not None:
        return text
    if isinstance(mesh, str | Path):
        return existing_file(mesh, "mesh")
    if isinstance(mesh, Mapping):
        return _npz(folder / "mesh.npz", {str(key): _array(value, str(key)) for key, value in mesh.items()})
    if hasattr(mesh, "faces"):
        raise BadArgument(
            f"mesh: expected faces (T, 3) or (T, 4), got {kind_of(mesh)}. Give its faces, such as mesh.faces, as an array, or a file."
        )
    faces = _array(mesh, "mesh")
    if faces.shape == (2,) and faces.dtype.kind in "iu":  # a tuple, a list or an array; faces have two axes
        return f"{faces[0]}x{faces[1]}"
    return _npz(folder / "mesh.npz", {"faces": faces})


def mesh_text(mesh: str) -> str | None:
    """Return a grid size as ``"12x20"``, or ``"none"``; None for another text, which is a path."""
    word = "".join(mesh.lower().split()).replace("×", "x")
    return word if re.fullmatch(r"none|[0-9]{1,6}x[0-9]{1,6}", word) is not None else None


def region_part(region: Region, folder: Path, *, film: Path | str | None = None) -> Path:
    """Return the picture of a film's region; an array is written as PNG.

    Raises
    ------
    BadArgument
        The region is neither such an array nor a file, or it is a file among the pictures of the film.
    """
    if isinstance(region, str | Path):
        file = existing_file(region, "region")
        if film is not None and is_frame(file, expanded(film, "film")):
            raise BadArgument(
                f"region: expected a mask outside the film's folder of pictures, got {file.name} in it, which would be a frame of the "
                "film. Move the mask to another folder."
            )
        return file
    mask = _array(region, "region")
    if mask.ndim != 2 or mask.size == 0 or mask.dtype not in (np.dtype(bool), np.dtype(np.uint8)):
        raise BadArgument(
            "region: expected the path of a mask picture, or an array (H, W) of bool or uint8, got an array of shape "
            f"{mask.shape} and dtype {mask.dtype}. Convert it; a polygon is the option region_polygon."
        )
    from PIL import Image  # here, because it is not needed otherwise

    # A mask of 0 and 1, as segmentation models return it, or a picture of 0 to 255.
    levels = np.asarray(mask, dtype=np.uint8)
    inside = mask if mask.dtype == bool else levels >= (1 if levels.max() == 1 else 128)
    path = folder / "region.png"
    Image.fromarray(np.where(inside, 255, 0).astype(np.uint8)).save(path)
    return path


def array_part(value: Source, name: str, key: str, folder: Path) -> Path:
    """Return the file of the ground truth or of the rotations."""
    if isinstance(value, str | Path):
        return existing_file(value, name)
    arrays = value if isinstance(value, Mapping) else {key: value}
    return _npz(folder / f"{name}.npz", {str(k): _array(v, f"{name}.{k}") for k, v in arrays.items()})


def refuse_visible(visible: ArrayLike | None) -> None:
    """Refuse visibility beside an input that has its own.

    Raises
    ------
    BadArgument
        It was given.
    """
    if visible is not None:
        raise BadArgument(
            "visible: only valid with an array of tracks. A file or dictionary contains its own visibility."
        )


def expanded(path: Path | str, name: str) -> Path:
    """Return a path with ``~`` or ``~user`` at its beginning expanded.

    Raises
    ------
    BadArgument
        There is no such user, or the user has no home directory.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise BadArgument(
            f"{name}: expected a path, got {path}, and {Path(path).parts[0]} is no user's home directory. "
            "Write out the whole path."
        ) from None


def folder_to_fill(path: Path | str) -> Path:
    """Return the path of a folder for files, which need not exist yet, with ``~`` expanded.

    Raises
    ------
    BadArgument
        There is no such user, or the path is that of a file, or below one.
    """
    found = expanded(path, "folder")
    there = next((each for each in (found, *found.parents) if each.exists()), None)
    if there is not None and not there.is_dir():
        raise BadArgument(f"folder: expected a folder, got the file {there}. Choose another folder.")
    return found


def job_name(of_file: str) -> str:
    """Return the name of a job for a file name: valid UTF-8, truncated to `LONGEST_NAME` characters."""
    return of_file.encode("utf-8", "replace").decode()[:LONGEST_NAME]


def existing_file(path: Path | str, name: str) -> Path:
    """Return the path of an input, with ``~`` expanded.

    Raises
    ------
    BadArgument
        The value is not a path, or the file is missing, a folder, or not readable.
    """
    if not isinstance(path, str | Path):
        raise BadArgument(f"{name}: expected the path of a file, got {kind_of(path)}. Give a str or a pathlib.Path.")
    found = expanded(path, name)
    if found.is_dir():
        raise BadArgument(f"{name}: expected a file, got the folder {found}. Give the path of a file in it.")
    if not found.is_file():
        expected = EXPECTED.get(name, "a file, an array or a dictionary of arrays")
        raise BadArgument(f"{name}: expected {expected}, got no file at {found}. Check the path.")
    if not os.access(found, os.R_OK):
        raise BadArgument(f"{name}: the file {found} cannot be read. Change its permissions.")
    return found


def _array(value: Any, name: str, *, text: bool = False) -> NDArray[np.generic]:
    """Convert anything that NumPy accepts, and PyTorch and JAX tensors on any device; masked entries become NaN.

    With `text`, the array may also be one of text.
    """
    for step in ("detach", "cpu"):
        if hasattr(value, "__array__") and hasattr(value, step):  # a file has `detach`, too, which makes it unusable
            value = getattr(value, step)()
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value) and value.dtype.kind in "biuf":
        value = np.ma.filled(value.astype(np.result_type(value, np.float16)), np.nan)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # rows of several lengths, or an object that NumPy cannot convert
        array = np.asarray(None)
    if array.dtype.kind not in ("biufU" if text else "biuf"):
        got = f"dtype {array.dtype}" if hasattr(value, "dtype") else f"{kind_of(value)}, which cannot be converted"
        raise BadArgument(
            f"{name}: expected an array of numbers or booleans, got {got}. "
            "Pad ragged lists with NaN, omit entries that are not arrays, and give files by their path."
        )
    return array


def kind_of(value: object) -> str:
    """Return the type of a value, in the words of an error."""
    return f"a value of type {type(value).__name__}"


def _npz(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> Path:
    """Write without compression: equal arrays give equal bytes, so the service recognises a repeated submission."""
    with zipfile.ZipFile(path, "w") as file:  # not `numpy.savez`, which takes no array of the name `file`
        for name, array in arrays.items():
            with file.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
    return path
