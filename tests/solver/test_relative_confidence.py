"""Confidences of observations: only their ratios count."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import (
    KnownCamera,
    Settings,
    Tracks,
    estimate_cameras,
    find_outliers,
    gallery,
    learn_prior,
    solve,
    solve_shapes,
)
from pliant.solver.evaluation.trust import size_of
from pliant.solver.tracks.normalization import normalize, relative
from rolled_sheets import FOCAL, SIZE, rolled

FACE = gallery.face(6, 40, degrees=60)
SPOILED, _ = gallery.corrupt_tracks(FACE.tracks, noise=0.005, outliers=0.08, hidden=0.1, seed=0)


def at(confidence: float, tracks: Tracks = SPOILED) -> Tracks:
    return Tracks.from_arrays(tracks.points, confidence * tracks.visible)


def test_the_largest_confidence_counts_as_1() -> None:
    visible = np.array([[0.5, 0.25, 0.0, 0.5]] * 3)
    normalized = normalize(Tracks.from_arrays(gallery.face(3, 4).tracks.points, visible))
    assert normalized.full_confidence == 0.5
    assert normalized.visible == pytest.approx(visible / 0.5)
    assert not normalized.visible.flags.writeable
    assert relative(visible, 1.0) is visible


@pytest.mark.parametrize("prior", [pytest.param("gaussian", marks=[pytest.mark.slow, pytest.mark.long]), "smooth"])
def test_a_common_factor_of_all_confidences_changes_nothing(prior: str) -> None:
    settings = Settings(prior=prior, max_reweightings=5, basis_size=2)
    whole, part = (solve(at(each), FACE.mesh, settings=settings) for each in (1.0, 0.25))
    assert part.shapes == pytest.approx(whole.shapes, abs=1e-9 * size_of(whole.shapes))
    assert part.inlier_probability == pytest.approx(whole.inlier_probability, nan_ok=True)
    assert part.choices.noise == pytest.approx(whole.choices.noise)
    assert part.trust == whole.trust


@pytest.mark.slow
def test_stages_agree_on_a_subset_of_points_with_scaled_confidences() -> None:
    tracks = at(0.25)
    known = KnownCamera.from_arrays(FACE.rotations, FACE.scales)
    cameras = estimate_cameras(tracks, known, settings=Settings(max_reweightings=5))
    prior = learn_prior(tracks, cameras)
    found, whole = find_outliers(tracks, cameras, prior), solve_shapes(tracks, cameras, prior)
    some = np.flatnonzero(np.arange(40) % 2)
    half = Tracks.from_arrays(tracks.points[:, some], tracks.visible[:, some])
    assert (find_outliers(half, cameras, prior) == found[:, some]).all()
    assert solve_shapes(half, cameras, prior).choices.noise == pytest.approx(whole.choices.noise)


def test_weights_of_an_isometric_surface_exclude_the_confidence() -> None:
    settings = Settings(surface="isometric", focal=FOCAL, image_size=SIZE, order="film")
    found = solve(at(0.25, rolled(frames=6, side=5).tracks), settings=settings)
    assert set(np.unique(found.weights)) <= {0.0, 1.0}
    seen = np.median(found.residuals / found.camera.scales[:, None])
    assert found.trust is not None
    assert found.trust.residual == pytest.approx(seen / size_of(found.shapes))
