"""How close images are to those of a plane."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import Settings, Tracks, solve
from pliant.solver.isometry import confirmation, surface
from pliant.solver.isometry.confirmation import deformation
from pliant.solver.isometry.homographies import FEWEST_COMMON, off_homography, unlike_homography
from pliant.solver.isometry.surface import isometric_surface, sheetlike
from pliant.solver.model.so3 import exponential
from rolled_sheets import CENTRE, SIZE, one_scale_error, rolled

from benchmarks.sequences import rolled_sheet


def off_plane(points: np.ndarray) -> float:
    return off_homography(points, np.ones(points.shape[:2], dtype=bool))


def pictures(shape: np.ndarray, turns: np.ndarray, distance: float) -> np.ndarray:
    """Images `(F, P, 2)` of a rigid shape `(P, 3)` of size 1 that turns in front of a pinhole camera."""
    placed = shape @ exponential(turns).transpose(0, 2, 1) + [0, 0, distance]
    return placed[..., :2] / placed[..., 2:]


def turns(degrees: float) -> np.ndarray:
    return np.radians(np.linspace(-degrees, degrees, 6))[:, None] * [0.3, 1.0, 0.1]


@pytest.mark.parametrize("distance", [1.8, 50.0])
def test_images_of_a_plane_are_homographies_at_any_distance(distance: float) -> None:
    plane = np.hstack([np.random.default_rng(0).uniform(-1, 1, (30, 2)), np.zeros((30, 1))])
    assert off_plane(pictures(plane, turns(35), distance)) < 1e-9


def test_a_solid_deviates_from_homographies_with_its_depth() -> None:
    random = np.random.default_rng(0)
    flat = random.uniform(-1, 1, (40, 2))
    off = [
        off_plane(pictures(np.hstack([flat, depth * random.normal(size=(40, 1))]), turns(20), 10.0))
        for depth in (0.01, 0.1, 0.5)
    ]
    assert 1e-4 < off[0] < 0.3 * off[1] < 0.3 * off[2]
    assert off[2] > 0.06


def test_frames_with_too_few_common_points_are_ignored() -> None:
    plane = np.hstack([np.random.default_rng(0).uniform(-1, 1, (30, 2)), np.zeros((30, 1))])
    points = pictures(plane, turns(20), 5.0)
    points[5] = np.random.default_rng(1).normal(size=(30, 2))
    seen = np.ones((6, 30), dtype=bool)
    seen[5, FEWEST_COMMON - 1 :] = False
    assert off_homography(points, seen) < 1e-9
    seen[:, FEWEST_COMMON - 1 :] = False
    assert off_homography(points, seen) == np.inf


def test_coincident_points_are_neither_planar_nor_an_error() -> None:
    assert unlike_homography(np.zeros((9, 2)), np.random.default_rng(0).normal(size=(9, 2))) > 0.1


@pytest.mark.slow
def test_a_sheet_near_the_camera_is_solved_as_isometric() -> None:
    sheet = rolled_sheet(6, bend=(0.2, 0.8))  # its third singular value is .22 of the second
    found = solve(sheet.tracks, settings=Settings(image_size=SIZE))
    assert found.choices.reasons["surface"].startswith("Taken as an isometric sheet")
    assert found.camera.focal == pytest.approx(600, rel=0.03)
    assert one_scale_error(found.shapes @ found.camera.rotations.transpose(0, 2, 1), sheet.shapes) < 0.01


def test_isometry_is_not_tested_for_a_solid_body() -> None:
    body = np.random.default_rng(0).normal(size=(60, 3)) * 0.4
    verdict = isometric_surface(Tracks.from_arrays(500 * pictures(body, turns(45), 4.0)), image_size=SIZE)
    assert verdict.surface is None
    assert verdict.reason.startswith("Isometry was not tested: the pictures differ from those of a plane by")


@pytest.mark.slow
def test_a_rigid_solid_is_not_a_sheet_although_it_preserves_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    across = np.stack(np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-1, 1, 6)), axis=2).reshape(-1, 2)
    dome = np.column_stack([across, 0.25 * np.exp(-2 * np.square(across).sum(axis=1))])
    tracks = Tracks.from_arrays(500 * pictures(dome, turns(25), 4.0) + CENTRE)
    for focal in (500.0, None):
        with monkeypatch.context() as patched:  # found before the costly steps
            patched.setattr(surface, "disagreement", None)
            patched.setattr(surface, "_everywhere", None)
            verdict = isometric_surface(tracks, focal=focal, image_size=SIZE)
        assert verdict.surface is None
        assert "as those of a rigid solid do" in verdict.reason
    assert isometric_surface(tracks, focal=500.0, image_size=SIZE, required=True).surface is not None


@pytest.mark.slow
def test_a_sheet_whose_bending_is_unknown_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks = rolled_sheet(8, bend=(0.2, 0.8)).tracks
    assert isometric_surface(tracks, image_size=SIZE).surface is not None
    monkeypatch.setattr(surface, "bending_of", lambda search, tried: None)
    verdict = isometric_surface(tracks, image_size=SIZE)
    assert verdict.surface is None
    assert verdict.reason == surface.TOO_LITTLE
    assert isometric_surface(tracks, image_size=SIZE, required=True).surface is not None


@pytest.mark.slow
@pytest.mark.long
def test_a_long_film_is_compared_at_a_fixed_number_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []

    def off(points: np.ndarray, seen: np.ndarray) -> float:
        compared.append(len(seen))
        return off_homography(points, seen)

    monkeypatch.setattr(surface, "off_homography", off)
    monkeypatch.setattr(confirmation, "off_homography", off)
    verdict = isometric_surface(rolled_sheet(40, bend=(0.2, 0.8)).tracks, image_size=SIZE)
    assert verdict.surface is not None
    assert compared == [surface.SOLVED_FRAMES] * 3  # of the first test, at the first focal length and at the best


def test_deformation_is_the_distance_from_one_rigid_shape() -> None:
    random = np.random.default_rng(0)
    shape = random.normal(size=(50, 3))
    shape -= shape.mean(axis=0)
    moved = shape @ exponential(random.normal(size=(7, 3))).transpose(0, 2, 1) + random.normal(size=(7, 1, 3))
    assert deformation(moved) < 1e-9
    size = np.sqrt(np.square(shape).sum() / 50)
    noisy = moved + 0.01 * size / np.sqrt(3) * random.normal(size=moved.shape)
    assert deformation(noisy) == pytest.approx(0.01 * np.sqrt(6 / 7), rel=0.1)


def test_pictures_like_those_of_a_plane_are_recognised_without_a_lens() -> None:
    sheet = rolled_sheet(6)
    solid = np.random.default_rng(0).normal(size=(60, 3)) * 0.4
    assert 0 < (sheetlike(sheet.tracks) or 0) < surface.SHEETLIKE
    assert sheetlike(Tracks.from_arrays(500 * pictures(solid, turns(30), 4.0))) is None
    assert sheetlike(Tracks.from_arrays(sheet.tracks.points[:, :5])) is None  # too few to say


@pytest.mark.slow
def test_a_poor_result_for_a_sheet_without_a_lens_asks_for_the_image_size() -> None:
    sheet = rolled(frames=5, side=6)
    found = solve(sheet.tracks, settings=Settings(basis_size=1))
    assert found.trust is not None
    assert found.trust.verdict != "good"
    assert found.choices.reasons["surface"].startswith("Isometry was not tested, because neither image_size nor focal")
    assert any("Give image_size or focal" in warning for warning in found.choices.warnings)
    free = solve(sheet.tracks, settings=Settings(basis_size=1, surface="free"))
    assert "surface" not in free.choices.reasons
    assert np.array_equal(free.shapes, found.shapes)
