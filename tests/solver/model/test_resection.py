"""Resection: the pose and deformation of a frame by mean shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.model.random_walk import random_walk, random_walk_at
from pliant.solver.model.resection import MeanShapes, Poses, Views, interpolated, predicted, resected
from pliant.solver.model.so3 import angles_between, exponential

FRAMES, POINTS, MODES = 9, 40, 2


@pytest.fixture(scope="module")
def shapes() -> MeanShapes:
    random = np.random.default_rng(0)
    mean = random.normal(size=(3, POINTS))
    modes = 0.3 * random.normal(size=(MODES, 3, POINTS))
    mean -= mean.mean(axis=1, keepdims=True)
    modes -= modes.mean(axis=2, keepdims=True)
    return MeanShapes(mean, modes, np.eye(MODES), 0.1 * np.eye(3), 1e-6)


@pytest.fixture(scope="module")
def truth() -> Poses:
    random = np.random.default_rng(1)
    return Poses(
        exponential(random.normal(size=(FRAMES, 3))), np.exp(0.1 * random.normal(size=FRAMES)),
        random.normal(size=(FRAMES, MODES)), random.normal(size=(FRAMES, 2)),
        np.zeros((FRAMES, MODES)), np.tile(np.eye(3), (FRAMES, 1, 1)), np.ones(FRAMES),
    )  # fmt: skip


def start() -> Poses:
    still, none = np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, MODES))
    return Poses(still, np.ones(FRAMES), none, np.zeros((FRAMES, 2)), none, still, np.ones(FRAMES))


@pytest.mark.parametrize("inverse_focal", [0.0, 0.1])
def test_poses_far_from_the_start_are_found_despite_outliers_and_hidden_points(
    shapes: MeanShapes, truth: Poses, inverse_focal: float
) -> None:
    _, image, nearer = predicted(shapes, truth, inverse_focal)
    points, weight = image / nearer[:, None], np.ones((FRAMES, POINTS))
    points[:, :, 3] += 2.0
    points[:, :, 5], weight[:, 5] = np.nan_to_num(np.inf, posinf=50.0), 0.0
    found = resected(Views(points, weight, inverse_focal), shapes, start(), turning=True, with_scales=True)
    assert np.degrees(angles_between(found.rotations, truth.rotations)).max() < 0.1
    assert found.scales == pytest.approx(truth.scales, rel=1e-3)
    assert found.coefficients == pytest.approx(truth.coefficients, abs=1e-2)
    assert found.translations == pytest.approx(truth.translations, abs=1e-3)


def test_given_cameras_are_kept(shapes: MeanShapes, truth: Poses) -> None:
    _, image, _ = predicted(shapes, truth, 0.0)
    begun = replace(start(), rotations=truth.rotations, scales=truth.scales)
    found = resected(Views(image, np.ones((FRAMES, POINTS))), shapes, begun, turning=False, with_scales=False)
    assert (found.rotations == truth.rotations).all()
    assert (found.scales == truth.scales).all()
    assert found.coefficients == pytest.approx(truth.coefficients, abs=1e-4)


def test_a_stop_keeps_the_starting_rotations(shapes: MeanShapes, truth: Poses) -> None:
    _, image, _ = predicted(shapes, truth, 0.0)
    found = resected(
        Views(image, np.ones((FRAMES, POINTS))), shapes, start(), turning=True, with_scales=True,
        should_stop=lambda: True,
    )  # fmt: skip
    assert (found.rotations == np.eye(3)).all()


def test_poses_are_interpolated_and_constant_beyond_the_frames_used(truth: Poses) -> None:
    used = np.array([2, 4])
    poses = interpolated(used, truth.rotations[:2], truth.scales[:2], truth.coefficients[:2], 6)
    assert poses.rotations[used] == pytest.approx(truth.rotations[:2])
    assert poses.rotations[0] == pytest.approx(truth.rotations[0])
    assert poses.rotations[5] == pytest.approx(truth.rotations[1])
    assert poses.coefficients[3] == pytest.approx(truth.coefficients[:2].mean(axis=0))
    assert poses.doubt == pytest.approx([1, 1, 1e-3, 1, 1e-3, 1])
    half = angles_between(poses.rotations[3], truth.rotations[0]) / angles_between(*truth.rotations[:2])
    assert half == pytest.approx(0.5, abs=1e-6)
    assert interpolated(used, truth.rotations[:2], truth.scales[:2], np.zeros((2, 0)), 6).coefficients.shape == (6, 0)


@pytest.mark.parametrize("ordered", [True, False])
def test_the_walk_at_some_frames_is_a_submatrix_of_the_full_walk(ordered: bool) -> None:
    used = np.array([0, 3, 4, 20])
    assert random_walk_at(used, 21, ordered) == pytest.approx(random_walk(21, ordered)[np.ix_(used, used)], abs=1e-12)
