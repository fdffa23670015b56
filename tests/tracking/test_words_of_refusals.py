"""The exact error messages for films, regions and frame selections, as a user sees them."""

# ruff: noqa: E501
from __future__ import annotations

import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import films
import numpy as np
import pytest
from PIL import Image
from pliant.tracking import FilmError, FilmLimits, open_film, track_film

PICTURES = films.textured_pictures(8)
FTYP = films.box(b"ftyp", b"isom", b"\0\0\2\0", b"isom")
EMPTY = np.zeros((48, 64), bool)
TRACKS = (
    "film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got {}, a file of "
    "tracks. Send it as the tracks instead (on the page: under Tracks; REST: -F tracks=@tracks.npz; Python: submit('tracks.npz'); "
    "command line: pliant solve tracks.npz)."
)
ODD = [(64, 48), (64, 48), (32, 48)]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A file, the arguments it is opened with, and the expected message; with `track` it is also tracked."""

    name: str = "film.mp4"
    data: bytes | Callable[[Path], object] = b""
    given: Mapping[str, Any] = field(default_factory=dict)
    track: bool = False
    words: str


def film(path: Path) -> Path:
    return films.write_film(path, PICTURES)


def zipped(**entries: bytes) -> Callable[[Path], object]:
    return lambda path: films.zip_of(path, {name.replace("_", "."): data for name, data in entries.items()})


def pictures(path: Path) -> Path:
    return films.zip_of(path, {f"{i}.png": films.png(p) for i, p in enumerate(PICTURES)})


def animation(path: Path, kind: str) -> None:
    first, *others = (Image.fromarray(picture) for picture in PICTURES)
    first.save(path, kind, save_all=True, append_images=others)


def elsewhere(path: Path) -> None:
    film(path)
    data = bytearray(path.read_bytes())
    data[data.index(b"url ", data.index(b"dref")) + 7] = 0
    path.write_bytes(data)


def broken_deflate(path: Path) -> None:
    films.zip_of(path, {"1.png": bytes(2000)})
    data = bytearray(path.read_bytes())
    data[35:39] = b"\xff" * 4  # after the local header
    path.write_bytes(data)


def refused(case: Case, folder: Path) -> FilmError:
    path = folder / case.name
    if callable(case.data):
        case.data(path)
    else:
        path.write_bytes(case.data)
    with pytest.raises(FilmError) as caught:
        _ = track_film(path, **case.given) if case.track else list(open_film(path, **case.given).frames())
    return caught.value


CASES: dict[str, Case] = {
    "no file": Case(data=lambda path: None,
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4: No such file or directory. Check the path."),
    "an empty file": Case(data=b"",
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4, which is empty. Copy the film again."),
    "a playlist": Case(data=b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n",
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4, a playlist or text that refers to other files. Pass the film itself; other files and addresses are never opened."),
    "another kind of file": Case(data=b"%PDF-1.7",
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4, which is none of these. Convert it: ffmpeg -i FILM film.mp4"),
    "a single picture": Case(name="frame.png", data=films.png(PICTURES[0]),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got frame.png, a single picture. Depth comes from motion: pass a film, or a zip or folder with all its pictures."),
    "a single WebP picture": Case(name="frame.webp", data=b"RIFF\x1a\0\0\0WEBPVP8L",
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got frame.webp, a single picture. Depth comes from motion: pass a film, or a zip or folder with all its pictures."),
    "an animated WebP": Case(name="film.webp", data=lambda path: animation(path, "WEBP"),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.webp, an animated WebP or PNG. Convert it to an animated GIF or an mp4 film."),
    "an animated PNG": Case(name="film.png", data=lambda path: animation(path, "PNG"),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.png, an animated WebP or PNG. Convert it to an animated GIF or an mp4 film."),
    "a file of thousands of boxes": Case(data=FTYP + films.box(b"free") * 30_000,
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4 with over 20000 boxes. Convert it: ffmpeg -i FILM film.mp4"),
    "samples in another file": Case(name="film.mov", data=elsewhere,
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mov, whose samples lie in another file. Export the film with its media inside; other files and addresses are never opened."),
    "thousands of streams": Case(data=FTYP + films.box(b"moov", films.box(b"trak") * 5000),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4 with over 16 streams. Keep the picture: ffmpeg -i FILM -map 0:v:0 film.mp4"),
    "thousands of streams of an avi": Case(name="film.avi", data=lambda path: films.patched(film(path), b"avih", 32, struct.pack("<I", 4000)),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.avi with 4000 streams. Keep the picture: ffmpeg -i FILM -map 0:v:0 film.mp4"),
    "sound alone": Case(data=lambda path: films.patched(film(path), b"hdlr", 12, b"soun"),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4, which holds sound but no picture. Pass a film with a picture track."),
    "no index": Case(data=lambda path: path.write_bytes(film(path).read_bytes()[:600]),
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.mp4, which has no index (moov): it was cut off before the recording ended. Copy it again, or film again."),
    "an avi without its header": Case(name="film.avi", data=b"RIFF\0\0\0\0AVI LIST",
        words="film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got film.avi without its header (avih). Copy it again."),
    "random bytes": Case(name="film.mkv", data=lambda path: path.write_bytes(film(path).read_bytes()[:64] + bytes(1000)),
        words="film: expected a film with a picture that FFmpeg decodes, got film.mkv. It may be damaged, hold sound only, or use a codec that OpenCV lacks, such as AV1. Convert it: ffmpeg -i FILM film.mp4"),
    "equal frames, as of an interlaced film": Case(name="film.mkv", data=lambda path: films.write_film(path, PICTURES[:1] * 5),
        words="film: expected frames that differ, got 5 equal frames in film.mkv. If it is not a still picture, it is interlaced. Convert it: ffmpeg -i FILM -vf yadif film.mp4"),
    "absurd pixels": Case(data=lambda path: films.patched(film(path), b"tkhd", 80, struct.pack(">I", 640 << 16)),
        words="film: expected pixels at most 4 times as wide as high, or as high as wide, got film.mp4 with pixels of 10:1. Convert it: ffmpeg -i FILM -vf setsar=1 film.mp4"),
    "more bytes than allowed": Case(data=lambda path: path.write_bytes(film(path).read_bytes().ljust(10_000, b"\0")), given={"limits": FilmLimits(bytes=100)},
        words="film: expected at most 100 bytes, got film.mp4 of 10,000. Cut the film, or compress it more."),
    "more frames than allowed": Case(data=film, given={"limits": FilmLimits(frames=5)},
        words="film: expected at most 5 frames, got more. Use fewer frames, e.g. every second one: frames='::2'."),
    "more pixels than allowed": Case(data=film, given={"limits": FilmLimits(pixels=1000)},
        words="film: expected at most 1,000 pixels a frame, got film.mp4 of 64×48. Scale the film down: ffmpeg -i FILM -vf scale=1280:-2 film.mp4"),
    "longer than allowed": Case(data=film, given={"limits": FilmLimits(seconds=0.1)},
        words="film: expected at most 0.1 seconds, got more. Cut the film, or select the frames of a part: frames='0:300'."),
    "pictures of more pixels than allowed": Case(name="film.zip", data=pictures, given={"limits": FilmLimits(pixels=1000)},
        words="film: expected at most 1,000 pixels a frame, got 0.png of 64×48. Scale the film down: ffmpeg -i FILM -vf scale=1280:-2 film.mp4"),
    "more bytes of pictures than allowed": Case(name="film.zip", data=zipped(a_bmp=b"BM" + bytes(20_000_000)), given={"limits": FilmLimits(bytes=5_000_000)},
        words="film: expected pictures of at most 5,000,000 bytes together, got 20,000,002 in film.zip. Use fewer or smaller pictures."),
    "a zip of too many pictures": Case(name="film.zip", data=lambda path: films.zip_of(path, {f"{i:0200d}.png": b"" for i in range(20_000)}, zipfile.ZIP_STORED),
        words="film: expected a zip directory of at most 4,194,304 bytes, got 5,000,000 in film.zip. Put fewer pictures in the zip."),
    "a zip without pictures": Case(name="film.zip", data=zipped(notes_txt=b"none"),
        words="film: expected pictures (.png, .jpg, .jpeg, .webp, .bmp), got none in film.zip. Export the film's frames as PNG or JPEG, numbered in order."),
    "a folder without pictures": Case(name="film", data=lambda path: path.mkdir(),
        words="film: expected pictures (.png, .jpg, .jpeg, .webp, .bmp), got none in film. Export the film's frames as PNG or JPEG, numbered in order."),
    "a picture that ends early": Case(name="film.zip", data=zipped(a_png=films.png(PICTURES[0]), b_png=films.png(PICTURES[1])[:-200]),
        words="film: expected pictures that can be decoded, got b.png: …. Save it again as PNG or JPEG."),
    "a GIF that ends early": Case(name="film.gif", data=lambda path: path.write_bytes(films.gif(PICTURES)[:-500]),
        words="film: expected pictures that can be decoded, got film.gif: …. Copy it again, or convert the frames that it has: ffmpeg -i FILM film.mp4"),
    "a broken deflate stream": Case(name="film.zip", data=broken_deflate,
        words="film: expected pictures that can be decoded, got 1.png: …. Save it again as PNG or JPEG."),
    "pictures of several sizes": Case(name="film.zip", data=lambda path: films.zip_of(path, {f"{i}.png": films.png(np.zeros((h, w, 3), np.uint8)) for i, (w, h) in enumerate(ODD)}),
        words="film: expected all frames of 64×48 pixels, got 32×48 in frame 2. Export all frames in one size."),
    "a tiny picture": Case(name="film.zip", data=zipped(a_png=films.png(np.zeros((8, 8, 3), np.uint8))),
        words="film: expected frames of at least 16×16 pixels, got a.png of 8×8. Film at 640×480 or more."),
    "a selection that is none": Case(data=film, given={"frames": "5:2"},
        words="frames: expected a number of frames from 1, or start:stop:step with start ≥ 0, stop > start and step ≥ 1, got '5:2'. For example '0:300:2', every second of the first 300 frames."),
    "two frames": Case(data=film, given={"frames": "0:2"}, track=True,
        words="film: expected at least 3 frames, got 2. Widen the selection of the 8 frames."),
    "two pictures": Case(name="film.zip", data=lambda path: films.zip_of(path, {f"{i}.png": films.png(np.zeros((48, 64, 3), np.uint8)) for i in range(2)}), track=True,
        words="film: expected at least 3 frames, got 2 pictures in film.zip, read as a zip of pictures. Add the other frames of the film."),
    "an npz of tracks": Case(name="tracks.npz", data=lambda path: np.savez(path, tracks=np.zeros((3, 4, 2))), words=TRACKS.format("tracks.npz")),
    "an npy of tracks": Case(name="tracks.npy", data=lambda path: np.save(path, np.zeros((3, 4, 2))), words=TRACKS.format("tracks.npy")),
    "a MATLAB file": Case(name="tracks.mat", data=b"MATLAB 5.0 MAT-file" + bytes(600), words=TRACKS.format("tracks.mat")),
    "a MATLAB 7.3 file": Case(name="tracks.mat", data=b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(600), words=TRACKS.format("tracks.mat")),
    "a table": Case(name="tracks.csv", data=b"frame,point,x,y\n0,0,1,2\n", words=TRACKS.format("tracks.csv")),
    "a frame beyond the film": Case(data=film, given={"region": ~EMPTY, "region_frame": 99}, track=True,
        words="region_frame: expected a frame number from 0 to 7, got 99. Frames are counted in the whole film from 0."),
    "a template beyond the film": Case(data=film, given={"template_frame": 99}, track=True,
        words="template_frame: expected a frame number from 0 to 7, got 99. Frames are counted in the whole film from 0."),
    "points too close": Case(data=film, given={"grid_step": 0.0}, track=True,
        words="grid_step: expected a distance of 1 to 100 pixels, got 0.0. Correct the argument."),
    "a region of another size": Case(data=film, given={"region": np.ones((10, 10), bool)}, track=True,
        words="region: expected a mask of 64×48 pixels, the film's size, got 10×10. Draw the region on a frame of this film, upright as it is shown."),
    "an empty region": Case(data=film, given={"region": EMPTY}, track=True,
        words="region: expected some pixels inside, got none. Draw around the object to track."),
    "a region that is no mask": Case(data=film, given={"region": np.ones((2, 3, 4, 5))}, track=True,
        words="region: expected a mask (H, W) of bool or uint8, or a polygon (N, 2) with N ≥ 3, got shape (2, 3, 4, 5), dtype float64. Convert the array."),
    "a polygon of two corners": Case(data=film, given={"region": np.ones((2, 2))}, track=True,
        words="region: expected a polygon of at least 3 corners around an area, with finite pixel coordinates up to 1,000,000, got 2 corners. Draw around the object to track."),
    "a polygon on a line": Case(data=film, given={"region": np.array([[0, 0], [10, 10], [20, 20]])}, track=True,
        words="region: expected a polygon of at least 3 corners around an area, with finite pixel coordinates up to 1,000,000, got corners on one line. Draw around the object to track."),
    "a region that is no picture": Case(data=film, given={"region": __file__}, track=True,
        words="region: expected a PNG, JPEG, WebP, BMP or GIF picture, got test_words_of_refusals.py: …. Save the mask as PNG: white inside, black outside."),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_each_invalid_film_gets_its_exact_error_message(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    words = str(refused(case, tmp_path))
    if "…" in case.words:  # this part comes from a library
        words = re.sub(r"\.(png|py|gif): .+\. (Save|Copy)", r".\1: …. \2", words)
    assert words == case.words
