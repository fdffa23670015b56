"""Two halves of the frames must agree on the edge lengths: they do for a real sheet, but not for wrong depths."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pliant.solver import Settings, Tracks, gallery, solve
from pliant.solver.evaluation.trust import Verdict
from pliant.solver.isometry import focal_sweep, surface
from pliant.solver.isometry.confirmation import DISAGREEMENT, disagreement, unlike
from pliant.solver.isometry.focal_sweep import FocalSearch, Judgement, Tried, tried_at
from pliant.solver.isometry.inextensible import SurfaceGraph, maximum_depth
from pliant.solver.isometry.refinement import Isometry, refine
from pliant.solver.isometry.surface import isometric_surface
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import never
from pliant.solver.reconstruction.surface import with_verdict
from pliant.solver.stages import Stage
from rolled_sheets import CENTRE, FOCAL, SIZE, one_scale_error, rolled


def search_of(tracks: Tracks) -> FocalSearch:
    found = surface._prepared(tracks.points, tracks.visible > 0, np.array(CENTRE), never)
    assert found is not None
    begun = found.begun(FOCAL)
    assert begun is not None
    return begun


@pytest.mark.slow
def test_halves_of_a_rolled_sheet_agree() -> None:
    search = search_of(rolled().tracks)
    chosen = tried_at(search, FOCAL, None)
    assert chosen is not None
    assert disagreement(search, chosen) < 0.1 * DISAGREEMENT


@pytest.mark.slow
def test_wrong_depths_that_preserve_lengths_are_detected() -> None:
    search = search_of(gallery.flag(6, 40).tracks)
    focal = 400.0
    first = tried_at(search, focal, None)
    assert first is not None
    stretched = np.square(first.found.depths / first.found.depths.max())
    chosen = Tried(focal, first.graph, refine(first.graph, stretched, iterations=60))
    assert chosen.found.inconsistency < 0.002  # as small as that of a real sheet
    assert disagreement(search, chosen) > 10 * DISAGREEMENT


@pytest.mark.slow
def test_a_surface_that_the_halves_do_not_confirm_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks = rolled(frames=5, side=6).tracks
    monkeypatch.setattr(surface, "disagreement", lambda search, chosen: 0.4)
    refused = isometric_surface(tracks, focal=FOCAL, image_size=SIZE)
    assert refused.surface is None
    why = "its edge lengths differ by 40% between halves of the frames"
    advice = "If it is one that keeps its lengths, such as paper or cloth seen from nearby, try surface=isometric and compare."
    assert refused.reason == f"Rejected as an isometric sheet: {why}. {advice}"
    assert [each for each in refused.warnings if each.startswith("The object was not recognised as a sheet")]
    required = isometric_surface(tracks, focal=FOCAL, image_size=SIZE, required=True)
    assert required.surface is not None
    assert required.reason == f"Solved as an isometric sheet, as set, although {why}."
    assert any("hardly support" in warning for warning in required.warnings)


@pytest.mark.parametrize(
    ("clear", "ratio", "share", "supported", "words"),
    [
        (True, 1.3, 0.019, True, "Halves of the frames agree on the lengths to within 1.9%."),
        (True, 1.3, 0.021, False, "its edge lengths differ by 2% between halves of the frames"),
        (False, 1.08, 0.009, True, "to within 0.9%."),
        (False, 1.08, 0.011, False, "its edge lengths hardly single out a focal length"),
        (False, 1.08, 0.4, False, "its edge lengths differ by 40% between halves of the frames"),
        (False, 9.0, 0.03, False, "its edge lengths differ by 3% between halves of the frames"),
        (False, np.inf, 0.03, False, "its edge lengths differ by 3% between halves of the frames"),
        (False, 9.0, np.inf, False, "its edge lengths differ by more than their length between halves"),
    ],
)
def test_weaker_evidence_needs_halves_that_agree_better(
    clear: bool, ratio: float, share: float, supported: bool, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(surface, "disagreement", lambda search, chosen: share)
    unused: Any = None
    found, why = surface._confirmed(unused, unused, Judgement(ratio, clear, "Taken."))
    assert found is supported
    assert words in why


@pytest.mark.slow
def test_weak_evidence_decides_only_against_a_free_surface_that_differs_and_is_not_good() -> None:
    sheet = rolled(frames=6, side=7)
    accepted = isometric_surface(sheet.tracks, focal=FOCAL, image_size=SIZE)
    weak = replace(accepted, weak=True)
    settings = Settings(prior="smooth", refine_rotations=False, max_reweightings=1)
    free = solve(sheet.tracks, settings=settings)
    alike = replace(free, shapes=sheet.points - sheet.points.mean(axis=1, keepdims=True))
    monitor = Monitor(None, plan=[Stage("finish", 1.0, 1)])
    kept = with_verdict(alike, sheet.tracks, weak, Settings(), monitor, began=0.0)
    assert kept.shapes is alike.shapes
    assert kept.choices.reasons["surface"].startswith("Solved as a free surface, which differs")
    assert kept.choices.focal_lengths == weak.focal_lengths
    assert free.trust is not None
    doubted = replace(free.trust, verdict=Verdict.WITH_CARE)
    flat = replace(alike, shapes=alike.shapes * (1, 1, 0), trust=doubted)
    chosen = with_verdict(flat, sheet.tracks, weak, Settings(), monitor, began=0.0)
    assert one_scale_error(chosen.shapes, sheet.points) < 0.015
    assert chosen.choices.reasons["surface"].startswith("Taken as an isometric sheet")
    assert chosen.trust is not None
    assert chosen.trust.verdict is Verdict.WITH_CARE
    assert "Solve with surface=free, too, and look at both from the side" in chosen.trust.reasons[0]
    good = replace(flat, trust=replace(doubted, verdict=Verdict.GOOD))
    kept = with_verdict(good, sheet.tracks, weak, Settings(), monitor, began=0.0)
    assert kept.shapes is good.shapes
    assert kept.choices.reasons["surface"].startswith("Solved as a free surface, whose verdict is good. The evidence")


def test_a_stretched_surface_starts_again_from_the_conic_program(monkeypatch: pytest.MonkeyPatch) -> None:
    search = search_of(rolled(frames=5, side=6).tracks)
    conic = maximum_depth(search.solved(FOCAL))
    assert conic is not None
    beside = tried_at(search, 1.2 * FOCAL, None)
    assert beside is not None
    starts: list[NDArray[np.float64]] = []

    def stretched_at_first(graph: SurfaceGraph, depths: NDArray[np.float64], **options: object) -> Isometry:
        starts.append(depths)
        return Isometry(stretched(depths) if len(starts) == 1 else depths, beside.found.lengths, 0.0)

    monkeypatch.setattr(focal_sweep, "refine_with_restarts", stretched_at_first)
    found = tried_at(search, FOCAL, beside)
    assert found is not None
    first, again = starts
    np.testing.assert_allclose(again, conic, rtol=1e-12)
    np.testing.assert_array_equal(found.found.depths, again)
    assert not np.array_equal(first, again)


def stretched(depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return depths in the same order whose differences are far larger than distances across the viewing rays."""
    return depths**40 / depths.max() ** 39


def test_surfaces_stretched_along_the_rays_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    search = search_of(rolled(frames=4, side=5).tracks)
    first = tried_at(search, FOCAL, None)
    assert first is not None
    assert tried_at(search, 1.1 * FOCAL, first) is not None

    def always(graph: SurfaceGraph, depths: NDArray[np.float64], **options: object) -> Isometry:
        return Isometry(stretched(depths), first.found.lengths, 0.0)

    monkeypatch.setattr(focal_sweep, "refine_with_restarts", always)
    assert tried_at(search, 1.1 * FOCAL, first) is None


@pytest.mark.parametrize(("tilt", "drawn_out"), [(0.0, False), (60.0, False), (89.9, False), (0.0, True)])
def test_no_plane_is_stretched_however_it_is_tilted(tilt: float, drawn_out: bool) -> None:
    """Edges in all directions in a plane that is seen from its edge have half of their squared lengths in depth, and more if drawn out."""
    angles = 2 * np.pi * np.arange(12) / 12
    wheel = np.concatenate([np.zeros((1, 2)), np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    turn = np.radians(tilt)
    points = np.stack([wheel[:, 0], np.cos(turn) * wheel[:, 1], 1000 + np.sin(turn) * wheel[:, 1]], axis=1)
    if drawn_out:  # by a tenth along the viewing rays
        points = np.stack([wheel[:, 0], 0 * wheel[:, 1], 1000 + 1.1 * wheel[:, 1]], axis=1)
    edges = np.array([(0, rim) for rim in range(1, 13)])
    graph = SurfaceGraph((points / points[:, 2:])[None], np.ones((1, 13)), edges)
    found = Isometry(points[None, :, 2], np.ones(12), 0.0)
    assert focal_sweep._stretched(graph, found) is drawn_out


def test_fewer_than_two_frames_per_half_confirm_nothing() -> None:
    search = search_of(rolled(frames=4).tracks)
    chosen = tried_at(search, FOCAL, None)
    assert chosen is not None
    assert disagreement(replace(search, frames=search.frames[:3]), chosen) == np.inf


def test_lengths_are_compared_up_to_their_unit() -> None:
    lengths = np.array([1.0, 2.0, 3.0, 0.0])
    assert unlike(5 * lengths, lengths) == pytest.approx(0)
    assert unlike(np.array([1.0, 2.0, 4.5, 9.0]), lengths) == pytest.approx(1.5 / 6)
    assert unlike(np.zeros(4), lengths) == np.inf
