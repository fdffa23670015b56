"""Automatic weights: robust to outliers without flattening clean shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Solution, Tracks, gallery, solve
from pliant.solver.energy.hyperparameters import PAPER, Roughness, roughness_of
from pliant.solver.evaluation import metrics
from pliant.solver.tracks.normalization import normalize


@pytest.fixture(scope="module")
def face() -> gallery.Sequence:
    return gallery.face(16, 250)


def solved(sequence: gallery.Sequence, tracks: Tracks, *, mesh: bool = True, **settings: Any) -> Solution:
    """Solve with the true cameras; estimating them would take ten times as long as all that is tested here."""
    cameras = KnownCamera.from_arrays(sequence.rotations, sequence.scales)
    return solve(tracks, sequence.mesh if mesh else None, cameras=cameras, settings=Settings(**settings))


@pytest.fixture(scope="module")
def default(face: gallery.Sequence) -> Solution:
    return solved(face, face.tracks)


def error(sequence: gallery.Sequence, tracks: Tracks, **settings: Any) -> float:
    return metrics.e3d_frame(solved(sequence, tracks, **settings).shapes, sequence.shapes)


def test_the_paper_preset_uses_the_published_weights(face: gallery.Sequence) -> None:
    chosen = solved(face, face.tracks, preset="paper", max_reweightings=1).choices
    assert (chosen.temporal_weight, chosen.spatial_weight, chosen.low_rank_weight) == (1e-3, 1.0, 0.0)
    assert (chosen.robust_scale, chosen.temporal_order) == (1e-3, 1)
    assert PAPER.temporal == 1e-3


def test_given_weights_override_the_automatic_ones(face: gallery.Sequence) -> None:
    given = {"temporal_weight": 0.5, "spatial_weight": 0.25, "robust_scale": 0.125, "temporal_order": 2}
    chosen = solved(face, face.tracks, max_reweightings=1, **given).choices
    assert (chosen.temporal_weight, chosen.spatial_weight, chosen.robust_scale) == (0.5, 0.25, 0.125)
    assert chosen.temporal_order == 2


def test_without_a_mesh_there_is_no_spatial_weight(face: gallery.Sequence) -> None:
    assert solved(face, face.tracks, mesh=False, max_reweightings=1).choices.spatial_weight == 0


def test_the_low_rank_prior_is_used_only_on_request(face: gallery.Sequence) -> None:
    smooth = solved(face, face.tracks, prior="smooth", low_rank_weight=1.0, max_reweightings=1).choices
    asked = solved(face, face.tracks, prior="smooth+low_rank", max_reweightings=1).choices
    assert smooth.low_rank_weight == 0
    assert asked.low_rank_weight > 0
    assert any("low_rank_weight has no effect" in warning for warning in smooth.warnings)
    assert not any("no effect" in warning for warning in asked.warnings)


@pytest.mark.slow
def test_the_default_is_robust_to_outliers_that_ruin_least_squares(face: gallery.Sequence, default: Solution) -> None:
    spoiled = gallery.corrupt(face, outliers=0.1, seed=3).tracks
    pseudo = error(face, spoiled, method="pseudo_inverse")
    temporal = error(face, spoiled, method="temporal")
    robust = error(face, spoiled)
    clean = metrics.e3d_frame(default.shapes, face.shapes)
    assert min(pseudo, temporal) > 5 * robust
    assert 0.003 < clean <= robust < 0.03


def test_the_low_rank_prior_reduces_the_error_of_a_face(face: gallery.Sequence) -> None:
    spoiled = gallery.corrupt(face, outliers=0.1, seed=3).tracks
    assert error(face, spoiled, prior="smooth+low_rank") < 0.9 * error(face, spoiled, prior="smooth")


@pytest.mark.parametrize("frames", [3, 4, 40])
def test_noise_is_measured_where_nothing_moves(frames: int) -> None:
    rng = np.random.default_rng(5)
    still = rng.standard_normal((1, 500, 2)) * 100
    tracks = Tracks.from_arrays(still + rng.standard_normal((frames, 500, 2)) * 0.5)
    normalized = normalize(tracks)
    assert roughness_of(normalized).noise_std * normalized.unit == pytest.approx(0.5, rel=0.1)


def test_points_never_visible_in_consecutive_frames_are_ignored() -> None:
    visible = np.zeros((8, 6))
    visible[::3] = 1
    tracks = Tracks.from_arrays(np.random.default_rng(0).standard_normal((8, 6, 2)), visible)
    assert roughness_of(normalize(tracks)) == Roughness(0.0, 0.0)


def test_jumps_are_distinguished_from_motion(face: gallery.Sequence) -> None:
    assert roughness_of(normalize(face.tracks)).jumps < 0.01
    spoiled = gallery.corrupt(face, outliers=0.05, seed=3).tracks
    assert 0.1 < roughness_of(normalize(spoiled)).jumps < 0.3


@pytest.mark.parametrize(("loss", "scale"), [("l1", 1e3), ("huber", 1e-9)])
@pytest.mark.parametrize("prior", ["gaussian", "smooth"])
def test_a_given_robust_scale_does_not_let_the_prior_outweigh_the_tracks(
    face: gallery.Sequence, prior: str, loss: str, scale: float
) -> None:
    chosen = solved(face, face.tracks, prior=prior, loss=loss, robust_scale=scale)
    assert metrics.e3d_frame(chosen.shapes, face.shapes) < 1.2 * error(face, face.tracks, prior=prior, loss=loss)
    assert f"turns linear at {scale:.2g} RMS radii" in chosen.choices.reasons["weights"]
