"""Full covariance of mode coefficients: its energy, when it is used, and the gain for the cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.model.full_mode_covariance import (
    MAX_BASIS_FRAMES,
    MAX_NOISE_STD,
    POINTS_PER_COEFFICIENT,
    Basis,
    begin,
    energy,
    is_identifiable,
    refined,
)
from pliant.solver.model.marginal_likelihood import Scene, cameras_of
from pliant.solver.model.random_walk import random_walk
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import angles_between, exponential, nearest
from pliant.solver.refinement.learned import Refinement

FRAMES = 16


def covariance(frames: int = FRAMES, modes: int = 2, noise: float = 1e-6) -> ShapeCovariance:
    time = np.linspace(0, 1, frames)
    along = np.stack([0.2 * np.sin((2 + index) * np.pi * time) for index in range(modes)], axis=1)
    return ShapeCovariance(np.diag([0.5, 0.4, 0.3]), np.diag([0.5, 1.0, 1.5]), along, 1e-5, noise, np.inf)


def scene(gram: np.ndarray, rotations: np.ndarray, *, with_scales: bool, prior_weight: float) -> Scene:
    return Scene(gram, rotations, with_scales, prior_weight, noise_std_floor=1e-4, smoothness=0.0)


def a_scene(*, with_scales: bool, prior_weight: float = 0.01) -> tuple[Scene, Basis]:
    """Random tracks and a randomly perturbed basis."""
    random = np.random.default_rng(3)
    tracks = random.normal(size=(2 * FRAMES, 60))
    rotations = exponential(random.normal(0, 0.4, (FRAMES, 3)))
    place = scene(tracks @ tracks.T / 60, rotations, with_scales=with_scales, prior_weight=prior_weight)
    flat = begin(place, np.ones(FRAMES), covariance(noise=0.01)).flat()
    return place, Basis.unflat(flat + random.normal(0, 0.1, flat.size), FRAMES, 3)


def image_of(basis: Basis, projections: np.ndarray, axis_covariance: np.ndarray, noise: float) -> np.ndarray:
    """The dense image covariance, computed from that of the world."""
    seen = np.zeros((2 * FRAMES, 3 * FRAMES))
    for frame in range(FRAMES):
        seen[2 * frame : 2 * frame + 2, 3 * frame : 3 * frame + 3] = projections[frame]
    shapes = np.kron(basis.weights, np.eye(3)) @ basis.root
    world = shapes @ shapes.T + np.exp(2 * basis.logs[1]) * np.kron(random_walk(FRAMES, ordered=True), axis_covariance)
    return np.asarray(seen @ world @ seen.T + noise * np.eye(2 * FRAMES))


def test_the_energy_is_the_likelihood_of_the_dense_covariance() -> None:
    place, basis = a_scene(with_scales=True, prior_weight=0.0)
    rotations, scales = cameras_of(place, basis)
    image = image_of(
        basis, rotations[:, :2] * scales[:, None, None], covariance().axis_covariance, np.exp(2 * basis.logs[0]) + 1e-8
    )
    expected = (np.linalg.slogdet(image)[1] + np.trace(np.linalg.solve(image, place.gram))) / (2 * FRAMES)
    assert energy(place, covariance().axis_covariance, basis)[0] == pytest.approx(expected, rel=1e-10)


def test_the_initial_covariance_equals_the_shape_covariance() -> None:
    place, _ = a_scene(with_scales=False)
    start = covariance(noise=0.01)
    projections = place.rotations[:, :2]
    begun = image_of(begin(place, np.ones(FRAMES), start), projections, start.axis_covariance, 0.01)
    np.testing.assert_allclose(begun, start.of_image(projections), atol=1e-9)


@pytest.mark.parametrize("with_scales", [True, False])
def test_the_gradient_matches_finite_differences_of_the_energy(with_scales: bool) -> None:
    place, basis = a_scene(with_scales=with_scales)
    flat, gradient = basis.flat(), energy(place, covariance().axis_covariance, basis)[1].flat()
    random, step = np.random.default_rng(0), 1e-6
    for _ in range(12):
        way = random.standard_normal(flat.size)
        ahead, behind = (
            energy(place, covariance().axis_covariance, Basis.unflat(flat + sign * step * way, FRAMES, 3))[0]
            for sign in (1, -1)
        )
        assert gradient @ way == pytest.approx((ahead - behind) / (2 * step), rel=1e-5, abs=1e-6)


def test_identifiability_needs_many_points_few_modes_low_noise_few_frames() -> None:
    quiet = covariance(noise=1e-8)
    least = POINTS_PER_COEFFICIENT * 3 * 3
    assert is_identifiable(quiet, least)
    assert not is_identifiable(quiet, least - 1)
    assert not is_identifiable(replace(quiet, noise_variance=MAX_NOISE_STD**2), least)
    assert not is_identifiable(
        covariance(frames=5, modes=3, noise=1e-8), 10_000
    )  # 12 coefficients, but 10 numbers per point
    assert not is_identifiable(covariance(frames=MAX_BASIS_FRAMES + 1, noise=1e-8), 10_000)


@pytest.mark.slow
def test_modes_along_different_axes_determine_the_cameras() -> None:
    """Noise-free shapes of low rank: the separable covariance leaves cameras where they start, this one finds them."""
    random = np.random.default_rng(2)
    time = np.linspace(0, 1, FRAMES)
    rotations = exponential(np.stack([0.3 * np.sin(6 * time), np.sin(4 * time), 0.1 * time], axis=1))
    own = np.diag([1.6, 0.1, 0.3, 0.1, 0.2, 1.6, 0.6, 0.6, 0.6])
    weights = np.column_stack([covariance().modes, np.ones(FRAMES)])
    shapes = (np.kron(weights, np.eye(3)) @ own @ random.normal(size=(9, 600))).reshape(FRAMES, 3, -1)
    tracks = np.einsum("fij,fjp->fip", rotations[:, :2], shapes).reshape(2 * FRAMES, -1)
    gram = tracks @ tracks.T / 600
    wander = 0.05 * np.stack([np.sin(5 * time + 1), np.cos(3 * time), np.sin(2 * time)], axis=1)
    wrong = exponential(wander) @ rotations
    how = Refinement()
    before = how.refine(gram, how.learn(gram, wrong, np.ones(FRAMES)), rounds=2)
    place = scene(gram, before.rotations, with_scales=False, prior_weight=0.01)
    found, scales = refined(place, np.ones(FRAMES), before.covariance)

    def off(cameras: np.ndarray) -> float:
        common = nearest(np.einsum("fij,fik->jk", cameras, rotations))
        return float(np.degrees(angles_between(cameras @ common, rotations).mean()))

    assert off(before.rotations) > 0.5 * off(wrong) > 1
    assert off(found) < 0.05
    np.testing.assert_array_equal(scales, np.ones(FRAMES))


def test_a_stop_ends_the_refinement_after_one_step() -> None:
    place, _ = a_scene(with_scales=False)
    asked = []

    def stop() -> bool:
        asked.append(True)
        return True

    refined(place, np.ones(FRAMES), covariance(noise=0.01), should_stop=stop)
    assert len(asked) == 1
