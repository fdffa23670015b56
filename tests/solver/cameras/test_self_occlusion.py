"""A solid body that turns and hides parts of itself, seen from nearby."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import Settings, Tracks, solve
from pliant.solver.evaluation.metrics import e3d_frame_scaled
from pliant.solver.records import Floats
from pliant.solver.tracks.completion import briefly_hidden, often_visible

PICTURE = (1280.0, 720.0)
FOCAL = 1200.0


def body(frames: int = 24, points: int = 300, turn: float = 50.0) -> tuple[Floats, Floats, np.ndarray]:
    """Return the images `(F, P, 2)` and camera coordinates `(F, P, 3)` of an uneven ellipsoid, and which points it hides.

    The largest coordinate is 300, the distance 1,200.
    """
    index = np.arange(points) + 0.5
    polar, round_ = np.arccos(1 - 2 * index / points), np.pi * (1 + 5**0.5) * index
    normal = np.stack([np.cos(round_) * np.sin(polar), np.sin(round_) * np.sin(polar), np.cos(polar)], axis=1)
    radii = np.array([0.75, 1.0, 0.8])
    shape = normal * radii * (1 + 0.12 * np.sin(5 * normal[:, :1]) * np.cos(4 * normal[:, 1:2]))
    outward = normal / radii
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    time = np.linspace(0, 1, frames)
    yaw, pitch = np.radians(turn) * (time - 0.5), np.radians(12) * np.sin(2 * np.pi * time)
    zero, one = np.zeros(frames), np.ones(frames)
    about_y = np.array([[np.cos(yaw), zero, np.sin(yaw)], [zero, one, zero], [-np.sin(yaw), zero, np.cos(yaw)]])
    about_x = np.array([[one, zero, zero], [zero, np.cos(pitch), -np.sin(pitch)], [zero, np.sin(pitch), np.cos(pitch)]])
    rotations = np.diag([1.0, -1.0, -1.0]) @ about_x.transpose(2, 0, 1) @ about_y.transpose(2, 0, 1)
    placed = np.einsum("fij,pj->fpi", rotations, shape)
    placed *= 300 / np.abs(placed).max()
    seen_from = placed + np.array([0.0, 0.0, FOCAL])
    images = (np.array(PICTURE) - 1) / 2 + FOCAL * seen_from[..., :2] / seen_from[..., 2:]
    facing = -np.einsum("fij,pj,fpi->fp", rotations, outward, seen_from) / np.linalg.norm(seen_from, axis=2)
    return images, placed, facing > 0.15


@pytest.mark.slow
def test_the_focal_length_does_not_depend_on_the_points_that_the_body_hides() -> None:
    images, placed, visible = body(points=150)
    kept = visible.sum(axis=0) >= 3
    assert 0.2 < 1 - visible[:, kept].mean() < 0.4
    images = images + np.random.default_rng(1).normal(scale=0.1, size=images.shape)
    found = solve(Tracks.from_arrays(images[:, kept], visible[:, kept]), settings=Settings(image_size=PICTURE))
    assert found.camera.focal == pytest.approx(FOCAL, rel=0.04)
    assert e3d_frame_scaled(found.shapes, placed[:, kept]) < 0.012


def test_points_are_learned_from_if_half_of_the_frames_show_them() -> None:
    visible = np.zeros((10, 4))
    visible[:, 0], visible[:5, 1], visible[5:, 2], visible[:4, 3] = 1, 0.5, 1, 1
    assert often_visible(visible).tolist() == [True, True, True, False]


def test_short_tracks_keep_half_of_the_points_of_every_frame() -> None:
    random = np.random.default_rng(0)
    visible = np.zeros((100, 60))
    for column in visible.T:
        first = random.integers(0, 90)
        column[first : first + random.integers(3, 30)] = 1
    often = often_visible(visible)
    shown = (visible > 0).sum(axis=1)
    assert ((visible > 0)[:, often].sum(axis=1) >= shown / 2).all()
    assert not often.all()
    assert often_visible(np.ones((5, 6))).all()
    assert not often_visible(np.zeros((5, 6))).any()


def test_perspective_is_looked_for_in_points_that_are_never_hidden_for_long() -> None:
    visible = np.ones((40, 12))
    visible[::2, 1] = 0.0  # every second frame: completion interpolates it well
    visible[10:14, 2] = 0.0
    visible[10:15, 3] = 0.0
    visible[:5, 4] = 0.0  # it begins late
    visible[35:, 5] = 0.0
    visible[:, 6] = 0.0
    visible[:, 7] *= 0.3
    assert np.flatnonzero(~briefly_hidden(visible)).tolist() == [3, 4, 5, 6]


def test_if_most_points_are_hidden_for_long_half_of_every_frame_is_used() -> None:
    random = np.random.default_rng(0)
    visible = np.zeros((100, 60))
    for column in visible.T:
        first = random.integers(0, 90)
        column[first : first + random.integers(3, 30)] = 1
    used, shown = briefly_hidden(visible), (visible > 0).sum(axis=1)
    assert ((visible > 0)[:, used].sum(axis=1) >= shown / 2).all()
    assert not used.all()
    assert briefly_hidden(np.ones((5, 6))).all()
    assert not briefly_hidden(np.zeros((5, 6))).any()
