"""Completion of tracks that hardly determine it."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import Tracks
from pliant.solver.model.so3 import exponential
from pliant.solver.tracks.completion import complete
from pliant.solver.tracks.normalization import MAX_MEDIAN_RADII, normalize


@pytest.mark.parametrize("seed", [1, 93, 272])
def test_no_hidden_point_is_predicted_hundreds_of_radii_away(seed: int) -> None:
    """In frames that show as many points as the basis has columns, noise determines it."""
    random = np.random.default_rng(seed)
    turns = exponential(2 * random.normal(size=(6, 3)))
    shapes = random.normal(size=(5, 3)) + 0.3 * random.normal(size=(6, 5, 3))
    points = np.einsum("fij,fpj->fpi", turns[:, :2], shapes)
    visible = random.random((6, 5)) < 0.7
    visible[:2] = True
    normalized = normalize(Tracks.from_arrays(points, visible))
    filling = complete(normalized).filling
    assert filling is not None
    predicted, _ = filling.filled(normalized.points, normalized.visible)
    assert np.linalg.norm(predicted[~visible], axis=1).max() <= MAX_MEDIAN_RADII * (1 + 1e-12)
