"""Input records: accepted and rejected values, and read-only arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver import InvalidInput, KnownCamera, Mesh, Outcome, Settings, Tracks, gallery
from pliant.solver.errors import InvalidSettings

POINTS = np.arange(5 * 6 * 2, dtype=float).reshape(5, 6, 2)


def refusal(make: Any, *args: Any, **kwargs: Any) -> InvalidInput:
    with pytest.raises(InvalidInput) as caught:
        make(*args, **kwargs)
    error = caught.value
    assert error.field in str(error)
    assert error.expected in str(error)
    assert error.got in str(error)
    assert error.hint.endswith(".")
    return error


class TestTracks:
    def test_nan_and_infinity_in_either_coordinate_hide_the_observation(self) -> None:
        points = POINTS.copy()
        points[0, 1, 0] = np.nan
        points[2, 3, 1] = np.inf
        tracks = Tracks.from_arrays(points)
        assert (tracks.visible == 0).sum() == 2
        assert tracks.visible[0, 1] == 0
        assert tracks.visible[2, 3] == 0
        assert np.isfinite(tracks.points).all()
        assert not tracks.all_visible

    def test_masked_coordinates_hide_the_observation(self) -> None:
        masked = np.ma.array(POINTS.copy(), mask=np.zeros(POINTS.shape, dtype=bool))
        masked[1, 2, 0] = np.ma.masked
        masked.data[1, 2] = 1e5
        tracks = Tracks.from_arrays(masked)
        of_confidence = Tracks.from_arrays(POINTS, np.ma.array(np.ones(POINTS.shape[:2]), mask=masked.mask[..., 0]))
        np.testing.assert_array_equal(of_confidence.visible, tracks.visible)
        assert tracks.visible[1, 2] == 0
        assert tracks.visible.sum() == tracks.visible.size - 1

    def test_a_hidden_observation_may_be_anywhere(self) -> None:
        points, visible = np.where(POINTS == 7, 1e300, POINTS), np.ones(POINTS.shape[:2])
        visible[(points > 1e12).any(axis=2)] = 0
        assert Tracks.from_arrays(points, visible).points.max() == POINTS.max()

    def test_fractional_confidence_is_kept_and_zero_is_hidden(self) -> None:
        visible = np.full((5, 6), 0.25)
        visible[4] = 0
        tracks = Tracks.from_arrays(POINTS, visible)
        assert tracks.visible[0, 0] == 0.25
        assert (tracks.points[4] == 0).all()
        assert Tracks.from_arrays(POINTS, np.ones((5, 6), dtype=bool)).all_visible

    def test_arrays_are_copied_and_read_only(self) -> None:
        points = POINTS.copy()
        tracks = Tracks.from_arrays(points)
        points[:] = -1
        assert tracks.points[0, 0, 1] == 1
        assert (tracks.num_frames, tracks.num_points) == (5, 6)
        with pytest.raises(ValueError, match="read-only"):
            tracks.points[0, 0, 0] = 1
        with pytest.raises(ValueError, match="read-only"):
            tracks.visible[0, 0] = 0

    @pytest.mark.parametrize(
        ("points", "visible", "field", "code"),
        [
            (POINTS.astype(str), None, "tracks", "wrong_type"),
            (POINTS.astype(object), None, "tracks", "wrong_type"),
            (POINTS.astype(complex), None, "tracks", "wrong_type"),
            (POINTS[0], None, "tracks", "wrong_shape"),
            (POINTS.transpose(2, 0, 1), None, "tracks", "wrong_shape"),
            (POINTS[:2], None, "tracks", "too_few_frames"),
            (POINTS[:, :3], None, "tracks", "too_few_points"),
            (POINTS * np.nan, None, "tracks", "nothing_visible"),
            (POINTS * 1e153, None, "tracks", "out_of_range"),
            (POINTS * 1e300, None, "tracks", "out_of_range"),
            (np.where(POINTS == 7, -1e13, POINTS), None, "tracks", "out_of_range"),
            (POINTS, np.zeros((5, 6)), "tracks", "nothing_visible"),
            (POINTS, np.ones((6, 5)), "visibility", "wrong_shape"),
            (POINTS, np.ones((5, 6)).astype(str), "visibility", "wrong_type"),
            (POINTS, np.full((5, 6), 1.5), "visibility", "out_of_range"),
            (POINTS, np.full((5, 6), -0.5), "visibility", "out_of_range"),
            (POINTS, np.full((5, 6), np.nan), "visibility", "out_of_range"),
        ],
    )
    def test_invalid_tracks_are_rejected(self, points: Any, visible: Any, field: str, code: str) -> None:
        error = refusal(Tracks.from_arrays, points, visible)
        assert (error.field, error.code) == (field, code)


class TestMesh:
    def test_two_triangles_have_five_unique_edges(self) -> None:
        mesh = Mesh.from_faces([[0, 1, 2], [2, 1, 3]], 4)
        assert mesh.edges.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]

    def test_a_quad_has_four_edges_and_no_diagonal(self) -> None:
        assert Mesh.from_faces([[0, 1, 2, 3]], 4).edges.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]

    def test_no_faces_have_no_edges(self) -> None:
        assert Mesh.from_faces([], 4).edges.shape == (0, 2)

    def test_grid_quads_that_touch_a_hole_are_omitted(self) -> None:
        full = Mesh.from_grid(np.arange(12).reshape(3, 4))
        assert (full.num_points, len(full.faces)) == (12, 6)
        holed = np.array([[0, 1, 2], [3, -1, 4], [5, 6, 7]])
        mesh = Mesh.from_grid(holed)
        assert (mesh.num_points, len(mesh.faces)) == (8, 0)
        corner = np.array([[-1, 0, 1], [2, 3, 4]])
        assert Mesh.from_grid(corner).faces.tolist() == [[0, 3, 4, 1]]

    def test_grid_quads_are_counter_clockwise_with_rows_downward(self) -> None:
        (face,) = Mesh.from_grid([[0, 1], [2, 3]]).faces.tolist()
        assert face == [0, 2, 3, 1]

    @pytest.mark.parametrize(
        ("faces", "code"),
        [
            ([[0.0, 1.0, 2.0]], "wrong_type"),
            ([[0, 1]], "wrong_shape"),
            ([[0, 1, 2, 3, 4]], "wrong_shape"),
            ([[0, 1, 4]], "index_out_of_range"),
            ([[0, 1, 2], [-1, 2, 3]], "index_out_of_range"),
            ([[0, 1, 2], [1, 1, 3]], "degenerate_face"),
            ([[0, 1, 2], [1, 2]], "wrong_type"),
        ],
    )
    def test_invalid_faces_are_rejected(self, faces: Any, code: str) -> None:
        error = refusal(Mesh.from_faces, faces, 4)
        assert (error.field, error.code) == ("mesh.faces", code)

    @pytest.mark.parametrize(
        ("grid", "code"),
        [
            ([0, 1, 2], "wrong_shape"),
            ([[0.0, 1.0]], "wrong_shape"),
            ([[0, 1], [1, 2]], "index_out_of_range"),
            ([[0, 1], [3, 4]], "index_out_of_range"),
            ([[-1, -1]], "index_out_of_range"),
            ([[0, -5], [1, 2]], "index_out_of_range"),
            ([[0, 1], [2]], "wrong_type"),
        ],
    )
    def test_invalid_grids_are_rejected(self, grid: Any, code: str) -> None:
        error = refusal(Mesh.from_grid, grid)
        assert (error.field, error.code) == ("mesh.grid", code)


class TestKnownCamera:
    def test_two_rows_are_completed_to_a_rotation(self) -> None:
        rows = np.tile(np.eye(3)[:2], (4, 1, 1))
        camera = KnownCamera.from_arrays(rows, np.ones(4))
        assert np.allclose(camera.rotations, np.eye(3))
        assert np.allclose(np.linalg.det(camera.rotations), 1)

    def test_rows_rounded_in_a_file_are_made_orthonormal_again(self) -> None:
        turned = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0]]) + 2e-4
        camera = KnownCamera.from_arrays(np.tile(turned, (3, 1, 1)))
        assert camera.scales is None
        products = camera.rotations @ camera.rotations.transpose(0, 2, 1)
        assert np.abs(products - np.eye(3)).max() < 1e-12

    @pytest.mark.parametrize(
        ("rotations", "scales", "field", "code"),
        [
            (np.eye(3), None, "rotations", "wrong_shape"),
            (np.zeros((4, 3, 2)), None, "rotations", "wrong_shape"),
            (np.tile(np.eye(3) * 1.1, (4, 1, 1)), None, "rotations", "not_a_rotation"),
            (np.full((4, 2, 3), np.nan), None, "rotations", "not_a_rotation"),
            (np.tile(np.eye(3), (4, 1, 1)), np.ones(3), "scales", "wrong_shape"),
            (np.tile(np.eye(3), (4, 1, 1)), np.zeros(4), "scales", "out_of_range"),
            (np.tile(np.eye(3), (4, 1, 1)), np.full(4, np.inf), "scales", "out_of_range"),
            (np.tile(np.eye(3), (4, 1, 1)), np.full(4, 1e-300), "scales", "out_of_range"),
            (np.tile(np.eye(3), (4, 1, 1)), np.full(4, 1e300), "scales", "out_of_range"),
            (np.tile(np.eye(3), (4, 1, 1)), np.array([1, 1, 1, 1.1e4]), "scales", "out_of_range"),
            (np.zeros((0, 3, 3)), None, "rotations", "wrong_shape"),
            ([[1, 0, 0], [0, 1]], None, "rotations", "wrong_type"),
            (np.tile(np.eye(3) + 0j, (4, 1, 1)), None, "rotations", "wrong_type"),
            (np.tile(np.diag([1, 1, 7]), (4, 1, 1)), None, "rotations", "not_a_rotation"),
        ],
    )
    def test_invalid_cameras_are_rejected(self, rotations: Any, scales: Any, field: str, code: str) -> None:
        error = refusal(KnownCamera.from_arrays, rotations, scales)
        assert (error.field, error.code) == (field, code)

    def test_left_handed_rotations_are_named(self) -> None:
        error = refusal(KnownCamera.from_arrays, np.tile(np.diag([1.0, 1.0, -1.0]), (4, 1, 1)))
        assert (error.code, error.got) == ("not_a_rotation", "its negative: the determinants are -1")

    @pytest.mark.parametrize("point", [(1, 2, 3), 5.0, (np.nan, 1)])
    def test_a_principal_point_has_two_coordinates(self, point: Any) -> None:
        error = refusal(KnownCamera.from_arrays, np.tile(np.eye(3), (4, 1, 1)), principal_point=point)
        assert (error.field, error.code) == ("cameras.principal_point", "not_finite")

    def test_a_principal_point_is_made_of_numbers(self) -> None:
        error = refusal(KnownCamera.from_arrays, np.tile(np.eye(3), (4, 1, 1)), principal_point=("a", "b"))
        assert (error.field, error.code) == ("cameras.principal_point", "wrong_type")

    @pytest.mark.parametrize("focal", ["12", 0.0, -5.0, float("nan"), [900.0]], ids=str)
    def test_focal_length_must_be_a_positive_number(self, focal: Any) -> None:
        error = refusal(KnownCamera.from_arrays, np.tile(np.eye(3), (4, 1, 1)), focal=focal)
        assert (error.code, error.field) == ("wrong_type" if focal == "12" else "out_of_range", "cameras.focal")

    def test_a_focal_length_for_each_frame_is_named_by_its_shape(self) -> None:
        error = refusal(KnownCamera.from_arrays, np.tile(np.eye(3), (4, 1, 1)), focal=np.full(4, 900.0))
        assert (error.got, error.hint) == (
            "an array of shape (4)",
            "Give one length for all frames, in the tracks' unit.",
        )


class TestSettings:
    @pytest.mark.parametrize(
        "wrong",
        [
            {"method": "magic"},
            {"camera": "fisheye"},
            {"preset": "best"},
            {"loss": "l3"},
            {"laplacian": "none"},
            {"prior": "flat"},
            {"precision": "float16"},
            {"temporal_order": 3},
            {"basis_size": 0},
            {"basis_size": 101},
            {"temporal_weight": -1.0},
            {"spatial_weight": float("nan")},
            {"low_rank_weight": 1e7},
            {"robust_scale": 0.0},
            {"max_reweightings": 0},
            {"tolerance": 1.0},
            {"seed": -1},
            {"seed": 1.5},
            {"basis_size": 2.5},
            {"max_reweightings": 2.5},
            {"max_reweightings": None},
            {"temporal_weight": "a"},
            {"focal": "x"},
            {"image_size": 5},
            {"image_size": "ab"},
            {"principal_point": 5},
            {"y_up": "no"},
            {"y_up": np.array([True, False])},
            {"refine_rotations": "no"},
            {"refine_rotations": 1},
            {"max_reweightings": True},
            pytest.param({"principal_point": iter((5.0, 5.0))}, id="an iterator of two numbers"),
            {"surface": "isometric", "camera": "orthographic"},
            {"surface": "isometric", "camera": "scaled_orthographic"},
        ],
        ids=str,
    )
    def test_refusals_name_the_option(self, wrong: dict[str, Any]) -> None:
        with pytest.raises(InvalidSettings) as caught:
            Settings(**wrong)
        assert caught.value.field == f"options.{next(iter(wrong))}"
        assert caught.value.code == "invalid_option"


@pytest.mark.parametrize("kind", [np.array, list])
def test_pairs_may_be_arrays_and_are_kept_as_tuples(kind: Any) -> None:
    given = Settings(image_size=kind([640, 480]), principal_point=kind([319.5, 2.0]))
    assert given == Settings(image_size=(640, 480), principal_point=(319.5, 2.0))
    assert given != Settings(image_size=kind([641, 480]), principal_point=kind([319.5, 2.0]))
    cameras = KnownCamera.from_arrays(np.tile(np.eye(3), (4, 1, 1)), principal_point=kind([319.5, 2.0]))
    assert cameras.principal_point == (319.5, 2.0)


@pytest.mark.parametrize(
    "wrong", [np.array(640), np.zeros((2, 2)), np.array([640]), np.array([640, np.nan]), np.array(["a", "b"])]
)
def test_an_array_that_is_no_pair_is_refused_in_words(wrong: Any) -> None:
    for name in ("image_size", "principal_point"):
        with pytest.raises(InvalidSettings, match=f"options.{name}: expected two .*numbers"):
            Settings(**{name: wrong})


def test_every_outcome_has_a_sentence() -> None:
    assert all(outcome.sentence.endswith(".") for outcome in Outcome)
    assert "a tolerance above the rounding errors" in Outcome.REJECTED.sentence


def test_records_are_shown_without_their_arrays() -> None:
    film = gallery.face(5, 20)
    assert repr(film) == "<Sequence face: <Tracks of shape (5, 20, 2)>>"
    assert repr(film.mesh) == f"<Mesh of 20 points, faces of shape {film.mesh.faces.shape}>"
    assert repr(KnownCamera.from_arrays(film.rotations, focal=500)) == (
        "<KnownCamera of 5 frames, scales estimated, focal length 500>"
    )
    assert repr(KnownCamera.from_arrays(film.rotations, film.scales)) == "<KnownCamera of 5 frames, scales given>"
    assert repr(Tracks(None, None)) == "<Tracks of shape ()>"  # type: ignore[arg-type]
