"""Jackknife: how much shapes depend on the points that were learned from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import depth_map
from pliant.solver.model.early_stopping import learn_with_early_stopping
from pliant.solver.model.expectation_maximisation import ModelOrder, annealed
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.pulse import never
from pliant.solver.records import MIN_POINTS, Floats
from pliant.solver.shapes.jackknife import PARTS, learning_changes, parts
from pliant.solver.tracks.matrix import centred, columns
from scipy.spatial.transform import Rotation

FRAMES = 12


def seen(
    points: int, *, degrees: float = 50.0, noise: float = 1e-3, seed: int = 0
) -> tuple[CameraEstimate, ShapeCovariance, np.ndarray]:
    """A mean shape with two modes seen by a turning camera: estimate, learned covariance and true shapes."""
    rng = np.random.default_rng(seed)
    modes = np.stack([np.sin(np.arange(FRAMES) / 2), np.cos(np.arange(FRAMES) / 3)])
    shapes = rng.normal(size=(points, 3)) + 0.3 * np.einsum("kf,kpi->fpi", modes, rng.normal(size=(2, points, 3)))
    shapes = centred(shapes)
    turn = np.linspace(0, degrees, FRAMES)
    rotations = Rotation.from_euler("yx", np.stack([turn, 0.3 * turn], axis=1), degrees=True).as_matrix()
    sample = np.einsum("fij,fpj->fpi", rotations[:, :2], shapes) + noise * rng.normal(size=(FRAMES, points, 2))
    rows = columns(centred(sample))
    gram = rows @ rows.T / points
    covariance = annealed(gram, rotations[:, :2], ModelOrder(), iterations=40)
    estimate = CameraEstimate(rotations, np.ones(FRAMES), np.zeros((FRAMES, 2)), 0, gram, sample)
    return estimate, covariance, shapes


def learning_std(
    estimate: CameraEstimate,
    covariance: ShapeCovariance,
    shapes: np.ndarray,
    *,
    turning: bool,
    observed: np.ndarray | None = None,
    should_stop: Callable[[], bool] = never,
) -> Floats:
    observed = np.ones(estimate.sample.shape[:2], dtype=bool) if observed is None else observed
    found = learning_changes(estimate, covariance, observed, turning=turning, should_stop=should_stop)
    return found.std_of(shapes, 1.0)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


@pytest.mark.slow
def test_few_points_are_less_certain_than_many() -> None:
    few, many = (rms(learning_std(*seen(points), turning=True)) for points in (14, 200))
    assert 0 < many < 0.5 * few


def test_a_camera_that_hardly_turns_is_less_certain() -> None:
    narrow, wide = (rms(learning_std(*seen(40, degrees=degrees), turning=True)) for degrees in (3, 60))
    assert wide < 0.5 * narrow


def test_learning_std_does_not_depend_on_the_world_axes() -> None:
    estimate, covariance, shapes = seen(30)
    plain = learning_std(estimate, covariance, shapes, turning=False)
    turn = Rotation.from_euler("xyz", (30, -20, 50), degrees=True).as_matrix()
    turned = replace(
        covariance,
        mean_covariance=turn @ covariance.mean_covariance @ turn.T,
        axis_covariance=turn @ covariance.axis_covariance @ turn.T,
    )
    elsewhere = replace(estimate, rotations=estimate.rotations @ turn.T)
    np.testing.assert_allclose(
        learning_std(elsewhere, turned, shapes @ turn.T, turning=False), plain, rtol=1e-3, atol=1e-5
    )


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("points", [20, 30])
def test_hidden_entries_count_nothing(points: int, turning: bool) -> None:
    estimate, covariance, shapes = seen(points)
    observed = np.random.default_rng(1).uniform(size=(FRAMES, points)) > 0.2
    values = np.random.default_rng(2).normal(size=estimate.sample.shape) * ~observed[..., None]
    hidden = ~observed[..., None] / np.maximum((~observed).sum(axis=1), 1)[:, None, None]
    values -= hidden * values.sum(axis=1, keepdims=True)  # keeps the centre of all entries
    plain, other = (
        learning_std(replace(estimate, sample=each), covariance, shapes, turning=turning, observed=observed)
        for each in (estimate.sample, estimate.sample + values)
    )
    np.testing.assert_allclose(other, plain, rtol=1e-2 if turning else 1e-6)  # L-BFGS amplifies rounding


def test_refits_of_few_noisy_points_stop_early() -> None:
    """Otherwise they fit the noise, and the changes exceed the error twofold."""
    estimate, _, shapes = seen(14, noise=0.05)
    covariance, why = learn_with_early_stopping(estimate.sample, estimate.gram, estimate.rotations[:, :2], ModelOrder())
    assert "held-out" in why
    depths = depth_map(estimate.rotations, estimate.scales, covariance) @ columns(centred(estimate.sample))
    truth = np.einsum("fj,fpj->fp", estimate.rotations[:, 2], shapes)
    ratio = rms(learning_std(estimate, covariance, shapes, turning=True)) / rms(depths - truth)
    assert 0.3 < ratio < 1.3


def test_learning_std_is_interpolated_between_evaluated_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    estimate, covariance, shapes = seen(30)
    whole = learning_std(estimate, covariance, shapes, turning=False)
    monkeypatch.setattr("pliant.solver.shapes.jackknife.MAX_JACKKNIFE_FRAMES", 8)
    some = learning_std(estimate, covariance, shapes, turning=False)
    assert some.shape == whole.shape == shapes.shape[:2]
    assert 0.3 < rms(some) / rms(whole) < 3


def test_too_few_points_or_a_stop_give_zero() -> None:
    estimate, covariance, shapes = seen(20)
    few = replace(estimate, sample=estimate.sample[:, :MIN_POINTS])
    assert (learning_std(few, covariance, shapes, turning=True) == 0).all()
    assert (learning_std(estimate, covariance, shapes, turning=True, should_stop=lambda: True) == 0).all()


def test_unbounded_depth_caps_the_std_at_the_distance_from_the_centroid() -> None:
    estimate, covariance, shapes = seen(30)  # more points than coordinates: learning starts from this covariance
    unbounded = replace(covariance, mean_covariance=np.full((3, 3), 1e30))
    found = learning_std(estimate, unbounded, shapes, turning=False)
    np.testing.assert_allclose(found, np.linalg.norm(shapes - shapes.mean(axis=1, keepdims=True), axis=2))


def test_parts_are_compact_and_hold_every_point() -> None:
    rng = np.random.default_rng(0)
    corners = np.array([[x, y] for x in (-5.0, 5.0) for y in (-5.0, 0.0, 5.0)])
    at = rng.permutation(np.repeat(np.arange(PARTS), 7))
    part_of = parts(np.tile(corners[at] + 0.1 * rng.normal(size=(len(at), 2)), (3, 1, 1)))
    assert part_of.shape == at.shape
    assert len({(int(a), int(b)) for a, b in zip(part_of, at, strict=True)}) == PARTS
