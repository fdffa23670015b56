"""The energy of cameras is the negative log-likelihood of the covariance that it reports, whatever floor the noise has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.model.marginal_likelihood import UNLIKELY, Motion, Scene, cameras_of, covariances_of, energy, start
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
    over_frames = motion.modes @ motion.modes.T + walk_variance * random_walk(frames, ordered=True)
    world = np.kron(np.ones((frames, frames)), mean_covariance) + np.kron(over_frames, axis_covariance)
    image = seen @ world @ seen.T + noise * np.eye(2 * frames)
    expected = (np.linalg.slogdet(image)[1] + np.trace(np.linalg.solve(image, gram))) / (2 * frames)
    assert energy(scene, motion)[0] == pytest.approx(expected, rel=1e-10)


def test_scales_stay_finite_where_nothing_bounds_them() -> None:
    rotations = np.broadcast_to(np.eye(3), (3, 3, 3))
    scene = Scene.of(np.eye(6), rotations, with_scales=True, prior_weight=0.0, ordered=False)
    motion = replace(start(scene, np.ones(3)), log_scales=np.array([-3000.0, 0.0, 0.0]))
    scales = cameras_of(scene, motion)[1]
    assert np.isfinite(scales).all()
    assert scales[0] > 0
    value, gradient = energy(scene, motion)
    assert np.isfinite(value)
    assert np.isfinite(gradient.flat()).all()


def test_a_vanishing_walk_variance_gives_a_large_finite_energy() -> None:
    random, frames = np.random.default_rng(1), 6
    tracks = random.normal(size=(2 * frames, 40))
    rotations = exponential(random.normal(0, 0.4, (frames, 3)))
    scene = Scene.of(tracks @ tracks.T / 40, rotations, with_scales=False, prior_weight=0.0, noise_std_floor=1e-3)
    motion = start(scene, np.ones(frames))
    assert energy(scene, motion)[0] < UNLIKELY
    value, gradient = energy(scene, replace(motion, logs=np.array([motion.logs[0], -1000.0])))
    assert value == UNLIKELY
    assert (gradient.flat() == 0).all()
