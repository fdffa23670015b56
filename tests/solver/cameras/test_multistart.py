"""Multistart: several factorizations as candidates, and the choice of the best start."""

from __future__ import annotations

import numpy as np
import pytest
from learning import learn
from pliant.solver import Settings, Tracks, gallery
from pliant.solver.cameras.estimation import (
    MAX_START_DEPTH_VARIANCE,
    CameraEstimate,
    OtherCameras,
    estimate_cameras,
)
from pliant.solver.cameras.multistart import CANDIDATES, SMOOTH_STARTS, depth
from pliant.solver.model.so3 import angles_between, exponential, nearest
from pliant.solver.tracks.normalization import normalize

FRAMES = 16
FACE = normalize(gallery.face(FRAMES, 120).tracks)


@pytest.fixture(scope="module")
def found() -> CameraEstimate:
    return estimate_cameras(FACE, Settings())


@pytest.mark.slow
def test_candidates_are_cameras_of_every_factorization_and_of_smooth_starts(found: CameraEstimate) -> None:
    sizes = [each.basis_size for each in found.candidates]
    assert set(sizes) == {size for size in CANDIDATES if size <= 2 * 16 / 3}
    assert len(sizes) == len(set(sizes)) + SMOOTH_STARTS
    for rotations in (each.rotations for each in found.candidates):
        assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3))
        assert np.allclose(rotations[0], np.eye(3))


@pytest.mark.slow
def test_hypotheses_are_distinct_cameras_of_plausible_depth(found: CameraEstimate) -> None:
    assert found.hypotheses
    assert len({each.basis_size for each in found.hypotheses}) == len(found.hypotheses)
    for rotations in (each.rotations for each in found.hypotheses):
        assert rotations.shape == (16, 3, 3)
        assert depth(found.gram, rotations) < MAX_START_DEPTH_VARIANCE


@pytest.mark.slow
def test_cameras_that_are_not_refined_have_no_further_starts() -> None:
    found = estimate_cameras(FACE, Settings(refine_rotations=False))
    assert not found.candidates
    assert not found.hypotheses


@pytest.mark.slow
@pytest.mark.long
def test_a_sheet_has_no_further_starts() -> None:
    found = estimate_cameras(normalize(gallery.flag(12, 150).tracks), Settings())
    assert not found.hypotheses
    assert not found.candidates


@pytest.mark.slow
def test_cameras_with_implausible_depth_are_not_hypotheses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.solver.cameras.estimation.MAX_START_DEPTH_VARIANCE", 0.0)
    assert not estimate_cameras(FACE, Settings()).hypotheses


@pytest.mark.parametrize("kind", ["candidates", "hypotheses"])
@pytest.mark.parametrize("better", ["own", "rival"])
@pytest.mark.slow
def test_the_start_that_leads_to_the_higher_likelihood_is_chosen(
    better: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "pliant.solver.model.full_mode_covariance.POINTS_PER_COEFFICIENT", np.inf
    )  # it would correct either start
    random, time = np.random.default_rng(2), np.linspace(0, 1, FRAMES)
    true = exponential(np.stack([0.3 * np.sin(6 * time), np.sin(4 * time), 0.1 * time], axis=1))
    modes = np.stack([0.2 * np.sin(2 * np.pi * time), 0.2 * np.sin(3 * np.pi * time)], axis=1)
    shapes = np.einsum("fk,kcp->fcp", modes, random.normal(size=(2, 3, 300))) + random.normal(size=(3, 300))
    tracks = np.einsum("fij,fjp->fpi", true[:, :2], shapes)
    rows = tracks.transpose(0, 2, 1).reshape(2 * FRAMES, -1)
    wrong = exponential(0.2 * np.stack([np.sin(5 * time + 1), np.cos(3 * time), np.sin(2 * time)], axis=1)) @ true
    own, other = (true, wrong) if better == "own" else (wrong, true)
    estimate = CameraEstimate(
        own,
        np.ones(FRAMES),
        np.zeros((FRAMES, 2)),
        1,
        rows @ rows.T / 300,
        tracks,
        **{kind: (OtherCameras(7, other, "other rotations, from K = 7,"),)},
    )
    found, _ = learn(estimate, normalize(Tracks.from_arrays(tracks)), turning=True)
    common = nearest(np.einsum("fij,fik->jk", found.rotations, true))
    assert np.degrees(angles_between(found.rotations @ common, true)).mean() < 0.1
    assert found.basis_size == (7 if better == "rival" else 1)
    assert ("other rotations, from K = 7" in found.reasons.get("basis_size", "")) == (better == "rival")
