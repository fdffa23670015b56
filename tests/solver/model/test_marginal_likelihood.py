"""The energy of cameras is the negative log-likelihood of the covariance that it reports, whatever floor the noise has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.model.marginal_likelihood import (
    UNLIKELY,
    Motion,
    Scene,
    cameras_of,
    covariances_of,
    energy,
    fit,
    start,
)
from pliant.solver.model.random_walk import random_walk
from pliant.solver.model.so3 import exponential


@pytest.mark.parametrize("floor", [1e-4, 3e-3, 0.5])
def test_the_covariances_reported_are_those_of_the_energy(floor: float) -> None:
    random, frames = np.random.default_rng(1), 6
    tracks = random.normal(size=(2 * frames, 40))
    gram = tracks @ tracks.T / 40
    rotations = exponential(random.normal(0, 0.4, (frames, 3)))
    scene = Scene.of(gram, rotations, with_scales=True, prior_weight=0.0, noise_std_floor=floor)
    scene = Scene(gram, rotations, True, 0.0, floor, smoothness=0.0)
    flat = start(scene, np.exp(random.normal(0, 0.1, frames))).flat()
    motion = Motion.unflat(flat + random.normal(0, 0.1, flat.size), frames)
    mean_covariance, axis_covariance, noise, walk_variance = covariances_of(scene, motion)
    turned, scales = cameras_of(scene, motion)
    seen = np.zeros((2 * frames, 3 * frames))
    for frame in range(frames):
        seen[2 * frame : 2 * frame + 2, 3 * frame : 3 * frame + 3] = scales[frame] * turned[frame, :2]
    over_frames = motion.modes @ motion.modes.T + walk_variance * random_walk(frames)
    world = np.kron(np.ones((frames, frames)), mean_covariance) + np.kron(over_frames, axis_covariance)
    image = seen @ world @ seen.T + noise * np.eye(2 * frames)
    expected = (np.linalg.slogdet(image)[1] + np.trace(np.linalg.solve(image, gram))) / (2 * frames)
    assert energy(scene, motion)[0] == pytest.approx(expected, rel=1e-10)


def test_a_random_walk_that_vanishes_to_rounding_is_unlikely_instead_of_a_division_by_zero() -> None:
    random, frames = np.random.default_rng(1), 6
    tracks = random.normal(size=(2 * frames, 40))
    rotations = exponential(random.normal(0, 0.4, (frames, 3)))
    scene = Scene.of(tracks @ tracks.T / 40, rotations, with_scales=False, prior_weight=0.0, noise_std_floor=1e-3)
    motion = start(scene, np.ones(frames))
    assert energy(scene, motion)[0] < UNLIKELY
    value, gradient = energy(scene, replace(motion, logs=np.array([motion.logs[0], -1000.0])))
    assert value == UNLIKELY
    assert (gradient.flat() == 0).all()


@pytest.mark.parametrize("ordered", [True, False])
def test_white_coordinates_reach_the_same_optimum_of_a_film_in_fewer_iterations(ordered: bool) -> None:
    random, frames = np.random.default_rng(4), 12
    time = np.linspace(0, 1, frames)
    rotations = exponential(time[:, None] * np.array([0.2, 1.0, 0.1]))
    cloud = random.normal(size=(3, 80)) + 0.2 * np.sin(5 * time)[:, None, None] * random.normal(size=(3, 80))
    tracks = (rotations[:, :2] @ cloud).reshape(2 * frames, -1) + 0.02 * random.normal(size=(2 * frames, 80))
    wrong = exponential(0.05 * np.sin(4 * time)[:, None] * np.ones(3)) @ rotations
    scene = Scene(tracks @ tracks.T / 80, wrong, False, 0.0, 1e-3, smoothness=0.0, ordered=ordered)
    begun = start(scene, np.ones(frames), num_modes=1)
    reached = {
        (white, iterations): fit(scene, begun, iterations=iterations, turning=True, white=white)[1]
        for white in (False, True)
        for iterations in (15, 2000)
    }
    assert reached[True, 2000] <= reached[True, 15] <= energy(scene, begun)[0]
    assert reached[True, 2000] == pytest.approx(reached[False, 2000], abs=1e-3)
    if ordered:
        assert reached[True, 15] < reached[False, 15]
    else:  # the walk is white as it is
        assert reached[True, 15] == reached[False, 15]


def test_white_coordinates_leave_fixed_rotations_as_they_are() -> None:
    random, frames = np.random.default_rng(1), 8
    tracks = random.normal(size=(2 * frames, 40))
    scene = Scene.of(tracks @ tracks.T / 40, exponential(random.normal(0, 0.4, (frames, 3))), with_scales=False)
    begun = start(scene, np.ones(frames))
    found, value = fit(scene, begun, iterations=10, turning=False, white=True)
    assert (found.turns == 0).all()
    assert value < energy(scene, begun)[0]
