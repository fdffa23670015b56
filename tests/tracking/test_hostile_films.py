"""Files that are not films, refer to other files, or have inconsistent headers."""

from __future__ import annotations

import os
import struct
import sys
import zipfile
from pathlib import Path

import films
import pytest
from pliant.tracking import FilmError, open_film

PICTURES = films.textured_pictures(12)
FTYP = films.box(b"ftyp", b"isom", b"\0\0\2\0", b"isom")


def refused(path: Path) -> str:
    with pytest.raises(FilmError) as caught:
        for _ in open_film(path).frames():
            pass
    assert caught.value.field == "film"
    assert caught.value.hint
    return caught.value.code


@pytest.mark.parametrize("suffix", [".mp4", ".m3u8", ".avi", ".txt"])
@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n",
        "ffconcat version 1.0\nfile /etc/passwd\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
        "\n  <?xml version='1.0'?><MPD></MPD>",
        "http://127.0.0.1/film.mp4",
    ],
)
def test_playlists_are_refused_whatever_their_name(tmp_path: Path, suffix: str, text: str) -> None:
    path = tmp_path / f"film{suffix}"
    path.write_text(text)
    assert refused(path) == "playlist"


@pytest.mark.parametrize(
    "data", [b"DISPLAY=AviSource('x.avi')", b"\x89PNG\r\n\x1a\n", b"\0" * 100, b"%PDF-1.7", b"\x1aE\xdf\xa3 other"]
)
def test_files_that_are_not_films_are_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(data)
    assert refused(path) == "unsupported_film"


def test_missing_and_empty_files_are_refused(tmp_path: Path) -> None:
    assert refused(tmp_path / "none.mp4") == "unreadable_film"
    (tmp_path / "film.mp4").write_bytes(b"")
    assert refused(tmp_path / "film.mp4") == "empty_film"
    assert refused(tmp_path) == "no_picture"


@pytest.mark.parametrize("name", ["%03d.mp4", "http:film.mp4", "concat:a|b.mp4", "pipe:0"])
def test_file_names_are_not_interpreted_as_patterns_or_urls(tmp_path: Path, name: str) -> None:
    films.write_film(tmp_path / "plain.mp4", PICTURES).rename(tmp_path / name)
    assert len(list(open_film(tmp_path / name).frames())) == 12


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "pictures"])
def test_a_path_that_is_no_utf_8_is_refused(tmp_path: Path, name: str) -> None:
    """OpenCV would end the process."""
    folder = Path(os.fsdecode(bytes(tmp_path) + b"/bad\xff"))
    folder.mkdir()
    films.write_film(tmp_path / "film.mp4", PICTURES).rename(folder / "film.mp4")
    (folder / "film.gif").write_bytes(b"GIF89a")
    (folder / "pictures").mkdir()
    with pytest.raises(FilmError, match="Rename the file or folder") as caught:
        open_film(folder / name)
    assert caught.value.code == "unreadable_film"
    assert caught.value.got.encode().endswith(f"bad?/{name}".encode())


def test_pipes_and_devices_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "film.mp4")
    for path in (tmp_path / "film.mp4", Path("/dev/zero")):
        with pytest.raises(FilmError, match="a pipe or a device") as caught:
            open_film(path)
        assert caught.value.code == "unreadable_film"


@pytest.mark.parametrize("name", ["x" * 300 + ".mp4", "a\0b.mp4", "film.mp4/below"])
def test_names_that_the_system_does_not_allow_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "film.mp4").write_bytes(b"")
    assert refused(tmp_path / name) == "unreadable_film"


def test_a_film_that_may_not_be_looked_at_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = films.write_film(tmp_path / "film.mp4", PICTURES)

    def locked(self: Path, **options: object) -> os.stat_result:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "stat", locked)
    assert refused(path) == "unreadable_film"


@pytest.mark.parametrize("matrix", [(-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, -1, -1, 0)])
@pytest.mark.parametrize(("kind", "place"), [(b"tkhd", 44), (b"mvhd", 40)])
def test_mirrored_films_are_refused(tmp_path: Path, kind: bytes, place: int, matrix: tuple[int, ...]) -> None:
    a, b, c, d = (number << 16 for number in matrix)
    path = films.write_film(tmp_path / "film.mp4", PICTURES)
    films.patched(path, kind, place, struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30))
    with pytest.raises(FilmError, match=r"to be shown mirrored\. Convert it") as caught:
        open_film(path)
    assert caught.value.code == "unsupported_film"


def test_the_matrix_of_a_long_header_is_read(tmp_path: Path) -> None:
    def film(*matrix: int) -> Path:
        a, b, c, d = (number << 16 for number in matrix)
        header = b"\1" + bytes(51) + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
        path = tmp_path / "film.mp4"
        path.write_bytes(FTYP + films.box(b"moov", films.box(b"trak", films.box(b"tkhd", header + bytes(8)))))
        return path

    assert refused(film(-1, 0, 0, 1)) == "unsupported_film"
    assert refused(film(0, 1, -1, 0)) == "no_picture"


@pytest.mark.parametrize("brand", [b"heic", b"mif1", b"avif"])
def test_a_photograph_is_no_film_that_was_cut_off(tmp_path: Path, brand: bytes) -> None:
    path = tmp_path / "photo.heic"
    path.write_bytes(
        films.box(b"ftyp", brand, b"\0\0\0\0", b"mif1") + films.box(b"meta", bytes(4)) + films.box(b"mdat")
    )
    with pytest.raises(FilmError, match="a single photograph") as caught:
        open_film(path)
    assert caught.value.code == "unsupported_film"


def test_a_picture_of_an_unknown_format_is_named_without_its_address(tmp_path: Path) -> None:
    path = films.zip_of(tmp_path / "film.zip", {"1.png": b"no picture"})
    with pytest.raises(FilmError) as caught:
        open_film(path)
    assert caught.value.got == "1.png: its format is not recognised"


@pytest.mark.parametrize("frames", [slice("a", None), slice(1.5, 9), slice(0, 9, 2.0), 5.0, [3]])
def test_selections_of_other_types_are_refused(tmp_path: Path, frames: object) -> None:
    path = films.write_film(tmp_path / "film.avi", PICTURES)
    with pytest.raises(FilmError) as caught:
        open_film(path, frames=frames)  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("wrong_selection", "frames")


def test_samples_in_another_file_are_refused(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mov", PICTURES)
    entry = path.read_bytes().index(b"url ", path.read_bytes().index(b"dref"))
    data = bytearray(path.read_bytes())
    data[entry + 7] = 0
    path.write_bytes(data)
    assert refused(path) == "external_reference"


def test_miscounted_data_references_are_refused(tmp_path: Path) -> None:
    def film(dref: bytes) -> Path:
        path = tmp_path / "film.mp4"
        minf = films.box(b"minf", films.box(b"dinf", films.box(b"dref", dref)))
        path.write_bytes(FTYP + films.box(b"moov", films.box(b"trak", films.box(b"mdia", minf))))
        return path

    own = struct.pack(">I4sI", 12, b"url ", 1)
    assert refused(film(struct.pack(">II", 0, 1) + own)) == "no_picture"
    assert refused(film(struct.pack(">II", 0, 2) + own)) == "external_reference"
    assert refused(film(struct.pack(">II", 0, 9999) + own * 300)) == "external_reference"


def test_a_reference_movie_is_refused(tmp_path: Path) -> None:
    (tmp_path / "film.mov").write_bytes(FTYP + films.box(b"moov", films.box(b"rmra", b"")))
    assert refused(tmp_path / "film.mov") == "external_reference"


def test_a_film_without_a_picture_track_is_refused(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mp4", PICTURES)
    assert refused(films.patched(path, b"hdlr", 12, b"soun")) == "no_picture"
    with pytest.raises(FilmError) as caught:
        open_film(path)
    assert str(caught.value).endswith(
        "got film.mp4, which holds sound but no picture. Pass a film with a picture track."
    )


def test_thousands_of_streams_are_refused(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(FTYP + films.box(b"moov", films.box(b"trak") * 5000))
    assert refused(tmp_path / "film.mp4") == "too_many_streams"
    path = films.write_film(tmp_path / "film.avi", PICTURES)
    assert refused(films.patched(path, b"avih", 32, struct.pack("<I", 4000))) == "too_many_streams"


def test_thousands_of_boxes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(FTYP + films.box(b"free") * 30_000)
    assert refused(tmp_path / "film.mp4") == "unsupported_film"


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_truncated_films_are_refused(tmp_path: Path, share: float) -> None:
    path = films.write_film(tmp_path / "film.mp4", PICTURES)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert refused(path) in ("truncated_film", "no_picture", "undecodable_film")


def test_a_headless_avi_is_refused(tmp_path: Path) -> None:
    (tmp_path / "film.avi").write_bytes(b"RIFF\0\0\0\0AVI LIST")
    assert refused(tmp_path / "film.avi") == "truncated_film"


def test_immense_dimensions_are_refused(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.avi", PICTURES)
    data = path.read_bytes()
    lying = data.replace(
        b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", 48, 64), b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", 9000, 9000)
    )
    assert lying != data
    path.write_bytes(lying)
    assert refused(path) in ("too_many_pixels", "undecodable_film")


def test_wrong_container_dimensions_are_ignored(tmp_path: Path) -> None:
    path = films.patched(
        films.write_film(tmp_path / "film.avi", PICTURES), b"strf", 12, struct.pack("<ii", 60_000, 60_000)
    )
    assert open_film(path).size == (64, 48)


def test_a_film_header_followed_by_zeros_is_refused(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mkv", PICTURES)
    path.write_bytes(path.read_bytes()[:64] + bytes(1000))
    assert refused(path) == "undecodable_film"


@pytest.mark.parametrize("data", [b"PK\x03\x04" + bytes(100), b"GIF89a" + bytes(20)])
def test_broken_zips_and_gifs_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "film").write_bytes(data)
    assert refused(tmp_path / "film") in ("broken_picture", "too_small")


def test_a_broken_picture_is_named(tmp_path: Path) -> None:
    pictures = {"1.png": films.png(PICTURES[0]), "2.png": films.png(PICTURES[1])[:-200]}
    path = films.zip_of(tmp_path / "film.zip", pictures)
    with pytest.raises(FilmError, match=r"2\.png"):
        list(open_film(path).frames())
    assert refused(films.zip_of(tmp_path / "none.zip", {"notes.txt": b"none"})) == "no_picture"


def test_a_broken_picture_of_any_zip_compression_is_refused(tmp_path: Path) -> None:
    for compression in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        path = films.zip_of(tmp_path / "film.zip", {"1.png": films.png(PICTURES[0])}, compression)
        data = bytearray(path.read_bytes())
        data[60:1000] = b"\xff" * 940
        path.write_bytes(data)
        assert refused(path) == "broken_picture"


def test_a_picture_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for number, picture in enumerate(PICTURES[:3]):
        (tmp_path / f"{number}.png").write_bytes(films.png(picture))
    frames = open_film(tmp_path).frames()
    next(frames)
    (tmp_path / "2.png").unlink()
    with pytest.raises(FilmError, match=r"got 2\.png: No such file or directory") as caught:
        list(frames)
    assert caught.value.code == "unreadable_film"
