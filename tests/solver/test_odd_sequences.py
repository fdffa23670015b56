"""Tracks with very few visible points give shapes or an input error, never an arithmetic error."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import InvalidInput, KnownCamera, Mesh, Outcome, Settings, Solution, Tracks, gallery, solve
from pliant.solver.agreement import separate_points_warnings, shared_position_warnings
from pliant.solver.cameras.planar_ambiguity import poses
from pliant.solver.cameras.scale import rigid_scales
from pliant.solver.model.marginal_likelihood import LOWER, root_of
from pliant.solver.model.so3 import exponential

SEEDS = (2, 6, 17, 21, 23, 71)
"""Refused sequences, sequences whose cameras are given, and one whose cameras are estimated, which takes ten times as long."""

SLOW_SEEDS = (13, 18, 19)
"""Sequences whose cameras are estimated."""

MORE_SEEDS = (*sorted(set(range(24)) - {*SEEDS, *SLOW_SEEDS}), 45, 91)
"""Further sequences of every kind."""


@pytest.mark.slow
def test_points_dropped_by_completion_do_not_break_the_solve() -> None:
    tracks = gallery.sphere(5, 20).tracks  # completion keeps 16 points, fewer than the 20 given
    assert np.isfinite(solve(tracks, settings=Settings(basis_size=1)).shapes).all()


@pytest.mark.parametrize("known", [True, False])
def test_too_few_observations_are_an_input_error(known: bool) -> None:
    random = np.random.default_rng(0)
    visible = np.zeros((6, 20), dtype=bool)
    visible[[0, 3], :3] = True  # three points in two frames, the others once at most
    visible[2, 3:9] = True
    cameras = KnownCamera.from_arrays(np.broadcast_to(np.eye(3), (6, 3, 3))) if known else None
    with pytest.raises(InvalidInput) as caught:
        solve(Tracks.from_arrays(random.normal(size=(6, 20, 2)), visible), cameras=cameras)
    assert (caught.value.code, caught.value.field, caught.value.got) == ("too_little_seen", "visibility", "3")


@pytest.mark.parametrize(
    "seed",
    [
        *SEEDS,
        *(pytest.param(seed, marks=pytest.mark.slow) for seed in SLOW_SEEDS),
        *(pytest.param(seed, marks=[pytest.mark.slow, pytest.mark.long]) for seed in MORE_SEEDS),
    ],
)
def test_small_sequences_give_finite_shapes_or_an_input_error(seed: int) -> None:
    random = np.random.default_rng(seed)
    frames, points = int(random.integers(3, 10)), int(random.integers(4, 30))
    flat = random.choice([0.0, 0.01, 1.0])
    shapes = random.normal(size=(points, 3)) * [1, 1, flat] + random.choice([0, 0.3]) * random.normal(
        size=(frames, points, 3)
    )
    angles = np.linspace(0, random.choice([0, 0.3, 2]), frames)
    zero = np.zeros(frames)
    rows = [[np.cos(angles), zero, -np.sin(angles)], [zero, zero + 1, zero], [np.sin(angles), zero, np.cos(angles)]]
    rotations = np.moveaxis(np.array(rows), 2, 0)
    image = np.einsum("fij,fpj->fpi", rotations[:, :2], shapes) * random.choice([1e-6, 1, 1e5])
    visible = random.random((frames, points)) > random.choice([0, 0.3, 0.7, 0.9])
    visible[:, random.integers(0, points, size=points // 3)] &= random.random() < 0.5
    faces = random.integers(0, points, size=(points, 3))
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    cameras = KnownCamera.from_arrays(rotations) if random.random() < 0.4 else None
    weight = random.choice([None, None, 0.0, 1.0])
    try:
        tracks = Tracks.from_arrays(image, visible)
        found = solve(
            tracks, Mesh.from_faces(faces, points), cameras=cameras, settings=Settings(temporal_weight=weight)
        )
    except InvalidInput as error:
        refused = error.code
    else:
        refused = None
    if refused is not None:
        assert refused in {"too_little_seen", "nothing_visible", "no_extent"}
        return
    for array in (found.shapes, found.residuals, found.weights, found.camera.scales, found.camera.translations):
        assert np.isfinite(array).all()


def odd_points(kind: str, frames: int, points: int) -> np.ndarray:
    """Tracks (F, P, 2) that violate something a solver may take for granted; NaN is hidden."""
    random = np.random.default_rng([frames, points])
    shapes = random.normal(size=(points, 3)) + 0.1 * random.normal(size=(frames, points, 3))
    turned = exponential(np.linspace(0, 1, frames)[:, None] * (0.0, 1.0, 0.0))
    image = 100 + 20 * np.einsum("fij,fpj->fpi", turned[:, :2], shapes)
    if kind == "duplicated frames":
        image[1] = image[0]
        image[-1] = image[-2]
    elif kind == "duplicated points":
        image[:, 1::2] = image[:, ::2][:, : image[:, 1::2].shape[1]]
    elif kind == "constant":
        image[:] = image[0]
    elif kind == "one moving point":
        image[:] = image[0]
        image[:, 2] += 5.0 * np.arange(frames)[:, None]
    elif kind == "one place but one":
        image[:] = 100.0
        image[:, 0] = 100 + np.arange(frames)[:, None]
    elif kind == "hidden":
        image[random.random(image.shape) < 0.15] = np.nan
    elif kind == "a point seen once":
        image[1:, 0] = np.nan
    return image


ODD = (
    "duplicated frames", "duplicated points", "constant", "one moving point", "one place but one", "hidden", "a point seen once",
)  # fmt: skip


def assert_finite(found: Solution, visible: np.ndarray) -> None:
    camera = found.camera
    for array in (
        found.shapes, found.residuals, found.weights, found.trace.objective, found.trace.residual,
        camera.rotations, camera.scales, camera.translations, camera.project(found.shapes),
    ):  # fmt: skip
        assert np.isfinite(array).all()
    if found.shapes_std is not None:
        assert np.isfinite(found.shapes_std).all()
    assert found.inlier_probability is not None
    assert ((found.inlier_probability >= 0) & (found.inlier_probability <= 1) == visible).all()
    assert np.isnan(found.inlier_probability[~visible]).all()
    assert found.trust is not None
    assert found.outcome is not Outcome.STOPPED


def finite_or_refused(image: np.ndarray, cameras: KnownCamera | None, settings: Settings) -> None:
    count = image.shape[1]
    mesh = Mesh.from_faces([[index, index + 1, index + 2] for index in range(count - 2)], count)
    refused, found = "", None
    try:
        found = solve(Tracks.from_arrays(image), mesh, cameras=cameras, settings=settings)
    except InvalidInput as error:
        refused = error.code
    if found is None:
        assert refused in {"too_little_seen", "nothing_visible", "no_extent"}
    else:
        assert_finite(found, np.isfinite(image).all(axis=2))


@pytest.mark.parametrize(
    ("frames", "points", "kind"),
    [
        *((3, 4, kind) for kind in ODD),
        *(pytest.param(5, 8, kind, marks=pytest.mark.slow) for kind in ("hidden", "a point seen once")),
        *(pytest.param(5, 8, kind, marks=[pytest.mark.slow, pytest.mark.long]) for kind in ODD[:5]),
    ],
)
def test_odd_tracks_of_known_cameras_give_finite_results_or_an_input_error(kind: str, frames: int, points: int) -> None:
    rotations = exponential(np.linspace(0, 1, frames)[:, None] * (0.0, 1.0, 0.0))
    for settings in (Settings(order="film"), Settings(prior="smooth"), Settings(method="temporal")):
        finite_or_refused(odd_points(kind, frames, points), KnownCamera.from_arrays(rotations), settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "hidden",
        *(pytest.param(each, marks=pytest.mark.long) for each in ODD if each != "hidden"),
    ],
)
def test_odd_tracks_give_finite_results_or_an_input_error(kind: str) -> None:
    finite_or_refused(odd_points(kind, 3, 5), None, Settings())
    finite_or_refused(odd_points(kind, 4, 6), None, Settings(prior="smooth"))


def test_a_covariance_without_extent_along_an_axis_still_has_a_root() -> None:
    root = np.zeros((3, 3))
    root[LOWER] = root_of(np.diag([1.0, 0.25, 0.0]))
    np.testing.assert_allclose(root @ root.T, np.diag([1.0, 0.25, 0.0]), atol=1e-8)
    np.testing.assert_array_equal(
        root_of(np.diag([4.0, 1.0, 9.0])), np.linalg.cholesky(np.diag([4.0, 1.0, 9.0]))[LOWER]
    )


def test_hidden_frames_get_finite_poses_and_scales() -> None:
    random = np.random.default_rng(1)
    rows = random.normal(size=(10, 3)) @ random.normal(size=(3, 40))
    rows[4:6] = 0
    gram = rows @ rows.T / 40
    rotations = np.linalg.qr(random.normal(size=(5, 3, 3)))[0]
    scales = rigid_scales(gram, rotations)
    assert np.isfinite(scales).all()
    assert scales.min() > 0
    assert all(np.isfinite(each).all() for each in poses(gram))


@pytest.mark.parametrize("marker", [-1.0, 0.0])
def test_a_position_that_marks_hidden_points_is_named(marker: float) -> None:
    film = gallery.face(12, 60)
    hidden = np.random.default_rng(0).random((12, 60)) < 0.1
    points = np.where(hidden[..., None], marker, film.tracks.points)
    given = Settings(method="pseudo_inverse")
    cameras = KnownCamera.from_arrays(film.rotations)
    (warning,) = solve(Tracks.from_arrays(points), cameras=cameras, settings=given).choices.warnings
    assert warning.startswith(f"{hidden.mean():.0%} of the visible positions are exactly ({marker:g}, {marker:g})")
    assert solve(Tracks.from_arrays(points, ~hidden), cameras=cameras, settings=given).choices.warnings == ()


def test_positions_that_few_points_share_are_no_markers() -> None:
    still = gallery.face(12, 60).tracks.points.copy()
    still[:, :2] = 5.0  # two points that do not move
    assert shared_position_warnings(Tracks.from_arrays(still)) == ()
    still[:, 2] = 5.0
    assert len(shared_position_warnings(Tracks.from_arrays(still))) == 1
    assert shared_position_warnings(Tracks.from_arrays(np.round(gallery.face(60, 900).tracks.points))) == ()


def test_points_that_no_chain_of_frames_connects_are_named() -> None:
    points = np.random.default_rng(0).random((30, 60, 2))
    visible = np.zeros((30, 60), dtype=bool)
    visible[:10, :20] = visible[10:20, 20:40] = visible[20:, 40:] = True
    assert "connects 40 of the points" in separate_points_warnings(Tracks.from_arrays(points, visible))[0]
    visible[9, 20] = visible[20, 39] = True
    assert separate_points_warnings(Tracks.from_arrays(points, visible)) == ()
    few = np.ones((30, 60), dtype=bool)
    few[5:, :3], few[:5, 3:] = False, False  # three points are too few for a part of their own
    assert separate_points_warnings(Tracks.from_arrays(points, few)) == ()
    once = np.ones((30, 60), dtype=bool)
    once[1:, :20], once[0, 20:] = False, False  # and so is one frame
    assert separate_points_warnings(Tracks.from_arrays(points, once)) == ()


def test_the_solution_warns_about_points_that_no_frame_connects() -> None:
    film = gallery.face(12, 60)
    visible = np.ones((12, 60), dtype=bool)
    visible[6:, :30] = visible[:6, 30:] = False
    cameras = KnownCamera.from_arrays(film.rotations)
    tracks = Tracks.from_arrays(film.tracks.points, visible)
    (warning,) = solve(tracks, cameras=cameras, settings=Settings(method="pseudo_inverse")).choices.warnings
    assert warning.startswith("No frame connects 30 of the points")


def test_points_of_which_hardly_one_is_visible_twice_are_finite() -> None:
    seen = np.zeros((8, 9))
    for frame, points in enumerate(((), (4,), (1, 2, 6), (2,), (0,), (0, 5), (5, 6), (8,))):
        seen[frame, list(points)] = 1
    image = np.random.default_rng(0).uniform(100, 400, size=(8, 9, 2))
    found = solve(Tracks.from_arrays(image, seen), settings=Settings(image_size=(640.0, 480.0)))
    assert_finite(found, seen > 0)
