"""Held-out error: its closed form equals a refit, and it separates correct models from wrong ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.records import Camera, Tracks
from pliant.solver.shapes.held_out import held_out_error, held_out_errors
from scipy.spatial.transform import Rotation

FRAMES, POINTS, NOISE = 30, 24, 0.01


def a_film(seed: int = 0, *, focal: float | None = None) -> tuple[Tracks, np.ndarray, Camera, ShapeCovariance]:
    """Points drawn from a covariance, and their images; the shapes are the true ones."""
    rng = np.random.default_rng(seed)
    modes = 0.1 * np.sin(np.linspace(0, 4, FRAMES)[:, None] * [1, 2])
    covariance = ShapeCovariance(np.diag([1.0, 0.8, 0.4]), np.eye(3), modes, 1e-4, NOISE**2, np.inf)
    shapes = rng.normal(size=(POINTS, 3)) * np.sqrt([1.0, 0.8, 0.4])
    shapes = shapes + np.einsum("fk,kpc->fpc", modes, rng.normal(size=(2, POINTS, 3)))
    turns = Rotation.from_euler("y", np.linspace(-30, 30, FRAMES)[:, None], degrees=True).as_matrix()
    camera = Camera(turns, np.linspace(0.9, 1.1, FRAMES), rng.normal(size=(FRAMES, 2)), focal)
    tracks = camera.project(shapes) + NOISE * rng.normal(size=(FRAMES, POINTS, 2))
    return Tracks.from_arrays(tracks), shapes, camera, covariance


def test_the_closed_form_is_a_refit_without_the_observations() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(12, 12))
    covariance, images = root @ root.T + np.eye(12), rng.normal(size=(2, 6, 2))
    blocks = [np.array([0]), np.array([2, 3]), np.array([5])]
    found = held_out_errors(covariance, images, blocks)
    for block in blocks:
        out = (2 * block[:, None] + [0, 1]).reshape(-1)
        kept = np.setdiff1d(np.arange(12), out)
        gain = covariance[np.ix_(out, kept)] @ np.linalg.inv(covariance[np.ix_(kept, kept)])
        flat = images.reshape(2, 12)
        expected = flat[:, out] - flat[:, kept] @ gain.T
        np.testing.assert_allclose(found[:, block].reshape(2, -1), expected, atol=1e-10)
    assert (found[:, [1, 4]] == 0).all()


@pytest.mark.parametrize("focal", [None, 8.0])
@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_only_a_correct_model_predicts_down_to_the_noise(focal: float | None, unit: float) -> None:
    tracks, shapes, camera, covariance = a_film(focal=focal)
    scaled = replace(camera, translations=unit * camera.translations, focal=None if focal is None else unit * focal)
    seen = np.ones((FRAMES, POINTS))

    def error(points: np.ndarray, prior: ShapeCovariance = covariance) -> float:
        found = held_out_error(Tracks.from_arrays(unit * points), unit * shapes, scaled, seen, prior, unit=unit)
        assert found is not None
        return found

    size = np.sqrt(np.square(shapes - shapes.mean(axis=1, keepdims=True)).sum(axis=2).mean())
    noise = NOISE * np.sqrt(2 * np.log(2)) / size  # the median of a Rayleigh distribution
    assert noise < error(tracks.points) < 2 * noise
    rng = np.random.default_rng(2)
    assert error(tracks.points + 0.1 * rng.normal(size=tracks.points.shape)) > 8 * noise
    loose = replace(covariance, modes=np.eye(FRAMES), noise_variance=1e-6)  # a mode for every frame fits anything
    assert error(rng.normal(size=tracks.points.shape), loose) > 0.25
    assert error(tracks.points, replace(covariance, modes=covariance.modes[:, :0])) > 2 * error(tracks.points)


def test_hidden_and_doubtful_observations_do_not_count() -> None:
    tracks, shapes, camera, covariance = a_film()
    rng = np.random.default_rng(3)
    confidence = np.where(rng.random((FRAMES, POINTS)) < 0.3, 0.0, 1.0)
    spoiled = tracks.points + np.where(confidence[..., None] > 0, 0.0, 5.0)
    found = held_out_error(tracks, shapes, camera, confidence, covariance, unit=1.0)
    assert found == held_out_error(Tracks.from_arrays(spoiled), shapes, camera, confidence, covariance, unit=1.0)
    doubtful = np.where(confidence > 0, confidence, 1e-12)
    assert held_out_error(Tracks.from_arrays(spoiled), shapes, camera, doubtful, covariance, unit=1.0) == found


def test_the_order_of_the_points_does_not_matter() -> None:
    tracks, shapes, camera, covariance = a_film()
    order, seen = np.random.default_rng(4).permutation(POINTS), np.ones((FRAMES, POINTS))
    moved = Tracks.from_arrays(tracks.points[:, order])
    found = held_out_error(tracks, shapes, camera, seen, covariance, unit=1.0)
    assert held_out_error(moved, shapes[:, order], camera, seen, covariance, unit=1.0) == pytest.approx(found)


def test_no_error_is_reported_if_nothing_can_be_held_out() -> None:
    tracks, shapes, camera, covariance = a_film()
    rarely = np.zeros((FRAMES, POINTS))
    rarely[:2] = 1
    assert held_out_error(tracks, shapes, camera, rarely, covariance, unit=1.0) is None
    indefinite = replace(covariance, mean_covariance=-np.eye(3))
    assert held_out_error(tracks, shapes, camera, np.ones((FRAMES, POINTS)), indefinite, unit=1.0) is None
