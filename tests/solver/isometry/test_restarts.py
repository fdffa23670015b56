"""Frames in poor minima start again from similar frames, and frames are refined independently for given lengths."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pliant.solver.isometry.anchors import nearest_neighbours
from pliant.solver.isometry.inextensible import SurfaceGraph
from pliant.solver.isometry.refinement import edge_lengths, refine, typical
from pliant.solver.isometry.restarts import (
    SIMILAR_FRAMES,
    _restarted,
    carried,
    refine_frames,
    refine_with_restarts,
    similar_frames,
    unlikeness,
)  # fmt: skip
from rolled_sheets import CENTRE, FOCAL, RolledSheet, rolled


def graph_of(sheet: RolledSheet, confidence: NDArray[np.float64] | None = None) -> SurfaceGraph:
    images = (sheet.tracks.points - np.array(CENTRE)) / FOCAL
    rays = np.concatenate([images, np.ones((*images.shape[:2], 1))], axis=2)
    confidence = np.ones(rays.shape[:2]) if confidence is None else confidence
    return SurfaceGraph(rays, confidence, nearest_neighbours(sheet.tracks.points, confidence > 0, neighbours=8))


def bent_backwards(depths: NDArray[np.float64], frames: list[int]) -> NDArray[np.float64]:
    """Return the depths with those of some frames mirrored about their mean and exaggerated."""
    changed = depths.copy()
    for frame in frames:
        mean = depths[frame].mean()
        changed[frame] = mean - 2 * (depths[frame] - mean)
    return changed


def hidden(shape: tuple[int, ...], share: float) -> NDArray[np.float64]:
    return (np.random.default_rng(2).random(shape) > share).astype(np.float64)


def test_frames_return_to_the_true_depths_for_the_true_lengths() -> None:
    sheet = rolled()
    graph, truth = graph_of(sheet), sheet.points[..., 2]
    lengths = typical(edge_lengths(graph, truth))
    begun = truth * np.exp(np.random.default_rng(1).normal(0, 0.01, truth.shape))
    exact, least = refine_frames(graph, truth, lengths, 0.1)
    found, costs = refine_frames(graph, begun, lengths, 0.1)
    np.testing.assert_allclose(costs, least, rtol=1e-3)
    assert np.abs(found / exact - 1).max() < 0.01


def test_a_frame_does_not_depend_on_the_others() -> None:
    sheet = rolled(side=5)
    confidence = hidden((8, 25), 0.2)
    graph = graph_of(sheet, confidence)
    truth = np.where(confidence > 0, sheet.points[..., 2], 0.0)
    lengths = typical(edge_lengths(graph, truth))
    begun = np.where(confidence > 0, bent_backwards(sheet.points[..., 2], [3]), 0.0)
    whole, costs = refine_frames(graph, begun, lengths, 0.1)
    for frame in range(8):
        alone = SurfaceGraph(graph.rays[[frame]], graph.confidence[[frame]], graph.edges)
        depths, cost = refine_frames(alone, begun[[frame]], lengths, 0.1)
        np.testing.assert_allclose(depths[0], whole[frame], rtol=1e-6)
        np.testing.assert_allclose(cost[0], costs[frame], rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_frames_that_bend_the_wrong_way_take_the_depths_of_similar_frames(share: float) -> None:
    sheet = rolled(frames=24, side=6)
    confidence = hidden((24, 36), share)
    graph, truth = graph_of(sheet, confidence), np.where(confidence > 0, sheet.points[..., 2], 0.0)
    begun = np.where(confidence > 0, bent_backwards(sheet.points[..., 2], [9, 10, 11]), 0.0)
    stuck, found = refine(graph, begun), refine_with_restarts(graph, begun)
    seen = confidence > 0

    def off(depths: NDArray[np.float64]) -> float:
        scaled = depths * np.median(truth[seen] / depths[seen])
        return float(np.abs(scaled / np.where(seen, truth, 1) - 1)[seen].max())

    assert off(stuck.depths) > 0.1
    assert off(found.depths) < 0.02
    assert found.inconsistency < 0.5 * stuck.inconsistency


def test_frames_in_good_minima_are_left_alone() -> None:
    sheet = rolled(frames=12, side=6)
    graph = graph_of(sheet)
    plain, found = refine(graph, sheet.points[..., 2]), refine_with_restarts(graph, sheet.points[..., 2])
    np.testing.assert_array_equal(found.depths, plain.depths)


def test_nothing_restarts_after_a_stop() -> None:
    sheet = rolled(frames=12, side=6)
    graph = graph_of(sheet)
    found = refine(graph, bent_backwards(sheet.points[..., 2], [5]))
    assert _restarted(graph, found, lambda: False) is not None
    assert _restarted(graph, found, lambda: True) is None


def test_depths_far_too_steep_are_refined_without_overflow() -> None:
    sheet = rolled(frames=4, side=5)
    graph, truth = graph_of(sheet), sheet.points[..., 2]
    lengths = typical(edge_lengths(graph, truth))
    wild = truth * np.exp(np.random.default_rng(1).normal(0, 3, truth.shape))
    found, costs = refine_frames(graph, wild, lengths, 0.1)
    assert np.isfinite(found).all()
    assert np.isfinite(costs).all()


def test_unlikeness_is_the_mean_square_after_removing_the_mean_difference() -> None:
    sheet = rolled(side=4)
    confidence = hidden((8, 16), 0.4)
    confidence[7] = 0.0
    confidence[7, 0] = 1.0
    graph = graph_of(sheet, confidence)
    some = np.array([2, 5, 7])
    found = unlikeness(graph, some)
    for row, one in enumerate(some):
        for other in range(8):
            both = (confidence[one] > 0) & (confidence[other] > 0)
            if both.sum() < 2:
                assert found[row, other] == np.inf
                continue
            apart = (graph.rays[one] - graph.rays[other])[both]
            expected = np.square(apart - apart.mean(axis=0)).sum(axis=1).mean()
            assert found[row, other] == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("frames", [3, 12])
def test_similar_frames_exclude_the_frame_itself(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = graph_of(rolled(frames=frames, side=4))
    found = similar_frames(graph, SIMILAR_FRAMES)
    assert found.shape == (frames, min(SIMILAR_FRAMES, frames - 1))
    assert (found != np.arange(frames)[:, None]).all()
    monkeypatch.setattr("pliant.solver.isometry.restarts.CHUNK_OBSERVATIONS", 2 * frames)
    np.testing.assert_array_equal(similar_frames(graph, SIMILAR_FRAMES), found)


def test_carried_depths_fill_hidden_points_with_the_mean() -> None:
    sheet = rolled(frames=3, side=2)
    graph = graph_of(rolled(frames=3, side=2), np.array([[1, 1, 1, 0], [1, 1, 1, 1], [0, 1, 1, 1]]) * 1.0)
    assert sheet.tracks.num_points == 4
    depths = np.array([[2.0, 4.0, 0.0, 5.0], [0.0, 0.0, 0.0, 0.0], [1.0, 2.0, 3.0, 0.0]])
    expected = [[2.0, 4.0, 11 / 3, 0.0], [1.0, 1.0, 1.0, 1.0], [0.0, 2.0, 3.0, 2.0]]
    np.testing.assert_allclose(carried(depths, graph), expected)
