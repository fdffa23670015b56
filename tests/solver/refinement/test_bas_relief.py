"""The step along the bas-relief family: its geometry, what decides it, and heads that turn by 2° and by 30°."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Tracks, estimate_cameras, gallery, solve
from pliant.solver.cameras.estimation import given_cameras
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.gallery.sequence import Sequence
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import MIRROR, angles_between, exponential
from pliant.solver.refinement import bas_relief, joint_refinement, observed
from pliant.solver.refinement.bas_relief import LOG_DEPTH_STD, VISIBLE_DEPTH, at_probable_depth, bulges, extent_penalty
from pliant.solver.refinement.depth_rounds import with_stretched_depth
from pliant.solver.refinement.evidence import Evidence
from pliant.solver.refinement.learned import Learned
from pliant.solver.refinement.observed import Moments, Observed
from pliant.solver.tracks.normalization import normalize
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

FRAMES = 24


def found(degrees: float, depth: float) -> tuple[np.ndarray, Learned]:
    """The Gram matrix, cameras and covariance of an object with extents 1, 1 and `depth`."""
    time = np.linspace(0, 2 * np.pi, FRAMES)
    tilts = np.radians(degrees / 2) * np.stack([np.sin(time), np.cos(2 * time), 0 * time], axis=1)
    rolls = exponential(np.stack([0 * time, 0 * time, 0.4 * np.sin(time)], axis=1))
    covariance = ShapeCovariance(
        np.diag([1.0, 1.0, depth**2]), np.eye(3), 0.05 * np.cos(np.outer(time, [1, 2])), 1e-4, 1e-4, 0.0
    )
    rotations = rolls @ exponential(tilts)
    return covariance.of_image(rotations[:, :2]), Learned(rotations, np.ones(FRAMES), covariance, 0.0)


def test_the_expected_depth_is_that_of_half_a_sphere() -> None:
    side = np.linspace(-1, 1, 401)
    x, y = (each.ravel() for each in np.meshgrid(side, side))
    inside = x**2 + y**2 < 1
    assert np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2).std() / x[inside].std() == pytest.approx(
        VISIBLE_DEPTH, rel=2e-3
    )


def test_the_prior_leaves_a_factor_of_3_or_4_of_depth() -> None:
    logs = np.linspace(-25, 25, 20001)
    density = np.exp([-extent_penalty(np.exp(2 * log)) for log in logs])
    density /= density.sum()
    spread = np.sqrt(density @ logs**2 - (density @ logs) ** 2)
    assert spread == pytest.approx(LOG_DEPTH_STD, rel=1e-3)
    assert 3 < np.exp(LOG_DEPTH_STD) < 4


def test_the_penalty_is_least_at_the_expected_ratio_and_steeper_for_deep_objects() -> None:
    least = minimize_scalar(lambda log: extent_penalty(np.exp(log)), bounds=(-3, 3), method="bounded")
    assert least.x == pytest.approx(0, abs=1e-4)
    assert extent_penalty(1.0) == 0
    assert extent_penalty(4e8) - extent_penalty(1e8) == pytest.approx(2 * np.log(2), rel=1e-6)
    assert extent_penalty(1e-8) - extent_penalty(4e-8) == pytest.approx(np.log(2), rel=1e-6)


def test_rotations_are_rolls_after_tilts() -> None:
    _, given = found(8, 0.5)
    toward, rolls, tilts = bas_relief._decomposed(given.rotations)
    np.testing.assert_allclose(rolls @ exponential(tilts), given.rotations, atol=1e-12)
    np.testing.assert_allclose(rolls @ toward, np.tile([0, 0, 1], (FRAMES, 1)), atol=1e-12)
    np.testing.assert_allclose(tilts @ toward, 0, atol=1e-12)


def test_images_change_only_to_second_order_in_the_angles() -> None:
    def change(degrees: float) -> float:
        gram, given = found(degrees, 0.5)
        moved = bas_relief._stretched(given, 0.5, *bas_relief._decomposed(given.rotations))
        assert given.covariance.axis_covariance.trace() == pytest.approx(3)
        assert moved.covariance.axis_covariance.trace() == pytest.approx(3)
        return float(np.abs(moved.covariance.of_image(moved.rotations[:, :2]) - gram).max())

    assert change(2) / change(1) == pytest.approx(4, rel=0.1)
    gram, given = found(10, 0.5)
    same = bas_relief._stretched(given, 1.0, *bas_relief._decomposed(given.rotations))
    np.testing.assert_allclose(same.covariance.of_image(same.rotations[:, :2]), gram, atol=1e-12)


def test_depth_follows_the_tracks_only_with_enough_rotation() -> None:
    gram, deep = found(1, 4.0)
    settled, stretch = at_probable_depth(gram, deep)
    assert settled.covariance.mean_covariance[2, 2] ** 0.5 == pytest.approx(4.0 * stretch)
    assert 4.0 * stretch == pytest.approx(VISIBLE_DEPTH, rel=0.3)
    gram, turning = found(60, 1.5)
    assert at_probable_depth(gram, turning)[1] == pytest.approx(1, abs=0.01)


def test_zero_prior_weight_keeps_the_depth_of_the_tracks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bas_relief, "CAMERA_PRIOR_WEIGHT", 0.0)
    gram, given = found(10, 1.5)
    assert at_probable_depth(gram, given)[1] == pytest.approx(1, abs=0.01)


def test_cameras_from_all_around_are_unchanged() -> None:
    rotations = Rotation.from_euler("y", np.linspace(0, 350, FRAMES)[:, None], degrees=True).as_matrix()
    gram, given = found(10, 1.5)
    around = Learned(rotations, given.scales, given.covariance, 0.0)
    settled, stretch = at_probable_depth(gram, around)
    assert stretch == 1
    assert settled is around


def depth_of(shapes: np.ndarray, rotations: np.ndarray) -> float:
    """Standard deviation of depth over that of x and y, mean over frames."""
    seen = shapes @ rotations.transpose(0, 2, 1)
    return float((seen[..., 2].std(axis=1) / seen[..., :2].std(axis=(1, 2))).mean())


@pytest.mark.slow
def test_a_head_that_turns_by_2_degrees_gets_a_plausible_depth() -> None:
    head = gallery.face(12, 60, degrees=1, tilt=0.5)
    tracks, _ = gallery.corrupt_tracks(head.tracks, noise=0.003, seed=0)
    solution = solve(tracks, head.mesh)
    found = depth_of(solution.shapes, solution.camera.rotations)
    assert 0.5 < found / depth_of(head.shapes, head.rotations) < 2
    assert "like that of half a sphere" in solution.choices.reasons["depth_extent"]
    assert solution.trust is not None
    assert solution.trust.verdict != "good"
    assert solution.trust.interval is None


@pytest.mark.slow
def test_refinement_on_observations_does_not_deepen_a_head_that_turns_by_2_degrees() -> None:
    """With the step only before it, the depth is 3.1 times the true one."""
    head = gallery.face(12, 60, degrees=1, tilt=0.5, seed=1)
    tracks, _ = gallery.corrupt_tracks(head.tracks, noise=0.003, seed=0)
    visible = np.random.default_rng(0).random(tracks.points.shape[:2]) > 0.3
    solution = solve(Tracks.from_arrays(tracks.points, visible), head.mesh)
    found = depth_of(solution.shapes, solution.camera.rotations)
    assert 0.5 < found / depth_of(head.shapes, head.rotations) < 2


def test_the_focal_length_follows_the_typical_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    gram, given = found(8, 0.5)
    moved = bas_relief._stretched(given, 0.5, *bas_relief._decomposed(given.rotations))
    monkeypatch.setattr(observed, "at_probable_depth", lambda *_: (moved, 0.5))
    head = gallery.face(FRAMES, 20)
    normalized, scales = normalize(gallery.corrupt(head, hidden=0.1).tracks), np.ones(FRAMES)
    estimate = given_cameras(normalized, KnownCamera.from_arrays(head.rotations, scales), Settings())
    plain = Observed.of(normalized, estimate, np.arange(FRAMES))
    moments = Moments(gram, estimate.sample, np.asarray(estimate.translations), 0.0)
    assert observed._with_typical_depth(plain, given, moments) == (moved, plain)
    view = Perspective(np.zeros((FRAMES, 2)), np.zeros(2), inverse_focal=0.1, inverse_focal_std=0.02)
    cameras, after = observed._with_typical_depth(replace(plain, view=view), given, moments)
    assert cameras is moved
    assert after.view is not None
    assert (after.view.inverse_focal, after.view.inverse_focal_std) == (0.2, 0.04)


@pytest.mark.slow
def test_a_head_that_turns_by_30_degrees_keeps_its_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    stretches = []

    def settled(gram: np.ndarray, given: Learned) -> tuple[Learned, float]:
        moved, stretch = at_probable_depth(gram, given)
        stretches.append(stretch)
        return moved, stretch

    monkeypatch.setattr(joint_refinement, "at_probable_depth", settled)
    head = gallery.face(12, 60, degrees=15)
    tracks, _ = gallery.corrupt_tracks(head.tracks, noise=0.003, seed=0)
    cameras = estimate_cameras(tracks)
    assert stretches == [pytest.approx(1, abs=0.01)], "the candidates are not compared"
    assert "depth_extent" not in cameras.estimate.reasons


def nearby(head: Sequence, noise: float = 0.0) -> Tracks:
    """Tracks in a picture of 1280×720 of a head three half-sizes away, φ = 900 px."""
    seen = (head.shapes - head.shapes.mean(axis=1, keepdims=True)) @ head.rotations.transpose(0, 2, 1)
    seen *= 300 / np.abs(seen).max()
    tracks = Tracks.from_arrays(np.array([639.5, 359.5]) + seen[..., :2] / (1 + seen[..., 2:] / 900))
    return gallery.corrupt_tracks(tracks, noise=noise, seed=0)[0]


@pytest.mark.long
@pytest.mark.slow
def test_perspective_is_the_same_at_twice_the_depth_and_twice_the_focal_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a prior determines the depth, the focal length follows, and is no better known than the depth."""
    tracks, before = nearby(gallery.face(12, 40, degrees=8, tilt=2)), []

    def settled(gram: np.ndarray, given: Learned) -> tuple[Learned, float]:
        before.append(given)
        return bas_relief._stretched(given, 2.0, *bas_relief._decomposed(given.rotations)), 2.0

    monkeypatch.setattr(joint_refinement, "at_probable_depth", settled)
    settings = Settings(camera="perspective", image_size=(1280.0, 720.0), basis_size=2)
    deep = estimate_cameras(tracks, settings=settings).estimate
    assert deep.perspective is not None
    assert deep.depth_is_typical
    assert deep.perspective.inverse_focal_std > LOG_DEPTH_STD * abs(deep.perspective.inverse_focal)
    assert "focal length" in deep.reasons["depth_extent"]

    strong = replace(deep, perspective=replace(deep.perspective, inverse_focal=0.04))
    (given,) = before
    evidence = Evidence.of(strong, normalize(tracks), np.arange(12), np.ones(12))
    plain = with_stretched_depth(evidence, given, 1.0).estimate
    moved, _ = settled(plain.gram, given)
    twice = with_stretched_depth(evidence, moved, 2.0).estimate
    assert twice.perspective is not None
    assert twice.perspective.inverse_focal == 0.02
    view = deep.perspective.learning_sample
    bent = (plain.sample - view + view.mean(axis=1, keepdims=True)).std()
    assert bent > 0.005
    assert (twice.sample - plain.sample).std() < 0.1 * bent


@pytest.mark.slow
def test_a_given_focal_length_determines_the_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_refinement, "at_probable_depth", None)
    settings = Settings(focal=900.0, image_size=(1280.0, 720.0), basis_size=2)
    found = estimate_cameras(nearby(gallery.face(8, 40, degrees=4)), settings=settings).estimate
    assert not found.depth_is_typical


@pytest.mark.slow
@pytest.mark.long
def test_a_near_head_that_turns_by_2_degrees_gets_a_plausible_depth() -> None:
    """Without the step, the depth is 3.8 times the true one, and the focal length 15 times."""
    head = gallery.face(12, 60, degrees=1, tilt=0.5, seed=1)
    settings = Settings(camera="perspective", image_size=(1280.0, 720.0))
    solution = solve(nearby(head, noise=0.003), head.mesh, settings=settings)
    found = depth_of(solution.shapes, solution.camera.rotations)
    assert 0.5 < found / depth_of(head.shapes, head.rotations) < 2
    assert solution.camera.focal is not None
    assert solution.camera.focal_std is not None
    assert abs(solution.camera.focal - 900) < solution.camera.focal_std


@pytest.mark.parametrize("y_up", [False, True])
def test_a_hill_bulges_and_a_bowl_does_not(y_up: bool) -> None:
    _, given = found(10, 0.5)
    side = np.linspace(-1, 1, 9)
    x, y = (each.ravel() for each in np.meshgrid(side, side))
    hill = np.stack([x, y, (-1 if y_up else 1) * (x**2 + y**2)])  # the rim lies behind the middle
    hill -= hill.mean(axis=1, keepdims=True)
    assert bulges(given, (given.rotations[:, :2] @ hill).transpose(0, 2, 1), y_up=y_up)
    assert not bulges(given, (given.rotations[:, :2] @ MIRROR @ hill).transpose(0, 2, 1), y_up=y_up)


@pytest.mark.parametrize(
    ("y_up", "hidden"),
    [
        pytest.param(False, (), marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param(True, (3, 9), marks=pytest.mark.slow),
    ],
)
def test_a_face_has_its_nose_in_front(y_up: bool, hidden: tuple[int, ...]) -> None:
    """The first cameras of this face are inside out; those of sparsely observed frames lie between their neighbours."""
    head = gallery.face(14, 60, degrees=30, seed=1)
    visible = head.tracks.visible.copy()
    visible[list(hidden), 2:] = 0
    tracks = Tracks.from_arrays(head.tracks.points * (1, -1 if y_up else 1), visible)
    solution = solve(tracks, head.mesh, settings=Settings(y_up=y_up))
    assert solution.choices.depth_sign == "ambiguous"
    around = solution.shapes - solution.shapes.mean(axis=1, keepdims=True)
    radius, depth = (around[..., :2] ** 2).sum(axis=2), (-1 if y_up else 1) * around[..., 2]
    assert ((radius - radius.mean(axis=1, keepdims=True)) * depth).sum() > 0
    seen = np.einsum("f,fij,fpj->fpi", solution.camera.scales, solution.camera.rotations[:, :2], around)
    shown = tracks.points - tracks.points.mean(axis=1, keepdims=True)
    whole = [frame for frame in range(14) if frame not in hidden]
    scale = (seen[whole] * shown[whole]).sum() / (seen[whole] ** 2).sum()
    assert np.abs(scale * seen[whole] - shown[whole]).max() < 0.05 * np.abs(shown).max()
    steps = angles_between(solution.camera.rotations[1:], solution.camera.rotations[:-1])
    assert steps.max() < 3 * np.median(steps)
