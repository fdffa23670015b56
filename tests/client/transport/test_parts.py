"""User inputs become files that the service reads; inputs that cannot are rejected by the client."""

from __future__ import annotations

import copy
import gc
import io
import os
import zipfile
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image
from pliant.client import BadArgument, Client, NotLoaded, Options, Retry, Unreachable
from pliant.client.input_files import array_part, existing_file, film_file, mesh_part, region_part, tracks_file
from pliant.client.multipart import Form, Inputs, checked_options
from pliant.service.testing import InMemoryService
from pliant.tracking.region import read_region

POINTS = np.arange(4 * 9 * 2, dtype=np.float32).reshape(4, 9, 2)


def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as held:
        return dict(held)


class Tensor:
    """Like a PyTorch tensor on a device and in a graph."""

    def __init__(self, array: np.ndarray, *, attached: bool = True, remote: bool = True) -> None:
        self.array, self.attached, self.remote = array, attached, remote

    def detach(self) -> Tensor:
        return Tensor(self.array, attached=False, remote=self.remote)

    def cpu(self) -> Tensor:
        return Tensor(self.array, attached=self.attached, remote=False)

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        if self.attached or self.remote:
            raise TypeError("call detach() and cpu() first")
        return self.array


def test_an_array_keeps_its_dtype_and_stores_its_visibility(tmp_path: Path) -> None:
    held = arrays(tracks_file(POINTS, np.ones((4, 9), bool), tmp_path))
    np.testing.assert_array_equal(held["tracks"], POINTS)
    assert held["tracks"].dtype == np.float32
    assert held["visibility"].shape == (4, 9)
    assert set(arrays(tracks_file(POINTS.tolist(), None, tmp_path))) == {"tracks"}


def test_masked_array_entries_become_hidden_points(tmp_path: Path) -> None:
    mask = np.zeros(POINTS.shape, bool)
    mask[1, 2, 0] = True
    masked = np.ma.masked_array(POINTS, mask)
    confidence = np.ma.masked_array(np.ones((4, 9), bool), mask[..., 0])
    for given, visible in ((masked, None), (masked, np.ones((4, 9))), ({"tracks": masked}, None)):
        held = arrays(tracks_file(given, visible, tmp_path))
        assert np.argwhere(np.isnan(held["tracks"]).any(axis=2)).tolist() == [[1, 2]]
        assert held["tracks"].dtype == np.float32
    held = arrays(tracks_file(POINTS, confidence, tmp_path))
    assert np.argwhere(np.isnan(held["visibility"])).tolist() == [[1, 2]]
    reading = Client("http://pliant.test", transport=InMemoryService()).inspect(POINTS, visible=confidence)
    assert reading.hidden_fraction == 1 / 36
    assert (
        arrays(tracks_file(np.ma.masked_array(np.arange(72).reshape(4, 9, 2)), None, tmp_path))["tracks"].dtype.kind
        == "i"
    )


def test_the_dictionary_of_a_tracker_is_sent_unchanged(tmp_path: Path) -> None:
    given = {"pred_tracks": Tensor(POINTS[None]), "pred_visibility": Tensor(np.ones((1, 4, 9), bool))}
    held = arrays(tracks_file(given, None, tmp_path))
    assert {name: array.shape for name, array in held.items()} == {
        "pred_tracks": (1, 4, 9, 2),
        "pred_visibility": (1, 4, 9),
    }


def test_the_same_arrays_make_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one, other = (tracks_file(POINTS, None, tmp_path / name).read_bytes() for name in "ab")
    assert one == other


def test_meshes_can_be_grid_sizes_faces_or_files(tmp_path: Path) -> None:
    assert {mesh_part(each, tmp_path) for each in ((3, 4), [3, 4], np.array([3, 4]), "3x4", "3 x 4", "3X4", "3×4")} == {
        "3x4"
    }
    assert mesh_part("none", tmp_path) == "none"
    faces = mesh_part([[0, 1, 2], [0, 2, 3]], tmp_path)
    assert arrays(Path(faces))["faces"].tolist() == [[0, 1, 2], [0, 2, 3]]
    assert arrays(Path(mesh_part({"grid": np.zeros((2, 2), int)}, tmp_path)))["grid"].shape == (2, 2)
    assert mesh_part(faces, tmp_path) == mesh_part(str(faces), tmp_path) == faces


def test_ground_truth_can_be_an_array_a_dictionary_or_a_file(tmp_path: Path) -> None:
    path = array_part(np.zeros((4, 9, 3)), "ground_truth", "shapes", tmp_path)
    assert list(arrays(path)) == ["shapes"]
    assert set(arrays(array_part({"shapes": [1.0], "rotations": [2.0]}, "ground_truth", "shapes", tmp_path))) == {
        "shapes",
        "rotations",
    }
    assert array_part(path, "ground_truth", "shapes", tmp_path) == path


@pytest.mark.parametrize("inside", [True, 255, 128])
def test_a_region_can_be_an_array_or_a_file(inside: object, tmp_path: Path) -> None:
    mask = np.zeros((24, 32), bool if inside is True else np.uint8)
    mask[3:9, 4:20] = inside
    path = region_part(mask, tmp_path)
    np.testing.assert_array_equal(read_region(path, (32, 24)), read_region(mask, (32, 24)))
    assert region_part(path, tmp_path) == region_part(str(path), tmp_path) == path
    (tmp_path / "film.mp4").write_bytes(b"a film")
    form = Inputs(tracks=None, film=tmp_path / "film.mp4", region=mask).form(tmp_path, {}, None)
    assert form.files == {"film": tmp_path / "film.mp4", "region": path}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda here: tracks_file("nowhere.npz", None, here), "got no file at nowhere.npz"),
        (
            lambda here: tracks_file("~nosuchuser/x.npz", None, here),
            "tracks: expected a path, got ~nosuchuser/x.npz, and ~nosuchuser is no user's home directory",
        ),
        (lambda here: tracks_file({"tracks": POINTS}, np.ones((4, 9)), here), "contains its own visibility"),
        (lambda here: tracks_file({"model": "cotracker3"}, None, here), "model: expected an array of numbers"),
        (lambda here: tracks_file(np.array([None]), None, here), "got dtype object"),
        (lambda here: tracks_file(POINTS * 1j, None, here), "got dtype complex"),
        (lambda here: mesh_part("3by4", here), "mesh: expected a file"),
        (lambda here: checked_options({"loss": "l3", "los": 1}), r"loss: .*'l3'.*los: .*mean loss\? `pliant options`"),
        (lambda here: checked_options({"image_size": [320, 240]}), r"expected width and height in pixels, such as 1920x1080, got \[320"),
        (lambda here: checked_options({"frames": 3}), "expected start:stop:step, such as 10:200:2, got 3"),
        (lambda here: checked_options(5), "options: expected a mapping .* got a value of type int"),
        (lambda here: tracks_file(object(), None, here), "tracks: expected an array of numbers or booleans, got a value of type object"),
        (lambda here: tracks_file([[1.0], [2.0, 3.0]], None, here), "got a value of type list, which cannot be converted. Pad ragged"),
        (lambda here: tracks_file(b"x", None, here), "got a value of type bytes, which .* by their path"),
        (lambda here: mesh_part(object(), here), "mesh: expected an array of numbers or booleans, got a value of type object"),
        (
            lambda here: Inputs(tracks=None, film="nofilm.mp4").form(here, {}, None),
            r"^film: expected the path of a film or of a folder of pictures, got no file at nofilm\.mp4\. Check the path\.$",
        ),
        (
            lambda here: region_part("nomask.png", here),
            r"^region: expected the path of a mask picture, or an array \(H, W\), got no file at nomask\.png",
        ),
        (lambda here: existing_file(POINTS, "film"), "film: expected the path of a file, got a value of type ndarray"),
        (lambda here: region_part(POINTS, here), r"region: expected the path .* of bool or uint8, got an array of shape \(4, 9, 2\)"),
        (lambda here: region_part(POINTS[0], here), r"dtype float32\. Convert it; a polygon is the option region_polygon"),
        (lambda here: tracks_file(io.BytesIO(b"x"), None, here), "got a value of type BytesIO, which cannot be converted"),
        (lambda here: region_part(object(), here), "region: expected an array of numbers or booleans"),
    ],
)  # fmt: skip
def test_invalid_inputs_are_rejected_before_anything_is_sent(make: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(BadArgument, match=words):
        make(tmp_path)


def test_an_open_file_that_is_refused_can_still_be_read(tmp_path: Path) -> None:
    path = tmp_path / "tracks.npz"
    path.write_bytes(b"some bytes")
    with path.open("rb") as file:
        with pytest.raises(BadArgument, match="give files by their path"):
            tracks_file(file, None, tmp_path)
        assert file.read() == b"some bytes"


def test_a_mask_among_the_pictures_of_a_film_is_refused(tmp_path: Path) -> None:
    mask = np.full((8, 6), 255, np.uint8)
    for name in ("1.png", "mask.png"):
        Image.fromarray(mask).save(tmp_path / name)
    with pytest.raises(
        BadArgument, match=r"region: expected a mask outside the film's folder of pictures, got mask\.png in it"
    ):
        Inputs(tracks=None, film=tmp_path, region=tmp_path / "mask.png").form(tmp_path, fields={}, on_upload=None)
    (tmp_path / "film").mkdir()
    assert region_part(tmp_path / "mask.png", tmp_path, film=tmp_path / "film") == tmp_path / "mask.png"


def test_a_region_of_zeros_and_ones_is_a_mask(tmp_path: Path) -> None:
    mask = np.zeros((6, 8), dtype=np.uint8)
    mask[2:4, 3:6] = 1
    assert read_region(region_part(mask, tmp_path), (8, 6)).sum() == 6
    assert read_region(region_part(255 * mask, tmp_path), (8, 6)).sum() == 6


@pytest.mark.parametrize("timeout", ["3", True, float("nan"), object(), np.ones(2)])
def test_a_timeout_that_is_no_number_is_refused(timeout: Any) -> None:
    with pytest.raises(BadArgument, match="timeout: expected seconds as a number"):
        Client("http://pliant.test", transport=InMemoryService()).limits(timeout=timeout)


def test_arguments_of_clients_and_submissions_are_checked() -> None:
    client = Client("http://pliant.test", transport=InMemoryService(), token="")
    assert client.limits(timeout=np.float32(20)).max_frames > 0
    with pytest.raises(BadArgument, match="name: expected a str, got a value of type int"):
        client.submit(POINTS, name=5)  # type: ignore[arg-type]
    with pytest.raises(BadArgument, match="token: expected a str"):
        Client("http://pliant.test", token=5)  # type: ignore[arg-type]
    with pytest.raises(BadArgument, match=r"retries: expected a Retry, such as Retry\(patience=10\), got 3"):
        Client("http://pliant.test", retries=3)  # type: ignore[arg-type]
    with pytest.raises(BadArgument, match="limit: expected at least 0 jobs, or None for all, got -1"):
        list(client.list(limit=-1))
    for size in (0, 201):
        with pytest.raises(BadArgument, match=f"page_size: expected 1 to 200 jobs, got {size}. Use limit"):
            list(client.list(page_size=size))
    wrong: Any
    for wrong in ("3", 1.5):
        with pytest.raises(BadArgument, match=f"limit: expected at least 0 jobs, or None for all, got {wrong!r}"):
            list(client.list(limit=wrong))
        with pytest.raises(BadArgument, match=f"page_size: expected 1 to 200 jobs, got {wrong!r}"):
            list(client.list(page_size=wrong))
    wrong = timedelta(days=1)
    with pytest.raises(BadArgument, match="days: expected a minute"):
        client.submit(POINTS).share(days=wrong)
    client.close()
    with pytest.raises(BadArgument, match="The client is closed"):
        client.limits()
    with pytest.raises(Unreachable, match=r"at http://127\.0\.0\.1:1:"):
        Client("http://127.0.0.1:1", retries=Retry(first_contact=0)).limits()


def test_options_are_a_record_or_a_mapping() -> None:
    assert checked_options(None) == Options()
    assert checked_options({"loss": "huber"}) == checked_options(Options(loss="huber"))


def test_a_body_is_streamed_counted_and_can_be_sent_again(tmp_path: Path) -> None:
    big = tmp_path / "big.bin"
    big.write_bytes(bytes(300_000))
    updates: list[tuple[int, int]] = []
    form = Form(fields={"name": "ü"}, files={"tracks": big}, on_upload=lambda *now: updates.append(now))
    for _ in range(2):
        updates.clear()
        with form.open() as files:
            request = httpx.Client().build_request("POST", "http://x/", data=dict(form.fields), files=files)
            pieces = list(request.stream)
        assert max(map(len, pieces)) <= 65536
        assert int(request.headers["content-length"]) == sum(map(len, pieces))
        assert updates[-1] == (300_000, 300_000)
        body = b"".join(pieces)
        assert 'name="name"\r\n\r\nü\r\n'.encode() in body
        assert b'name="tracks"; filename="big.bin"' in body
        assert bytes(300_000) in body


def test_no_temporary_file_remains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = InMemoryService()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with Client("http://pliant.test", transport=service) as client:
        result = client.submit(POINTS).wait(timeout=9)
        assert result.shapes.shape == (4, 9, 3)
        assert len(list(tmp_path.glob("pliant-result-*"))) == 1
        del result
    service.stop()
    assert list(tmp_path.iterdir()) == []


def test_reading_a_result_before_load_is_an_error(tmp_path: Path) -> None:
    with Client("http://pliant.test", transport=InMemoryService()) as client:
        result = client.submit(POINTS).wait(timeout=9, load=False, folder=tmp_path)
        with pytest.raises(NotLoaded, match=r"call load\(\)"):
            _ = result.shapes
        assert result.load().shapes.shape == (4, 9, 3)
        assert result.metrics["reprojection_median"] < 1e-9
        assert result.faces.shape == (0, 3)


def test_a_plot_shows_the_requested_frames(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with Client("http://pliant.test", transport=InMemoryService()) as client:
        figure = client.submit(POINTS, name="a face").wait(timeout=9).plot(frames=3)
    assert [axes.get_title() for axes in figure.axes] == ["frame 0", "frame 2", "frame 3"]
    picture = io.BytesIO()
    figure.savefig(picture)
    assert picture.getvalue()[:4] == b"\x89PNG"


def test_a_copy_of_a_result_keeps_its_files() -> None:
    with Client("http://pliant.test", transport=InMemoryService()) as client:
        result = client.submit(POINTS).wait(timeout=60)
    folder, other = result.folder, copy.copy(result)
    shapes = result.shapes
    del result
    gc.collect()
    np.testing.assert_array_equal(other.shapes, shapes)
    assert folder.exists()
    del other
    gc.collect()
    assert not folder.exists()


def test_a_folder_is_not_an_input(tmp_path: Path) -> None:
    with pytest.raises(BadArgument, match="got the folder"):
        existing_file(tmp_path, "mesh")
    (tmp_path / "notes.md").write_text("no picture")
    with pytest.raises(BadArgument, match=r"film: expected a film or a folder of pictures \(\.png, .*, which has none"):
        film_file(tmp_path, tmp_path)


def test_a_folder_that_cannot_be_read_is_not_a_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(folder: Path) -> list[Path]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pliant.client.input_files.pictures_in", refuse)
    with pytest.raises(BadArgument, match=r"film: the folder .* cannot be read: Permission denied\. Change its perm"):
        film_file(tmp_path, tmp_path)


def test_the_zip_of_a_folder_of_pictures_depends_only_on_its_pictures(tmp_path: Path) -> None:
    sent = []
    for name, order in (("first", (3, 0, 2, 1)), ("second", range(4))):
        folder, scratch = tmp_path / name, tmp_path / f"scratch of {name}"
        folder.mkdir()
        scratch.mkdir()
        for number in order:
            (folder / f"{number}.PNG").write_bytes(bytes([number]))
        (folder / "notes.md").write_text(name)
        (folder / ".hidden.png").write_bytes(b"")
        packed = film_file(folder, scratch)
        sent.append(packed.read_bytes())
        with zipfile.ZipFile(packed) as archive:
            assert archive.namelist() == ["0.PNG", "1.PNG", "2.PNG", "3.PNG"]
    assert sent[0] == sent[1]


@pytest.mark.skipif(os.fsencode("\udcff") != b"\xff", reason="names of files are text here")
def test_a_file_whose_name_is_not_utf8_is_sent(tmp_path: Path) -> None:
    path = tmp_path / "take \udcff.npz"
    np.savez(path, tracks=POINTS)
    with Client("http://pliant.test", transport=InMemoryService()) as client:
        assert client.submit(path).wait(timeout=60).shapes.shape == (4, 9, 3)
