"""The first pass: tracks from optical flow, frame by frame."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pliant.tracking import chaining
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import Chain, _in_box, chain
from pliant.tracking.registration import ROUNDING, Registration
from pliant.tracking.seeding import neighbours, place

cv2 = pytest.importorskip("cv2")

FRAMES = 8


def texture(size: tuple[int, int], seed: int) -> np.ndarray:
    """Return blurred noise, grey levels."""
    noise = np.random.default_rng(seed).standard_normal(size[::-1]).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 8.0))
    return np.clip(128 + 30 * fine / fine.std() + 30 * coarse / coarse.std(), 0, 255).astype(np.uint8)


def followed(speed: float, *, template: int = 0, hidden: range = range(0)) -> tuple[Chain, np.ndarray, list[int]]:
    """Track a textured square that moves right at `speed` pixels per frame; return tracks, true paths and the order of the frames.

    In the frames `hidden`, another texture covers its left half.
    """
    width = 304 + round(speed * FRAMES)
    behind, thing, cover = texture((width, 304), 0), texture((240, 240), 1), texture((120, 240), 2)
    frames = []
    for t in range(FRAMES):
        picture, shown, left = behind.copy(), thing.copy(), 32 + round(speed * t)
        if t in hidden:
            shown[:, :120] = cover
        picture[32:272, left : left + 240] = shown
        frames.append(picture)
    region = np.zeros((304, width), bool)
    start = 32 + round(speed * template)
    region[40:264, start + 8 : start + 232] = True
    seeds, _ = place(frames[template], region, step=8)
    appearance = Appearance.of(frames[template], region, seeds.points, neighbours(seeds.grid, len(seeds.points)))
    registration = Registration.of(frames[template], seeds.points, seeds.grid, noise=appearance.noise)
    order: list[int] = []
    with ThreadPoolExecutor(2) as pool:
        result = chain(
            lambda t: frames[t], FRAMES, template, appearance, registration,
            pool=pool, on_frame=lambda t, points, visible: order.append(t), should_stop=lambda: False,
        )  # fmt: skip
    moved = np.stack([speed * (np.arange(FRAMES) - template), np.zeros(FRAMES)], axis=1)
    return result, seeds.points + moved[:, None].astype(np.float32), order


def test_tracking_runs_from_the_template_to_both_ends() -> None:
    result, true, order = followed(2, template=3)
    assert order == [4, 5, 6, 7, 2, 1, 0]
    assert result.visible.mean() > 0.97
    assert np.linalg.norm(result.points - true, axis=2)[result.visible].max() < 0.5


def test_points_moving_26_pixels_per_frame_are_tracked() -> None:
    result, true, _ = followed(26)
    assert result.visible[2:].mean() > 0.9
    assert np.median(np.linalg.norm(result.points - true, axis=2)[2:]) < 0.1


@pytest.mark.parametrize("template", [0, 7])
def test_every_flow_continues_one_between_similar_frames(monkeypatch: pytest.MonkeyPatch, template: int) -> None:
    compute, motions = chaining.dense_flow, []

    def recorded(first: np.ndarray, second: np.ndarray, similar: np.ndarray | None = None) -> np.ndarray:
        flow = compute(first, second, similar)
        motions.append([0.0 if each is None else float(np.median(each[..., 0])) for each in (similar, flow)])
        return flow

    monkeypatch.setattr(chaining, "dense_flow", recorded)
    monkeypatch.setattr(chaining, "DELTAS", (1, 4))
    followed(4, template=template)
    # From the template to 7 frames, from the frame before to 6, over four frames to 3, each there and back.
    assert len(motions) == 2 * (7 + 6 + 3)
    starts, flows = np.array(motions).T
    assert (starts == 0).sum() == 2
    assert np.abs(flows - starts).max() == pytest.approx(4, abs=0.3)


def test_points_are_recovered_after_an_occlusion() -> None:
    result, true, _ = followed(1, hidden=range(3, 5))
    left = true[0, :, 0] < 32 + 112
    assert result.visible[3:5, left].mean() < 0.1
    assert result.visible[5:, left].mean() > 0.9
    assert np.percentile(np.linalg.norm(result.points - true, axis=2)[5:, left], 90) < 0.3


def confidence_of(visible: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the confidence of all frames."""
    chained = Chain(np.zeros((*visible.shape, 2), np.float32), visible, variance)
    return chained.confidence(slice(None), chained.usual_variance())


def test_confidence_ignores_the_template_if_most_observations_are_in_it() -> None:
    visible, variance = np.zeros((4, 10), bool), np.full((4, 10), 0.04, np.float32)
    visible[0], visible[1:, :3], variance[0] = True, True, 0.0
    variance[1, 0] = 0.4
    found = confidence_of(visible, variance)
    assert (found[0] == 1).all()
    assert found[2, :3] == pytest.approx(1)
    assert found[1, 0] == pytest.approx(0.1)
    assert (found[~visible] == 0).all()
    exact = confidence_of(visible, np.zeros((4, 10), np.float32))
    assert (exact == visible).all()


def test_confidence_ignores_frames_identical_to_the_template_if_most_observations_are_in_them() -> None:
    visible, variance = np.ones((6, 10), bool), np.full((6, 10), 1.5 * ROUNDING, np.float32)
    variance[0], variance[4], variance[5] = 0.0, 1.0, 2.0
    found = confidence_of(visible, variance)
    assert (found[:5] == 1).all()
    assert found[5] == pytest.approx(0.75)


def test_a_flow_in_another_box_keeps_its_places_and_repeats_its_border() -> None:
    rows, columns = np.mgrid[:20, :30].astype(np.float32)
    picture = np.stack([columns, rows], axis=-1)
    old, new = np.s_[4:12, 6:20], np.s_[2:10, 10:25]
    inside = np.clip(picture, [6, 4], [19, 11])
    np.testing.assert_array_equal(_in_box(picture[old], old, new), inside[new])
    np.testing.assert_array_equal(_in_box(picture[old], old, np.s_[15:18, 24:29]), inside[15:18, 24:29])
