"""Lengths along a surface: a cylinder in closed form, hidden points, and what they are good for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pliant.solver.isometry import arc_lengths
from pliant.solver.isometry.anchors import nearest_neighbours
from pliant.solver.isometry.arc_lengths import arc_chord_ratios, refine_along_surface
from pliant.solver.isometry.inextensible import SurfaceGraph
from pliant.solver.isometry.refinement import Isometry, edge_lengths, inconsistency, refine, residuals
from pliant.solver.isometry.splines import partial_splines, spline, spline_basis
from pliant.solver.isometry.surface import isometric_surface
from rolled_sheets import CENTRE, FOCAL, SIZE, one_scale_error, rolled


def cylinder(side: int = 7) -> tuple[SurfaceGraph, Isometry, NDArray[np.float64]]:
    """Return exact rays of a cylinder, its true depths and lengths along it, and its points."""
    sheet = rolled(frames=8, side=side)
    points, confidence = sheet.tracks.points, np.asarray(sheet.tracks.visible)
    rays = np.concatenate([(points - CENTRE) / FOCAL, np.ones((*confidence.shape, 1))], axis=2)
    edges = nearest_neighbours(points, confidence > 0)
    lengths = np.linalg.norm(sheet.flat[edges[:, 0]] - sheet.flat[edges[:, 1]], axis=1)
    return SurfaceGraph(rays, confidence, edges), Isometry(sheet.points[..., 2], lengths, 0.0), sheet.points


def test_arc_chord_ratios_a_cylinder_turn_distances_into_lengths_along_it() -> None:
    graph, true, _ = cylinder()
    distances = edge_lengths(graph, true.depths)
    found = arc_chord_ratios(graph, true)
    assert found is not None
    assert np.abs(found * distances - true.lengths).mean() < 0.25 * np.abs(distances - true.lengths).mean()
    assert inconsistency(edge_lengths(replace(graph, arc_ratios=found), true.depths)) < 0.25 * inconsistency(distances)


def test_hidden_points_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, true, _ = cylinder()
    seen = np.random.default_rng(0).random(graph.seen.shape) < 0.8
    seen[3] = False
    partly = replace(graph, confidence=seen.astype(float))
    found = arc_chord_ratios(partly, replace(true, depths=np.where(seen, true.depths, 0.0)))
    assert found is not None
    np.testing.assert_array_equal(found[3], 1.0)
    both = seen[:, graph.edges[:, 0]] & seen[:, graph.edges[:, 1]]
    whole = arc_chord_ratios(graph, true)
    assert whole is not None
    np.testing.assert_allclose(found[both], whole[both], atol=0.015)
    monkeypatch.setattr(arc_lengths, "CHUNK_OBSERVATIONS", 1)
    np.testing.assert_allclose(arc_chord_ratios(partly, replace(true, depths=np.where(seen, true.depths, 7.0))), found)


def test_partial_splines_are_splines_of_their_known_points() -> None:
    random = np.random.default_rng(0)
    source, values, target = random.normal(size=(12, 2)), random.normal(size=(3, 12, 2)), random.normal(size=(5, 2))
    known = random.random((3, 12)) < 0.7
    found = spline_basis(target, source) @ partial_splines(source, values, known)
    for frame in range(3):
        some = known[frame]
        np.testing.assert_allclose(found[frame], spline(source[some], values[frame, some], target), atol=1e-9)


def test_the_jacobian_with_ratios_matches_finite_differences() -> None:
    graph, true, _ = cylinder(5)
    random = np.random.default_rng(0)
    graph = replace(graph, confidence=(random.random(graph.seen.shape) < 0.8) * 1.0)
    graph = replace(graph, arc_ratios=1 + 0.2 * random.random((len(graph.rays), len(graph.edges))))
    x, count = np.concatenate([np.log(true.depths[graph.seen]), true.lengths]), int(graph.seen.sum())
    jacobian = residuals(graph, x[:count], x[count:])[1].toarray()
    for column in random.choice(len(x), 25, replace=False):
        step = 1e-6 * np.eye(len(x))[column]
        high, low = (residuals(graph, y[:count], y[count:])[0] for y in (x + step, x - step))
        np.testing.assert_allclose(jacobian[:, column], (high - low) / 2e-6, atol=1e-8)
    frame, edge = graph.pairs
    left, _ = residuals(replace(graph, confidence=1.0 * graph.seen), x[:count], 0 * true.lengths)
    np.testing.assert_allclose(left, edge_lengths(graph, np.where(graph.seen, true.depths, 0.0))[frame, edge])


def test_frames_of_a_graph_keep_their_ratios() -> None:
    graph, true, _ = cylinder(5)
    curved = replace(graph, arc_ratios=arc_chord_ratios(graph, true))
    some = np.array([4, 1])
    expected = edge_lengths(curved, true.depths)[some]
    np.testing.assert_array_equal(edge_lengths(curved.of(some), true.depths[some]), expected)


def test_depths_along_the_surface_are_nearer_to_the_true_ones() -> None:
    graph, true, points = cylinder()
    straight = refine(graph, true.depths)
    along = refine_along_surface(graph, straight)
    before, after = (one_scale_error(each.depths[..., None] * graph.rays, points) for each in (straight, along))
    assert after < 0.6 * before


def test_nothing_changes_without_connection_or_when_stopped() -> None:
    graph, true, _ = cylinder(5)
    apart = replace(true, lengths=np.where(np.arange(len(true.lengths)) < 3, true.lengths, 0.0))
    assert refine_along_surface(graph, apart) is apart
    assert refine_along_surface(graph, true, should_stop=lambda: True) is true


@pytest.mark.slow
def test_the_focal_length_is_that_of_lengths_along_the_surface() -> None:
    sheet = rolled()
    found = isometric_surface(sheet.tracks, image_size=SIZE).surface
    assert found is not None
    assert found.focal == pytest.approx(FOCAL, rel=0.005)
    assert one_scale_error(found.points, sheet.points) < 0.006
