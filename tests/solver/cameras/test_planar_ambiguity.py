"""Planar (Necker) ambiguity: both poses of a plane, and the choice of pose signs for thin sheets."""

from __future__ import annotations

import numpy as np
import pytest
from camera_errors import degrees_apart
from pliant.solver import Settings, Tracks, gallery, solve
from pliant.solver.cameras import estimation
from pliant.solver.cameras.estimation import estimate_cameras, with_other_cameras
from pliant.solver.cameras.planar_ambiguity import (
    fitted,
    is_planar,
    on_one_line,
    poses,
    resolve_pose_signs,
    reversed_at,
    smoothest_signs,
)
from pliant.solver.evaluation import metrics
from pliant.solver.model.so3 import MIRROR, angles_between, exponential
from pliant.solver.tracks.completion import complete
from pliant.solver.tracks.normalization import normalize

PLANE = np.random.default_rng(4).uniform(-1, 1, (80, 3)) * [1.0, 0.7, 0.0]


def swaying(frames: int, degrees: float = 35.0) -> np.ndarray:
    """A camera that sways in front of the plane, past the frontal view, and nods."""
    time = np.linspace(0, 2 * np.pi, frames)
    return exponential(np.radians(degrees) * np.stack([0.5 * np.sin(2 * time), np.cos(time), 0.1 * time], axis=1))


def gram_of_view(shapes: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    points = np.einsum("fij,fpj->fip", rotations[:, :2], np.broadcast_to(shapes, (len(rotations), *shapes.shape[-2:])))
    rows = (points - points.mean(axis=2, keepdims=True)).reshape(2 * len(rotations), -1)
    return rows @ rows.T / (rows**2).mean() / rows.shape[1]


def test_a_reversed_plane_looks_the_same() -> None:
    rotations, pose_signs = swaying(12), np.arange(12) % 3 == 0
    turned = reversed_at(rotations, MIRROR, pose_signs)
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (12, 3, 3)), atol=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1.0)
    np.testing.assert_allclose(gram_of_view(PLANE, turned), gram_of_view(PLANE, rotations), atol=1e-12)
    assert np.degrees(angles_between(turned, rotations))[pose_signs].min() > 5
    assert (turned[~pose_signs] == rotations[~pose_signs]).all()


def test_the_poses_of_a_plane_are_exact_up_to_their_signs() -> None:
    camera = swaying(40)
    found, scales = poses(gram_of_view(PLANE, camera))
    np.testing.assert_allclose(scales, 1.0, atol=5e-3)
    tilt, truth = np.degrees(np.arccos(np.abs(found[:, 2, 2]))), np.degrees(np.arccos(np.abs(camera[:, 2, 2])))
    assert np.abs(tilt - truth).max() < 3
    assert degrees_apart(reversed_at(found, MIRROR, smoothest_signs(found, 2)), camera) < 2
    mixed = reversed_at(found, MIRROR, smoothest_signs(found, 2) ^ (np.arange(40) > 20))
    assert degrees_apart(mixed, camera) > 8


def test_the_smoothest_pose_signs_are_those_of_a_smooth_camera() -> None:
    spin = exponential(np.linspace(-0.6, 0.6, 30)[:, None] * np.array([0.1, 1.0, 0.0]))
    wrong = np.random.default_rng(0).random(30) < 0.4
    assert len({*(smoothest_signs(reversed_at(spin, MIRROR, wrong), 2) ^ wrong)}) == 1
    # in the frontal view, both signs need the same rotation: order 1 cannot decide
    least = reversed_at(spin, MIRROR, smoothest_signs(reversed_at(spin, MIRROR, wrong), 1) ^ wrong)
    assert angles_between(least[1:], least[:-1]).max() < 1.01 * angles_between(spin[1:], spin[:-1]).max()


def test_only_sheets_are_detected_as_planar() -> None:
    flat, solid = gallery.flag(12, 150), gallery.face(12, 150)
    assert is_planar(complete(normalize(flat.tracks)).gram)
    assert not is_planar(complete(normalize(solid.tracks)).gram)
    assert not is_planar(complete(normalize(gallery.sphere(12, 150).tracks)).gram)


@pytest.mark.parametrize("noise", [1e-16, 1e-6])
def test_collinear_points_are_planar_at_any_residual_noise(noise: float) -> None:
    assert is_planar(np.ones((6, 6)) + noise * np.diag([0.0, 5.0, 4.0, 3.0, 2.0, 1.0]))
    assert not is_planar(np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
    assert not is_planar(np.zeros((0, 0)))


def test_points_collinear_in_most_frames_are_detected() -> None:
    along, angle = np.linspace(-1, 1, 9)[None, :], np.linspace(0, 3, 7)[:, None]
    points = 300 + 100 * np.stack([along * np.cos(angle), along * np.sin(angle)], axis=2)
    visible = np.ones((7, 9))
    assert on_one_line(Tracks.from_arrays(points, visible))
    visible[:2, 2:] = 0  # frames that show too few points do not count
    points[2:4] = np.random.default_rng(0).normal(size=(2, 9, 2))
    assert on_one_line(Tracks.from_arrays(points, visible))
    points[4] = points[2]
    assert not on_one_line(Tracks.from_arrays(points, visible))
    assert not on_one_line(Tracks.from_arrays(points, np.eye(7, 9)))
    assert not on_one_line(gallery.flag(12, 150).tracks)


@pytest.fixture(scope="module")
def flag() -> gallery.Sequence:
    return gallery.flag(24, 300)


@pytest.mark.long
@pytest.mark.slow
def test_the_pose_signs_of_a_flag_are_found(flag: gallery.Sequence) -> None:
    # without the sheet's own search the cameras are 23° off, and the shapes .34
    found = solve(flag.tracks)
    assert degrees_apart(found.camera.rotations, np.asarray(flag.rotations)) < 10
    assert 0.05 < metrics.e3d_frame(found.shapes, flag.shapes) < 0.17
    assert "other pose signs are more probable" in found.choices.reasons["rotations"]


def test_the_reason_states_whether_pose_signs_were_kept(flag: gallery.Sequence) -> None:
    gram, truth = complete(normalize(flag.tracks)).gram, np.asarray(flag.rotations)
    best = fitted(gram, truth, np.ones(24), iterations=400)
    kept, _, sentence = resolve_pose_signs(gram, best.rotations, should_stop=lambda: True)
    assert ("are unchanged" in sentence) == (kept is best.rotations)


@pytest.mark.slow
def test_pose_signs_of_a_long_sequence_are_found_on_a_subset_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.solver.cameras.planar_ambiguity.PLANAR_FRAMES", 20)
    long = gallery.flag(50, 200, degrees=40)
    gram = complete(normalize(long.tracks)).gram
    found, _, _ = resolve_pose_signs(gram, np.broadcast_to(np.eye(3), (50, 3, 3)))
    assert found.shape == (50, 3, 3)
    steps = np.degrees(angles_between(found[1:], found[:-1]))
    assert steps.max() < 20


@pytest.mark.long
@pytest.mark.slow
def test_more_probable_reversed_poses_are_offered_as_an_alternative() -> None:
    small = gallery.flag(16, 100)
    found = estimate_cameras(normalize(small.tracks), Settings())
    assert "unchanged. Cameras with some poses reversed" in found.reasons["rotations"]
    (alternative,) = found.hypotheses
    assert (
        "With the shapes, reversed poses of some frames lead"
        in with_other_cameras(found, alternative).reasons["basis_size"]
    )
    given, other = (fitted(found.gram, each.rotations, np.ones(16)).energy for each in (found, alternative))
    assert other < given - 0.1
    solution = solve(small.tracks)  # with the given cameras the error is .52
    assert metrics.e3d_frame(solution.shapes, small.shapes) < 0.2


def test_a_stop_keeps_the_given_cameras(flag: gallery.Sequence) -> None:
    gram = complete(normalize(flag.tracks)).gram
    given = np.broadcast_to(np.eye(3), (24, 3, 3))
    kept, none, sentence = resolve_pose_signs(gram, given, should_stop=lambda: True)
    assert kept is given
    assert none is None
    assert "are unchanged" in sentence


@pytest.mark.slow
def test_the_orthographic_setting_keeps_unit_scales() -> None:
    tracks = gallery.flag(10, 100).tracks
    assert (solve(tracks, settings=Settings(camera="orthographic")).camera.scales == 1).all()


@pytest.mark.long
@pytest.mark.slow
def test_cameras_of_a_sheet_with_outliers_are_not_refined_jointly() -> None:
    """The values that replace outliers are enough to flip the pose of a sheet."""
    film = gallery.flag(24, 300)
    spoiled = gallery.corrupt(film, outliers=0.05, hidden=0.2, noise=0.01, seed=0).tracks
    found, clean = solve(spoiled, film.mesh), solve(film.tracks, film.mesh)
    assert "Then refined together" not in found.choices.reasons["rotations"]
    assert "Then refined together" in clean.choices.reasons["rotations"]
    assert metrics.e3d_frame(found.shapes, film.shapes) < 0.3


def test_an_object_whose_poses_a_plane_does_not_change_is_treated_like_any_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracks = normalize(gallery.face(8, 60).tracks)
    usual = estimate_cameras(tracks, Settings())
    monkeypatch.setattr(estimation, "is_planar", lambda gram: True)
    monkeypatch.setattr(estimation, "resolve_pose_signs", lambda gram, rotations, **how: (rotations, None, "Kept."))
    kept = estimate_cameras(tracks, Settings())
    np.testing.assert_array_equal(kept.rotations, usual.rotations)
    assert len(kept.candidates) == len(usual.candidates) > 0
    assert len(kept.hypotheses) == len(usual.hypotheses)
    mirrored = MIRROR @ usual.rotations @ MIRROR
    monkeypatch.setattr(estimation, "resolve_pose_signs", lambda gram, rotations, **how: (mirrored, None, "Changed."))
    changed = estimate_cameras(tracks, Settings())
    assert changed.rotations is mirrored
    assert not changed.candidates
    assert not changed.hypotheses
