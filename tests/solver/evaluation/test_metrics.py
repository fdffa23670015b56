"""Error metrics: invariances, values worked by hand, and rejected input."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pliant.solver import Camera, InvalidInput, Tracks
from pliant.solver.evaluation.alignment import MIRROR, align, procrustes
from pliant.solver.evaluation.metrics import (
    NINETY,
    coverage,
    e3d_frame,
    e3d_frame_scaled,
    e3d_frame_similarity,
    e3d_mocap,
    e3d_sequence,
    evaluate,
    focal_error,
    reprojection,
    rotation_degrees,
)
from pliant.solver.model.so3 import nearest
from scipy.spatial.transform import Rotation

ALL = (e3d_sequence, e3d_frame, e3d_frame_similarity, e3d_mocap)
random = np.random.default_rng(7)
TRUTH = random.standard_normal((6, 30, 3))
TURN = Rotation.from_euler("xyz", (20, -50, 110), degrees=True).as_matrix()
TURNS = Rotation.random(6, rng=random).as_matrix()


def solution_of(shapes, rotations=None, scales=None, translations=None):
    frames = len(shapes)
    camera = Camera(
        rotations=np.tile(np.eye(3), (frames, 1, 1)) if rotations is None else rotations,
        scales=np.ones(frames) if scales is None else scales,
        translations=np.zeros((frames, 2)) if translations is None else translations,
    )
    return SimpleNamespace(shapes=shapes, camera=camera, shapes_std=None)


@pytest.mark.parametrize("metric", ALL)
def test_identity_and_translation_cost_nothing(metric):
    assert metric(TRUTH, TRUTH) == pytest.approx(0, abs=1e-14)
    assert metric(TRUTH + random.standard_normal((6, 1, 3)), TRUTH) == pytest.approx(0, abs=1e-14)


@pytest.mark.parametrize("metric", ALL)
@pytest.mark.parametrize("mirror", [np.eye(3), MIRROR, -np.eye(3)])
def test_every_metric_ignores_one_orthogonal_transform_per_sequence(metric, mirror):
    assert metric(TRUTH @ (mirror @ TURN).T, TRUTH) == pytest.approx(0, abs=1e-13)


def test_only_per_frame_metrics_ignore_per_frame_rotations():
    turned = TRUTH @ TURNS.transpose(0, 2, 1)
    assert e3d_frame(turned, TRUTH) == pytest.approx(0, abs=1e-13)
    assert e3d_frame_similarity(turned, TRUTH) == pytest.approx(0, abs=1e-13)
    assert e3d_sequence(turned, TRUTH) > 0.5
    assert e3d_mocap(turned, TRUTH) > 0.5


def test_only_per_frame_mirroring_ignores_mirrored_frames():
    flipped = TRUTH.copy()
    flipped[::2] = flipped[::2] @ MIRROR
    assert e3d_frame_similarity(flipped, TRUTH) == pytest.approx(0, abs=1e-13)
    assert align(flipped, TRUTH, kind="frame_similarity").relative.max() == pytest.approx(0, abs=1e-13)
    # Half of the frames fit exactly and half are mirror images, whichever of the two the sequence's mirror is.
    errors = np.sort(align(flipped, TRUTH).relative)
    assert errors[:3] == pytest.approx(0, abs=1e-13)
    assert errors[3:].min() > 0.5
    assert e3d_frame(flipped, TRUTH) == pytest.approx(errors[3:].sum() / 6)
    assert e3d_sequence(flipped, TRUTH) > 0.5


@pytest.mark.parametrize("metric", [e3d_sequence, e3d_frame])
def test_scale_errors_count_fully_unless_scale_is_aligned(metric):
    assert metric(1.25 * TRUTH, TRUTH) == pytest.approx(0.25)
    assert metric(0.8 * TRUTH, TRUTH) == pytest.approx(0.2)
    assert e3d_frame_similarity(1.25 * TRUTH, TRUTH) == pytest.approx(0, abs=1e-13)


def test_similarity_error_is_the_sine_between_the_shapes():
    # Truth along x, reconstruction along x with an orthogonal part of half its size: min over c of ‖c S − G‖/‖G‖ = sin(atan ½).
    truth = np.zeros((3, 4, 3))
    truth[:, :, 0] = (-1, -1, 1, 1)
    ours = 3 * truth
    ours[:, :, 1] = 1.5 * np.array((-1, 1, -1, 1))
    assert e3d_frame_similarity(ours, truth) == pytest.approx(np.sin(np.arctan(0.5)))
    assert align(ours, truth, kind="frame_similarity").scales == pytest.approx(
        np.full(3, np.cos(np.arctan(0.5)) ** 2 / 3)
    )


def test_mocap_error_worked_by_hand():
    # A square in the plane: x, y = ±1, z = 0. Population deviations are 1, 1 and 0, so σ = 2/3 in every frame.
    square = np.array([(1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0)], dtype=float)
    truth = np.stack([square] * 3)
    # ±h out of the plane, alternating: uncorrelated with x and y, so the best Q leaves it; every point is h off.
    ours = truth.copy()
    ours[:, :, 2] = 0.3 * np.array((1, -1, -1, 1))
    assert e3d_mocap(ours, truth) == pytest.approx(0.3 / (2 / 3))
    assert e3d_sequence(ours, truth) == pytest.approx(0.3 / np.sqrt(2))
    assert align(ours, truth, kind="sequence").distances == pytest.approx(np.full((3, 4), 0.3))


def test_more_alignment_freedom_gives_a_lower_error():
    ours = TRUTH @ TURN.T + 0.1 * random.standard_normal(TRUTH.shape)
    assert 0.05 < e3d_frame_similarity(ours, TRUTH) < e3d_frame(ours, TRUTH) < e3d_sequence(ours, TRUTH) < 0.15


def test_procrustes_beats_nearby_rotations():
    products = random.standard_normal((3, 3))
    for nearby in (procrustes, nearest):
        best = nearby(products)
        assert best @ best.T == pytest.approx(np.eye(3))
        for nudge in Rotation.from_rotvec(0.05 * random.standard_normal((20, 3))).as_matrix():
            assert np.sum(best * products) > np.sum((nudge @ best) * products)
    assert np.linalg.det(nearest(-np.eye(3))) == pytest.approx(1)
    assert procrustes(-np.eye(3)) == pytest.approx(-np.eye(3))


def test_coverage_is_the_share_within_the_central_interval():
    rng = np.random.default_rng(3)
    truth = rng.standard_normal((8, 600, 3))
    std = rng.uniform(0.01, 0.03, (8, 600))
    ours = truth.copy()
    ours[..., 2] += (
        std * rng.standard_normal(std.shape) * NINETY / 1.645
    )  # 90 % of a normal error lie within 1.645 deviations
    assert coverage(std, ours, truth) == pytest.approx(0.9, abs=0.015)
    assert coverage(0.5 * std, ours, truth) == pytest.approx(0.589, abs=0.02)  # P(|n| < .8225)
    # One scale per sequence is aligned, and it applies to the deviations as well.
    assert coverage(7 * std, 7 * ours @ TURN.T, truth) == pytest.approx(coverage(std, ours, truth), abs=1e-3)
    with pytest.raises(InvalidInput, match="shapes_std"):
        coverage(std[:, 1:], ours, truth)


def test_rotation_degrees_ignores_world_axes_and_the_mirror_but_not_an_error():
    assert rotation_degrees(TURNS @ TURN, TURNS) == pytest.approx(0, abs=1e-10)
    assert rotation_degrees(MIRROR @ TURNS @ TURN @ MIRROR, TURNS) == pytest.approx(0, abs=1e-10)
    # A path that turns at 9° a frame instead of 10°: frame f of 5 is off by f − 2 degrees from the best common turn.
    true, ours = (Rotation.from_euler("y", step * np.arange(5)[:, None], degrees=True).as_matrix() for step in (10, 9))
    assert rotation_degrees(ours, true) == pytest.approx((2 + 1 + 0 + 1 + 2) / 5)


def test_reprojection_is_weighted_by_confidence_and_skips_hidden_points():
    shapes = np.zeros((3, 4, 3))
    shapes[:, :, :2] = [(0, 0), (1, 0), (0, 1), (1, 1)]
    scales, shift = np.array((1.0, 2.0, 0.5)), np.array([(5, 6)] * 3, dtype=float)
    points = scales[:, None, None] * shapes[:, :, :2] + shift[:, None]
    visible = np.ones((3, 4))
    points[0, 0] += (3, 4)
    points[1, 1] += (6, 8)
    points[2, 2] += 1000
    visible[1, 1], visible[2, 2] = 0.25, 0
    fit = reprojection(Tracks.from_arrays(points, visible), solution_of(shapes, scales=scales, translations=shift))
    assert fit.median == 0
    assert fit.rms == pytest.approx(np.sqrt((25 + 0.25 * 100) / (10 + 0.25)))


def test_evaluate_names_what_the_inputs_allow():
    tracks = Tracks.from_arrays(TRUTH[..., :2])
    rotations = np.tile(np.eye(3), (6, 1, 1))
    fit = {"reprojection_median", "reprojection_rms"}
    assert set(evaluate(solution_of(TRUTH), tracks)) == fit
    shapes = {"e3d_sequence", "e3d_frame", "e3d_frame_scaled", "e3d_frame_similarity", "e3d_mocap", "size_ratio"}
    both = evaluate(solution_of(TRUTH), tracks, TRUTH, rotations)
    assert set(both) == fit | shapes | {"rotation_degrees"}
    assert both.pop("size_ratio") == pytest.approx(1)
    assert max(both.values()) < 1e-12
    off = evaluate(solution_of(TRUTH + 0.1 * random.standard_normal(TRUTH.shape)), tracks, TRUTH)
    assert off["e3d_sequence"] == pytest.approx(0.1, rel=0.2)
    assert off["reprojection_rms"] == pytest.approx(0.1 * np.sqrt(2), rel=0.2)


def test_evaluate_without_tracks_is_refused_in_words():
    with pytest.raises(
        InvalidInput, match=r"tracks: expected a Tracks, .*evaluate\(solution, tracks, truth\)"
    ) as caught:
        evaluate(solution_of(TRUTH), TRUTH)
    assert caught.value.code == "wrong_type"


def test_a_truth_in_another_unit_shows_in_the_size_ratio_and_not_in_the_scaled_error():
    found = evaluate(solution_of(TRUTH), Tracks.from_arrays(TRUTH[..., :2]), TRUTH / 1000)
    assert found["size_ratio"] == pytest.approx(1e-3)
    assert found["e3d_frame_scaled"] < 1e-12
    assert found["e3d_frame"] > 100


@pytest.mark.parametrize(
    ("ours", "truth", "code"),
    [
        (TRUTH, TRUTH[..., :2], "wrong_shape"),
        (TRUTH, TRUTH[:5], "wrong_shape"),
        (TRUTH, np.where(np.arange(3) == 1, np.nan, TRUTH), "not_finite"),
        (np.full_like(TRUTH, np.inf), TRUTH, "not_finite"),
        (TRUTH, np.ones_like(TRUTH), "no_extent"),
    ],
)
def test_unusable_shapes_are_rejected(ours, truth, code):
    with pytest.raises(InvalidInput) as caught:
        align(ours, truth)
    assert caught.value.code == code


def test_rotations_of_another_shape_are_refused():
    with pytest.raises(InvalidInput, match=r"expected \(frames, 3, 3\)"):
        rotation_degrees(TURNS, TURNS[:, :2])


def test_e3d_frame_scaled_aligns_one_scale_per_sequence() -> None:
    turned = 3.0 * np.einsum("fpi,fji->fpj", TRUTH, TURNS)
    assert e3d_frame_scaled(turned, TRUTH) == pytest.approx(0, abs=1e-9)
    growing = np.linspace(0.5, 1.5, 6)[:, None, None] * TRUTH
    scale = np.vdot(growing - growing.mean(axis=1, keepdims=True), TRUTH - TRUTH.mean(axis=1, keepdims=True))
    scale /= np.square(growing - growing.mean(axis=1, keepdims=True)).sum()
    assert e3d_frame_scaled(growing, TRUTH) == pytest.approx(np.abs(scale * np.linspace(0.5, 1.5, 6) - 1).mean())
    assert e3d_frame_similarity(growing, TRUTH) == pytest.approx(0, abs=1e-9)


def test_the_error_of_a_focal_length_is_relative() -> None:
    camera = solution_of(TRUTH).camera
    assert focal_error(camera, 900.0) == np.inf
    assert focal_error(replace(camera, focal=990.0), 900.0) == pytest.approx(0.1)
    with pytest.raises(InvalidInput):
        focal_error(camera, 0.0)
