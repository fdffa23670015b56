"""The second pass: tracking again from the expected paths of all points."""

from __future__ import annotations

import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pliant.tracking.appearance import Appearance, noise_variance
from pliant.tracking.chaining import Chain
from pliant.tracking.errors import FilmError, TrackingStopped
from pliant.tracking.registration import Registration
from pliant.tracking.seeding import neighbours, place
from pliant.tracking.trajectories import WINDOW, move_to_expected, track_again, windows

FRAMES = 12


def turning(points: np.ndarray) -> np.ndarray:
    """Return paths `(F, P, 2)` of a bent sheet that turns."""
    depth = 0.004 * (points - points.mean(axis=0)) ** 2
    angle = np.linspace(-0.4, 0.4, FRAMES)[:, None]
    across = (points[:, 0] - 80) * np.cos(angle) + depth.sum(axis=1) * np.sin(angle) + 80
    return np.stack([across, np.broadcast_to(points[:, 1], across.shape)], axis=2).astype(np.float32)


def test_expected_positions_correct_uncertain_and_fill_hidden_ones() -> None:
    points = np.random.default_rng(0).uniform(20, 140, (200, 2)).astype(np.float32)
    true = turning(points)
    tracked, variance, visible = true.copy(), np.full((FRAMES, 200), 0.01, np.float32), np.ones((FRAMES, 200), bool)
    tracked[8:11, :20] += 2
    variance[8:11, :20] = 1
    tracked[2:6, 20:40], visible[2:6, 20:40] = 0, False
    move_to_expected(Chain(tracked, visible, variance), 0, bool)
    error = np.linalg.norm(tracked - true, axis=2)
    assert error[8:11, :20].mean() < 0.5
    assert error[2:6, 20:40].mean() < 0.2
    assert np.median(error) < 0.02


def test_computing_expected_positions_can_be_stopped() -> None:
    points = turning(np.random.default_rng(0).uniform(20, 140, (60, 2)).astype(np.float32))
    chained = Chain(points, np.ones((FRAMES, 60), bool), np.full((FRAMES, 60), 0.01, np.float32))
    with pytest.raises(TrackingStopped):
        move_to_expected(chained, 0, lambda: True)


@pytest.mark.parametrize("seen", [1, 3])
def test_too_few_points_beyond_the_template_are_lost_tracks(seen: int) -> None:
    points = turning(np.random.default_rng(0).uniform(20, 140, (60, 2)).astype(np.float32))
    visible = np.zeros((FRAMES, 60), bool)
    visible[0] = True
    visible[1:3, :seen] = True
    with pytest.raises(FilmError) as caught:
        move_to_expected(Chain(points, visible, np.full((FRAMES, 60), 0.01, np.float32)), 0, bool)
    assert str(caught.value) == (
        f"film: expected at least 4 points that stay visible beyond the template, got {seen}. Film more slowly and with more light, so "
        "that successive frames overlap and are not blurred."
    )
    assert caught.value.code == "tracks_lost"


def test_windows_cover_the_film_once_and_hold_the_template() -> None:
    assert [list(rows) for rows in windows(5, 2)] == [list(range(5))]
    for frames, template in ((WINDOW, 0), (WINDOW + 1, WINDOW), (3 * WINDOW, 700), (3 * WINDOW + 2, 0)):
        found = windows(frames, template)
        assert len(found) == -(-frames // WINDOW)
        assert all(len(rows) <= WINDOW + 1 and template in rows for rows in found)
        assert sorted(np.concatenate([rows[rows != template] for rows in found])) == [
            t for t in range(frames) if t != template
        ]


def test_long_films_are_fitted_in_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.tracking.trajectories.WINDOW", 6)
    points = np.random.default_rng(0).uniform(20, 140, (200, 2)).astype(np.float32)
    true = turning(points)
    tracked, visible = true.copy(), np.ones((FRAMES, 200), bool)
    tracked[8:10, :20] += 2
    variance = np.where(tracked[..., 0] != true[..., 0], 1.0, 0.01).astype(np.float32)
    tracked[2:6, 20:40], visible[2:6, 20:40] = 0, False
    move_to_expected(Chain(tracked, visible, variance), 6, bool)
    assert np.linalg.norm(tracked - true, axis=2).max() < 0.3
    assert np.array_equal(tracked[6], true[6])


def test_a_window_without_points_keeps_its_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.tracking.trajectories.WINDOW", 4)
    points = np.random.default_rng(0).uniform(20, 140, (60, 2)).astype(np.float32)
    tracked, visible = turning(points), np.ones((FRAMES, 60), bool)
    tracked[4:8], visible[4:8] = 7.0, False
    before = tracked.copy()
    move_to_expected(Chain(tracked, visible, np.full((FRAMES, 60), 0.01, np.float32)), 0, bool)
    assert np.array_equal(tracked[4:8], before[4:8])
    assert 0 < np.abs(tracked - before).max() < 0.5


def test_memory_for_expected_positions_is_proportional_to_the_tracks() -> None:
    frames, count = 300, 4000
    drift = np.arange(frames, dtype=np.float32)[:, None, None] * np.float32([0.1, 0.05])
    points = np.random.default_rng(0).uniform(0, 300, (count, 2)).astype(np.float32) + drift
    chained = Chain(points.copy(), np.ones((frames, count), bool), np.ones((frames, count), np.float32))
    tracemalloc.start()
    try:
        move_to_expected(chained, 0, bool)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert np.abs(chained.points - points).max() < 0.01
    assert peak < 2.7 * points.nbytes


def film() -> tuple[np.ndarray, np.ndarray, Appearance, Registration]:
    """Return frames of a drifting texture, the true paths, and the appearance and registration of the first frame."""
    cv2 = pytest.importorskip("cv2")
    noise = np.random.default_rng(1).standard_normal((120, 160)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    texture = 128 + 45 * texture / texture.std()
    frames = [
        cv2.warpAffine(texture, np.array([[1, 0, 0.8 * t], [0, 1, 0]], np.float32), (160, 120)) for t in range(FRAMES)
    ]
    grey = np.clip(frames, 0, 255).astype(np.uint8)
    region = np.zeros((120, 160), bool)
    region[20:100, 20:120] = True
    seeds, _ = place(grey[0], region, step=5)
    drift = np.stack([0.8 * np.arange(FRAMES), np.zeros(FRAMES)], axis=1).astype(np.float32)
    appearance = Appearance.of(grey[0], region, seeds.points, neighbours(seeds.grid, len(seeds.points)))
    registration = Registration.of(grey[0], seeds.points, seeds.grid, noise=noise_variance(grey[0]))
    return grey, seeds.points + drift[:, None], appearance, registration


def again(chained: Chain, *, stop: bool = False) -> tuple[Chain, np.ndarray, list[int]]:
    """Track the film again from given tracks; return the tracks, the true paths and the reported frames."""
    grey, true, appearance, registration = film()
    seen: list[int] = []
    rough = registration.coarse(grey[0], 2.0)
    with ThreadPoolExecutor(2) as pool:
        track_again(
            lambda t: grey[t], chained, 0, appearance, rough, registration,
            pool=pool, on_frame=lambda t, points, visible: seen.append(t), should_stop=lambda: stop and len(seen) == 2,
        )  # fmt: skip
    return chained, true, seen


def spoiled() -> Chain:
    """Return tracks of the film, some of them wrong and some lost."""
    true = film()[1]
    variance = np.full(true.shape[:2], 0.01, np.float32)
    points, visible = true.copy(), np.ones(true.shape[:2], bool)
    points[6:9, 60:90] += 3
    variance[6:9, 60:90] = 2
    visible[3:5, 100:140] = False
    return Chain(points, visible, variance)


def test_the_second_pass_recovers_lost_points_and_corrects_wrong_ones() -> None:
    result, true, seen = again(spoiled())
    error = np.linalg.norm(result.points - true, axis=2)
    assert error[6:9, 60:90].max() < 0.3
    assert result.visible[3:5, 100:140].mean() > 0.95
    assert np.percentile(error[result.visible], 99) < 0.3
    assert seen == list(range(1, FRAMES))


def test_lost_points_off_their_paths_are_found_with_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    true = film()[1]
    lost = slice(100, 140)
    visible = np.ones(true.shape[:2], bool)
    visible[1:, lost] = False
    points = true.copy()
    points[1:, lost] += np.float32([0, 2.5])
    monkeypatch.setattr("pliant.tracking.trajectories.move_to_expected", lambda chained, template, should_stop: None)
    result, *_ = again(Chain(points, visible, np.full(visible.shape, 0.01, np.float32)))
    assert result.visible[1:, lost].mean() > 0.95
    error = np.linalg.norm(result.points - true, axis=2)[1:, lost]
    assert np.percentile(error, 80) < 0.2


def test_the_second_pass_can_be_stopped() -> None:
    with pytest.raises(TrackingStopped):
        again(spoiled(), stop=True)
