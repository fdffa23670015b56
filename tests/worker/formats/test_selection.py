"""Selection of frames and points: input order is kept, and all related arrays are selected alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, Mesh
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import Inputs, load_inputs, read_inputs, save_inputs
from pliant.worker.formats.tracks.decimation import spread, thin
from pliant.worker.formats.tracks.selection import chosen_frames
from results import moving_sheet

F, ROWS, COLUMNS = 10, 12, 15
P = ROWS * COLUMNS
SHAPES = moving_sheet(F, ROWS, COLUMNS)
POINTS = SHAPES[..., :2] + 200
GRID = np.arange(P).reshape(ROWS, COLUMNS)
QUADS = Mesh.from_grid(GRID).faces
TURNS = np.linalg.qr(np.random.default_rng(0).normal(size=(F, 3, 3)))[0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.savez(tmp_path / "tracks.npz", tracks=POINTS)
    np.savez(tmp_path / "quads.npz", faces=QUADS)
    np.savez(tmp_path / "truth.npz", shapes=SHAPES, rotations=TURNS[:, :2])
    np.savez(tmp_path / "cameras.npz", rotations=TURNS[:, :2], scales=np.arange(1.0, F + 1))
    return tmp_path


def read(folder: Path, mesh: Path | str | None = None, **options: object) -> Inputs:
    return read_inputs(
        tracks=folder / "tracks.npz", mesh=mesh, ground_truth=folder / "truth.npz", rotations=folder / "cameras.npz",
        options=Options.model_validate(options),
    )  # fmt: skip


def cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    return one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]


def follows(got: Inputs, frames: np.ndarray, points: np.ndarray) -> None:
    """Check that tracks, truth, cameras and the selection record hold these frames and points of the files."""
    assert got.ground_truth is not None
    assert got.ground_truth.rotations is not None
    assert got.cameras is not None
    assert got.cameras.scales is not None
    assert got.selection is not None
    np.testing.assert_array_equal(got.tracks.points, POINTS[np.ix_(frames, points)])
    np.testing.assert_array_equal(got.ground_truth.shapes, SHAPES[np.ix_(frames, points)])
    np.testing.assert_allclose(got.ground_truth.rotations[:, :2], TURNS[frames, :2], atol=1e-12)
    np.testing.assert_array_equal(got.cameras.scales, frames + 1.0)
    np.testing.assert_array_equal(got.selection.frames, frames)
    np.testing.assert_array_equal(got.selection.points, points)
    interpretation = got.interpretation
    assert (interpretation.given_frames, interpretation.given_points) == (F, P)
    assert (interpretation.num_frames, interpretation.num_points) == (len(frames), len(points))


numbers = st.one_of(st.none(), st.integers(-15, 15))


@given(numbers, numbers, st.one_of(st.none(), st.integers(1, 4)), st.booleans())
def test_frames_are_selected_as_by_a_python_slice(
    start: int | None, stop: int | None, step: int | None, short: bool
) -> None:
    words = ["" if part is None else str(part) for part in (start, stop, step)]
    text = ":".join(words[:2] if short and step is None else words)
    assert Options(frames=text).frames == text
    expected = list(range(10))[slice(start, stop, step)]
    if len(expected) < 3:
        with pytest.raises(InvalidInput, match="at least 3 of the 10 frames") as caught:
            chosen_frames(text, 10)
        assert (caught.value.code, caught.value.field) == ("no_frames_left", "options.frames")
    else:
        assert chosen_frames(text, 10)[0].tolist() == expected


def test_only_frames_without_times_of_their_own_run_faster() -> None:
    assert chosen_frames("::2", 10)[1] == [
        "Frames ::2: 5 of 10, from 0 to 8; one in 2, so at the same fps the animation runs 2 times as fast."
    ]
    assert chosen_frames("::2", 10, timed=True)[1] == ["Frames ::2: 5 of 10, from 0 to 8."]


@pytest.mark.parametrize("text", ["1", "1:2:0", "1:2:-1", "a:b", "1:2:3:4", "", " 1:2"])
def test_invalid_frame_ranges_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="frames"):
        Options(frames=text)


def test_frame_selection_applies_to_tracks_truth_and_cameras(folder: Path) -> None:
    got = read(folder, f"{ROWS}x{COLUMNS}", frames="1:9:2")
    follows(got, np.arange(1, 9, 2), np.arange(P))
    assert any("one in 2, so at the same fps" in note for note in got.interpretation.notes)
    assert got.interpretation.mesh_grid == (ROWS, COLUMNS)


@pytest.mark.parametrize("how", [{"stride": 3}, {"max_points": 20}], ids=str)
def test_a_grid_keeps_every_nth_row_and_column(folder: Path, how: dict[str, int]) -> None:
    got = read(folder, f"{ROWS}x{COLUMNS}", **how)
    kept = GRID[::3, ::3]
    follows(got, np.arange(F), kept.ravel())
    assert got.mesh is not None
    assert got.mesh.grid is not None
    np.testing.assert_array_equal(got.mesh.grid, np.arange(kept.size).reshape(kept.shape))
    assert any("one in 3 rows and columns" in note for note in got.interpretation.notes)


def test_a_stride_that_leaves_too_few_points_is_refused(folder: Path) -> None:
    for mesh in (f"{ROWS}x{COLUMNS}", "none"):
        with pytest.raises(InvalidInput, match="leaves 4 points or more") as caught:
            read(folder, mesh, stride=1000)
        assert (caught.value.code, caught.value.field) == ("too_few_points", "options.stride")


def test_a_maximum_that_leaves_too_few_points_of_a_grid_is_refused(folder: Path) -> None:
    with pytest.raises(InvalidInput, match="larger max_points") as caught:
        read(folder, f"1x{ROWS * COLUMNS}", max_points=4, stride=3 * ROWS * COLUMNS // 4)
    assert (caught.value.code, caught.value.field) == ("too_few_points", "options.max_points")


def test_a_grid_with_holes_keeps_its_holes(folder: Path) -> None:
    mask = np.ones((ROWS, COLUMNS + 2), dtype=bool)
    mask[:, 3:5] = False
    np.savez(folder / "mask.npz", mask=mask)
    got = read(folder, folder / "mask.npz", stride=2)
    assert got.mesh is not None
    assert got.mesh.grid is not None
    np.testing.assert_array_equal(got.mesh.grid >= 0, mask[::2, ::2])
    assert got.mesh.num_points == int(mask[::2, ::2].sum())


def test_every_point_kept_of_a_ragged_surface_belongs_to_a_face(folder: Path) -> None:
    """Programs drop points without a face when they import a mesh; point p would no longer be vertex p."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    mask = (abs(row - ROWS / 2) / ROWS + abs(column - COLUMNS / 2) / COLUMNS < 0.5) | (row == 2)
    numbered = np.full(mask.shape, -1)
    numbered[mask] = np.arange(mask.sum())
    points = POINTS[:, mask.ravel()]
    grid = Mesh.from_grid(numbered)
    for mesh in (grid, Mesh.from_faces(grid.faces, grid.num_points)):
        for limit in range(10, int(mask.sum()), 7):
            kept, thinned, notes = thin(points, None, mesh, Options(max_points=limit))
            assert thinned is not None
            np.testing.assert_array_equal(np.unique(thinned.faces), np.arange(len(kept)))
            assert thinned.num_points == len(kept) <= limit
            assert not any("belong to no face" in note for note in notes)


@pytest.mark.parametrize("how", [{"stride": 6}, {"max_points": P // 6}], ids=str)
def test_a_mesh_is_decimated_evenly_and_stays_connected(folder: Path, how: dict[str, int]) -> None:
    got = read(folder, folder / "quads.npz", **how)
    assert got.selection is not None
    kept = got.selection.points
    follows(got, np.arange(F), kept)
    assert P // 6 - 3 <= len(kept) <= P // 6
    assert (np.diff(kept) > 0).all()
    assert got.mesh is not None
    faces = got.mesh.faces
    edges, times = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])), axis=0, return_counts=True
    )
    assert times.max() == 2
    assert len(kept) - len(edges) + len(faces) == 1  # a disc, as the sheet is
    flat = POINTS[0][kept]
    one, two, three = (flat[faces[:, corner]] for corner in range(3))
    area = cross(two - one, three - one)
    whole = POINTS[0][QUADS[0]]
    assert (np.sign(area) == np.sign(cross(whole[1] - whole[0], whole[2] - whole[0]))).all()
    assert 0.75 < abs(area).sum() / 2 / (np.ptp(POINTS[0, :, 0]) * np.ptp(POINTS[0, :, 1])) <= 1.0
    lengths = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)
    assert np.percentile(lengths, 95) < 2.5 * np.percentile(lengths, 5)


def test_components_of_a_mesh_stay_separate_and_each_keeps_points() -> None:
    far = np.concatenate([POINTS, POINTS + np.array([0, 0.5])], axis=1)  # two sheets, one over the other in the picture
    mesh = Mesh.from_faces(np.concatenate([QUADS, QUADS + P]), 2 * P)
    kept, thinned, _ = thin(far, None, mesh, Options(max_points=60))
    assert thinned is not None
    sides = kept[thinned.faces] >= P
    assert (sides.all(axis=1) | ~sides.any(axis=1)).all()
    assert 20 < int((kept < P).sum()) < 40
    parts = np.repeat(np.arange(P), 2)
    assert (
        len(spread(far[:2], np.ones((2, 2 * P), dtype=bool), 10, parts)) == 10
    )  # more parts than points: some parts are dropped


def test_points_without_a_mesh_are_thinned_by_index_or_evenly_in_space(folder: Path) -> None:
    assert read(folder, "none", stride=7).selection.points.tolist() == list(range(0, P, 7))  # type: ignore[union-attr]
    got = read(folder, "none", max_points=50)
    assert got.selection is not None
    assert 40 <= got.tracks.num_points <= 50
    flat = got.tracks.points[0]
    apart = np.linalg.norm(flat[:, None] - flat[None], axis=2) + 1e9 * np.eye(len(flat))
    assert apart.min() > 9  # the sheet's spacing is 10: no two points share a place
    made = read(folder, None, max_points=50)
    assert made.mesh is not None
    assert made.interpretation.mesh_source == "delaunay"
    assert made.mesh.num_points == made.tracks.num_points


def test_everything_is_kept_within_the_limits(folder: Path) -> None:
    got = read(folder, folder / "quads.npz", max_points=P, frames=":")
    assert got.selection is None
    assert got.tracks.num_points == P
    np.testing.assert_array_equal(got.mesh.faces, QUADS)  # type: ignore[union-attr]


def test_a_selection_survives_storage_and_reaches_the_result(folder: Path) -> None:
    options = Options(method="temporal", refine_rotations=False, basis_size=1, stride=3, frames="2:")
    got = read(folder, f"{ROWS}x{COLUMNS}", stride=3, frames="2:")
    save_inputs(got, folder / "stored.npz")
    back = load_inputs(folder / "stored.npz")
    assert back.selection is not None
    assert got.selection is not None
    assert back.selection.whole == (F, P)
    np.testing.assert_array_equal(back.selection.points, got.selection.points)
    reconstruct(back, options, folder / "out")
    with np.load(folder / "out" / "shapes.npz") as result:
        np.testing.assert_array_equal(result["source_points"], GRID[::3, ::3].ravel())
        np.testing.assert_array_equal(result["source_frames"], np.arange(2, F))
        assert result["shapes"].shape == (F - 2, 20, 3)


def test_sparsely_observed_points_are_excluded_and_reported(folder: Path) -> None:
    tracks = POINTS.copy()
    tracks[3:, 4] = np.nan
    tracks[1:, [7, 9]] = np.nan
    np.savez(folder / "tracks.npz", tracks=tracks)
    faces = QUADS[~np.isin(QUADS, 9).any(axis=1)]
    np.savez(folder / "most.npz", faces=faces)
    got = read(folder, folder / "most.npz", min_seen=3)
    assert got.interpretation.left_out_points == [7, 9]
    assert got.interpretation.num_left_out == 2
    assert (got.tracks.visible[:, [7, 9]] == 0).all()
    assert got.tracks.visible[:, 4].sum() == 3
    notes = " ".join(got.interpretation.notes)
    assert "2 points are visible in fewer than 3 frames" in notes
    assert "1 of them follow their neighbours" in notes
    assert "1 of them belong to no face" in notes
    assert read(folder, folder / "most.npz", min_seen=4).interpretation.left_out_points == [4, 7, 9]
    assert read(folder, folder / "most.npz", min_seen=1).interpretation.num_left_out == 0
    with pytest.raises(InvalidInput, match="visible in 11 or more frames") as caught:
        read(folder, folder / "most.npz", min_seen=11)
    assert (caught.value.code, caught.value.field) == ("nothing_visible", "options.min_seen")


def test_a_mask_selects_pixels_of_a_picture(tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=POINTS.reshape(F, ROWS, COLUMNS, 2))
    mask = np.zeros((ROWS, COLUMNS), dtype=np.uint8)
    mask[2:9, 3:11] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    whole = read_inputs(tracks=tmp_path / "tracks.npz", options=Options())
    assert whole.mesh is not None
    assert whole.interpretation.mesh_grid == (ROWS, COLUMNS)
    np.testing.assert_array_equal(whole.mesh.faces, QUADS)
    got = read_inputs(tracks=tmp_path / "tracks.npz", mesh=tmp_path / "mask.png", options=Options(stride=2))
    assert got.selection is not None
    np.testing.assert_array_equal(got.selection.points, GRID[2:9:2, 4:11:2].ravel())
    np.testing.assert_array_equal(got.tracks.points, POINTS[:, got.selection.points])


def test_one_frame_and_one_point_are_counted_in_the_singular(tmp_path: Path) -> None:
    tracks = np.random.default_rng(0).uniform(0, 100, (6, 20, 2))
    tracks[4] = np.nan
    tracks[1:, 7] = np.nan
    np.savez(tmp_path / "tracks.npz", tracks=tracks)
    notes = read_inputs(tracks=tmp_path / "tracks.npz", mesh="none", options=Options(min_seen=2)).interpretation.notes
    assert "1 frame has no visible points: frame 4." in notes
    (left_out,) = (note for note in notes if "excluded" in note)
    assert left_out.startswith("1 point is visible in fewer than 2 frames and excluded from the solve (point 7).")
