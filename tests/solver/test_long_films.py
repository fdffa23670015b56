"""Films with more frames than are learned from jointly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import (
    KnownCamera,
    Outcome,
    Settings,
    Tracks,
    estimate_cameras,
    gallery,
    learn_prior,
    limits,
    solve,
    solve_shapes,
)
from pliant.solver.cameras import perspective
from pliant.solver.evaluation import metrics
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import exponential
from pliant.solver.reconstruction import long_films
from pliant.solver.records import Floats
from pliant.solver.refinement.learned import Learned, Refinement

FRAMES, LEARNED = 120, 20


def learn_from(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LEARNED_FRAMES", frames)
    monkeypatch.setattr(perspective, "LEARNED_FRAMES", frames)


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> None:
    learn_from(LEARNED, monkeypatch)


@pytest.fixture(scope="module")
def film() -> gallery.Sequence:
    return gallery.talk(FRAMES, 60)


def given(sequence: gallery.Sequence) -> KnownCamera:
    return KnownCamera.from_arrays(sequence.rotations, sequence.scales)


@pytest.mark.usefixtures("limited")
@pytest.mark.slow
def test_deformation_between_the_learned_frames_is_recovered(film: gallery.Sequence) -> None:
    found = estimate_cameras(film.tracks, given(film))
    prior = learn_prior(film.tracks, found)
    used = np.arange(0, FRAMES, 6)
    thin = replace(prior.normalized, modes=prior.normalized.modes[used]).stretched(used, FRAMES)
    error, interpolated = (
        metrics.e3d_frame(solve_shapes(film.tracks, found, each, film.mesh).shapes, film.shapes)
        for each in (prior, replace(prior, normalized=thin))
    )
    assert error < 0.5 * interpolated


class Unrefined(Refinement):
    def refine_once(self, gram: Floats, found: Learned, *, factor: Floats | None = None) -> Learned:
        assert factor is not None or len(gram)
        return found


@pytest.mark.slow
@pytest.mark.usefixtures("limited")
@pytest.mark.long
def test_resection_recovers_fast_motion_that_interpolation_loses(
    film: gallery.Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = solve(film.tracks, film.mesh)
    monkeypatch.setattr(long_films, "resected", lambda views, shapes, poses, **_: poses)
    monkeypatch.setattr(long_films, "Refinement", Unrefined)
    interpolated = solve(film.tracks, film.mesh)
    found, lost = (metrics.e3d_frame(each.shapes, film.shapes) for each in (solution, interpolated))
    assert found < 0.1 * lost
    assert f"These are {LEARNED} of {FRAMES} frames" in solution.choices.reasons["rotations"]
    assert solution.camera.rotations[0] == pytest.approx(np.eye(3), abs=1e-12)
    assert np.log(solution.camera.scales).mean() == pytest.approx(0, abs=1e-9)


@pytest.mark.usefixtures("limited")
@pytest.mark.slow
def test_hidden_points_and_outliers_are_predicted_in_every_frame(film: gallery.Sequence) -> None:
    spoiled, _ = gallery.corrupt_tracks(film.tracks, outliers=0.03, noise=0.0)
    visible = np.random.default_rng(0).random((FRAMES, 60)) > 0.2
    tracks = Tracks.from_arrays(spoiled.points, visible)
    found = estimate_cameras(tracks, given(film))
    assert found.estimate.sample.shape == (FRAMES, 60, 2)
    truth = film.tracks.points - film.tracks.points.mean(axis=1, keepdims=True)
    error = np.linalg.norm(found.estimate.sample * found.observations.normalized.unit - truth, axis=2)
    assert np.median(error) < 0.02 * found.observations.normalized.unit
    assert np.quantile(error, 0.99) < 0.2 * found.observations.normalized.unit
    assert found.estimate.filling is not None


@pytest.mark.slow
@pytest.mark.long
def test_perspective_is_corrected_in_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    learn_from(40, monkeypatch)
    film, focal, distance = gallery.talk(90, 60), 600.0, 600.0
    seen = np.einsum("fij,fpj->fpi", film.rotations, film.shapes)
    seen -= seen.mean(axis=1, keepdims=True)
    points = 320 + focal * seen[..., :2] / (seen[..., 2:] + distance)
    visible = np.random.default_rng(0).random((90, 60)) > 0.1
    solution = solve(Tracks.from_arrays(points, visible), film.mesh, settings=Settings(image_size=(641, 641)))
    assert solution.camera.focal == pytest.approx(focal, rel=0.1)
    assert metrics.e3d_frame(solution.shapes, film.shapes) < 0.02


@pytest.mark.usefixtures("limited")
def test_a_stop_returns_finite_shapes_for_every_frame(film: gallery.Sequence) -> None:
    solution = solve(film.tracks, film.mesh, should_stop=lambda: True)
    assert solution.outcome is Outcome.STOPPED
    assert solution.shapes.shape == (FRAMES, 60, 3)
    assert np.isfinite(solution.shapes).all()


@pytest.mark.usefixtures("limited")
@pytest.mark.slow
def test_unknown_scales_are_estimated_in_every_frame(film: gallery.Sequence) -> None:
    zoom = np.exp(0.2 * np.sin(np.arange(FRAMES) / 3))
    points = film.tracks.points * zoom[:, None, None]
    settings = Settings(camera="scaled_orthographic")
    found = estimate_cameras(Tracks.from_arrays(points), KnownCamera.from_arrays(film.rotations), settings=settings)
    ratio = np.log(found.camera.scales / zoom)
    assert np.std(ratio) < 0.03  # without resection 0.14


def test_factored_depth_map_matches_the_dense_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    rotations, scales = exponential(0.3 * random.normal(size=(20, 3))), np.exp(0.1 * random.normal(size=20))
    covariance = ShapeCovariance(np.eye(3), np.diag([1.5, 1.0, 0.5]), random.normal(size=(20, 2)), 0.01, 1e-4, 0.0)
    images = random.normal(size=(40, 7))
    matrix = perspective.depth_map(rotations, scales, covariance)
    monkeypatch.setattr(perspective, "LEARNED_FRAMES", 10)
    factors = perspective.depth_map(rotations, scales, covariance)
    assert isinstance(matrix, np.ndarray)
    assert isinstance(factors, perspective.DepthMap)
    assert factors @ images == pytest.approx(matrix @ images, abs=1e-8)


@pytest.mark.parametrize("frames", [1, 239, 240, 241, 480, 481, 1102, 10_000])
def test_every_nth_frame_is_learned_from_with_the_smallest_n(frames: int) -> None:
    stride = limits.learned_stride(frames)
    assert limits.learned_frames(frames) == len(range(0, frames, stride)) <= limits.LEARNED_FRAMES
    assert stride == 1 or frames / (stride - 1) > limits.LEARNED_FRAMES


@pytest.mark.slow
def test_photographs_are_all_learned_from(film: gallery.Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    learn_from(8, monkeypatch)
    first = Tracks.from_arrays(film.tracks.points[:16, ::2], film.tracks.visible[:16, ::2])
    found = {order: estimate_cameras(first, settings=Settings(order=order, basis_size=2)) for order in ("film", "any")}
    assert "These are 8 of 16 frames" in found["film"].reasons["rotations"]
    assert "resection" not in found["any"].reasons["rotations"]
