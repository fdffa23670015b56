"""Confidence between 0 and 1 weighs an observation in the completed tracks and their Gram matrix."""

from __future__ import annotations

import numpy as np
from pliant.solver import Tracks, gallery
from pliant.solver.tracks.completion import complete
from pliant.solver.tracks.normalization import normalize


def gram(points: np.ndarray, confidence: np.ndarray | None = None) -> np.ndarray:
    """The Gram matrix in the tracks' unit, so that those of differently weighted tracks compare."""
    normalized = normalize(Tracks.from_arrays(points, confidence))
    return np.asarray(complete(normalized).gram * normalized.unit**2)


def noisy() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    clean = np.array(gallery.face(12, 80, degrees=60).tracks.points)
    poor = random.random(clean.shape[:2]) < 0.2
    size = 0.05 * np.std(clean)
    return clean, clean + size * poor[..., None] * random.normal(size=clean.shape), poor


def test_observations_of_little_confidence_count_little() -> None:
    clean, points, poor = noisy()
    truth = gram(clean)
    trusted = np.abs(gram(points) - truth).max()
    doubted = np.abs(gram(points, np.where(poor, 0.05, 1.0)) - truth).max()
    half = np.abs(gram(points, np.where(poor, 0.5, 1.0)) - truth).max()
    assert doubted < 0.7 * trusted
    assert doubted < half < trusted


def test_only_the_ratios_of_confidences_count() -> None:
    _, points, poor = noisy()
    np.testing.assert_allclose(
        gram(points, np.where(poor, 0.1, 0.4)), gram(points, np.where(poor, 0.25, 1.0)), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(gram(points, np.full(poor.shape, 0.3)), gram(points), rtol=1e-9, atol=1e-9)
