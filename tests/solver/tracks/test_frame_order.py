"""Photographs in no order: detection, no terms between neighbouring frames, and equal results in every order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import InvalidSettings, KnownCamera, Settings, Tracks, gallery, solve
from pliant.solver.agreement import check_agreement
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.solver.limits import MAX_UNORDERED_FRAMES
from pliant.solver.model import full_mode_covariance
from pliant.solver.model.expectation_maximisation import ModelOrder, annealed
from pliant.solver.model.marginal_likelihood import Motion, Scene, energy, start
from pliant.solver.model.so3 import exponential
from pliant.solver.tracks.frame_order import (
    content_order,
    differences,
    resolved_order,
    step_share,
)

FACE = gallery.face(10, 60, degrees=80)
SHUFFLED = np.array([3, 7, 0, 9, 4, 1, 8, 5, 2, 6])


def shuffled(tracks: Tracks, order: np.ndarray = SHUFFLED) -> Tracks:
    return Tracks.from_arrays(tracks.points[order], tracks.visible[order])


def test_frame_differences_use_only_common_points() -> None:
    random = np.random.default_rng(0)
    points, visible = random.normal(size=(4, 9, 2)), random.uniform(0.1, 1, (4, 9))
    visible[1, 3:] = 0
    visible[2, :3] = 0
    found = differences(Tracks.from_arrays(points, visible))
    centred = points - np.einsum("fp,fpc->fc", visible, points)[:, None] / visible.sum(axis=1)[:, None, None]
    weight = visible[0] * visible[1]
    expected = (weight * np.square(centred[0] - centred[1]).sum(axis=1)).sum() / weight.sum()
    assert found[0, 1] == pytest.approx(expected)
    assert found[1, 2] == np.inf
    assert (np.diag(found) == 0).all()


def test_a_film_and_shuffled_frames_are_told_apart() -> None:
    settings, why = resolved_order(FACE.tracks, Settings())
    assert settings.order == "film"
    assert "order of a film" in why
    settings, why = resolved_order(shuffled(FACE.tracks), Settings())
    assert settings.order == "any"
    assert "no order" in why
    assert step_share(shuffled(FACE.tracks)) > 2 * step_share(FACE.tracks)
    assert resolved_order(shuffled(FACE.tracks), Settings(prior="smooth"))[0].order == "film"
    still = Tracks.from_arrays(np.tile(FACE.tracks.points[:1], (4, 1, 1)))
    assert resolved_order(still, Settings())[0].order == "film"


@pytest.mark.parametrize("share", [0.02, 0.1, 0.2])
def test_gross_outliers_do_not_change_the_detected_order(share: float) -> None:
    film = gallery.face(20, 200)
    order = np.random.default_rng(1).permutation(20)
    spoiled = gallery.corrupt(film, outliers=share, seed=0).tracks
    assert resolved_order(spoiled, Settings())[0].order == "film"
    assert resolved_order(shuffled(spoiled, order), Settings())[0].order == "any"


def test_points_that_stand_still_do_not_count() -> None:
    film = gallery.face(20, 60).tracks
    still = np.tile(film.points[:1], (1, 3, 1)) + np.random.default_rng(0).normal(0, 0.2, (20, 3 * film.num_points, 2))
    mixed = Tracks.from_arrays(np.concatenate([film.points, still], axis=1))
    assert resolved_order(mixed, Settings())[0].order == "film"
    assert resolved_order(shuffled(mixed, np.random.default_rng(1).permutation(20)), Settings())[0].order == "any"


def test_the_order_is_undefined_if_no_two_frames_share_a_point() -> None:
    apart = Tracks.from_arrays(np.random.default_rng(0).normal(size=(3, 9, 2)), np.kron(np.eye(3), np.ones(3)))
    assert np.isnan(step_share(apart))


def test_content_order_does_not_depend_on_the_input_order() -> None:
    between = differences(FACE.tracks)
    one = content_order(between)
    other = content_order(between[np.ix_(SHUFFLED, SHUFFLED)])
    assert (SHUFFLED[other] == one).all()
    hidden = between.copy()
    hidden[2, :], hidden[:, 2] = np.inf, np.inf
    assert sorted(content_order(hidden)) == list(range(10))


@pytest.mark.parametrize(
    "known",
    [pytest.param(False, marks=[pytest.mark.slow, pytest.mark.long]), pytest.param(True, marks=pytest.mark.slow)],
    ids=["estimated", "given"],
)
def test_permuted_frames_give_permuted_shapes(known: bool) -> None:
    first = second = None
    if known:
        first = KnownCamera.from_arrays(FACE.rotations, FACE.scales)
        second = KnownCamera.from_arrays(FACE.rotations[SHUFFLED], FACE.scales[SHUFFLED])
    film = solve(FACE.tracks, cameras=first, settings=Settings(order="film"))
    given = solve(FACE.tracks, cameras=first, settings=Settings(order="any"))
    found = solve(shuffled(FACE.tracks), cameras=second)
    assert "no order" in found.choices.reasons["order"]
    for name in ("shapes", "residuals", "weights", "shapes_std"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name)[SHUFFLED], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.camera.rotations, given.camera.rotations[SHUFFLED], atol=1e-9)
    assert e3d_frame(found.shapes, FACE.shapes[SHUFFLED]) < 1.1 * e3d_frame(film.shapes, FACE.shapes) + 0.005
    assert not found.shapes.flags.writeable


def test_unordered_energies_are_invariant_to_frame_permutations() -> None:
    random, frames = np.random.default_rng(1), 7
    tracks = random.normal(size=(frames, 2, 40))
    rotations, order = exponential(random.normal(0, 0.4, (frames, 3))), random.permutation(frames)
    flat = None
    values: dict[bool, list[float]] = {True: [], False: []}
    for ordered in (True, False):
        for places in (np.arange(frames), order):
            stacked = tracks[places].reshape(2 * frames, -1)
            scene = Scene.of(stacked @ stacked.T / 40, rotations[places], with_scales=True, ordered=ordered)
            if flat is None:
                flat = start(scene, np.exp(random.normal(0, 0.1, frames))).flat() + 0.1
            motion = Motion.unflat(flat, frames)
            motion = replace(
                motion, turns=motion.turns[places], log_scales=motion.log_scales[places], modes=motion.modes[places]
            )
            values[ordered].append(energy(scene, motion)[0])
            covariance = annealed(scene.gram, rotations[places, :2], ModelOrder(ordered=ordered), iterations=3)
            values[ordered].append(covariance.nll)
            basis = full_mode_covariance.begin(scene, np.ones(frames), covariance)
            values[ordered].append(full_mode_covariance.energy(scene, covariance.axis_covariance, basis)[0])
            banded = covariance.precisions()[1].bands[1]
            assert (banded != 0).any() == ordered
    film, any_order = np.array(values[True]).reshape(2, 3), np.array(values[False]).reshape(2, 3)
    np.testing.assert_allclose(any_order[0], any_order[1], rtol=1e-9)
    assert (np.abs(film[0] - film[1]) > 1e-3).all()


def test_the_unordered_gradient_matches_finite_differences() -> None:
    random, frames = np.random.default_rng(2), 6
    tracks = random.normal(size=(2 * frames, 30))
    scene = Scene.of(
        tracks @ tracks.T / 30, exponential(random.normal(0, 0.4, (frames, 3))), with_scales=True, ordered=False
    )
    flat = start(scene, np.ones(frames)).flat()
    flat = flat + 0.05 * random.normal(size=flat.size)
    gradient = energy(scene, Motion.unflat(flat, frames))[1].flat()
    for place in (1, 20, 30, len(flat) - 1):
        step = np.zeros_like(flat)
        step[place] = 1e-5
        rise = (
            energy(scene, Motion.unflat(flat + step, frames))[0] - energy(scene, Motion.unflat(flat - step, frames))[0]
        )
        assert gradient[place] == pytest.approx(rise / 2e-5, rel=1e-4, abs=1e-7)


def test_unsupported_order_settings_are_rejected() -> None:
    with pytest.raises(InvalidSettings, match="prior gaussian") as refused:
        Settings(order="any", prior="smooth")
    assert refused.value.field == "options.order"
    with pytest.raises(InvalidSettings) as refused:
        Settings(order="reverse")  # type: ignore[arg-type]
    assert refused.value.field == "options.order"
    many = Tracks.from_arrays(np.random.default_rng(3).normal(size=(MAX_UNORDERED_FRAMES + 1, 5, 2)))
    with pytest.raises(InvalidSettings, match="360") as refused:
        check_agreement(many, None, None, Settings(order="any"))
    assert refused.value.field == "options.order"
    settings, why = resolved_order(many, Settings())
    assert settings.order == "film"
    assert "too many" in why


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_order_by_content_does_not_depend_on_the_unit(unit: float) -> None:
    between = np.array([[0, 2, np.inf, 5], [2, 0, 3, np.inf], [np.inf, 3, 0, 1], [5, np.inf, 1, 0.0]])
    assert content_order(between * unit).tolist() == content_order(between).tolist()
