"""The comparison of focal lengths: noise, cameras that turn too little, kept rotations, depths that diverge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from pliant.solver import gallery
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.model.expectation_maximisation import ModelOrder
from pliant.solver.model.marginal_likelihood import UNLIKELY
from pliant.solver.model.so3 import angles_between, exponential, logarithm, nearest
from pliant.solver.records import Floats
from pliant.solver.refinement.focal_length import _Comparison, search
from pliant.solver.refinement.learned import Learned, Refinement, to_all_frames
from pliant.solver.tracks.frame_selection import evenly_spread

INVERSE_FOCAL = 0.18


@dataclass(frozen=True, eq=False)
class Seen:
    """A face seen by a pinhole camera, and cameras whose turn is a fifth too small."""

    views: Floats
    rotations: Floats
    start: Floats

    def off(self, rotations: Floats) -> float:
        """Mean angle to the true cameras after one alignment of the world axes, rad."""
        aligned = rotations @ nearest((rotations.transpose(0, 2, 1) @ self.rotations).sum(axis=0)[None])[0]
        return float(angles_between(aligned, self.rotations).mean())


def seen_face(frames: int, points: int, *, noise: float, seed: int = 2) -> Seen:
    face = gallery.face(frames, points, degrees=30, seed=seed)
    seen = (face.shapes - face.shapes.mean(axis=1, keepdims=True)) @ face.rotations.transpose(0, 2, 1)
    seen /= np.sqrt(np.square(seen[..., :2]).sum(axis=-1).mean())
    views = seen[..., :2] / (1 + INVERSE_FOCAL * seen[..., 2:])
    middle = face.rotations[frames // 2]
    start = exponential(0.8 * logarithm(face.rotations @ middle.T)) @ middle
    return Seen(views + noise * np.random.default_rng(seed).normal(size=views.shape), face.rotations, start)


def view_of(frames: int) -> Perspective:
    return Perspective(np.zeros((frames, 2)), np.zeros(2))


def test_noise_and_cameras_that_turn_too_little_do_not_hide_perspective() -> None:
    face = seen_face(32, 300, noise=0.01)
    view, found = search(face.views, face.start, np.ones(32), view_of(32), Refinement(ModelOrder(noisy_start=True)))
    assert view.inverse_focal == pytest.approx(INVERSE_FOCAL, rel=0.1)
    assert view.sign_known
    assert face.off(found.rotations) < 0.5 * face.off(face.start)
    nll = [each.nll for each in view.candidates]
    falling = np.diff(nll) < 0
    assert falling[: np.argmin(nll)].all(), "the likelihood has a second maximum"
    assert not falling[np.argmin(nll) :].any(), "the likelihood has a second maximum"


def test_given_rotations_are_kept() -> None:
    face = seen_face(8, 40, noise=0.0)
    view, found = search(face.views, face.rotations, np.ones(8), view_of(8), Refinement(turning=False))
    assert view.inverse_focal > 0
    assert found.rotations == pytest.approx(face.rotations, abs=1e-12)


def test_levelling_only_raises_likelihoods_and_reaches_orthography() -> None:
    face = seen_face(8, 40, noise=0.01)
    comparison = _Comparison.of(face.views, face.start, np.ones(8), Refinement())
    comparison.add(0.1)
    comparison.add(-0.1)
    before = {inverse_focal: trial.nll for inverse_focal, trial in comparison.trials.items()}
    comparison.level()
    after = {inverse_focal: trial.nll for inverse_focal, trial in comparison.trials.items()}
    assert all(after[inverse_focal] <= before[inverse_focal] for inverse_focal in before)
    assert after[0.0] < before[0.0]
    replace(comparison, how=Refinement(should_stop=lambda: True)).level()
    assert {inverse_focal: trial.nll for inverse_focal, trial in comparison.trials.items()} == after


def test_a_focal_length_at_which_the_depths_diverge_is_unlikely() -> None:
    face = seen_face(8, 40, noise=0.0)
    comparison = _Comparison.of(face.views, face.rotations, np.ones(8), Refinement())
    comparison.add(30.0)
    assert comparison.trials[30.0].nll == UNLIKELY


def test_cameras_of_some_frames_are_extended_to_all() -> None:
    face = seen_face(9, 40, noise=0.0)
    used = evenly_spread(9, 5)
    comparison = _Comparison.of(face.views[used], face.start[used], np.ones(5), Refinement())
    found = comparison.trials[0.0].found
    every = to_all_frames(found, used, face.start)
    assert every.rotations[used] == pytest.approx(found.rotations, abs=1e-9)
    assert every.scales == pytest.approx(np.ones(9))
    assert len(every.covariance.modes) == 9
    whole = Learned(face.start, np.ones(9), every.covariance, 0.0)
    assert to_all_frames(whole, np.arange(9), face.rotations) is whole
