"""Mask pictures with an EXIF orientation, 16-bit levels or transparency, and the messages about unusable ones."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pliant.tracking import FilmError
from pliant.tracking.region import read_region

SIZE = (64, 48)
INSIDE = np.zeros(SIZE[::-1], bool)
INSIDE[5:20, 8:30] = True


def stored_with(orientation: int, levels: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Image.Exif]:
    """Return the picture as it is stored so that its EXIF orientation turns it upright."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    back = {1: levels, 3: np.rot90(levels, 2), 6: np.rot90(levels, 1), 8: np.rot90(levels, -1), 2: levels[:, ::-1]}
    return np.ascontiguousarray(back[orientation]), exif


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
@pytest.mark.parametrize("name", ["mask.png", "mask.jpg"])
def test_the_orientation_of_a_mask_is_applied_as_that_of_a_frame(tmp_path: Path, name: str, orientation: int) -> None:
    stored, exif = stored_with(orientation, INSIDE.astype(np.uint8) * 255)
    Image.fromarray(stored).save(tmp_path / name, exif=exif, quality=95)
    assert (read_region(tmp_path / name, SIZE) != INSIDE).mean() < 0.01


def test_a_transparent_mask_is_turned_too(tmp_path: Path) -> None:
    stored, exif = stored_with(6, INSIDE.astype(np.uint8) * 255)
    Image.fromarray(np.dstack([np.zeros((*stored.shape, 3), np.uint8), stored])).save(tmp_path / "mask.png", exif=exif)
    np.testing.assert_array_equal(read_region(tmp_path / "mask.png", SIZE), INSIDE)


def test_a_mask_that_fits_only_as_it_is_stored_is_refused(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(INSIDE.astype(np.uint8) * 255).save(tmp_path / "mask.png", exif=exif)
    with pytest.raises(FilmError, match="got 48×64") as caught:
        read_region(tmp_path / "mask.png", SIZE)
    assert caught.value.code == "wrong_region_size"


def test_the_levels_of_a_mask_of_16_bits_are_scaled(tmp_path: Path) -> None:
    levels = np.where(INSIDE, 65_535, 0).astype(np.uint16)
    levels[21, 8:30] = 20_000  # a soft outline, dark
    Image.fromarray(levels).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_region(tmp_path / "mask.png", SIZE), INSIDE)


@pytest.mark.parametrize(("kind", "level"), [("array", 2), ("picture", 1)])
def test_an_empty_mask_of_low_levels_tells_its_brightest(tmp_path: Path, kind: str, level: int) -> None:
    levels = INSIDE.astype(np.uint8) * level
    Image.fromarray(levels).save(tmp_path / "mask.png")
    with pytest.raises(FilmError) as caught:
        read_region(levels if kind == "array" else tmp_path / "mask.png", SIZE)
    assert str(caught.value) == (
        f"region: expected some pixels inside, got none: the brightest level is {level}, of 255. "
        "Levels of 128 and above are inside: make the object white."
    )


def test_an_array_of_zeros_and_ones_is_a_mask() -> None:
    np.testing.assert_array_equal(read_region(INSIDE.astype(np.uint8), SIZE), INSIDE)


@pytest.mark.parametrize(
    ("corners", "got"),
    [
        ([(0, 0), (1, 1)], "2 corners"),
        ([(0, 0), (1, np.nan), (5, 5)], "the corner (1, nan)"),
        ([(0, 0), (9, 9), (5, 1e7)], "the corner (5, 1e+07)"),
        ([(0, 0), (1,), (5, 5)], "rows of several lengths"),
        ([("a", "b"), ("c", "d"), ("e", "f")], "corners that are no numbers"),
    ],
)
def test_what_is_wrong_with_a_polygon_is_told(corners: object, got: str) -> None:
    with pytest.raises(FilmError) as caught:
        read_region(corners, SIZE)  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.got) == ("wrong_polygon", got)


def test_a_mask_that_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "mask.png")
    for path in (tmp_path / "mask.png", tmp_path):
        with pytest.raises(FilmError, match="a folder, a pipe or a device") as caught:
            read_region(path, SIZE)
        assert caught.value.code == "unreadable_region"


def test_an_unknown_format_is_named_without_the_folder(tmp_path: Path) -> None:
    (tmp_path / "mask.png").write_bytes(b"no picture")
    with pytest.raises(FilmError) as caught:
        read_region(tmp_path / "mask.png", SIZE)
    assert caught.value.got == "mask.png: its format is not recognised"


@pytest.mark.parametrize("away", [100, -100])
def test_a_polygon_outside_the_picture_is_refused_with_where_it_lies(away: int) -> None:
    with pytest.raises(FilmError) as caught:
        read_region([(away, away), (away + 9, away), (away + 9, away + 5)], SIZE)
    assert caught.value.code == "empty_region"
    assert caught.value.got == f"x from {away} to {away + 9} and y from {away} to {away + 5}, outside the picture"
