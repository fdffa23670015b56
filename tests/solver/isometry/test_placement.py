"""Positions of points on the template of a surface, from their tracks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pliant.solver.isometry.placement import TemplateMap, places_of
from pliant.solver.isometry.splines import spline

CENTRE = np.array([320.0, 240.0])


def grid(columns: int, rows: int) -> NDArray[np.float64]:
    across, down = np.meshgrid(np.linspace(-1.6, 1.6, columns), np.linspace(-0.8, 0.8, rows))
    return np.column_stack([across.ravel(), down.ravel()])


def rolled_map(frames: int = 12) -> TemplateMap:
    """Return the map of a sheet rolled to almost a half circle, which turns until its images cover themselves."""
    flat, bend = grid(11, 6), 1.9
    shape = np.column_stack([np.sin(bend * flat[:, 0]) / bend, flat[:, 1], (1 - np.cos(bend * flat[:, 0])) / bend])
    anchors = []
    for angle in np.linspace(-1.2, 1.2, frames):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        anchors.append(shape @ turn.T + [0, 0, 6])
    return TemplateMap.of(flat, np.stack(anchors), 600.0, CENTRE)


def seen_by(surface: TemplateMap, places: NDArray[np.float64]) -> NDArray[np.float64]:
    return surface.image(surface.space(places))


def test_images_move_as_their_derivatives_say() -> None:
    surface, places = rolled_map(4), np.random.default_rng(0).uniform(-1, 1, (9, 2))
    image, along = surface.moved_image(places)
    np.testing.assert_allclose(image, seen_by(surface, places))
    for axis in range(2):
        step = 1e-5 * np.eye(2)[axis]
        numeric = (seen_by(surface, places + step) - seen_by(surface, places - step)) / 2e-5
        np.testing.assert_allclose(along[axis], numeric, rtol=1e-5, atol=1e-4)


def test_derivatives_exist_at_the_anchors() -> None:
    surface = rolled_map(3)
    assert np.isfinite(surface.moved_image(surface.template)[1]).all()


@pytest.mark.parametrize(("noise", "outliers", "limit"), [(0.0, 0.0, 1e-3), (0.3, 0.0, 0.02), (0.3, 0.25, 0.02)])
def test_points_of_a_sheet_that_covers_itself_are_placed(noise: float, outliers: float, limit: float) -> None:
    surface, random = rolled_map(), np.random.default_rng(3)
    places = random.uniform([-1.5, -0.75], [1.5, 0.75], (300, 2))
    exact = seen_by(surface, places)
    tracks = exact + noise * random.normal(size=exact.shape)
    wrong = random.random(exact.shape[:2]) < outliers
    tracks[wrong] += random.uniform(-150, 150, (int(wrong.sum()), 2))
    sure = (random.random(exact.shape[:2]) > 0.1).astype(np.float64)
    found = places_of(surface, tracks, sure, seen_by(surface, surface.template), np.ones((12, 66), dtype=bool))
    far = np.linalg.norm(found - places, axis=1)
    assert np.quantile(far, 0.99) < limit
    # In this picture a point cannot be found from its image alone: another part of the sheet is nearer to it in some frames.
    apart = np.linalg.norm(exact[:, :, None] - exact[:, None], axis=3)
    distant = np.linalg.norm(places[:, None] - places, axis=2) > 1
    assert ((apart < 3) & distant).any()


def test_weak_observations_hardly_count() -> None:
    surface, random = rolled_map(), np.random.default_rng(3)
    places = random.uniform([-1.5, -0.75], [1.5, 0.75], (100, 2))
    tracks, sure = seen_by(surface, places), np.ones((12, 100))
    sure[::2], tracks[::2] = 0.01, tracks[::2] + random.normal(0, 5, (6, 100, 2))
    found = places_of(surface, tracks, sure, seen_by(surface, surface.template), np.ones((12, 66), dtype=bool))
    assert np.linalg.norm(found - places, axis=1).max() < 5e-3


def test_points_that_no_frame_shows_or_far_outside_are_not_placed() -> None:
    surface = rolled_map()
    places = np.array([[0.1, 0.2], [0.3, -0.1], [0.5, 0.5]])
    tracks, sure = seen_by(surface, places), np.ones((12, 3))
    sure[:, 1] = 0.0
    tracks[:, 2] += 5_000.0
    found = places_of(surface, tracks, sure, seen_by(surface, surface.template), np.ones((12, 66), dtype=bool))
    np.testing.assert_allclose(found[0], places[0], atol=1e-3)
    assert np.isnan(found[1:]).all()


def test_blocks_of_points_change_no_position(monkeypatch: pytest.MonkeyPatch) -> None:
    surface, random = rolled_map(), np.random.default_rng(5)
    places = random.uniform([-1.5, -0.75], [1.5, 0.75], (40, 2))
    tracks, sure = seen_by(surface, places), np.ones((12, 40))
    images, known = seen_by(surface, surface.template), np.ones((12, 66), dtype=bool)
    whole = places_of(surface, tracks, sure, images, known)
    monkeypatch.setattr("pliant.solver.isometry.placement.CHUNK_OBSERVATIONS", 12 * 7)
    np.testing.assert_allclose(places_of(surface, tracks, sure, images, known), whole, atol=2e-3)


def test_a_spline_reproduces_affine_values() -> None:
    source, target = grid(5, 4), np.random.default_rng(0).uniform(-1, 1, (7, 2))
    values = source @ np.array([[2.0, -1.0], [0.5, 3.0]]) + [4.0, 5.0]
    np.testing.assert_allclose(
        spline(source, values, target), target @ [[2.0, -1.0], [0.5, 3.0]] + [4.0, 5.0], atol=1e-6
    )
