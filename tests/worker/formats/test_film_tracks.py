"""Files of `pliant track`: the arrays beside the tracks are used too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.solver.errors import InvalidInput
from pliant.worker.films.inputs import read_tracked
from pliant.worker.films.tracker import Tracked
from pliant.worker.formats import load_inputs, read_inputs, save_inputs, store_inputs
from pliant.worker.formats.cost import estimated
from pliant.worker.formats.tracks.film_tracks import tracks_options

FRAMES, ROWS, COLUMNS = 5, 4, 5
POINTS = ROWS * COLUMNS - 1


def film_arrays() -> dict[str, np.ndarray]:
    """A grid with one hole that moves to the right, with every array of `TrackedFilm.save_npz`."""
    random = np.random.default_rng(0)
    grid = np.arange(ROWS * COLUMNS, dtype=np.int32).reshape(ROWS, COLUMNS) - 1  # the first cell is the hole
    row, column = np.nonzero(grid >= 0)
    start = 8.0 * np.stack([column, row], axis=1) + 10
    tracks = start + np.arange(FRAMES)[:, None, None] * (1.5, 0.2) + 0.05 * random.standard_normal((FRAMES, POINTS, 2))
    visible = np.ones((FRAMES, POINTS), dtype=bool)
    visible[2, 3] = visible[4, 0] = False
    confidence = np.where(visible, random.uniform(0.2, 1, visible.shape), 0)
    return {
        "tracks": tracks.astype(np.float32), "visibility": visible, "confidence": confidence.astype(np.float32), "grid": grid,
        "uv": ((start + 0.5) / (64, 48)).astype(np.float32), "template": np.array(0), "fps": np.array(24.0),
        "template_image": random.integers(0, 256, (48, 64, 3), dtype=np.uint8), "image_size": np.array([64, 48]),
        "frame_indices": np.arange(FRAMES), "frame_times": np.arange(FRAMES) / 24, "warnings": np.array(["Only 5 frames are tracked."]),
    }  # fmt: skip


def film_file(path: Path, **changed: object) -> Path:
    arrays = {name: value for name, value in (film_arrays() | changed).items() if value is not None}
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def test_options_that_are_not_given_stay_so_in_the_isolated_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frame rate of a film's tracks follows from the selected frames unless the job gives one."""
    film = film_file(tmp_path / "tracks.npz")
    for given in ({}, {"fps": 50}):
        options = Options(frames="::2", **given)
        here = read_inputs(tracks=film, options=options).interpretation
        monkeypatch.setattr("pliant.worker.formats.isolated_reader.LARGE", 0)
        assert store_inputs(tracks=film, options=options, target=tmp_path / "c.npz").notes == here.notes
        assert any("at the same fps" in note for note in here.notes) == bool(given)


def test_every_array_of_the_tracker_is_used(tmp_path: Path) -> None:
    given = film_arrays()
    inputs = read_inputs(tracks=film_file(tmp_path / "tracks.npz"), options=Options())
    np.testing.assert_array_equal(inputs.tracks.points[given["visibility"]], given["tracks"][given["visibility"]])
    np.testing.assert_array_equal(inputs.tracks.visible, given["confidence"])
    assert inputs.mesh is not None
    np.testing.assert_array_equal(inputs.mesh.grid, given["grid"])
    assert inputs.texture is not None
    np.testing.assert_allclose(inputs.texture.uv, given["uv"])
    interpretation = inputs.interpretation
    assert (interpretation.format, interpretation.mesh_source, interpretation.image_size, interpretation.fps) == (
        "Pliant",
        "film",
        "64x48",
        24.0,
    )
    assert tracks_options(Options(), interpretation) == Options(image_size="64x48", fps=24)
    assert interpretation.estimate == estimated(FRAMES, POINTS, Options(image_size="64x48"))
    save_inputs(inputs, tmp_path / "stored.npz")
    back = load_inputs(tmp_path / "stored.npz")
    assert back.interpretation == interpretation
    assert back.texture == inputs.texture or back.texture.jpeg == inputs.texture.jpeg  # type: ignore[union-attr]
    for held in (inputs, back):
        np.testing.assert_array_equal(held.frame_times, given["frame_times"])
        assert held.warnings == ("Only 5 frames are tracked.",)


def test_options_and_a_given_mesh_override_the_file(tmp_path: Path) -> None:
    file = film_file(tmp_path / "tracks.npz")
    inputs = read_inputs(tracks=file, mesh="none", options=Options(frames="::2", y_axis="up"))
    assert inputs.mesh is None
    assert inputs.interpretation.y_axis == "up"
    assert inputs.interpretation.fps == 12.0
    given = Options(image_size="80x60", fps=10)
    assert tracks_options(given, inputs.interpretation) == given
    plain = Options()
    assert tracks_options(plain, read_inputs(tracks=plain_file(tmp_path), options=plain).interpretation) == plain


def plain_file(folder: Path) -> Path:
    given = film_arrays()
    np.savez(folder / "plain.npz", tracks=given["tracks"], visibility=given["visibility"])
    return folder / "plain.npz"


def test_a_film_job_reads_the_file_as_a_tracks_job_does(tmp_path: Path) -> None:
    file = film_file(tmp_path / "tracks.npz")
    alone = read_inputs(tracks=file, options=Options(stride=2))
    job = read_tracked(file, Tracked(container="mp4", fps=30.0, warnings=()), Options(stride=2))
    np.testing.assert_array_equal(alone.tracks.points, job.tracks.points)
    np.testing.assert_array_equal(alone.tracks.visible, job.tracks.visible)
    assert alone.mesh is not None
    assert job.mesh is not None
    np.testing.assert_array_equal(alone.mesh.faces, job.mesh.faces)
    np.testing.assert_array_equal(alone.texture.uv, job.texture.uv)  # type: ignore[union-attr]
    assert alone.texture.jpeg == job.texture.jpeg  # type: ignore[union-attr]
    np.testing.assert_array_equal(alone.frame_times, job.frame_times)


def test_selected_frames_keep_their_times_and_have_their_own_mean_rate(tmp_path: Path) -> None:
    file = film_file(tmp_path / "tracks.npz", frame_times=np.array([1.0, 1.1, 1.2, 1.3, 2.0]))
    inputs = read_inputs(tracks=file, options=Options(frames="::2"))
    np.testing.assert_array_equal(inputs.frame_times, [1.0, 1.2, 2.0])
    assert inputs.interpretation.fps == 2.0
    without = film_file(tmp_path / "without.npz", frame_times=None)
    inputs = read_inputs(tracks=without, options=Options(frames="::2"))
    assert (inputs.frame_times, inputs.interpretation.fps) == (None, 12.0)


@pytest.mark.parametrize(("left_out", "words"), [("frame_times", "without times"), ("tracks", "without tracks")])
def test_a_film_process_that_leaves_out_times_or_tracks_is_not_believed(
    left_out: str, words: str, tmp_path: Path
) -> None:
    file = film_file(tmp_path / "tracks.npz", **{left_out: None})
    with pytest.raises(InvalidInput, match=f"film: .* {words}"):
        read_tracked(file, Tracked(container="mp4", fps=30.0, warnings=()), Options())


@pytest.mark.parametrize(
    ("changed", "got"),
    [
        ({"confidence": None}, "without confidence"),
        ({"grid": None, "fps": None}, "without grid, fps"),
        ({"confidence": np.ones((FRAMES, 2))}, "confidence of shape"),
        ({"visibility": np.ones((FRAMES, 3), dtype=bool)}, "visibility of shape"),
        ({"confidence": np.full((FRAMES, POINTS), 1.5)}, "confidence outside"),
        ({"confidence": np.full((FRAMES, POINTS), np.nan)}, "confidence outside"),
        ({"grid": np.arange(12).reshape(3, 4)}, "a grid of 12 points"),
        ({"image_size": np.array([64, 0])}, "image_size"),
        ({"image_size": np.array([6.5, 4.0])}, "image_size"),
        ({"fps": np.array(0.0)}, "fps"),
        ({"fps": np.array([24.0, 25.0])}, "fps"),
        ({"frame_times": np.arange(FRAMES - 1.0)}, "frame_times of shape"),
        ({"frame_times": np.ones(FRAMES, dtype=bool)}, "frame_times that do not increase"),
        ({"frame_times": np.array([0.0, 1.0, 1.0, 2.0, 3.0])}, "frame_times that do not increase"),
        ({"frame_times": np.array([0.0, 1.0, np.nan, 2.0, 3.0])}, "frame_times that do not increase"),
        ({"frame_times": np.array([0.0, 1.0, 2.0, 3.0, 1e300])}, "frame_times over 1e\\+300 seconds"),
        ({"warnings": np.array("one")}, "warnings of shape \\(\\) and type"),
        ({"warnings": np.array(["much"] * 101)}, "warnings of shape \\(101,\\)"),
        ({"warnings": np.array(["a" * 1001])}, "warnings of shape \\(1,\\) and type <U1001"),
        ({"warnings": np.array([0x110000], np.uint32).view("U1")}, "not Unicode"),
        ({"uv": np.zeros((3, 2), np.float32)}, "texture coordinates"),
        ({"template_image": np.zeros((4, 4), np.uint8)}, "template_image"),
        ({"template_image": np.zeros((1, 65_501, 3), np.uint8)}, "template_image"),  # too wide for a JPEG
    ],
)
def test_inconsistent_arrays_are_refused(tmp_path: Path, changed: dict[str, np.ndarray], got: str) -> None:
    with pytest.raises(InvalidInput, match=got) as refused:
        read_inputs(tracks=film_file(tmp_path / "tracks.npz", **changed), options=Options())
    assert refused.value.code == "damaged_file"


def test_tracks_of_another_shape_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="as pliant track writes it") as refused:
        read_inputs(tracks=film_file(tmp_path / "tracks.npz", tracks=np.zeros((5, 22))), options=Options())
    assert refused.value.code == "wrong_shape"


def test_a_file_without_its_picture_has_no_texture(tmp_path: Path) -> None:
    inputs = read_inputs(tracks=film_file(tmp_path / "tracks.npz", template_image=None), options=Options())
    assert inputs.texture is None
    assert inputs.interpretation.mesh_source == "film"
