"""The metric is a root of σ²I + τT + L Lᵀ, and steps in its coordinates go further than steps in the parameters."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver.gallery import face
from pliant.solver.model.frame_metric import FrameMetric
from pliant.solver.model.marginal_likelihood import Scene, energy, fit, metric_of, start
from pliant.solver.model.random_walk import random_walk


def metric(frames: int, *, ordered: bool) -> tuple[FrameMetric, np.ndarray]:
    modes = np.random.default_rng(1).normal(size=(frames, 3))
    found = FrameMetric.of(modes, noise_variance=0.2, walk_variance=0.7, ordered=ordered)
    return found, 0.2 * np.eye(frames) + 0.7 * random_walk(frames, ordered) + modes @ modes.T


@pytest.mark.parametrize("frames", [3, 24])
def test_the_root_is_exact_for_unordered_frames(frames: int) -> None:
    found, expected = metric(frames, ordered=False)
    root = found.parameters(np.eye(frames))
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("frames", [3, 24, 200])
def test_the_root_for_a_film_is_within_a_factor_of_three_spectrally(frames: int) -> None:
    found, expected = metric(frames, ordered=True)
    root = found.parameters(np.eye(frames))
    values = np.linalg.eigvals(np.linalg.solve(expected, root @ root.T)).real
    assert values.min() > 1 / 3  # not exact: the walk's precision is taken as diagonal in cosines
    assert values.max() < 3


@pytest.mark.parametrize("ordered", [True, False])
def test_coordinates_invert_parameters_and_gradients_are_transposed(ordered: bool) -> None:
    found, _ = metric(12, ordered=ordered)
    values = np.random.default_rng(2).normal(size=(12, 5))
    np.testing.assert_allclose(found.coordinates(found.parameters(values)), values, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(found.gradient(values), found.parameters(np.eye(12)).T @ values, rtol=1e-10, atol=1e-10)


def scene_of_a_face() -> tuple[Scene, np.ndarray]:
    sequence = face(20, 200, degrees=40)
    points = sequence.tracks.points - sequence.tracks.points.mean(axis=1, keepdims=True)
    rows = points.transpose(0, 2, 1).reshape(40, -1) / np.sqrt(np.square(points).sum(axis=2).mean())
    return Scene(rows @ rows.T / 200, sequence.rotations, False, 0.01, 1e-4, smoothness=0.0), np.ones(20)


def test_20_steps_in_the_metric_beat_100_steps_in_the_parameters() -> None:
    scene, scales = scene_of_a_face()
    begun = start(scene, scales)
    _, plain = fit(scene, begun, iterations=100, turning=True)
    moved, natural = fit(scene, begun, iterations=20, turning=True, metric=metric_of(scene, begun))
    assert natural < plain < energy(scene, begun)[0]
    assert natural == pytest.approx(energy(scene, moved)[0], rel=1e-12)


def test_fixed_rotations_do_not_change() -> None:
    scene, scales = scene_of_a_face()
    begun = start(scene, scales)
    moved, _ = fit(scene, begun, iterations=10, turning=False, metric=metric_of(scene, begun))
    np.testing.assert_array_equal(moved.turns, begun.turns)
    assert (moved.modes != begun.modes).any()
