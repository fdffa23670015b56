"""New cameras from tracks corrected for perspective: gauge, comparison by evidence, and a film on which the first cameras are off."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pliant.solver import Settings, Tracks, gallery, solve
from pliant.solver.cameras.perspective import MIRROR, Perspective, depth_map
from pliant.solver.evaluation.metrics import e3d_frame_scaled
from pliant.solver.model.expectation_maximisation import ModelOrder, annealed
from pliant.solver.model.marginal_likelihood import UNLIKELY
from pliant.solver.model.so3 import angles_between, exponential, logarithm
from pliant.solver.refinement import depth_alternation, depth_rounds
from pliant.solver.refinement.depth_alternation import aligned, alternate, refactorize
from pliant.solver.refinement.learned import Learned, Refinement
from pliant.solver.tracks.matrix import centred, columns

PICTURE = (1280.0, 720.0)


@pytest.mark.parametrize("mirrored", [False, True])
def test_aligned_cameras_adopt_the_world_axes_and_depth_sign_of_others(mirrored: bool) -> None:
    random = np.random.default_rng(0)
    rotations = exponential(random.normal(0, 0.6, (9, 3)))
    moved = rotations @ exponential(random.normal(size=(1, 3)))[0]
    moved = MIRROR @ moved @ MIRROR if mirrored else moved
    used = np.array([0, 2, 5, 8])
    found = aligned(moved, rotations[used], used)
    np.testing.assert_allclose(found, rotations, atol=1e-10)


@pytest.fixture(scope="module")
def rigid() -> tuple[np.ndarray, Perspective, np.ndarray]:
    """Rotations, views in perspective at κ = .25, and the Gram matrix of the exactly corrected tracks of a rigid cloud."""
    random = np.random.default_rng(2)
    cloud = random.normal(size=(40, 3))
    rotations = exponential(np.linspace(0, 1.4, 12)[:, None] * np.array([0.2, 1.0, 0.1]))
    seen = (cloud - cloud.mean(axis=0)) @ rotations.transpose(0, 2, 1) / 1.5
    view = Perspective(
        np.zeros((12, 2)), np.zeros(2), inverse_focal=0.25, learning_sample=seen[..., :2] / (1 + 0.25 * seen[..., 2:])
    )
    flat = columns(centred(seen[..., :2]))
    return rotations, view, flat @ flat.T / 40


@pytest.mark.parametrize("degrees", [0.0, 6.0])
@pytest.mark.slow
def test_a_new_factorization_corrects_cameras_that_are_off(
    rigid: tuple[np.ndarray, Perspective, np.ndarray], degrees: float
) -> None:
    rotations, view, gram = rigid
    off = np.radians(degrees) * np.random.default_rng(2).normal(size=(12, 3))
    given = exponential(off) @ rotations
    start = Learned(given, np.ones(12), annealed(gram, given[:, :2], ModelOrder(), iterations=30), np.inf)
    used = np.arange(12)
    found, moved = alternate(view, start, used, Refinement())
    moved = replace(moved, depth=depth_map(found.rotations, found.scales, found.covariance))
    better = refactorize(found.scales, moved, found, used, Refinement())
    turned = found.rotations if better is None else better
    assert np.degrees(angles_between(aligned(turned, rotations, used), rotations)).max() < 0.5
    assert refactorize(found.scales, moved, found, used, Refinement(should_stop=lambda: True)) is None


def test_a_round_that_leads_to_extreme_depths_is_discarded(
    rigid: tuple[np.ndarray, Perspective, np.ndarray],
) -> None:
    rotations, view, gram = rigid
    covariance = annealed(gram, rotations[:, :2], ModelOrder(), iterations=5)
    given = Learned(rotations, np.ones(12), replace(covariance, mean_covariance=1e19 * np.eye(3)), np.inf)
    found, moved = alternate(view, given, np.arange(12), Refinement())
    assert found is given
    assert moved is view


def test_a_round_that_places_points_behind_a_camera_is_discarded(
    rigid: tuple[np.ndarray, Perspective, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    rotations, view, gram = rigid
    given = Learned(rotations, np.ones(12), annealed(gram, rotations[:, :2], ModelOrder(), iterations=5), np.inf)
    refined = depth_alternation.refine_with_focal

    def turned_less(*arguments: Any, **options: Any) -> tuple[Learned, float]:
        """Cameras that explain the tracks by ten times the depth."""
        found, inverse_focal = refined(*arguments, **options)
        rotations = exponential(logarithm(found.rotations) / 10)
        return replace(found, rotations=rotations, energy=-10.0), inverse_focal

    found, moved = alternate(view, given, np.arange(12), Refinement())
    assert found is not given
    monkeypatch.setattr(depth_alternation, "refine_with_focal", turned_less)
    found, moved = alternate(view, given, np.arange(12), Refinement())
    assert found is given
    assert moved is view
    flat = replace(given, rotations=exponential(logarithm(given.rotations) / 10), energy=-10.0)
    found, moved = alternate(view, flat, np.arange(12), Refinement())
    assert found.energy == UNLIKELY
    assert found.rotations is flat.rotations
    evidence: Any = SimpleNamespace(
        estimate=SimpleNamespace(perspective=view), start_scales=np.ones(12), used=np.arange(12)
    )
    assert depth_rounds.update_correction(evidence, flat, Refinement()) == (evidence, flat)
    same, found = depth_rounds._correct_from(evidence, flat, view, Refinement())  # its depth map may be singular
    assert same is evidence
    assert found.energy == UNLIKELY


def rolled_and_turned(frames: int, points: int) -> Tracks:
    """A sheet that rolls up while it turns from one edge to the other, 1.3 half-sizes before a pinhole with φ = 390 px."""
    time = np.linspace(0, 1, frames)
    across, down = (each.ravel()[:points] for each in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-0.7, 0.7, 7)))
    bend, angle = 1.2 * np.sin(0.3 + 4.7 * time)[:, None], 0.5 * np.sin(3 * time)[:, None]
    rolled, kept = across * np.cos(angle) + down * np.sin(angle), down * np.cos(angle) - across * np.sin(angle)
    arc, depth = np.sin(bend * rolled) / bend, (1 - np.cos(bend * rolled)) / bend
    shapes = np.stack(
        [arc * np.cos(angle) - kept * np.sin(angle), arc * np.sin(angle) + kept * np.cos(angle), depth], axis=2
    )
    turns = exponential(np.radians(180 * time - 90)[:, None] * np.array([0.0, 1.0, 0.0]))
    seen = (shapes - shapes.mean(axis=1, keepdims=True)) @ turns.transpose(0, 2, 1)
    seen *= 300 / np.abs(seen).max()
    noise = 0.3 * np.random.default_rng(0).normal(size=(frames, points, 2))
    return Tracks.from_arrays((np.array(PICTURE) - 1) / 2 + seen[..., :2] / (1 + seen[..., 2:] / 390) + noise)


def test_where_depths_diverge_at_the_given_focal_length_the_cameras_are_orthographic() -> None:
    settings = Settings(focal=390.0, image_size=PICTURE, surface="free")
    solution = solve(rolled_and_turned(20, 48), settings=settings)
    assert np.isfinite(solution.shapes).all()
    assert solution.choices.camera == "scaled_orthographic"
    assert "is impossible, because the depths of the points diverge" in solution.choices.reasons["camera_model"]
    (warning,) = (each for each in solution.choices.warnings if "focal length" in each)
    improbable = "The given focal length, 390, is improbable: the depths of the points diverge with it"
    assert warning == f"{improbable}, so the cameras are orthographic."
    assert solution.trust is not None
    assert solution.trust.verdict != "good"


@pytest.mark.slow
@pytest.mark.long
def test_a_film_from_nearby_needs_cameras_from_the_corrected_tracks(monkeypatch: pytest.MonkeyPatch) -> None:
    face = gallery.face(30, 120, seed=3, degrees=50)
    seen = (face.shapes - face.shapes.mean(axis=1, keepdims=True)) @ face.rotations.transpose(0, 2, 1)
    seen = 300 * seen / np.abs(seen).max()
    tracks = Tracks.from_arrays((np.array(PICTURE) - 1) / 2 + seen[..., :2] / (1 + seen[..., 2:] / 900))
    errors = []
    for restarts in (depth_rounds.RESTARTS, 0):
        monkeypatch.setattr(depth_rounds, "RESTARTS", restarts)
        errors.append(e3d_frame_scaled(solve(tracks, settings=Settings(image_size=PICTURE)).shapes, seen))
    assert errors[0] < 0.01
    assert errors[0] < errors[1]
