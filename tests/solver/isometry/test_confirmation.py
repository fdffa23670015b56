"""Two halves of the frames must agree on the edge lengths: they do for a real sheet, but not for wrong depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import Tracks, gallery
from pliant.solver.isometry import surface
from pliant.solver.isometry.confirmation import DISAGREEMENT, disagreement, unlike
from pliant.solver.isometry.focal_sweep import FocalSearch, Tried, tried_at
from pliant.solver.isometry.refinement import refine
from pliant.solver.isometry.surface import isometric_surface
from rolled_sheets import CENTRE, FOCAL, SIZE, rolled


def search_of(tracks: Tracks) -> FocalSearch:
    found = surface._prepared(tracks.points, tracks.visible > 0, np.array(CENTRE), None)
    assert found is not None
    return found


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
    chosen = Tried(focal, refine(search.graph(focal, search.frames), stretched, iterations=60))
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
    required = isometric_surface(tracks, focal=FOCAL, image_size=SIZE, required=True)
    assert required.surface is not None
    assert required.reason == f"Solved as an isometric sheet, as set, although {why}."
    assert any("hardly support" in warning for warning in required.warnings)


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
