"""Reading inputs: values are preserved, and invalid files are rejected with their code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, KnownCamera
from pliant.worker.formats import Inputs, Limits, load_inputs, read_inputs, save_inputs
from results import moving_sheet

pytestmark = pytest.mark.usefixtures("forked_readers")

F, P = 12, 30


def waving(frames: int = F, points: int = P) -> np.ndarray:
    """Tracks of a rotating random cloud: smooth in time, points in no order."""
    cloud = np.random.default_rng(5).normal(size=(points, 3)) * 40
    angles = np.linspace(0, 0.6, frames)
    rows = np.stack(
        [
            np.stack([np.cos(angles), np.zeros(frames), np.sin(angles)], axis=1),
            np.tile([0.0, 1.0, 0.0], (frames, 1))
            + np.stack([np.zeros(frames), np.zeros(frames), 0.3 * angles], axis=1),
        ],
        axis=1,
    )
    return np.einsum("fij,pj->fpi", rows, cloud) + 200.0


def saved(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def read(tmp_path: Path, options: Options | None = None, **arrays: object) -> Inputs:
    return read_inputs(tracks=saved(tmp_path / "tracks.npz", **arrays), options=options or Options())


def refused(code: str, act: Callable[[], object]) -> InvalidInput:
    with pytest.raises(InvalidInput) as caught:
        act()
    assert caught.value.code == code, str(caught.value)
    for text in (caught.value.field, caught.value.expected, caught.value.got, caught.value.hint):
        assert text
    return caught.value


def test_canonical_tracks_are_read_unchanged(tmp_path: Path) -> None:
    tracks = waving()
    visible = np.random.default_rng(0).random((F, P)) > 0.2
    got = read(tmp_path, tracks=tracks, visibility=visible)
    np.testing.assert_array_equal(got.tracks.points[visible], tracks[visible])
    np.testing.assert_array_equal(got.tracks.visible, visible)
    assert got.interpretation.layout == "tracks (F, P, 2)"
    assert got.interpretation.hidden_fraction == pytest.approx((~visible).mean())
    assert got.interpretation.y_axis == "down"


@pytest.mark.parametrize("dtype", [np.float32, np.float16, ">f8", np.int32])
def test_every_plain_number_type_is_read(tmp_path: Path, dtype: object) -> None:
    tracks = waving().astype(dtype)  # type: ignore[call-overload]
    np.testing.assert_array_equal(read(tmp_path, tracks=tracks).tracks.points, tracks.astype(float))


def test_fortran_order_and_compression_change_nothing(tmp_path: Path) -> None:
    tracks = np.asfortranarray(waving())
    np.savez_compressed(tmp_path / "tracks.npz", tracks=tracks)
    got = read_inputs(tracks=tmp_path / "tracks.npz", options=Options())
    np.testing.assert_array_equal(got.tracks.points, tracks)


def test_a_bare_npy_is_read(tmp_path: Path) -> None:
    np.save(tmp_path / "tracks.npy", waving())
    got = read_inputs(tracks=tmp_path / "tracks.npy", options=Options())
    np.testing.assert_array_equal(got.tracks.points, waving())


@pytest.mark.parametrize("rows", ["interleaved", "stacked"])
@pytest.mark.parametrize("file", ["mat", "npz"])
def test_a_matrix_is_read_with_interleaved_or_stacked_rows(tmp_path: Path, rows: str, file: str) -> None:
    tracks = waving()
    matrix = (
        tracks.transpose(0, 2, 1).reshape(2 * F, P)
        if rows == "interleaved"
        else np.vstack([*tracks.transpose(2, 0, 1)])
    )
    path = tmp_path / f"tracks.{file}"
    scipy.io.savemat(path, {"W": matrix}) if file == "mat" else saved(path, W=matrix)
    got = read_inputs(tracks=path, options=Options())
    np.testing.assert_array_equal(got.tracks.points, tracks)
    assert rows in got.interpretation.layout
    assert any("mean step in time" in note for note in got.interpretation.notes)


def test_hidden_points_never_carry_nan(tmp_path: Path) -> None:
    tracks = waving()
    tracks[2:5, 7] = np.nan
    tracks[3, 8, 1] = np.inf
    got = read(tmp_path, tracks=tracks)
    assert np.isfinite(got.tracks.points).all()
    assert (got.tracks.visible == 0).sum() == 4


def test_sparsely_observed_points_keep_their_index_and_are_reported(tmp_path: Path) -> None:
    tracks = waving()
    tracks[:, 4] = np.nan
    got = read(tmp_path, tracks=tracks)
    assert got.tracks.num_points == P
    assert any("(point 4)" in note for note in got.interpretation.notes)


def test_inputs_survive_storage_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    shapes = rng.normal(size=(F, P, 3))
    shapes[0, 0] = [1e-300, -0.0, 0.1]
    angles = np.linalg.qr(rng.normal(size=(F, 3, 3)))[0]
    got = read_inputs(
        tracks=saved(tmp_path / "t.npz", tracks=waving(), visibility=rng.random((F, P))),
        mesh="5x6",
        ground_truth=saved(tmp_path / "g.npz", shapes=shapes, rotations=angles[:, :2]),
        rotations=saved(tmp_path / "r.npz", rotations=angles[:, :2], scales=np.full(F, 2.0)),
        options=Options(),
    )
    save_inputs(got, tmp_path / "inputs.npz")
    back = load_inputs(tmp_path / "inputs.npz")
    assert got.mesh is not None
    assert back.mesh is not None
    assert got.ground_truth is not None
    assert back.ground_truth is not None
    assert isinstance(back.cameras, KnownCamera)
    assert isinstance(got.cameras, KnownCamera)
    assert back.interpretation == got.interpretation
    for mine, theirs in (
        (got.tracks.points, back.tracks.points), (got.tracks.visible, back.tracks.visible), (got.mesh.faces, back.mesh.faces),
        (got.mesh.grid, back.mesh.grid), (got.ground_truth.shapes, back.ground_truth.shapes),
        (got.ground_truth.rotations, back.ground_truth.rotations), (got.cameras.rotations, back.cameras.rotations),
        (got.cameras.scales, back.cameras.scales),
    ):  # fmt: skip
        assert mine is not None
        assert theirs is not None
        assert mine.dtype == theirs.dtype
        assert mine.tobytes() == theirs.tobytes()
        assert not theirs.flags.writeable


def test_inputs_that_fit_single_precision_are_stored_compactly(tmp_path: Path) -> None:
    for dtype, name in ((np.float32, "single"), (np.float64, "double")):
        tracks = waving(40, 200).astype(dtype)
        save_inputs(
            read_inputs(tracks=saved(tmp_path / "t.npz", tracks=tracks), mesh="none", options=Options()),
            tmp_path / name,
        )
    assert (tmp_path / "single").stat().st_size < 0.6 * (tmp_path / "double").stat().st_size


def test_a_stored_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    refused("damaged_file", lambda: load_inputs(saved(tmp_path / "x.npz", tracks=waving())))


BAD_TRACKS = {
    "too_few_frames": {"tracks": waving()[:2]},
    "too_few_points": {"W": np.zeros((2 * F, 3))},
    "wrong_shape": {"tracks": np.zeros((5, 6, 7))},
    "nothing_visible": {"tracks": np.full((F, P, 2), np.nan)},
    "missing_array": {"something": waving()},
    "wrong_type": {"tracks": waving().astype(complex)},
    "out_of_range": {"tracks": waving(), "visibility": np.full((F, P), 255)},
    "object_array": {"tracks": np.array([[1, "x"], [None, 2]], dtype=object)},
}


@pytest.mark.parametrize("code", BAD_TRACKS)
def test_invalid_tracks_are_refused_with_their_code(tmp_path: Path, code: str) -> None:
    refused(code, lambda: read(tmp_path, **BAD_TRACKS[code]))


def test_visibility_of_another_shape_is_refused(tmp_path: Path) -> None:
    error = refused("wrong_shape", lambda: read(tmp_path, tracks=waving(), visibility=np.ones((P, F))))
    assert error.field == "tracks.visibility"


def test_text_with_the_suffix_npz_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "tracks.npz").write_text("these are no tracks\n" * 20)
    refused("unknown_format", lambda: read_inputs(tracks=tmp_path / "tracks.npz", options=Options()))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"%PDF-1.7\n" + bytes(600), "a PDF document"),
        (b"%PDF-1.7\n% all text\n", "a PDF document"),
        (b"\xd0\xcf\x11\xe0" + bytes(600), "an Office document (xls, doc)"),
        (b"<!doctype html><p>Sign in</p>", "a web page or XML"),
        (b"MZebra stripes\nare no tracks", "text that begins 'MZebra stripes'"),
        (b" \n\n", "blank text"),
        (bytes([1, 2, 3, 0]) * 9, "a file of an unknown kind, which begins with the bytes 01 02 03 00 01 02 03 00"),
    ],
)
def test_the_error_names_the_kind_of_an_unsupported_file(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "tracks").write_bytes(content)
    error = refused("unknown_format", lambda: read_inputs(tracks=tmp_path / "tracks", options=Options()))
    assert error.got == words


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "tracks.npz").write_bytes(b"")
    refused("empty_file", lambda: read_inputs(tracks=tmp_path / "tracks.npz", options=Options()))


@pytest.mark.parametrize(
    "limits",
    [Limits(max_frames=F - 1), Limits(max_points=P - 1), Limits(max_observations=F * P - 1), Limits(max_bytes=900)],
)
def test_inputs_above_a_limit_are_refused(tmp_path: Path, limits: Limits) -> None:
    path = saved(tmp_path / "t.npz", tracks=waving())
    refused("too_large", lambda: read_inputs(tracks=path, options=Options(), limits=limits))


def test_inputs_at_the_limits_are_read(tmp_path: Path) -> None:
    path = saved(tmp_path / "t.npz", tracks=waving())
    size = path.stat().st_size
    limits = Limits(max_frames=F, max_points=P, max_observations=F * P, max_bytes=size)
    assert read_inputs(tracks=path, options=Options(), limits=limits).tracks.num_frames == F


def test_truth_must_match_the_tracks(tmp_path: Path) -> None:
    tracks = saved(tmp_path / "t.npz", tracks=waving())
    for code, arrays in {
        "wrong_shape": {"shapes": np.zeros((F, P + 1, 3))},
        "missing_array": {"truth": np.zeros((F, P, 3))},
        "wrong_type": {"shapes": np.zeros((F, P, 3), dtype=bool)},
        "not_finite": {"shapes": np.where(np.arange(F * P * 3).reshape(F, P, 3) == 7, np.nan, 1.0)},
        "no_extent": {"shapes": np.ones((F, P, 3))},
    }.items():
        truth = saved(tmp_path / "g.npz", **arrays)
        error = refused(code, lambda truth=truth: read_inputs(tracks=tracks, ground_truth=truth, options=Options()))
        assert error.field.startswith("ground_truth")


def test_truth_needs_one_rotation_per_frame(tmp_path: Path) -> None:
    tracks = saved(tmp_path / "t.npz", tracks=waving())
    truth = saved(
        tmp_path / "g.npz",
        shapes=np.random.default_rng(0).normal(size=(F, P, 3)),
        rotations=np.tile(np.eye(3), (F - 1, 1, 1)),
    )
    error = refused("wrong_shape", lambda: read_inputs(tracks=tracks, ground_truth=truth, options=Options()))
    assert error.field == "ground_truth.rotations"


def test_given_cameras_are_completed_and_checked(tmp_path: Path) -> None:
    tracks = saved(tmp_path / "t.npz", tracks=waving())
    two_rows = np.tile(np.eye(3)[:2], (F, 1, 1))
    for rotations in (two_rows, two_rows.reshape(2 * F, 3)):
        path = saved(tmp_path / "r.npz", Rs=rotations)
        got = read_inputs(tracks=tracks, rotations=path, options=Options())
        assert got.cameras is not None
        np.testing.assert_allclose(got.cameras.rotations, np.tile(np.eye(3), (F, 1, 1)))
        assert got.interpretation.has_rotations
    for code, array in (("not_a_rotation", 2 * two_rows), ("wrong_shape", two_rows[1:])):
        path = saved(tmp_path / "r.npz", rotations=array)
        refused(code, lambda path=path: read_inputs(tracks=tracks, rotations=path, options=Options()))
    path = saved(tmp_path / "r.npz", turns=two_rows)
    refused("missing_array", lambda: read_inputs(tracks=tracks, rotations=path, options=Options()))


@pytest.mark.parametrize("name", ["visibility", "expected_dist"])
def test_visibility_larger_than_the_tracks_is_refused_before_conversion(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Converting 900 MB of zeros, a file of 0.88 MB, takes 7.8 GB."""
    monkeypatch.setattr("pliant.worker.formats.tracks.visibility._confidence", None)  # not reached
    tracks = moving_sheet(6, 4, 5)[..., :2] + 100
    arrays = {"visibility": np.ones((6, 20)), name: np.zeros((600, 2000), bool)}
    np.savez_compressed(tmp_path / "t.npz", tracks=tracks, **arrays)
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tmp_path / "t.npz", options=Options(layout="frames_points"))
    assert (caught.value.code, caught.value.field, caught.value.got) == ("wrong_shape", f"tracks.{name}", "(600, 2000)")


@pytest.mark.parametrize("where", [0.0, 300.0])
def test_tracks_with_all_points_in_one_position_are_refused(tmp_path: Path, where: float) -> None:
    points = np.full((6, 20, 2), where) + np.arange(6)[:, None, None]
    np.savez(tmp_path / "t.npz", tracks=points)
    with pytest.raises(InvalidInput, match="one position for all visible points") as caught:
        read_inputs(tracks=tmp_path / "t.npz", mesh="none", options=Options())
    assert caught.value.code == "no_extent"
