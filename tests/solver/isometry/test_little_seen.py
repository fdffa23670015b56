"""Isometric surfaces that are sparsely observed in some or all frames, and stopped solves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver import Outcome, Settings, Tracks, gallery, solve
from pliant.solver.isometry import refinement, surface
from pliant.solver.isometry.anchors import nearest_neighbours
from pliant.solver.isometry.extension import complete_anchors
from pliant.solver.isometry.inextensible import SurfaceGraph
from rolled_sheets import CENTRE, FOCAL, SIZE, one_scale_error, rolled

GIVEN = Settings(surface="isometric", focal=FOCAL, image_size=SIZE, order="film")


@pytest.mark.parametrize(
    "shown",
    [
        range(7),
        pytest.param(range(8), marks=pytest.mark.long),
        pytest.param(range(0, 49, 8), marks=[pytest.mark.slow, pytest.mark.long]),
    ],
    ids=["row", "row and one", "diagonal"],
)
@pytest.mark.slow
def test_a_frame_that_shows_only_a_line_takes_the_shape_of_the_nearest_frame(shown: range) -> None:
    sheet = rolled(frames=6, side=7)
    visible = np.ones(sheet.tracks.visible.shape)
    visible[2] = np.isin(np.arange(49), shown)
    found = solve(Tracks.from_arrays(sheet.tracks.points, visible), settings=GIVEN)
    others = [0, 1, 3, 4, 5]
    assert one_scale_error(found.shapes[others], sheet.points[others]) < 0.03
    assert one_scale_error(found.shapes, sheet.points) < 0.05
    assert any(warning.startswith("1 of 6 frames show too little") for warning in found.choices.warnings)
    assert found.trust is not None
    assert found.trust.reasons == found.choices.warnings


@pytest.mark.parametrize(
    "shown", [pytest.param(0, marks=pytest.mark.slow), pytest.param(5, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_a_sparsely_observed_frame_is_filled_in_without_degrading_others(shown: int) -> None:
    sheet = rolled(frames=6, side=7)
    visible = np.ones(sheet.tracks.visible.shape)
    visible[2, shown:] = 0
    found = solve(Tracks.from_arrays(sheet.tracks.points, visible), settings=GIVEN)
    others = [0, 1, 3, 4, 5]
    assert one_scale_error(found.shapes[others], sheet.points[others]) < 0.03
    assert 0.5 < np.ptp(found.shapes[2]) / np.ptp(found.shapes[others]) < 1.5
    assert np.abs(np.log(found.camera.scales)).max() < 0.5
    assert any(warning.startswith("1 of 6 frames show too little") for warning in found.choices.warnings)


def test_nothing_is_filled_in_if_no_frame_shows_enough() -> None:
    points, seen = np.zeros((3, 7, 3)), np.zeros((3, 7), dtype=bool)
    filled, enough = complete_anchors(points, seen, np.random.default_rng(0).normal(size=(7, 2)))
    assert not enough.any()
    assert (filled == points).all()


@pytest.mark.slow
def test_a_body_none_of_whose_frames_show_enough_of_a_sheet_is_rejected() -> None:
    verdict = surface.isometric_surface(gallery.sphere(10, 60).tracks, focal=600.0, required=True)
    assert verdict.surface is None
    assert verdict.reason.startswith("No isometric surface was found")


@pytest.mark.parametrize("required", [False, True])
def test_points_rarely_seen_together_are_not_taken_as_a_sheet(required: bool) -> None:
    flag, random = gallery.flag(30, 600), np.random.default_rng(0)
    visible = np.zeros((30, 600))
    for point in range(600):
        visible[random.choice(30, 4, replace=False), point] = 1
    sparse = Tracks.from_arrays(flag.tracks.points, visible)
    assert surface.isometric_surface(sparse, image_size=SIZE, required=required).reason == surface.TOO_LITTLE


@pytest.mark.slow
@pytest.mark.long
def test_copies_of_points_give_finite_noise_and_probabilities() -> None:
    sheet = rolled(frames=6, side=5)
    found = solve(Tracks.from_arrays(np.repeat(sheet.tracks.points, 14, axis=1)), settings=GIVEN)
    assert np.isfinite(found.choices.noise)
    assert np.isfinite(found.inlier_probability).all()


@pytest.mark.slow
@pytest.mark.long
def test_a_stop_while_the_surface_is_refined_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    refining, everywhere = [], surface._everywhere
    monkeypatch.setattr(surface, "_everywhere", lambda *given: refining.append(True) or everywhere(*given))
    found = solve(rolled(frames=6, side=7).tracks, settings=GIVEN, should_stop=lambda: bool(refining))
    assert found.choices.camera == "perspective"
    assert found.outcome is Outcome.STOPPED


def test_a_stop_before_surface_refinement_is_reported() -> None:
    sheet = rolled(frames=6, side=7)
    verdict = surface.isometric_surface(
        sheet.tracks, focal=FOCAL, image_size=SIZE, required=True, should_stop=lambda: True
    )
    assert verdict.reason.startswith("Stopped before")


def test_frames_of_the_search_that_show_too_little_are_replaced_for_the_standard_deviations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searches, search, complete = [], surface._search, surface.complete_anchors

    def noted(*given: Any) -> Any:
        searches.append(search(*given))
        return searches[-1]

    def others_only(*given: Any) -> Any:
        filled, enough = complete(*given)
        return filled, enough & ~np.isin(np.arange(len(enough)), searches[-1].frames)

    monkeypatch.setattr(surface, "_search", noted)
    monkeypatch.setattr(surface, "complete_anchors", others_only)
    found = surface.isometric_surface(
        rolled(frames=28, side=6).tracks, focal=FOCAL, image_size=SIZE, required=True
    ).surface
    assert found is not None
    assert found.shown.sum() == 28 - surface.SOLVED_FRAMES
    assert np.isfinite(found.deviations).all()


def test_steps_to_depths_that_cannot_be_represented_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    sheet = rolled(frames=4, side=5)
    images = (sheet.tracks.points - np.array(CENTRE)) / FOCAL
    rays = np.concatenate([images, np.ones((4, 25, 1))], axis=2)
    graph = SurfaceGraph(rays, np.ones((4, 25)), nearest_neighbours(images, np.ones((4, 25)) > 0))
    begun = sheet.points[..., 2] * np.exp(np.random.default_rng(0).normal(0, 0.01, (4, 25)))
    monkeypatch.setattr(
        refinement, "gauss_newton_step", lambda graph, normal, gradient, damping: 1000 * np.sign(gradient)
    )
    np.testing.assert_allclose(refinement.refine(graph, begun).depths, begun, rtol=1e-12)
