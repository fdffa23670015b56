"""The bootstrap of a sheet's standard deviations: noise, exchanged poses, and the deviations of all points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pliant.solver import Tracks, solve
from pliant.solver.evaluation.metrics import e3d_frame_scaled
from pliant.solver.evaluation.trust import UNESTIMATED, Verdict, size_of
from pliant.solver.isometry import surface
from pliant.solver.isometry.anchors import nearest_neighbours
from pliant.solver.isometry.deviations import (
    FOCAL_MODEL_STD,
    MODEL_STD,
    Deviations,
    deviations_at,
    exchanged,
    focal_offset,
    noise_of,
    noisy_rays,
    standard_deviations,
)  # fmt: skip
from pliant.solver.isometry.focal_sweep import least_between, refocused
from pliant.solver.isometry.inextensible import SurfaceGraph
from pliant.solver.isometry.refinement import Isometry, edge_lengths, inconsistency, refine, typical
from pliant.solver.model.so3 import exponential, rotations_of
from pliant.solver.settings import Settings
from rolled_sheets import CENTRE, FOCAL, SIZE, RolledSheet, rolled

Floats = NDArray[np.float64]


def noisy(sheet: RolledSheet, noise: float, seed: int = 3) -> SurfaceGraph:
    """Return the rays of a sheet with noise in pixels."""
    images = sheet.tracks.points + noise * np.random.default_rng(seed).normal(size=sheet.tracks.points.shape)
    rays = np.concatenate([(images - np.array(CENTRE)) / FOCAL, np.ones((*images.shape[:2], 1))], axis=2)
    return SurfaceGraph(rays, np.ones(rays.shape[:2]), nearest_neighbours(images, np.ones(rays.shape[:2]) > 0))


def refined(graph: SurfaceGraph, sheet: RolledSheet) -> tuple[Isometry, Floats]:
    found = refine(graph, sheet.points[..., 2])
    return found, found.depths[..., None] * graph.rays


def measured(graph: SurfaceGraph, found: Isometry, points: Floats, *, seed: int = 0) -> Deviations:
    std = standard_deviations(graph, found, points, np.arange(10), seed=seed)
    assert std is not None
    return std


def deviations(noise: float, *, seed: int = 0) -> Floats:
    sheet = rolled(frames=10)
    graph = noisy(sheet, noise)
    found, points = refined(graph, sheet)
    return measured(graph, found, points, seed=seed).points / size_of(sheet.points)


def test_noise_is_that_of_edges_parallel_to_the_picture() -> None:
    random = np.random.default_rng(0)
    plane = np.stack(np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-1, 1, 12)), axis=2).reshape(-1, 2)
    rays = np.concatenate([plane, np.ones((144, 1))], axis=1) + 0.001 * random.normal(size=(400, 144, 3)) * [1, 1, 0]
    graph = SurfaceGraph(rays, np.ones((400, 144)), nearest_neighbours(rays[..., :2], np.ones((400, 144)) > 0))
    depths = np.full((400, 144), 5.0)
    lengths = edge_lengths(graph, depths)
    found = Isometry(depths, typical(lengths), inconsistency(lengths))
    assert noise_of(found, depths[..., None] * rays) == pytest.approx(0.001, rel=0.02)


def test_noisy_rays_have_the_variance_of_their_confidence() -> None:
    points = np.tile([0.3, -0.2, 4.0], (300, 3, 1))
    confidence = np.tile([1.0, 0.25, 0.0], (300, 1))
    rays = noisy_rays(points, confidence, 0.01, np.random.default_rng(0))
    np.testing.assert_array_equal(rays[..., 2], 1.0)
    np.testing.assert_allclose(rays.mean(axis=0)[:, :2], [[0.075, -0.05]] * 3, atol=0.003)
    np.testing.assert_allclose(rays.std(axis=0)[:, :2], np.array([[0.01], [0.02], [0.01]]) * [1, 1], rtol=0.15)


def test_exchanged_poses_move_shapes_rigidly_to_the_places_of_others() -> None:
    points = rolled(frames=6).points
    np.testing.assert_allclose(exchanged(points, 0), points, atol=1e-12)
    moved = exchanged(points, 2)
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    np.testing.assert_allclose(np.linalg.norm(moved[:, :, None] - moved[:, None], axis=3), apart, atol=1e-12)
    np.testing.assert_allclose(moved.mean(axis=1), np.roll(points.mean(axis=1), 2, axis=0), atol=1e-12)


def test_exchanged_poses_of_a_rigid_shape_are_those_of_other_frames() -> None:
    shape = np.random.default_rng(0).normal(size=(20, 3))
    angles = np.random.default_rng(1).normal(size=(5, 3))
    points = shape @ exponential(angles).transpose(0, 2, 1) + [0, 0, 9]
    points -= points.mean(axis=1, keepdims=True) - [0, 0, 9]
    np.testing.assert_allclose(exchanged(points, 1), np.roll(points, 1, axis=0), atol=1e-9)


def test_frames_that_would_reach_behind_the_camera_keep_their_pose() -> None:
    shape = np.random.default_rng(0).uniform(-1, 1, size=(40, 3)) * [2, 1, 0.1]
    shape -= shape.mean(axis=0)
    sideways = exponential(np.array([[0, np.pi / 2, 0]]))[0]  # the long axis along the viewing direction
    points = np.stack([shape, shape @ sideways.T, 1.5 * shape])
    points += [0, 0, 2.5]
    moved = exchanged(points, 1)
    np.testing.assert_array_equal(moved[2], points[2])
    assert (moved[..., 2] > 0).all()
    np.testing.assert_allclose(moved[1], points[0], atol=1e-9)


def test_rotations_align_shapes_with_their_mean() -> None:
    shape = np.random.default_rng(0).normal(size=(30, 3))
    shape -= shape.mean(axis=0)
    truth = exponential(np.random.default_rng(1).normal(size=(7, 3)))
    found = rotations_of(shape @ truth.transpose(0, 2, 1))
    np.testing.assert_allclose(found, truth @ truth[0].T, atol=1e-12)


def test_deviations_grow_with_the_noise_above_those_of_the_model() -> None:
    exact, little, much = (np.sqrt(np.square(deviations(noise)).mean()) for noise in (0.0, 0.5, 1.0))
    assert MODEL_STD <= exact < 1.5 * MODEL_STD
    beyond = [np.sqrt(each**2 - MODEL_STD**2) for each in (little, much)]
    assert 1.5 < beyond[1] / beyond[0] < 2.7


@pytest.mark.parametrize("noise", [0.7, 1.4])
def test_deviations_are_about_the_errors(noise: float) -> None:
    sheet = rolled(frames=10)
    graph = noisy(sheet, noise)
    found, points = refined(graph, sheet)
    std = measured(graph, found, points).points
    expected = np.sqrt(np.square(std).mean())
    error = e3d_frame_scaled(points, sheet.points)
    assert 0.5 < error / (expected / size_of(sheet.points)) < 2


def test_the_noise_depends_on_the_seed_alone() -> None:
    np.testing.assert_array_equal(deviations(1.0), deviations(1.0))
    other = deviations(1.0, seed=1)
    assert (other != deviations(1.0)).any()
    assert 0.6 < np.sqrt(np.square(other).mean() / np.square(deviations(1.0)).mean()) < 1.6


def test_hidden_anchors_do_not_count() -> None:
    sheet = rolled(frames=10)
    graph = noisy(sheet, 0.5)
    shown = np.ones(graph.confidence.shape)
    shown[:, 5], shown[:4, 20] = 0, 0  # one anchor is never visible
    graph = replace(graph, confidence=shown)
    found = refine(graph, np.where(shown > 0, sheet.points[..., 2], 0.0))
    points = np.where(shown[..., None] > 0, found.depths[..., None] * graph.rays, sheet.points)
    std = measured(graph, found, points).points
    assert std[5] == pytest.approx(np.sqrt(np.square(np.delete(std, 5)).mean()), rel=0.05)
    assert std.max() < 5 * np.median(std)


def test_reconstructions_completed_before_a_stop_count() -> None:
    sheet = rolled(frames=10)
    graph = noisy(sheet, 1.0)
    found, points = refined(graph, sheet)
    questions = 0

    def stop_after(most: float) -> Deviations | None:
        nonlocal questions
        questions = 0

        def should_stop() -> bool:
            nonlocal questions
            questions += 1
            return questions > most

        return standard_deviations(graph, found, points, np.arange(10), seed=0, should_stop=should_stop)

    whole = stop_after(np.inf)
    assert whole is not None
    total = questions
    part = stop_after(total - 1)  # in the last question of the third reconstruction
    assert part is not None
    assert 0.5 < np.sqrt(np.square(part.points).mean() / np.square(whole.points).mean()) < 2
    assert (part.points != whole.points).any()
    assert stop_after(0) is None
    assert stop_after(total // 6) is None


def test_a_stop_before_the_error_is_estimated_is_a_reason_for_care(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface, "standard_deviations", lambda *given, **named: None)
    sheet = rolled(frames=8, side=6)
    found = solve(sheet.tracks, settings=Settings(image_size=SIZE, surface="isometric"))
    assert found.trust is not None
    assert found.trust.depth_from_lengths
    assert (found.shapes_std, found.trust.expected_error, found.trust.interval) == (None, None, None)
    assert found.camera.focal_std is None
    assert found.trust.verdict is Verdict.WITH_CARE
    assert UNESTIMATED in found.trust.reasons


@pytest.mark.parametrize("ratio", [0.96, 1.0, 1.05])
def test_the_focal_length_of_the_least_inconsistency_is_found_beside_that_of_the_rays(ratio: float) -> None:
    sheet = rolled(frames=10)
    graph = noisy(sheet, 0.0)
    graph = replace(graph, rays=graph.rays / [ratio, ratio, 1.0])
    found = refine(graph, refocused(sheet.points[..., 2], graph.seen, ratio))
    assert focal_offset(graph, found) == pytest.approx(-np.log(ratio), abs=0.01)


def test_the_focal_length_is_less_certain_with_noise() -> None:
    sheet = rolled(frames=10)

    def focal(noise: float) -> float:
        graph = noisy(sheet, noise)
        return measured(graph, *refined(graph, sheet)).focal

    assert FOCAL_MODEL_STD <= focal(0.0) < 1.2 * FOCAL_MODEL_STD
    assert focal(0.0) < focal(1.0) < 0.1


def test_a_parabola_gives_the_focal_length_between_others() -> None:
    places = np.array([0.1, 0.3, 0.4])
    assert least_between(places, np.sqrt(2 + 3 * np.square(places - 0.27))) == pytest.approx(0.27)
    assert least_between(places, np.sqrt(2 + 3 * np.square(places - 0.9))) == pytest.approx(0.4)
    assert least_between(places, np.sqrt(5 - 3 * np.square(places - 0.27))) is None


def test_points_have_the_deviations_of_the_anchors_around_them() -> None:
    template = np.random.default_rng(0).normal(size=(40, 2))
    smooth = np.exp(0.3 * template[:, 0] - 0.2 * template[:, 1] - 4)
    places = np.array([[0.1, 0.2], [0.0, 0.0], [-0.5, 0.3], [9.0, 0.0]])
    placed = np.array([True, False, True, True])
    found = deviations_at(places, placed, smooth, template=template, size=0.1)
    expected = np.exp(0.3 * places[:, 0] - 0.2 * places[:, 1] - 4)
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], rtol=0.01)
    np.testing.assert_allclose(found[[1, 3]], 0.1)  # not placed; extrapolated beyond the size


def test_a_sheet_has_an_expected_error() -> None:
    sheet = rolled(frames=12)
    images = sheet.tracks.points + np.random.default_rng(0).normal(size=sheet.tracks.points.shape)
    solution = solve(Tracks.from_arrays(images), settings=Settings(image_size=SIZE, surface="isometric"))
    assert solution.trust is not None
    assert solution.trust.depth_from_lengths
    assert solution.shapes_std is not None
    assert solution.shapes_std.shape == solution.shapes.shape[:2]
    expected, interval = solution.trust.expected_error, solution.trust.interval
    assert expected == pytest.approx(np.sqrt(np.square(solution.shapes_std).mean()) / size_of(solution.shapes))
    assert interval is not None
    assert interval[0] < e3d_frame_scaled(solution.shapes, sheet.points) < interval[1]
    assert solution.trust.sentence.startswith("Expected error about")
    assert solution.camera.focal is not None
    assert solution.camera.focal_std is not None
    assert abs(solution.camera.focal - FOCAL) < 3 * solution.camera.focal_std < 0.3 * FOCAL


def test_a_given_focal_length_is_exact_and_a_doubtful_one_has_no_deviation() -> None:
    sheet = rolled("cone", frames=12, stretch=0.2, side=6)
    given, free = (
        solve(sheet.tracks, settings=Settings(image_size=SIZE, focal=focal, surface="isometric"))
        for focal in (FOCAL, None)
    )
    assert given.camera.focal_std == 0
    assert free.camera.focal is not None
    assert free.camera.focal_std is None
    assert free.trust is not None
    assert free.trust.interval is None
