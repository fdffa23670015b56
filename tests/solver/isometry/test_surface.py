"""Isometric surfaces: rolled sheets in closed form, invariances, and inputs that must be rejected."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pliant.solver import InvalidInput, InvalidSettings, KnownCamera, Outcome, Settings, Tracks, gallery, solve
from pliant.solver.evaluation.metrics import reprojection
from pliant.solver.evaluation.trust import per_frame
from pliant.solver.isometry.anchors import connected, nearest_neighbours
from pliant.solver.isometry.extension import _alike, _moved, complete_anchors, extend, flatten, share_of_track
from pliant.solver.isometry.inextensible import SurfaceGraph, maximum_depth
from pliant.solver.isometry.refinement import (
    edge_lengths,
    gauss_newton_step,
    inconsistency,
    refine,
    residuals,
    typical,
)
from pliant.solver.isometry.splines import spline
from pliant.solver.isometry.surface import IsometricSurface, isometric_surface
from pliant.solver.model.so3 import exponential, nearest
from pliant.solver.pulse import pulses_to
from pliant.solver.tracks.noise import RAYLEIGH_MEDIAN
from rolled_sheets import CENTRE, FOCAL, SIZE, one_scale_error, rolled

SMALL = {"frames": 6, "side": 7}
"""A cylinder that is recovered in half the default time."""
TINY = {"frames": 5, "side": 6}
"""A sheet whose edge lengths single out a focal length, but halves of so few frames do not agree on them."""


def graph_of(frames: int = 5, side: int = 5) -> tuple[SurfaceGraph, np.ndarray]:
    """Exact rays of a cylinder, and its true depths."""
    sheet = rolled(frames=frames, side=side)
    points, confidence = sheet.tracks.points, np.asarray(sheet.tracks.visible)
    rays = np.concatenate([(points - CENTRE) / FOCAL, np.ones((*confidence.shape, 1))], axis=2)
    return SurfaceGraph(rays, confidence, nearest_neighbours(points, confidence > 0, neighbours=8)), sheet.points[
        ..., 2
    ]


def test_the_jacobian_matches_finite_differences() -> None:
    graph, depths = graph_of()
    random = np.random.default_rng(0).random(graph.seen.shape)
    seen = random < 0.8
    graph = replace(graph, confidence=np.where(seen, 0.2 + random, 0.0))
    x = np.concatenate([np.log(depths[seen]), np.random.default_rng(1).random(len(graph.edges))])
    count = int(seen.sum())
    jacobian = residuals(graph, x[:count], x[count:])[1].toarray()
    for column in np.random.default_rng(2).choice(len(x), 25, replace=False):
        step = 1e-6 * np.eye(len(x))[column]
        high, low = (residuals(graph, y[:count], y[count:])[0] for y in (x + step, x - step))
        np.testing.assert_allclose(jacobian[:, column], (high - low) / 2e-6, atol=1e-8)


def test_a_step_solves_the_damped_normal_equations() -> None:
    graph, depths = graph_of()
    seen = np.random.default_rng(0).random(graph.seen.shape) < 0.7
    seen[1], seen[2], seen[:, 3] = (
        False,
        np.arange(seen.shape[1]) == 4,
        False,
    )  # a hidden frame, a single point, a hidden point
    graph = replace(graph, confidence=seen.astype(float))
    count = int(graph.seen.sum())
    left, jacobian = residuals(graph, np.log(depths[graph.seen]), 1.1 * typical(edge_lengths(graph, depths)))
    weighted = (jacobian.multiply(np.random.default_rng(1).uniform(0.1, 1, len(left))[:, None])).tocsr()
    normal, gradient = (jacobian.T @ weighted).tocsr(), weighted.T @ left
    found = gauss_newton_step(graph, normal, gradient, 0.01)
    diagonal = normal.diagonal()
    matrix = normal.toarray() + np.diag(0.01 * diagonal + 1e-12 * diagonal.max())
    rest = matrix @ found + gradient
    np.testing.assert_allclose(rest[:count], 0, atol=1e-9 * np.abs(gradient).max())
    reduced = gradient[count:] - matrix[count:, :count] @ np.linalg.solve(matrix[:count, :count], gradient[:count])
    assert np.linalg.norm(rest[count:]) < 2e-3 * np.linalg.norm(reduced)


@pytest.mark.parametrize(("distance", "focal"), [(4.0, None), (2.0, None), (2.0, 350.0)])
@pytest.mark.slow
def test_a_flag_that_bends_strongly_is_recognised(distance: float, focal: float | None) -> None:
    film = gallery.flag(30, 150, degrees=60)
    shapes = film.shapes - film.shapes.mean(axis=(0, 1))
    shapes = shapes / np.abs(shapes - shapes.mean(axis=1, keepdims=True)).max()
    seen = shapes @ (np.diag([1.0, -1.0, -1.0]) @ film.rotations).transpose(0, 2, 1) + [0.0, 0.0, distance]
    images = 175 * distance * seen[..., :2] / seen[..., 2:] + [319.5, 239.5]
    noisy = images + 0.2 * np.random.default_rng(1).normal(size=images.shape)
    found = isometric_surface(Tracks.from_arrays(noisy), focal=focal, image_size=(640.0, 480.0))
    assert found.surface is not None, found.reason
    assert not found.weak
    assert found.surface.focal == pytest.approx(175 * distance, rel=0.15)
    assert one_scale_error(found.surface.points, seen) < 0.08


def test_refinement_recovers_the_true_depths_of_a_rigid_plane() -> None:
    sheet = rolled(frames=4, side=5)
    plane = np.stack([sheet.flat[:, 0], sheet.flat[:, 1], np.zeros(25)], axis=1)
    turns = [
        np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        for c, s in ((np.cos(a), np.sin(a)) for a in (0.2, 0.5, -0.3, -0.6))
    ]
    points = np.array([plane @ turn.T + [0, 0, 4] for turn in turns])
    edges = np.array([(i, j) for i in range(25) for j in range(i) if np.hypot(*(sheet.flat[i] - sheet.flat[j])) < 0.75])
    graph = SurfaceGraph(points / points[..., 2:], np.ones((4, 25)), edges)
    assert inconsistency(edge_lengths(graph, points[..., 2])) < 1e-12
    moved = points[..., 2] * (1 + 0.02 * np.random.default_rng(0).standard_normal((4, 25)))
    found = refine(graph, moved, iterations=60)
    assert found.inconsistency < 1e-3 < 0.2 * inconsistency(edge_lengths(graph, moved))
    assert one_scale_error(found.depths[..., None] * graph.rays, points) < 5e-3
    assert found.lengths.sum() == pytest.approx(typical(edge_lengths(graph, moved)).sum())
    assert refine(graph, moved, should_stop=lambda: True).depths == pytest.approx(moved)


def test_the_variance_of_a_length_is_the_sum_of_those_of_its_ends() -> None:
    graph, _ = graph_of(frames=3)
    confidence = np.random.default_rng(0).uniform(0.1, 1.0, graph.seen.shape)
    confidence[1, :3] = 0.0
    weighted = replace(graph, confidence=confidence)
    frame, edge = weighted.pairs
    first, second = graph.edges[edge].T
    expected = 0.5 / confidence[frame, first] + 0.5 / confidence[frame, second]
    np.testing.assert_allclose(1 / weighted.weights, expected)
    np.testing.assert_array_equal(graph.weights, 1.0)


def test_refinement_trusts_confident_anchors_more() -> None:
    sheet = rolled(frames=12, side=6)
    random = np.random.default_rng(0)
    poor = random.random(sheet.tracks.visible.shape) < 0.5
    points = sheet.tracks.points + random.normal(size=sheet.tracks.points.shape) * np.where(poor, 2.5, 0.1)[..., None]
    rays = np.concatenate([(points - CENTRE) / FOCAL, np.ones((*poor.shape, 1))], axis=2)
    edges = nearest_neighbours(points, np.ones_like(poor), neighbours=8)
    depths = sheet.points[..., 2]

    def error(confidence: np.ndarray) -> float:
        found = refine(SurfaceGraph(rays, confidence, edges), depths, iterations=60).depths
        return float(np.abs(found / found.mean() - depths / depths.mean())[~poor].mean())

    assert error(np.where(poor, (0.1 / 2.5) ** 2, 1.0)) < 0.8 * error(np.ones_like(depths))


def test_noise_of_dense_tracks_is_averaged_with_the_surface_and_confidences_are_weights() -> None:
    sheet = rolled(frames=6, side=24)
    random = np.random.default_rng(0)
    poor = random.random(sheet.tracks.visible.shape) < 0.5
    noise = random.normal(size=sheet.tracks.points.shape) * np.where(poor, 3.0, 1.0)[..., None]

    def found(confidence: np.ndarray) -> IsometricSurface:
        tracks = Tracks.from_arrays(sheet.tracks.points + noise, confidence)
        surface = isometric_surface(tracks, focal=FOCAL, image_size=SIZE, required=True).surface
        assert surface is not None
        return surface

    weighted, alike = found(np.where(poor, 1 / 9, 1.0)), found(np.ones(poor.shape))
    assert one_scale_error(weighted.points, sheet.points) < 0.9 * one_scale_error(alike.points, sheet.points)
    assert weighted.noise_std < 1.1  # that of full confidence; patches also fit some of the noise
    images = FOCAL * weighted.points[..., :2] / weighted.points[..., 2:] + np.asarray(CENTRE)
    off = np.linalg.norm(images - sheet.tracks.points, axis=2)
    assert np.median(off) < 0.7 * np.median(np.linalg.norm(noise, axis=2))
    half = found(np.where(poor, 1 / 18, 0.5))  # only ratios count
    np.testing.assert_allclose(half.points, weighted.points, rtol=1e-9)


@pytest.mark.parametrize(
    ("noise", "off", "expected"),
    [
        (1.0, 2.0, [3 / 4, 0.75 / 1.75, 0.0]),  # the surface's own variance is 2² − 1
        (0.0, 2.0, [1.0, 1.0, 1.0]),
        (2.0, 1.0, [0.0, 0.0, 0.0]),  # nothing but noise
        (0.0, 0.0, [1.0, 1.0, 1.0]),
    ],
)
def test_tracks_and_the_surfaces_image_are_weighted_by_inverse_variances(
    noise: float, off: float, expected: list[float]
) -> None:
    confidence = np.array([[1.0, 0.25, 0.0]])
    share = share_of_track(np.full(5, off * RAYLEIGH_MEDIAN), confidence, noise)
    np.testing.assert_allclose(share, [expected])
    np.testing.assert_array_equal(
        share_of_track(np.zeros(0), confidence, 1.0), 0.0
    )  # no observation lies on the surface


def test_maximum_depth_satisfies_the_cones_and_approximates_the_sheet() -> None:
    graph, depths = graph_of()
    found = maximum_depth(graph)
    assert found is not None
    assert one_scale_error(found[..., None] * graph.rays, depths[..., None] * graph.rays) < 0.12
    longest = np.nanmax(edge_lengths(graph, found), axis=0)
    assert longest.sum() == pytest.approx(1.0, rel=1e-2)  # d_ij are the longest of the frames where they bind
    hidden = replace(graph, confidence=np.zeros_like(graph.confidence))
    assert maximum_depth(hidden) is None
    assert maximum_depth(graph, should_stop=lambda: True) is None


@pytest.mark.slow
@pytest.mark.long
def test_a_cone_is_recovered_with_the_focal_length_known() -> None:
    sheet = rolled("cone")
    # The cone's edges hardly determine the focal length, so isometry is not assumed unless it is required.
    verdict = isometric_surface(sheet.tracks, focal=FOCAL, image_size=SIZE, required=True)
    assert verdict.surface is not None, verdict.reason
    assert one_scale_error(verdict.surface.points, sheet.points) < 0.08
    assert verdict.surface.principal_point == CENTRE
    assert verdict.focal_lengths[0][0] == FOCAL == verdict.surface.focal


@pytest.mark.slow
def test_a_sheet_is_recovered_despite_hidden_points_and_outliers() -> None:
    sheet = rolled(side=24)
    random = np.random.default_rng(3)
    visible = (random.random(sheet.tracks.visible.shape) > 0.2).astype(float)
    points = sheet.tracks.points.copy()
    wrong = random.random(visible.shape) < 0.05
    points[wrong] += random.uniform(60, 120, (int(wrong.sum()), 2))
    verdict = isometric_surface(Tracks.from_arrays(points, visible), focal=FOCAL, image_size=SIZE, required=True)
    assert verdict.surface is not None, verdict.reason
    assert one_scale_error(verdict.surface.points, sheet.points) < 0.07
    judged = wrong & (visible > 0)
    assert verdict.surface.outliers[judged].mean() > 0.9
    assert verdict.surface.outliers[~judged].mean() < 0.1


@pytest.mark.long
@pytest.mark.slow
def test_the_order_of_the_frames_has_no_effect() -> None:
    sheet = rolled(frames=5, side=5)
    order = np.array([3, 0, 1, 4, 2])
    plain = isometric_surface(sheet.tracks, focal=FOCAL, image_size=SIZE, required=True).surface
    shuffled = Tracks.from_arrays(sheet.tracks.points[order])
    other = isometric_surface(shuffled, focal=FOCAL, image_size=SIZE, required=True).surface
    assert plain is not None
    assert other is not None
    assert one_scale_error(other.points, plain.points[order]) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("focal", [FOCAL, pytest.param(None, marks=pytest.mark.long)])
def test_a_stretching_sheet_is_not_taken_as_isometric(focal: float | None) -> None:
    verdict = isometric_surface(rolled("cone", stretch=0.2, **TINY).tracks, focal=focal, image_size=SIZE)
    assert verdict.surface is None
    assert verdict.reason


@pytest.mark.slow
def test_a_sheet_that_the_camera_passes_by_100_degrees_is_isometric() -> None:
    across, along = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-0.7, 0.7, 7)))
    bends = 1.2 * np.sin(np.linspace(0.3, 5, 12))
    sheets = np.stack([np.column_stack([np.sin(k * across) / k, along, (1 - np.cos(k * across)) / k]) for k in bends])
    turns = exponential(np.radians(np.linspace(-50, 50, 12))[:, None] * [0.2, 1.0, 0.1])
    points = (sheets - sheets.mean(axis=1, keepdims=True)) @ turns.transpose(0, 2, 1) + [0, 0, 3]
    tracks = Tracks.from_arrays(CENTRE + FOCAL * points[..., :2] / points[..., 2:])
    verdict = isometric_surface(tracks, image_size=SIZE)
    assert verdict.surface is not None
    assert verdict.surface.focal == pytest.approx(FOCAL, rel=0.04)
    assert one_scale_error(verdict.surface.points, points) < 0.03


@pytest.mark.slow
def test_a_sphere_is_not_taken_as_isometric() -> None:
    verdict = isometric_surface(gallery.sphere(12, 150).tracks)
    assert verdict.surface is None
    assert verdict.reason


@pytest.mark.slow
@pytest.mark.long
def test_a_shallow_face_without_perspective_is_not_taken_as_isometric() -> None:
    verdict = isometric_surface(gallery.face(6, 60).tracks)
    assert verdict.surface is None
    assert verdict.reason


@pytest.mark.slow
@pytest.mark.long
def test_pure_noise_gives_a_warning_and_finite_shapes() -> None:
    noise = Tracks.from_arrays(np.random.default_rng(0).uniform(0, 400, (4, 12, 2)))
    assert isometric_surface(noise).surface is None
    solution = solve(noise, settings=Settings(surface="isometric", prior="smooth", max_reweightings=1))
    assert np.isfinite(solution.shapes).all()
    assert any("isometric" in warning for warning in solution.choices.warnings)


@pytest.mark.parametrize(("frames", "points"), [(3, 8), (3, 4), (4, 5)])
def test_tiny_inputs_give_a_verdict(frames: int, points: int) -> None:
    image = Tracks.from_arrays(rolled(frames=frames, side=3).tracks.points[:, :points])
    verdict = isometric_surface(image, focal=FOCAL, required=True)
    assert verdict.reason
    assert verdict.surface is None or np.isfinite(verdict.surface.points).all()
    assert (verdict.surface is None) or points >= 6


def test_a_stopped_solve_does_not_assume_isometry() -> None:
    sheet = rolled(frames=4, side=5)
    assert isometric_surface(sheet.tracks, focal=FOCAL, image_size=SIZE, should_stop=lambda: True).surface is None


@pytest.mark.slow
def test_a_rolled_sheet_is_recovered_with_the_focal_length_known_in_one_world_frame() -> None:
    sheet = rolled(**SMALL)
    solution = solve(sheet.tracks, settings=Settings(focal=FOCAL, image_size=SIZE, order="film"))
    assert solution.outcome is Outcome.CONVERGED
    assert solution.camera.focal == FOCAL
    assert tuple(solution.camera.principal_point) == CENTRE
    assert (solution.choices.camera, solution.choices.depth_sign) == ("perspective", "settled")
    assert reprojection(sheet.tracks, solution).median < 1e-6
    assert one_scale_error(solution.shapes, sheet.points) < 0.015
    rotations = solution.camera.rotations
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(rotations[0], np.eye(3), atol=1e-12)
    assert np.log(solution.camera.scales).mean() == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(solution.shapes.mean(axis=1), 0, atol=1e-9)
    assert "isometric" in solution.choices.reasons["surface"]
    assert len(solution.choices.focal_lengths) >= 3
    focal, change = solution.choices.focal_lengths[0]
    assert focal == FOCAL
    assert change == min(change for _, change in solution.choices.focal_lengths)
    assert solution.choices.warnings == ()
    assert solution.weights[solution.residuals > 5].max(initial=0.0) == 0.0
    trust = solution.trust
    assert trust is not None
    assert (trust.degrees_per_frame, trust.deformation_per_frame) == per_frame(solution.shapes, rotations)
    assert trust.held_out_error is None


@pytest.mark.slow
def test_a_wrong_focal_length_is_reported_as_improbable() -> None:
    sheet = rolled(**TINY)
    verdict = isometric_surface(sheet.tracks, focal=2 * FOCAL, image_size=SIZE, required=True)
    assert verdict.surface is not None
    assert verdict.surface.focal == 2 * FOCAL
    assert any("improbable" in warning for warning in verdict.warnings)


def test_field_of_view_stands_for_the_focal_length() -> None:
    degrees = float(np.degrees(2 * np.arctan(SIZE[0] / 2 / FOCAL)))
    assert Settings(field_of_view=degrees, image_size=SIZE).focal_length == pytest.approx(FOCAL)
    assert Settings(focal=FOCAL).focal_length == FOCAL
    assert Settings().focal_length is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"surface": "rubber"}, {"focal": 0.0}, {"focal": -1.0}, {"focal": float("nan")}, {"field_of_view": 60.0},
        {"field_of_view": -5.0, "image_size": SIZE}, {"field_of_view": 60.0, "image_size": SIZE, "focal": FOCAL},
        {"image_size": (0, 480)}, {"image_size": (640,)}, {"principal_point": (float("nan"), 0.0)},
    ],
)  # fmt: skip
def test_invalid_settings_are_rejected(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidSettings) as caught:
        Settings(**wrong)  # type: ignore[arg-type]
    assert caught.value.field.removeprefix("options.") in wrong


def test_given_rotations_and_a_required_isometry_contradict() -> None:
    sheet = rolled(frames=3, side=3)
    known = KnownCamera.from_arrays(np.tile(np.eye(3), (3, 1, 1)))
    with pytest.raises(InvalidInput, match="surface"):
        solve(sheet.tracks, cameras=known, settings=Settings(surface="isometric"))


@pytest.mark.slow
def test_a_free_surface_is_the_solve_without_isometry() -> None:
    tracks = gallery.face(5, 24, degrees=60).tracks
    free, auto = (
        solve(
            tracks,
            settings=Settings(surface=kind, image_size=SIZE, refine_rotations=False, max_reweightings=1, basis_size=2),
        )
        for kind in ("free", "auto")
    )
    np.testing.assert_array_equal(free.shapes, auto.shapes)
    assert "surface" not in free.choices.reasons
    assert auto.choices.reasons["surface"].startswith("Not an isometric sheet")


def test_only_the_largest_connected_part_of_the_anchors_counts() -> None:
    edges = np.array([[0, 1], [1, 2], [3, 4]])
    seen = np.array([[True] * 5, [True, False, True, True, True], [False] * 5])
    np.testing.assert_array_equal(connected(seen, edges), [[1, 1, 1, 0, 0], [0, 0, 0, 1, 1], [0, 0, 0, 0, 0]])
    assert flatten(edges, np.ones(3), 5) is None


def test_flattening_recovers_a_grid_from_its_edge_lengths() -> None:
    side = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    pairs = [(i, j) for i in range(36) for j in range(i) if np.hypot(*(side[i] - side[j])) < 3.2]
    edges = np.array(pairs)
    template = flatten(edges, np.linalg.norm(side[edges[:, 0]] - side[edges[:, 1]], axis=1), 36)
    assert template is not None
    flat = np.concatenate([template, np.zeros((36, 1))], axis=1)[None]
    truth = np.concatenate([side, np.zeros((36, 1))], axis=1)[None]
    assert one_scale_error(flat, truth) < 0.03


def test_splines_reproduce_affine_maps_and_approximate_others() -> None:
    random = np.random.default_rng(0)
    source, target = random.standard_normal((30, 2)), random.standard_normal((7, 2))
    np.testing.assert_allclose(
        spline(source, source @ [[2.0], [-1]] + 3, target), target @ [[2.0], [-1]] + 3, atol=1e-6
    )
    np.testing.assert_allclose(spline(source, source**2, source), source**2, atol=0.05)


def test_hidden_anchors_follow_the_most_similar_frame() -> None:
    sheet = rolled(frames=3, side=6)
    points = np.stack([sheet.points[0], sheet.points[0] + [1.0, 2.0, 3.0]])
    seen = np.ones((2, 36), dtype=bool)
    seen[1, [0, 7, 35]] = False
    spoiled = np.where(seen[..., None], points, 0.0)
    completed, enough = complete_anchors(spoiled, seen, sheet.flat)
    np.testing.assert_allclose(completed, points, atol=1e-6)
    assert enough.all()


def test_frames_are_compared_after_a_rigid_motion_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """One motion at a time, for all pairs of frames, takes ten minutes for a film of 3,000 frames."""
    random = np.random.default_rng(0)
    sheet = rolled(frames=9, side=6)
    turns = nearest(random.standard_normal((9, 3, 3)))
    points = np.einsum("fpj,fij->fpi", sheet.points, turns) + np.array([0, 0, 9])
    seen = random.random(points.shape[:2]) < 0.8
    points[~seen] = random.normal(size=(int((~seen).sum()), 3))
    told, moved = list[None](), list[None]()

    def one_at_a_time(*given: Any) -> np.ndarray:
        moved.append(None)
        return _moved(*given)

    monkeypatch.setattr("pliant.solver.isometry.extension._moved", one_at_a_time)
    with pulses_to(lambda: told.append(None)):
        _, enough = complete_anchors(points, seen, sheet.flat)
    assert enough.all()
    assert len(told) == 9
    assert len(moved) < 9 * 8
    shown = np.where(seen[..., None], points, 0.0)
    by_anchor, squares = shown.transpose(1, 0, 2).reshape(36, -1), np.square(shown).sum(axis=2)
    for frame in range(9):
        both = seen & seen[frame]
        distance = [
            np.square(_moved(points[other], points[frame], both[other]) - points[frame])[both[other]].mean()
            for other in range(9)
        ]
        np.testing.assert_array_equal(
            _alike(by_anchor, squares, seen, frame), [each for each in np.argsort(distance) if each != frame]
        )


@pytest.mark.parametrize("shift", [(1500.0, -1500.0), (-320.0, 900.0)])
def test_the_dense_extension_does_not_depend_on_where_the_sheet_lies_in_the_picture(shift: tuple[float, float]) -> None:
    sheet = rolled(frames=6, side=9)
    images, spatial = np.array(sheet.tracks.points), np.asarray(sheet.points)
    seen, anchors = np.ones(images.shape[:2], dtype=bool), np.arange(0, images.shape[1], 2)
    random = np.random.default_rng(0)
    wrong = random.random(seen.shape) < 0.05
    wrong[:, anchors] = False
    images[wrong] += random.normal(scale=12.0, size=(wrong.sum(), 2))
    rows, across = np.divmod(np.arange(81), 9)
    template = np.stack([rows, across], axis=1).astype(float)[anchors]

    def extended(moved: np.ndarray) -> np.ndarray:
        found = extend(
            images + moved, seen.astype(float), images=images[:, anchors] + moved, known=seen[:, anchors], anchors=spatial[:, anchors],
            template=template - template.mean(axis=0), focal=FOCAL, centre=np.asarray(CENTRE) + moved,
            noise_std=0.1,
        )  # fmt: skip
        assert found.outliers[wrong].mean() > 0.8
        return found.points

    np.testing.assert_allclose(extended(np.array(shift)), extended(np.zeros(2)), rtol=1e-6)
