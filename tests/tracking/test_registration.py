"""The registration of a grid of points: accuracy, hidden points, samples, and the normal equations."""

from __future__ import annotations

import cv2
import films
import numpy as np
from pliant.tracking.appearance import noise_variance
from pliant.tracking.registration import HOLD, Registration
from pliant.tracking.seeding import place


def registered(spacing: float | None = None) -> tuple[Registration, np.ndarray, np.ndarray, np.ndarray]:
    """Return a template's registration, a frame of it rotated under other light, the true positions there, and noisy flow."""
    wide = cv2.cvtColor(films.textured_pictures(1, (96, 72))[0], cv2.COLOR_RGB2GRAY)
    turn = cv2.getRotationMatrix2D((48, 36), 6, 1.05)
    frame = np.asarray(cv2.warpAffine(wide, turn, (96, 72), flags=cv2.INTER_CUBIC), np.uint8)
    frame = np.clip(0.8 * frame + 20.0, 0, 255).astype(np.uint8)
    seeds, _ = place(wide, np.pad(np.ones((40, 64), bool), 16), step=4)
    true = seeds.points @ turn[:, :2].T.astype(np.float32) + turn[:, 2].astype(np.float32)
    flowed = true + np.random.default_rng(0).normal(0, 0.3, true.shape).astype(np.float32)
    made = Registration.of(wide, seeds.points, seeds.grid, noise=noise_variance(wide))
    return made if spacing is None else made.coarse(wide, spacing), frame, true, flowed


def test_hidden_points_go_along_with_the_visible_ones_around_them() -> None:
    registration, frame, true, flowed = registered()
    inside = ((true - true.mean(axis=0)) ** 2).sum(axis=1) < 6**2
    off = np.where(inside[:, None], flowed + np.float32([2, 0]), flowed)
    error = np.linalg.norm(registration.spread(frame, off, ~inside) - true, axis=1)
    assert error[inside].max() < 0.5 < 1.5 < np.linalg.norm(off - true, axis=1)[inside].mean()
    assert np.median(error[~inside]) < 0.15
    for visible in (np.zeros(len(off), bool), np.ones(len(off), bool)):
        np.testing.assert_array_equal(registration.spread(frame, off, visible), off)


def test_registration_with_few_samples_ends_near_the_one_with_all() -> None:
    registration, frame, true, flowed = registered(spacing=2)
    assert len(registration.template) == len(registered()[0].template) / 4
    everywhere, before = np.ones(len(true), bool), np.ones(len(true), np.float32)
    found, _ = registration.refine(frame, flowed, before, everywhere)
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.5 * np.median(np.linalg.norm(flowed - true, axis=1))


def test_registration_corrects_the_error_of_the_flow() -> None:
    registration, frame, true, flowed = registered()
    visible, before = np.ones(len(true), bool), np.full(len(true), 0.5, np.float32)
    found, variance = registration.refine(frame, flowed, before, visible)
    error, missed = (np.linalg.norm(points - true, axis=1) for points in (found, flowed))
    assert np.median(error) < 0.25 * np.median(missed)
    assert 1 / 1.7 < np.sqrt(np.median(variance) / (error**2).mean()) < 2
    grain = np.random.default_rng(1).normal(0, 16, frame.shape)
    _, noisy = registration.refine(np.clip(frame + grain, 0, 255).astype(np.uint8), flowed, before, visible)
    assert np.median(noisy) > 4 * np.median(variance)
    hidden, same = registration.refine(frame, flowed, before, ~visible)
    np.testing.assert_array_equal(hidden, flowed)
    np.testing.assert_array_equal(same, before)


def test_registration_leaves_points_on_unrelated_pictures_in_place_with_a_large_variance() -> None:
    registration, _, true, flowed = registered()
    other = cv2.cvtColor(films.textured_pictures(1, (96, 72), seed=5)[0], cv2.COLOR_RGB2GRAY)
    visible, before = np.ones(len(true), bool), np.full(len(true), 0.5, np.float32)
    found, variance = registration.refine(other, flowed, before, visible)
    assert (found == flowed).all(axis=1).mean() > 0.95
    assert np.median(variance) > 4 * before[0]


def test_registration_of_a_frame_with_itself_moves_nothing() -> None:
    wide = cv2.cvtColor(films.textured_pictures(1, (96, 72))[0], cv2.COLOR_RGB2GRAY)
    seeds, _ = place(wide, np.pad(np.ones((40, 64), bool), 16), step=4)
    registration = Registration.of(wide, seeds.points, seeds.grid, noise=noise_variance(wide))
    everywhere = np.ones(len(seeds.points), bool)
    found, variance = registration.refine(wide, seeds.points, np.ones(len(seeds.points), np.float32), everywhere)
    np.testing.assert_allclose(found, seeds.points, atol=1e-3)
    assert variance.max() < 0.01


def test_cells_interpolate_bilinearly_and_affine_motion_has_no_bending() -> None:
    registration, *_ = registered()
    cells, count = registration.cells, len(registration.points)
    corner = registration.points[cells.corners]
    places = cells.places(registration.points)
    inside = places.reshape(len(corner), -1, 2)
    np.testing.assert_allclose(inside.mean(axis=1), corner.mean(axis=1), rtol=1e-5)
    assert (inside.min(axis=1) > corner.min(axis=1)).all()
    assert (inside.max(axis=1) < corner.max(axis=1)).all()
    affine = registration.points @ np.array([[1.1, 0.3], [-0.2, 0.9]], np.float32) + 5
    np.testing.assert_allclose(registration.bending @ affine, 0, atol=1e-4)
    assert np.abs(registration.bending @ registration.points**2).max() > 1
    rng = np.random.default_rng(0)
    weight = rng.random(len(registration.template)).astype(np.float32)
    slopes = rng.normal(size=(len(weight), 2)).astype(np.float32)
    dense = np.zeros((len(weight), count))
    np.put_along_axis(
        dense, np.repeat(cells.corners, len(cells.weights), axis=0), np.tile(cells.weights, (len(corner), 1)), axis=1
    )
    np.testing.assert_allclose(cells.sums(weight), dense.T @ weight, rtol=1e-4)
    jacobian = np.einsum("sp,sc->spc", dense, slopes).reshape(len(weight), -1)
    stiffness = rng.random(registration.bending.shape[0]).astype(np.float32)
    bent = np.kron(registration.bending.toarray(), np.eye(2))
    expected = jacobian.T @ (weight[:, None] * jacobian) + bent.T @ (np.repeat(stiffness, 2)[:, None] * bent)
    found = registration.normal.matrix(cells.squares(weight, *slopes.T), stiffness)
    np.testing.assert_allclose(found.toarray(), expected + HOLD * np.eye(2 * count), atol=1e-4)
