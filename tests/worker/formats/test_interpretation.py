"""Ambiguous files are never guessed: options select the interpretation, and notes state the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, Tracks
from pliant.solver.gallery import face
from pliant.worker.formats import AmbiguousInput, Inputs, Limits, read_inputs
from pliant.worker.formats.ground_truth import as_rotations, as_shapes, unexplained
from pliant.worker.formats.reading.pose_hdf5 import read_hdf5 as read_matlab73
from pliant.worker.formats.tracks.interpretation import understand
from track_files import COLUMNS, MATRIX, POINTS, ROWS, SEEN, SHAPES, WORLD, F, P, pixels


def read(tmp_path: Path, arrays: Mapping[str, Any], **options: object) -> Inputs:
    np.savez(tmp_path / "tracks.npz", **arrays)
    return read_inputs(tracks=tmp_path / "tracks.npz", mesh="none", options=Options.model_validate(options))


def refused(code: str, arrays: Mapping[str, Any], **options: object) -> InvalidInput:
    with pytest.raises(InvalidInput) as caught:
        understand({name: np.asarray(array) for name, array in arrays.items()}, Options.model_validate(options))
    assert caught.value.code == code, str(caught.value)
    return caught.value


def offered(error: InvalidInput) -> list[dict[str, object]]:
    assert isinstance(error, AmbiguousInput)
    return [choice["options"] for choice in error.choices]


UNIT = POINTS / [8, 4]
SIGNED = UNIT * 2 - 1


def test_fractions_need_the_image_size_or_an_option(tmp_path: Path) -> None:
    error = refused("ambiguous_coordinates", {"tracks": UNIT})
    assert offered(error) == [{"coordinates": "unit"}, {"coordinates": "pixels"}]
    assert refused("missing_image_size", {"tracks": UNIT}, coordinates="unit").field == "options.image_size"
    for options in ({"image_size": "9x5"}, {"image_size": "9x5", "coordinates": "unit"}):
        got = read(tmp_path, {"tracks": UNIT}, **options)
        np.testing.assert_array_equal(got.tracks.points, POINTS)
        assert got.interpretation.coordinates == "unit"
    np.testing.assert_array_equal(read(tmp_path, {"tracks": UNIT}, coordinates="pixels").tracks.points, UNIT)


def test_signed_fractions_are_detected_with_a_known_size(tmp_path: Path) -> None:
    got = read(tmp_path, {"tracks": SIGNED}, image_size="9x5")
    np.testing.assert_array_equal(got.tracks.points, POINTS)
    assert got.interpretation.coordinates == "signed"
    alone = read(tmp_path, {"tracks": SIGNED})
    assert alone.interpretation.coordinates == "pixels"
    assert alone.interpretation.y_axis == "up"


@pytest.mark.parametrize(
    ("tracks", "coordinates", "options"),
    [(POINTS, "pixels", {}), (POINTS, "pixels", {"image_size": "9x5"}), (UNIT, "unit", {"image_size": "9x5"})],
)
def test_positions_of_hidden_points_do_not_decide_on_units_and_axes(
    tracks: np.ndarray, coordinates: str, options: dict[str, str], tmp_path: Path
) -> None:
    hidden = np.zeros((F, P), bool)
    hidden[::2, ::2] = True
    filled = np.where(hidden[..., None], -1.0, tracks)  # as trackers mark hidden points
    got = read(tmp_path, {"tracks": filled, "visibility": ~hidden}, **options)
    assert (got.interpretation.coordinates, got.interpretation.y_axis) == (coordinates, "down")
    np.testing.assert_array_equal(got.tracks.points[~hidden], POINTS[~hidden])


@pytest.mark.parametrize("axes", [(0, 2, 1), (2, 0, 1)], ids=["interleaved", "stacked"])
def test_positions_of_hidden_points_do_not_decide_on_the_layout_of_the_truth(axes: tuple[int, int, int]) -> None:
    sequence = face(20, 60)
    hidden = np.random.default_rng(0).random((20, 60)) < 0.3
    tracks = np.where(hidden[..., None], -1.0, sequence.tracks.points)
    understood = understand({"tracks": tracks, "visibility": ~hidden}, Options())
    shapes, notes = as_shapes(sequence.shapes.transpose(axes).reshape(60, 60), understood)
    np.testing.assert_array_equal(shapes, sequence.shapes)
    assert len(notes) == 1
    assert "leaves 0.0% of the tracks unexplained" in notes[0]


@pytest.mark.parametrize("rows", ["interleaved", "stacked"])
def test_positions_of_hidden_points_do_not_decide_on_the_layout(rows: str) -> None:
    points = face(40, 150).tracks.points
    hidden = np.random.default_rng(0).random((40, 150)) < 0.3
    filled = np.where(hidden[..., None], 0.0, points)
    matrix = filled.transpose(0, 2, 1) if rows == "interleaved" else filled.transpose(2, 0, 1)
    assert len(offered(refused("ambiguous_layout", {"W": matrix.reshape(80, 150)}))) == 4
    got = understand({"W": matrix.reshape(80, 150), "MD": hidden}, Options())
    np.testing.assert_array_equal(got.points, filled)
    refused("ambiguous_layout", {"W": matrix.reshape(80, 150), "MD": hidden[1:]})
    understand({"W": points.transpose(0, 2, 1).reshape(80, 150), "MD": np.ones((40, 150), bool)}, Options())


def test_fractions_are_detected_despite_points_outside_the_picture(tmp_path: Path) -> None:
    some = UNIT.copy()
    some[-1, :3] = [1.25, -0.5]
    assert read(tmp_path, {"tracks": some}, image_size="9x5").interpretation.coordinates == "unit"


def test_y_before_x_is_detected_by_the_image_size(tmp_path: Path) -> None:
    wide = POINTS * [80, 20]
    got = read(tmp_path, {"tracks": wide[..., ::-1]}, image_size="641x100")
    np.testing.assert_array_equal(got.tracks.points, wide)
    assert any("read as y, x: 100%" in note for note in got.interpretation.notes)
    kept = understand({"tracks": wide[..., ::-1]}, Options(image_size="641x100", coordinate_order="xy"))
    np.testing.assert_array_equal(kept.points, wide[..., ::-1])


@pytest.mark.parametrize(
    ("code", "field", "options"),
    [
        ("outside_picture", "image_size", {"image_size": "3x2"}),
        ("principal_point_far", "principal_point", {"principal_point": "1000000,0"}),
        ("invalid_option", "focal", {"focal": 0.5}),
        ("invalid_option", "laplacian", {"laplacian": "grid8"}),
        ("invalid_option", "surface", {"surface": "isometric"}),
        ("invalid_option", "focal", {"focal": 900, "camera": "orthographic"}),
    ],
)
def test_options_that_contradict_the_files_are_refused(
    tmp_path: Path, code: str, field: str, options: dict[str, object]
) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=POINTS)
    np.savez(tmp_path / "rotations.npz", rotations=np.broadcast_to(np.eye(3), (F, 3, 3)))
    with pytest.raises(InvalidInput) as caught:
        read_inputs(
            tracks=tmp_path / "tracks.npz",
            rotations=tmp_path / "rotations.npz",
            options=Options.model_validate(options),
        )
    assert (caught.value.code, caught.value.field) == (code, f"options.{field}")


def test_a_contradicted_layout_is_ambiguous(tmp_path: Path) -> None:
    error = refused("ambiguous_layout", {"tracks": POINTS.swapaxes(0, 1)})
    assert {"layout": "points_frames"} in offered(error)
    got = read(tmp_path, {"tracks": POINTS.swapaxes(0, 1)}, layout="points_frames")
    np.testing.assert_array_equal(got.tracks.points, POINTS)
    two = refused("ambiguous_layout", {"one.W": MATRIX, "two.W": MATRIX})
    assert "one.W and two.W" in two.got


def test_points_in_place_of_frames_are_mentioned_in_a_note() -> None:
    points = face(60, 400, degrees=50).tracks.points
    swapped = {"tracks": points.transpose(1, 0, 2)}
    reading = understand(swapped, Options())
    assert reading.points.shape == (400, 60, 2)
    (note,) = (note for note in reading.notes if "more frames than points" in note)
    assert note.startswith("Read as tracks (F, P, 2) (mean step in time: ")
    assert note.endswith("if they are swapped, set layout=points_frames.")
    np.testing.assert_array_equal(understand(swapped, Options(layout="points_frames")).points, points)
    for clear in ({"tracks": points}, {"tracks": points[:, ::10]}):
        assert not any("more frames than points" in note for note in understand(clear, Options()).notes)


def test_a_matrix_whose_x_and_y_are_the_same_in_every_layout_is_ambiguous() -> None:
    path = np.linspace(0.0, 100.0, 6)[:, None] + np.linspace(0.0, 500.0, 8)
    error = refused("ambiguous_layout", {"W": np.concatenate([path, path])})
    assert all("the same coordinate" in each["evidence"] for each in error.choices)


def test_a_frame_without_y_is_hidden(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[2, :, 1] = np.nan
    np.testing.assert_array_equal(
        read(tmp_path, {"tracks": points}, coordinates="pixels").tracks.visible.any(axis=1), np.arange(F) != 2
    )


def test_occlusion_that_is_not_finite_counts_as_hidden() -> None:
    occluded = np.zeros(POINTS.shape[:2])
    occluded[2, 1], occluded[3, 0] = np.nan, 1.0
    read_as = understand({"tracks": POINTS, "occluded": occluded}, Options(layout="frames_points"))
    assert np.argwhere(read_as.visible == 0).tolist() == [[2, 1], [3, 0]]


def test_a_long_list_of_pixels_is_not_read_as_many_frames() -> None:
    y, x = np.mgrid[:80, :160].astype(float)
    first = np.stack([x, y], axis=-1).reshape(1, -1, 2)
    quick = first + 30.0 * np.arange(4)[:, None, None] ** 1.5  # neighbours in the list are closer than frames
    assert understand({"tracks": quick}, Options()).points.shape == (4, 80 * 160, 2)


def test_options_of_arrays_that_the_file_does_not_have_are_listed() -> None:
    set_options = Options(rows="stacked", visibility="logits")
    unused = understand({"tracks": POINTS}, set_options).notes
    assert "Not used: the option visibility, because the file has no visibility." in unused
    assert "Not used: the option rows, because the tracks are no matrix." in unused
    used = understand(
        {"W": np.vstack([POINTS[..., 0], POINTS[..., 1]]), "visible_logits": np.ones((F, P))}, set_options
    ).notes
    assert not any("Not used" in note for note in used)


def test_the_option_y_axis_is_used(tmp_path: Path) -> None:
    assert read(tmp_path, {"tracks": POINTS}).interpretation.y_axis == "down"
    up = read(tmp_path, {"tracks": POINTS}, y_axis="up").interpretation
    assert up.y_axis == "up"
    assert "y points up, as set by y_axis." in up.notes


def test_visibility_above_1_may_be_a_mask_or_logits(tmp_path: Path) -> None:
    positive = np.where(SEEN, 3.0, 0.5)
    error = refused("out_of_range", {"tracks": POINTS, "visibility": positive})
    assert offered(error) == [{"visibility": "bool"}, {"visibility": "logits"}]
    logits = read(tmp_path, {"tracks": POINTS, "visibility": positive}, visibility="logits")
    np.testing.assert_allclose(logits.tracks.visible[SEEN], 1 / (1 + np.exp(-3.0)))
    assert read(tmp_path, {"tracks": POINTS, "visibility": positive}, visibility="bool").tracks.all_visible
    mask = read(tmp_path, {"tracks": POINTS, "visibility": SEEN * 255})
    np.testing.assert_array_equal(mask.tracks.visible > 0, SEEN)
    refused("out_of_range", {"tracks": POINTS, "visibility": positive}, visibility="probability")


@pytest.mark.parametrize("name", ["confidence", "conf"])
def test_confidence_is_read_as_visibility_and_multiplies_it(tmp_path: Path, name: str) -> None:
    moved = POINTS + 1  # trackers write (0, 0) where a point is lost
    sure = np.full((F, P), 0.9)
    sure[1] = 0.3
    got = read(tmp_path, {"tracks": moved, name: sure})
    np.testing.assert_array_equal(got.tracks.visible, np.where((sure < 0.5), 0, sure))
    assert f"Visibility from {name}: probabilities; below 0.5 counts as hidden." in got.interpretation.notes
    seen = np.ones((F, P), bool)
    seen[2, 0] = False
    got = read(tmp_path, {"tracks": moved, "visibility": seen, name: sure})
    np.testing.assert_array_equal(got.tracks.visible, np.where((sure < 0.5) | ~seen, 0, sure))
    assert any(f"times {name}" in note for note in got.interpretation.notes)
    for other in (np.ones(F), np.ones((P, F)), np.ones((F, 3 * P)), np.full((F, P), 90.0), np.array(0.5)):
        for more in ({}, {"visibility": seen}):
            got = read(tmp_path, {"tracks": moved, name: other, **more})
            assert any(note.startswith(f"Not used: {name} {other.shape}") for note in got.interpretation.notes)
            np.testing.assert_array_equal(got.tracks.visible > 0, seen if more else np.ones((F, P), bool))


def test_documented_axes_are_not_swapped_to_reach_the_smallest_size(tmp_path: Path) -> None:
    moved = np.random.default_rng(0).uniform(0, 500, (12, 3, 2))
    sentence = r"at least 4 points, got 3 in tracks .* if it is tracks \(P, F, 2\), set layout=points_frames\."
    with pytest.raises(InvalidInput, match=sentence):
        read(tmp_path, {"tracks": moved})
    assert read(tmp_path, {"tracks": moved}, layout="points_frames").tracks.points.shape == (3, 12, 2)


def test_options_of_files_that_are_not_written_are_listed_as_not_used(tmp_path: Path) -> None:
    options = {"outputs": ("glb", "csv"), "axes": "tracks", "normals": "none", "glb_quantized": True}
    notes = read(tmp_path, {"tracks": POINTS}, **options).interpretation.notes
    assert "Not used with outputs glb,csv: axes." in notes
    notes = read(tmp_path, {"tracks": POINTS}, **{**options, "outputs": ("csv",)}).interpretation.notes
    assert "Not used with outputs csv: axes, glb_quantized, normals." in notes


def test_options_for_films_are_listed_as_not_used(tmp_path: Path) -> None:
    options = {"grid_step": 8, "region_polygon": [[0, 0], [9, 0], [9, 9]], "frames": "0:4"}
    assert (
        read(tmp_path, {"tracks": POINTS}, **options).interpretation.notes[0]
        == "Not used for tracks: grid_step, region_polygon."
    )
    assert not any("Not used" in note for note in read(tmp_path, {"tracks": POINTS}, frames="0:4").interpretation.notes)


def test_arrays_that_are_not_used_are_listed(tmp_path: Path) -> None:
    more = {"weights": np.ones((F, P)), "faces": np.array([[0, 1, 2]]), "text": np.array("words")}
    notes = read(tmp_path, {"tracks": POINTS, **more}).interpretation.notes
    assert [note for note in notes if note.startswith("Not used")] == [
        f"Not used: weights ({F}, {P}), faces (1, 3), text."
    ]
    without = read_inputs(tracks=tmp_path / "tracks.npz", options=Options()).interpretation.notes
    assert any(note.endswith("text. Send this file as the mesh, too, to use its mesh.") for note in without)
    same = read_inputs(tracks=tmp_path / "tracks.npz", mesh=tmp_path / "tracks.npz", options=Options())
    assert (same.interpretation.mesh_source, same.interpretation.num_faces) == ("given", 1)
    many = {f"array_{number}": np.ones(2) for number in range(12)}
    (listed,) = [
        each for each in read(tmp_path, {"tracks": POINTS, **many}).interpretation.notes if each.startswith("Not used")
    ]
    assert listed.endswith("array_9 (2,) and 2 more.")
    assert not any(each.startswith("Not used") for each in read(tmp_path, {"tracks": POINTS}).interpretation.notes)


def test_a_matrix_may_have_visibility_for_each_coordinate_row(tmp_path: Path) -> None:
    twice = np.repeat(SEEN, 2, axis=0)
    np.testing.assert_array_equal(read(tmp_path, {"W": MATRIX, "mask": twice}).tracks.visible > 0, SEEN)
    stacked = np.vstack([POINTS[..., 0], POINTS[..., 1]])
    half = np.vstack([SEEN, np.ones_like(SEEN)])
    np.testing.assert_array_equal(read(tmp_path, {"W": stacked, "mask": half}).tracks.visible > 0, SEEN)


def test_unknown_axes_and_batches_are_refused() -> None:
    refused("wrong_shape", {"tracks": np.zeros((1, 1, 2, 3, 4, 2))})
    assert "a batch of 2" in refused("wrong_shape", {"pred_tracks": np.stack([POINTS, POINTS])}).got
    assert "a batch of 2" in refused("wrong_shape", {"tracks": np.stack([pixels(POINTS)] * 2)}).got
    refused("wrong_shape", {"tracks": np.zeros((4, 2, 1, 9))})


def test_three_dimensional_points_need_intrinsics(tmp_path: Path) -> None:
    assert refused("missing_array", {"tracks_xyz": WORLD}).field == "tracks.intrinsics"
    for bad in (np.ones(3), np.array([0.0, 1, 2, 3]), np.array([1, 1, np.nan, 1]), np.array(["8", "8", "4", "2"])):
        refused("wrong_shape", {"tracks_xyz": WORLD, "intrinsics": bad})
    matrix = np.array([[8.0, 0, 4], [0, 8, 2], [0, 0, 1]])
    behind = WORLD.copy()
    behind[2, 5, 2] = -1
    got = read(tmp_path, {"tracks_xyz": behind, "intrinsics": matrix})
    assert got.tracks.visible[2, 5] == 0
    assert got.interpretation.coordinates == "projected"
    assert got.ground_truth is not None
    third = np.where(np.arange(F * P).reshape(F, P, 1) == 3, 2.0, 0.5)
    refused("unsupported_feature", {"tracks": np.concatenate([POINTS, third], axis=2)})


def test_truth_is_read_in_the_layout_that_fits_the_tracks() -> None:
    understood = understand({"tracks": POINTS}, Options())
    interleaved = SHAPES.transpose(0, 2, 1).reshape(3 * F, P)
    stacked = np.vstack([*SHAPES.transpose(2, 0, 1)])
    for array in (
        SHAPES,
        SHAPES.transpose(0, 2, 1),
        SHAPES.transpose(2, 1, 0),
        SHAPES.transpose(2, 0, 1),
        interleaved,
        stacked,
        stacked.T,
    ):
        np.testing.assert_array_equal(as_shapes(array, understood)[0], SHAPES)
    assert unexplained(SHAPES, POINTS) < 1e-12 < 0.3 < unexplained(stacked.reshape(F, 3, P).transpose(0, 2, 1), POINTS)
    _, notes = as_shapes(SHAPES[:, np.random.default_rng(1).permutation(P)], understood)
    assert "same order" in notes[0]
    wrong = np.zeros((F, 4))
    assert as_shapes(wrong, understood)[0] is wrong
    assert unexplained(SHAPES[:, :3], POINTS[:, :3]) == 0.0  # too few points to say


def test_invalid_truth_in_the_tracks_file_is_skipped_with_a_note(tmp_path: Path) -> None:
    got = read(tmp_path, {"tracks": POINTS, "shapes": SHAPES[:, 1:]})
    assert got.ground_truth is None
    assert any("cannot be used: expected (8, 45, 3)" in note for note in got.interpretation.notes)


def test_rotations_are_read_in_the_layout_that_makes_them_orthonormal() -> None:
    turns = np.linalg.qr(np.random.default_rng(0).normal(size=(F, 3, 3)))[0]
    two = turns[:, :2]
    for array in (turns, turns.transpose(1, 2, 0), turns.reshape(3 * F, 3), np.vstack([*turns.transpose(1, 0, 2)])):
        np.testing.assert_array_equal(as_rotations(array, F), turns)
    for array in (
        two,
        two.transpose(0, 2, 1),
        two.transpose(1, 2, 0),
        two.reshape(2 * F, 3),
        np.vstack([*two.transpose(1, 0, 2)]),
    ):
        np.testing.assert_array_equal(as_rotations(array, F), two)
    odd = np.zeros((5, 5))
    assert as_rotations(odd, F) is odd


def test_matlab_struct_arrays_hold_one_frame_per_element(tmp_path: Path) -> None:
    frames = np.zeros((1, F), dtype=[("W", object), ("name", object)])
    for index in range(F):
        frames[0, index] = (POINTS[index].T, "made")
    scipy.io.savemat(tmp_path / "t.mat", {"frames": frames})
    got = read_inputs(tracks=tmp_path / "t.mat", mesh="none", options=Options())
    np.testing.assert_array_equal(got.tracks.points, POINTS)


def test_matlab_73_ignores_text_and_empty_arrays_and_limits_cells(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "t.mat", "w") as file:
        file["W"] = MATRIX.T
        file["text"] = np.zeros((4, 1), dtype=np.uint16)
        file["text"].attrs["MATLAB_class"] = np.bytes_("char")
        file["empty"] = np.zeros(2)
        file["empty"].attrs["MATLAB_empty"] = 1
        file.create_dataset("mixed", (2,), dtype=h5py.ref_dtype)
        file["mixed"][...] = [file["W"].ref, file["text"].ref]
    with (tmp_path / "t.mat").open("rb") as stream:
        assert set(read_matlab73(stream, field="tracks", limits=Limits())) == {"W"}
    with h5py.File(tmp_path / "t.mat", "w") as file:
        file.create_dataset("W", (1, 1 << 20), dtype=h5py.ref_dtype, chunks=(1, 16))
    with (tmp_path / "t.mat").open("rb") as stream, pytest.raises(InvalidInput, match="at most 20,000 cells"):
        read_matlab73(stream, field="tracks", limits=Limits())


def test_hdf5_of_other_programs_keeps_its_axes(tmp_path: Path) -> None:
    rows = np.arange(P) / P * 300  # neighbouring points are as close as neighbouring frames
    points = POINTS + np.stack([rows, np.sqrt(rows)], axis=1)
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["tracks"], file["visibility"] = points, np.ones((F, P), dtype=bool)
    got = read_inputs(tracks=tmp_path / "t.h5", mesh="none", options=Options())
    np.testing.assert_array_equal(got.tracks.points, points)


@pytest.mark.parametrize("axes", [(2, 1, 0), (0, 2, 1)])
def test_the_order_of_other_axes_than_the_documented_ones_is_not_guessed(axes: tuple[int, ...]) -> None:
    """With x and y on another axis than the last, frames before points is no more probable than points before frames."""
    angles = (
        (np.arange(12)[:, None] + np.arange(40)) * np.pi / 6
    )  # a step in time is as long as the distance of neighbours
    points = 300 + 100 * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    wrong = refused("ambiguous_layout", {"tracks": points.transpose(axes)})
    assert {str(way["layout"]) for way in offered(wrong)} == {"frames_points", "points_frames"}


def test_tracks_of_all_pixels_give_a_grid_mesh(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", tracks=pixels(POINTS), visibility=pixels(SEEN))
    got = read_inputs(tracks=tmp_path / "t.npz", options=Options())
    assert got.interpretation.mesh_source == "grid"
    assert got.interpretation.mesh_grid == (ROWS, COLUMNS)
    np.testing.assert_array_equal(got.tracks.visible > 0, SEEN)


def test_extreme_visible_coordinates_are_rejected(tmp_path: Path) -> None:
    far = POINTS.copy()
    far[2, 3] = 1e13
    with pytest.raises(InvalidInput, match="1 of them beyond") as caught:
        read(tmp_path, {"tracks": far})
    assert (caught.value.code, caught.value.field) == ("out_of_range", "tracks")
    seen = np.ones((F, P), dtype=bool)
    seen[2, 3] = False
    assert read(tmp_path, {"tracks": far, "visibility": seen}).tracks.visible[2, 3] == 0
    got = read(tmp_path, {"tracks": POINTS, "shapes": SHAPES * 1e13})
    assert any("within ±1e+12" in note for note in got.interpretation.notes)


def test_empty_arrays_are_refused() -> None:
    for shape in ((0, 4), (4, 0), (0, 5, 9, 2), (4, 0, 0, 2), (0, 0, 0)):
        with pytest.raises(InvalidInput):
            read_whole(np.zeros(shape))


def read_whole(array: np.ndarray) -> None:
    got = understand({"W" if array.ndim == 2 else "tracks": array}, Options())
    Tracks.from_arrays(got.points)


def test_arrays_of_the_same_meaning_and_cameras_in_the_tracks_file_are_listed_as_not_used(tmp_path: Path) -> None:
    turns = np.broadcast_to(np.eye(3), (F, 3, 3))
    got = read(tmp_path, {"tracks": POINTS, "W": MATRIX, "rotations": turns})
    assert [note for note in got.interpretation.notes if note.startswith("Not used")] == [
        f"Not used: W {MATRIX.shape}, rotations ({F}, 3, 3). Send given cameras as the part rotations."
    ]
    with_truth = read(tmp_path, {"tracks": POINTS, "shapes": SHAPES, "rotations": turns})
    assert not any(note.startswith("Not used") for note in with_truth.interpretation.notes)


def test_points_that_are_hardly_seen_are_refused_before_queueing(tmp_path: Path) -> None:
    seen = np.zeros((F, P), dtype=bool)
    seen[:, :3] = True
    seen[0] = True
    with pytest.raises(InvalidInput, match="visible in two or more frames") as caught:
        read(tmp_path, {"tracks": POINTS, "visibility": seen})
    assert (caught.value.code, caught.value.field) == ("too_little_seen", "visibility")


@pytest.mark.parametrize("every", [2, 10])
def test_tracks_with_empty_frames_are_read(tmp_path: Path, every: int) -> None:
    time = np.arange(60)[:, None]
    across = np.random.default_rng(0).uniform(0, 100, (2, 1, 40))
    points = np.stack([across[0] + 0.3 * time, across[1] + 5 * np.sin(0.1 * time)], axis=2)
    points[np.arange(60) % every > 0] = np.nan
    np.testing.assert_array_equal(read(tmp_path, {"tracks": points}, min_seen=1).tracks.visible[0], 1)
    lines = [f"{f},{p},{x},{y}" for f in range(0, 60, every) for p, (x, y) in enumerate(points[f])]
    (tmp_path / "tracks.csv").write_text("frame,point,x,y\n" + "\n".join(lines))
    table = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options(min_seen=1))
    assert table.tracks.points.shape == (60 - every + 1, 40, 2)
