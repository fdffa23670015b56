"""Films are recognised by content, decoded upright and in order, within limits."""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import films
import numpy as np
import pytest
from PIL import Image
from pliant.tracking import Film, FilmError, FilmLimits, open_film
from pliant.tracking.decoding.containers import edited_seconds
from pliant.tracking.decoding.film import PICTURE_RATE
from pliant.tracking.decoding.pictures import readable

PICTURES = films.textured_pictures(8)


def read(film: Film) -> np.ndarray:
    return np.stack([frame.image for frame in film.frames()])


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".webm", ".avi", ".mkv"])
def test_video_frames_come_in_order_with_times(tmp_path: Path, suffix: str) -> None:
    film = open_film(films.write_film(tmp_path / f"film{suffix}", PICTURES, fps=25))
    assert film.size == (64, 48)
    frames = list(film.frames())
    assert [frame.index for frame in frames] == list(range(8))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(8) / 25, atol=2e-3)
    for frame, picture in zip(frames, PICTURES, strict=True):
        errors = [np.abs(frame.image.astype(int) - other).mean() for other in PICTURES]
        assert np.argmin(errors) == next(i for i, other in enumerate(PICTURES) if other is picture)


def test_pictures_of_a_folder_and_a_zip_come_in_natural_order(tmp_path: Path) -> None:
    names = [f"shot{number}.png" for number in (1, 2, 9, 10, 11, 100, 101, 200)]
    entries = {name: films.png(picture) for name, picture in zip(names, PICTURES, strict=True)}
    folder = tmp_path / "pictures"
    folder.mkdir()
    for name in reversed(names):
        (folder / name).write_bytes(entries[name])
    (folder / "notes.txt").write_text("not a picture")
    packed = films.zip_of(tmp_path / "film.zip", {"__MACOSX/shot1.png": b"junk", **dict(reversed(entries.items()))})
    for path in (folder, packed):
        film = open_film(path)
        assert film.stated_frames == 8
        np.testing.assert_array_equal(read(film), np.stack(PICTURES))


def test_gif_frame_durations_are_kept(tmp_path: Path) -> None:
    first, *others = [Image.fromarray(picture).quantize(64) for picture in PICTURES]
    first.save(tmp_path / "film.gif", save_all=True, append_images=others, duration=[40, 40, 200, 40, 40, 40, 40, 40])
    frames = list(open_film(tmp_path / "film.gif").frames())
    assert [frame.index for frame in frames] == list(range(8))
    np.testing.assert_allclose([frame.time for frame in frames], [0, 0.04, 0.08, 0.28, 0.32, 0.36, 0.4, 0.44])
    assert frames[3].image.shape == (48, 64, 3)
    assert len(list(open_film(tmp_path / "film.gif", frames="1:6:2").frames())) == 3
    assert [frame.index for frame in open_film(tmp_path / "film.gif", frames=3).frames()] == [0, 3, 6]


def test_frames_that_an_edit_list_leaves_out_are_not_counted(tmp_path: Path) -> None:
    """As in a film that was cut without being encoded again."""
    path = films.write_film(tmp_path / "film.mp4", films.textured_pictures(30, (64, 48)))
    assert edited_seconds(path) == pytest.approx(30 / open_film(path).fps)
    content = path.read_bytes()
    scale = int.from_bytes(content[content.index(b"mvhd") + 16 :][:4])
    films.patched(path, b"elst", 12, struct.pack(">I", scale * 12 // 30))
    film = open_film(path)
    assert film.stated_frames == len(list(film.frames())) == 12


def test_edit_lists_may_have_times_of_64_bits_and_sound_has_its_own(tmp_path: Path) -> None:
    def track(media: bytes, length: int) -> bytes:
        edits = films.box(b"elst", b"\1", bytes(3), struct.pack(">IQqI", 1, length, 0, 1 << 16))
        handler = films.box(b"hdlr", bytes(8), media, bytes(13))
        data = films.box(b"hdlr", bytes(4), b"dhlralis", bytes(13))
        return films.box(b"trak", films.box(b"edts", edits), films.box(b"mdia", handler, films.box(b"minf", data)))

    movie = films.box(b"mvhd", b"\1", bytes(19), struct.pack(">I", 600), bytes(88))
    for tracks in ((b"vide", b"soun"), (b"soun", b"vide")):
        boxes = [track(media, {b"vide": 900, b"soun": 60}[media]) for media in tracks]
        (tmp_path / "film.mov").write_bytes(films.box(b"moov", movie, *boxes))
        assert edited_seconds(tmp_path / "film.mov") == 1.5
    (tmp_path / "film.mov").write_bytes(films.box(b"moov", movie))
    assert edited_seconds(tmp_path / "film.mov") is None


def test_the_rate_of_a_gif_comes_from_its_durations(tmp_path: Path) -> None:
    first, *others = [Image.fromarray(picture).quantize(64) for picture in PICTURES]
    first.save(tmp_path / "film.gif", save_all=True, append_images=others, duration=80)
    film = open_film(tmp_path / "film.gif")
    assert film.fps == pytest.approx(12.5)
    assert film.stated_frames == len(PICTURES), "for the estimate of its time"
    first.save(tmp_path / "single.gif")
    assert open_film(tmp_path / "single.gif").fps == PICTURE_RATE


def test_a_recording_without_a_rate_gets_that_of_its_times(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.webm", films.textured_pictures(31), fps=30)
    film = open_film(films.like_a_recording(path))
    assert [round(step, 3) for step in np.diff([frame.time for frame in film.frames()])[:2]] == [0.044, 0.032]
    assert film.fps == pytest.approx(30, rel=0.01), "not the 1000 ticks per second of the container's clock"
    assert film.stated_frames == 0


def test_pictures_of_16_bits_keep_their_contrast(tmp_path: Path) -> None:
    grey = cv2.cvtColor(PICTURES[0], cv2.COLOR_RGB2GRAY)
    cv2.imwrite(str(tmp_path / "1.png"), grey.astype(np.uint16) * 257)
    np.testing.assert_array_equal(read(open_film(tmp_path))[0], np.repeat(grey[..., None], 3, axis=2))


def test_a_zip_is_opened_once_for_all_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = films.zip_of(tmp_path / "film.zip", {f"{i}.png": films.png(p) for i, p in enumerate(PICTURES)})
    film, opened = open_film(path), []
    archive = zipfile.ZipFile
    monkeypatch.setattr(zipfile, "ZipFile", lambda *given: opened.append(archive(*given)) or opened[-1])
    assert len(read(film)) == 8
    assert len(opened) == 1, "opening a zip takes time in proportion to its pictures"
    assert opened[0].fp is None, "it is closed afterwards"


def test_a_rotation_flag_is_applied(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mp4", PICTURES)
    upright = read(open_film(path))
    turned = open_film(films.turned_by_90(path))
    assert turned.size == (48, 64)
    np.testing.assert_array_equal(read(turned), np.rot90(upright, -1, axes=(1, 2)))


def test_exif_orientation_is_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    for number, picture in enumerate(PICTURES[:3]):
        Image.fromarray(picture).save(tmp_path / f"{number}.png", exif=exif)
    np.testing.assert_array_equal(read(open_film(tmp_path))[0], np.rot90(PICTURES[0], -1))


def test_variable_rate_gives_the_true_times(tmp_path: Path) -> None:
    path = films.with_uneven_times(films.write_film(tmp_path / "film.mp4", PICTURES, fps=25), first=4)
    times = [frame.time for frame in open_film(path).frames()]
    # FFmpeg stops at the duration that the edit list still states.
    np.testing.assert_allclose(np.diff(times), [0.04] * 4 + [0.12] * (len(times) - 5), atol=1e-3)
    assert len(times) >= 6


@pytest.mark.parametrize(
    ("frames", "indices"),
    [
        (None, range(8)),
        ("::3", [0, 3, 6]),
        (slice(2, 5), [2, 3, 4]),
        ("1:7:2", [1, 3, 5]),
        (4, [0, 2, 4, 6]),
        ("3", [0, 3, 6]),
    ],
)
def test_frames_can_be_selected(tmp_path: Path, frames: int | slice | str | None, indices: range | list[int]) -> None:
    film = open_film(films.write_film(tmp_path / "film.avi", PICTURES), frames=frames)
    assert [frame.index for frame in film.frames()] == list(indices)


@pytest.mark.parametrize("frames", [0, -1, True, "a", "5:2", "::0", "-3:", "1:2:3:4", ""])
def test_invalid_frame_selections_are_rejected(tmp_path: Path, frames: int | str) -> None:
    path = films.write_film(tmp_path / "film.avi", PICTURES)
    with pytest.raises(FilmError, match="start:stop:step") as caught:
        open_film(path, frames=frames)
    assert (caught.value.code, caught.value.field) == ("wrong_selection", "frames")


@pytest.mark.parametrize(
    ("limits", "code"),
    [
        (FilmLimits(bytes=100), "too_many_bytes"),
        (FilmLimits(frames=5), "too_many_frames"),
        (FilmLimits(pixels=1000), "too_many_pixels"),
        (FilmLimits(seconds=0.1), "too_long"),
    ],
)
@pytest.mark.parametrize("kind", ["mkv", "zip"])
def test_films_over_a_limit_are_rejected(tmp_path: Path, limits: FilmLimits, code: str, kind: str) -> None:
    if kind == "mkv":
        path = films.write_film(tmp_path / "film.mkv", PICTURES)
    else:
        path = films.zip_of(tmp_path / "film.zip", {f"{i}.png": films.png(p) for i, p in enumerate(PICTURES)})
    with pytest.raises(FilmError) as caught:
        read(open_film(path, limits=limits))
    assert caught.value.code == code


def test_a_selection_keeps_a_long_film_within_limits(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mkv", PICTURES)
    assert len(read(open_film(path, frames="::2", limits=FilmLimits(frames=5)))) == 4


def test_pictures_of_several_sizes_are_refused(tmp_path: Path) -> None:
    sizes = [(64, 48), (64, 48), (32, 48)]
    entries = {f"{i}.png": films.png(np.zeros((h, w, 3), np.uint8)) for i, (w, h) in enumerate(sizes)}
    with pytest.raises(FilmError, match="32×48 in frame 2"):
        read(open_film(films.zip_of(tmp_path / "film.zip", entries)))


def test_a_tiny_film_is_refused(tmp_path: Path) -> None:
    path = films.zip_of(tmp_path / "film.zip", {"1.png": films.png(np.zeros((8, 8, 3), np.uint8))})
    with pytest.raises(FilmError, match="16×16"):
        open_film(path)


def test_a_zip_with_a_broken_deflate_stream_is_refused(tmp_path: Path) -> None:
    path = films.zip_of(tmp_path / "film.zip", {"1.png": bytes(2000)})
    broken = bytearray(path.read_bytes())
    start = 30 + len("1.png")  # after the local header
    broken[start : start + 4] = b"\xff" * 4
    path.write_bytes(broken)
    with pytest.raises(FilmError, match="while decompressing") as caught:
        read(open_film(path))
    assert caught.value.code == "broken_picture"


def test_zlib_running_out_of_memory_raises_memory_error() -> None:
    with pytest.raises(MemoryError, match="Error -4"), readable("1.png"):
        raise zlib.error("Error -4 while decompressing data")


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = films.zip_of(tmp_path / "film.zip", {f"{i}.bmp": b"BM" + bytes(20_000_000) for i in range(3)})
    assert path.stat().st_size < 100_000
    with pytest.raises(FilmError) as caught:
        open_film(path, limits=FilmLimits(bytes=50_000_000))
    assert caught.value.code == "too_many_bytes"


def test_a_decompression_bomb_in_a_picture_is_refused(tmp_path: Path) -> None:
    flat = Image.new("1", (10_000, 10_000))
    flat.save(tmp_path / "1.png")
    path = films.zip_of(tmp_path / "film.zip", {"1.png": (tmp_path / "1.png").read_bytes()})
    with pytest.raises(FilmError) as caught:
        open_film(path)
    assert caught.value.code in ("too_many_pixels", "broken_picture")


def test_a_zip_with_an_immense_directory_is_refused(tmp_path: Path) -> None:
    path = films.zip_of(tmp_path / "film.zip", {f"{i:0200d}.png": b"" for i in range(20_000)}, zipfile.ZIP_STORED)
    with pytest.raises(FilmError) as caught:
        open_film(path)
    assert caught.value.code == "too_many_pictures"


def with_displayed_width(path: Path, width: int) -> Path:
    """Set an MP4 film's display width; FFmpeg takes its ratio to the stored width as the pixel aspect."""
    return films.patched(path, b"tkhd", 80, struct.pack(">I", width << 16))


def test_non_square_pixels_are_stretched_to_square(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mp4", PICTURES)
    plain = read(open_film(path))
    wide = open_film(with_displayed_width(path, 96))
    assert (wide.size, wide.pixel_aspect, wide.rotation) == ((96, 48), 1.5, 0)
    np.testing.assert_array_equal(read(wide)[3], cv2.resize(plain[3], (96, 48), interpolation=cv2.INTER_LINEAR))
    high = open_film(with_displayed_width(path, 32))
    assert (high.size, high.pixel_aspect) == ((64, 96), 0.5)
    assert read(high).shape == (8, 96, 64, 3)
    turned = open_film(films.turned_by_90(with_displayed_width(path, 96)))
    assert (turned.size, turned.rotation) == ((48, 96), 90)
    assert read(turned).shape == (8, 96, 48, 3)


def test_extreme_pixel_aspect_ratios_are_refused(tmp_path: Path) -> None:
    path = with_displayed_width(films.write_film(tmp_path / "film.mp4", PICTURES), 640)
    with pytest.raises(FilmError, match="setsar=1") as caught:
        open_film(path)
    assert caught.value.code == "unsupported_film"
