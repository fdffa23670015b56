"""Sparsely observed and hidden points: the surface is closed over them, and their observations are matched."""

from __future__ import annotations

import tracemalloc
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pliant.solver import KnownCamera, Mesh, Settings, Tracks, gallery, solve
from pliant.solver.evaluation import metrics
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.shapes.sparsely_observed import (
    MAX_DEVIATION,
    MEAN_VARIANCE_SHARE,
    MIN_OUTLIER_DISTANCE,
    SURFACE_RIDGE,
    WELL_OBSERVED_SHARE,
    Kriging,
    close_surface,
    well_observed,
)
from pliant.solver.tracks.normalization import normalize
from scipy import sparse

MADE = gallery.face(16, 400, degrees=60, mesh="triangles")
TRUE = MADE.shapes - MADE.shapes.mean(axis=1, keepdims=True)
CAMERAS = KnownCamera.from_arrays(MADE.rotations, MADE.scales)


def seen_but(points: list[int], *, shown: tuple[int, ...] = ()) -> Tracks:
    """All points are visible, except `points`, which are seen only in the frames `shown`."""
    visible = np.ones(MADE.tracks.points.shape[:2])
    visible[np.ix_(np.setdiff1d(np.arange(16), shown), points)] = 0
    return Tracks.from_arrays(MADE.tracks.points, visible)


def patch(centre: int, rings: int) -> list[int]:
    found = {centre}
    for _ in range(rings):
        found |= set(MADE.mesh.edges[np.isin(MADE.mesh.edges, list(found)).any(axis=1)].ravel().tolist())
    return sorted(found)


HOLE, SHOWN = patch(190, 2), (0, 7, 15)
ROWS = np.ix_(SHOWN, HOLE)


@pytest.mark.parametrize(
    "cameras", [pytest.param(CAMERAS, id="known"), pytest.param(None, id="estimated", marks=pytest.mark.long)]
)
@pytest.mark.slow
def test_a_hole_in_the_face_is_closed(cameras: KnownCamera | None) -> None:
    assert len(HOLE) > 12
    found = solve(seen_but(HOLE), MADE.mesh, cameras=cameras)
    whole = solve(MADE.tracks, MADE.mesh, cameras=cameras).shapes
    assert metrics.e3d_frame(found.shapes, MADE.shapes) < 1.5 * metrics.e3d_frame(whole, MADE.shapes) + 0.02
    assert (found.weights[:, HOLE] == 0).all()
    assert (found.residuals[:, HOLE] == 0).all()
    np.testing.assert_allclose(found.shapes.mean(axis=1), 0, atol=1e-9)
    sides = np.delete(np.arange(400), HOLE)
    centred, expected = (each[:, sides] - each[:, sides].mean(axis=1, keepdims=True) for each in (found.shapes, whole))
    assert metrics.e3d_frame(centred, expected) < 0.1
    assert (
        "3.2% of the points" in found.choices.reasons["sparsely_observed"]
        or "of the points" in found.choices.reasons["sparsely_observed"]
    )


@pytest.mark.slow
def test_sparsely_observed_points_match_their_observations() -> None:
    """Seen in 3 of 16 frames, the patch passes through its observations and is closer to the truth than an unseen one."""
    drawn, seldom = (
        solve(seen_but(HOLE), MADE.mesh, cameras=CAMERAS),
        solve(seen_but(HOLE, shown=SHOWN), MADE.mesh, cameras=CAMERAS),
    )
    typical = np.median(seldom.residuals[:, np.delete(np.arange(400), HOLE)])
    assert np.median(seldom.residuals[ROWS]) < 3 * typical
    assert (seldom.weights[ROWS] > 0).all()
    image = np.einsum("f,fij,fpj->fpi", seldom.camera.scales, seldom.camera.rotations[:, :2], seldom.shapes)
    image += seldom.camera.translations[:, None]
    apart = np.linalg.norm(image - MADE.tracks.points, axis=2)
    np.testing.assert_allclose(apart[ROWS], seldom.residuals[ROWS], atol=1e-9 * np.abs(MADE.tracks.points).max())
    errors = [np.linalg.norm((each.shapes - TRUE)[:, HOLE]) for each in (drawn, seldom)]
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=[pytest.mark.slow, pytest.mark.long])])
@pytest.mark.slow
def test_two_noisy_observations_from_one_side_keep_the_depth_bounded(seed: int) -> None:
    """They hardly determine depth: if points could be anywhere in the body, the error would be three times that without them."""
    noise = np.random.default_rng(seed).normal(size=MADE.tracks.points.shape) * 0.02 * np.abs(TRUE).max()
    errors = []
    for shown in ((), (0, 1)):
        tracks = seen_but(HOLE, shown=shown)
        found = solve(Tracks.from_arrays(tracks.points + noise, tracks.visible), MADE.mesh, cameras=CAMERAS)
        errors.append(np.linalg.norm((found.shapes - TRUE)[:, HOLE]))
    assert errors[1] < 1.7 * errors[0]


@given(seed=st.integers(0, 2**32 - 1))
def test_a_constant_mode_equals_a_larger_mean_position_covariance(seed: int) -> None:
    """With estimated cameras, learning may attribute the variance of mean positions to the modes, or vice versa."""
    random = np.random.default_rng(seed)
    frames, share = int(random.integers(3, 12)), random.uniform(0.2, 2)
    root, modes = random.normal(size=(3, 3)), random.normal(size=(frames, 2))
    axis_covariance = root @ root.T + 0.1 * np.eye(3)
    mean_covariance = np.diag(random.uniform(0.1, 1, 3))
    mode = np.full((frames, 1), share**0.5)
    problem = SimpleNamespace(points=np.zeros((frames, 2, 1)), projections=random.normal(size=(frames, 2, 3)))
    one, other = (
        Kriging.of(problem, ShapeCovariance(a, axis_covariance, m, 1e-3, 1e-4, 0.0), np.zeros((frames, 2)))  # type: ignore[arg-type]
        for a, m in ((mean_covariance, np.hstack([modes, mode])), (mean_covariance + share * axis_covariance, modes))
    )
    shown = np.sort(random.choice(frames, int(random.integers(1, frames)), replace=False))
    for expected, found in (
        (one.columns(shown), other.columns(shown)),
        (one.image(shown, one.columns(shown)), other.image(shown, other.columns(shown))),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9 * max(np.abs(expected).max(), 1))


@given(seed=st.integers(0, 2**32 - 1))
def test_covariances_of_the_shown_frames_are_those_of_all_frames(seed: int) -> None:
    """Compared with ΠΣΠᵀ and Σ about a path's mean, written out for all frames."""
    random = np.random.default_rng(seed)
    frames = int(random.integers(3, 12))
    root = random.normal(size=(3, 3))
    covariance = ShapeCovariance(
        np.diag(random.uniform(0.1, 1, 3)), root @ root.T + 0.1 * np.eye(3), random.normal(size=(frames, 2)),
        1e-3, 1e-4, 0.0, ordered=bool(random.integers(2)),
    )  # fmt: skip
    rows = random.normal(size=(frames, 2, 3))
    problem = SimpleNamespace(points=np.zeros((frames, 2, 1)), projections=rows)
    kriging = Kriging.of(problem, covariance, np.zeros((frames, 2)))  # type: ignore[arg-type]
    centre = np.eye(frames) - 1 / frames
    moving = centre @ covariance.over_frames() @ centre
    near = MEAN_VARIANCE_SHARE * (covariance.over_frames().mean() + covariance.axes()[1])
    sigma = np.einsum("fg,cd->fcgd", moving, np.eye(3)) + np.einsum("c,cd->cd", near, np.eye(3))[None, :, None]
    image = np.einsum("fic,fcgd,gjd->figj", rows, sigma, rows)
    shown = np.sort(random.choice(frames, int(random.integers(1, frames)), replace=False))
    columns = kriging.columns(shown)
    np.testing.assert_allclose(columns, moving[:, shown], atol=1e-9)
    expected = image[shown][:, :, shown].reshape(2 * len(shown), -1)
    np.testing.assert_allclose(kriging.image(shown, columns), expected, atol=1e-9)


def test_memory_for_a_rarely_seen_point_is_proportional_to_the_frames_and_its_observations() -> None:
    random = np.random.default_rng(0)
    peaks = []
    for frames in (1000, 4000):
        covariance = ShapeCovariance(np.eye(3), np.eye(3), random.normal(size=(frames, 5)), 1e-3, 1e-4, 0.0)
        problem = SimpleNamespace(
            points=random.normal(size=(frames, 2, 1)), projections=random.normal(size=(frames, 2, 3)), loss="l2",
            weights=SimpleNamespace(temporal=1e-3, robust_scale=1.0),
        )  # fmt: skip
        confidence = np.zeros((frames, 1))
        confidence[::100] = 1.0
        tracemalloc.start()
        kriging = Kriging.of(problem, covariance, np.zeros((frames, 2)))  # type: ignore[arg-type]
        path = kriging.moved(0, confidence, np.zeros((frames, 3, 1)))
        peaks.append(tracemalloc.get_traced_memory()[1] / int(confidence.sum()))
        tracemalloc.stop()
        assert np.isfinite(path).all()
    assert peaks[1] < 6 * peaks[0]
    assert peaks[1] < 1e6


@pytest.mark.slow
def test_outliers_of_sparsely_observed_points_cost_little_more_than_hiding_them() -> None:
    """Of three observations of a point one or two may be outliers: a fit to all of them would lose the good ones."""
    tracks = seen_but(HOLE, shown=(0, 5, 10))
    random, visible = np.random.default_rng(6), np.asarray(tracks.visible) > 0
    points, wrong = np.array(tracks.points), visible & (random.random(visible.shape) < 0.1)
    points[wrong] += random.choice([-1, 1], (int(wrong.sum()), 2)) * np.abs(TRUE).max()
    found, spared = (
        solve(Tracks.from_arrays(points, each), MADE.mesh, cameras=CAMERAS) for each in (visible, visible & ~wrong)
    )
    in_hole = np.zeros_like(wrong)
    in_hole[:, HOLE] = True
    assert (wrong & in_hole).sum() >= 5
    assert (found.weights[wrong & in_hole] == 0).all()
    assert (found.weights[visible & ~wrong & in_hole] > 0).mean() > 0.97
    errors = [np.linalg.norm((each.shapes - TRUE)[:, HOLE]) for each in (found, spared)]
    assert errors[0] < 1.05 * errors[1]


@given(seed=st.integers(0, 2**32 - 1))
def test_the_worst_observation_is_rejected_first(seed: int) -> None:
    """Compared with removing one at a time by the conditional mean and covariance of a Gaussian."""
    random = np.random.default_rng(seed)
    frames = 6
    root = random.normal(size=(2 * frames, 2 * frames))
    image, scatter = root @ root.T / 50, 0.01
    expected = image + scatter * np.eye(2 * frames)
    off = random.multivariate_normal(np.zeros(2 * frames), expected).reshape(frames, 2)
    off[random.random(frames) < 0.3] += 3.0
    confidence = (random.random((frames, 1)) < 0.8).astype(float)
    path = np.zeros((frames, 3, 1))
    kriging = Mock(spec=Kriging, scatter=scatter)
    kriging.left.return_value = off[:, :, None]
    kriging.image.side_effect = lambda there, _: image.reshape(frames, 2, frames, 2)[there][:, :, there].reshape(
        2 * len(there), -1
    )
    left = np.flatnonzero(confidence[:, 0] > 0).tolist()
    while left:
        deviation = []
        for one in left:
            others = [2 * f + axis for f in left if f != one for axis in (0, 1)]
            mine = [2 * one, 2 * one + 1]
            gain = expected[np.ix_(mine, others)] @ np.linalg.inv(expected[np.ix_(others, others)])
            apart = off[one] - gain @ off.ravel()[others]
            spread = expected[np.ix_(mine, mine)] - gain @ expected[np.ix_(others, mine)]
            deviation.append(apart @ np.linalg.solve(spread, apart) if np.hypot(*apart) > MIN_OUTLIER_DISTANCE else 0.0)
        if max(deviation) <= MAX_DEVIATION**2:
            break
        left.pop(int(np.argmax(deviation)))
    gone = np.setdiff1d(np.flatnonzero(confidence[:, 0] > 0), left)
    np.testing.assert_array_equal(Kriging.inconsistent(kriging, 0, confidence, path), gone)


def test_a_patch_attached_to_an_edge_stays_bounded() -> None:
    far = np.flatnonzero(TRUE[0, :, 1] < np.quantile(TRUE[0, :, 1], 0.3)).tolist()
    found = solve(seen_but(far), MADE.mesh, cameras=CAMERAS)
    assert np.abs(found.shapes[:, far]).max() < 1.5 * np.abs(TRUE).max()


def test_unconnected_points_stay_at_the_centre() -> None:
    alone = 77
    faces = MADE.mesh.faces[~(MADE.mesh.faces == alone).any(axis=1)]
    found = solve(seen_but([alone]), Mesh.from_faces(faces, 400), cameras=CAMERAS)
    size = np.linalg.norm(found.shapes, axis=2).mean()
    assert np.linalg.norm(found.shapes[:, alone], axis=1).max() < 0.2 * size


def test_hidden_grid_points_become_a_hole_and_are_filled_in() -> None:
    made = gallery.face(12, 400, degrees=60)
    assert made.mesh.grid is not None
    hole = made.mesh.grid[8:10, 8:10].ravel()
    visible = np.ones(made.tracks.points.shape[:2])
    visible[:, hole] = 0
    tracks = Tracks.from_arrays(made.tracks.points, visible)
    part = well_observed(normalize(tracks), made.mesh)
    assert part is not None
    assert part.mesh.grid is not None
    assert part.mesh.grid.shape == made.mesh.grid.shape
    assert (part.mesh.grid[8:10, 8:10] == -1).all()
    assert (part.mesh.grid >= 0).sum() == (made.mesh.grid >= 0).sum() - 4
    found = solve(tracks, made.mesh, cameras=KnownCamera.from_arrays(made.rotations, made.scales))
    true = made.shapes - made.shapes.mean(axis=1, keepdims=True)
    assert np.linalg.norm((found.shapes - true)[:, hole], axis=2).max() < 0.1 * np.abs(true).max()


@pytest.mark.parametrize("mesh", [None, Mesh.from_faces(np.zeros((0, 3), dtype=int), 60)], ids=["no mesh", "no faces"])
def test_the_std_of_unseen_points_without_a_surface_is_not_bounded_by_their_neighbours(mesh: Mesh | None) -> None:
    made, unseen = gallery.face(6, 60, degrees=60), [20, 30, 40]
    visible = np.ones((6, 60))
    visible[:, unseen] = 0
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)
    settings = Settings(camera="scaled_orthographic")
    found = solve(Tracks.from_arrays(made.tracks.points, visible), mesh, cameras=cameras, settings=settings)
    assert found.shapes_std is not None
    true = made.shapes - made.shapes.mean(axis=1, keepdims=True)
    error = np.linalg.norm((found.shapes - true)[:, unseen], axis=2)
    assert 0.8 < np.sqrt(np.square(found.shapes_std[:, unseen]).mean() / np.square(error).mean()) < 3


@pytest.mark.parametrize(
    ("tracks", "mesh"),
    [
        (MADE.tracks, MADE.mesh),
        (seen_but([7]), None),
        (seen_but([7]), Mesh.from_faces(np.zeros((0, 3), dtype=int), 400)),
        (seen_but(list(range(250))), MADE.mesh),
        (seen_but([7], shown=tuple(range(int(WELL_OBSERVED_SHARE * 16)))), MADE.mesh),
    ],
    ids=["all seen", "no mesh", "no faces", "most are seldom seen", "seen just often enough"],
)
def test_all_points_are_fitted_together_if_no_split_applies(tracks: Tracks, mesh: Mesh | None) -> None:
    assert well_observed(normalize(tracks), mesh) is None


def test_closing_the_surface_minimises_its_energy_and_keeps_known_points() -> None:
    random = np.random.default_rng(0)
    energy, shapes = sparse.random_array((60, 20), density=0.3, rng=random), random.normal(size=(3, 3, 20))
    known = np.setdiff1d(np.arange(20), [2, 5, 11])
    before = shapes.copy()
    close_surface(shapes, known, energy)
    np.testing.assert_array_equal(shapes[:, :, known], before[:, :, known])
    pull = shapes @ (energy.T @ energy).toarray() + SURFACE_RIDGE * shapes
    np.testing.assert_allclose(pull[:, :, [2, 5, 11]], 0, atol=1e-10)


@pytest.mark.parametrize("settings", [{"prior": "smooth"}, {"temporal_weight": 0.0}], ids=str)
def test_smooth_prior_and_zero_weight_do_not_split_off_sparse_points(settings: dict[str, object]) -> None:
    found = solve(seen_but(HOLE), MADE.mesh, cameras=CAMERAS, settings=Settings(**settings))  # type: ignore[arg-type]
    assert "sparsely_observed" not in found.choices.reasons
