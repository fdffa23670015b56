"""Affine iterations: perspective of a deforming object recovered from its tracks alone, given focal lengths, and stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.cameras.perspective import Candidate, Perspective
from pliant.solver.model.so3 import angles_between, exponential
from pliant.solver.records import Floats
from pliant.solver.refinement.affine_iterations import affine_iterations
from pliant.solver.refinement.depth_alternation import aligned
from pliant.solver.refinement.learned import Learned, Refinement

FRAMES, INVERSE_FOCAL = 24, 0.16
ANY = (Candidate(0.0, np.inf),)


@pytest.fixture(scope="module")
def hinge() -> tuple[Floats, Perspective]:
    """Rotations, and views in perspective of a box whose right end turns about a hinge, by up to 23°.

    If it turns by 30°, two solutions 4° apart are about equally probable, and which one is found depends on the processor's rounding.
    """
    random = np.random.default_rng(0)
    box = random.uniform(-1, 1, (60, 3)) * np.array([1.0, 0.6, 0.6])
    angles = 0.4 * np.sin(np.linspace(0, 5, FRAMES))
    pivot = np.array([0.5, 0.0, 0.0])
    turned = (box - pivot) @ exponential(angles[:, None] * np.array([0.0, 0.3, 1.0])).transpose(0, 2, 1) + pivot
    shapes = np.where(box[:, :1] > 0.5, turned, box)
    shapes -= shapes.mean(axis=1, keepdims=True)
    rotations = exponential(np.linspace(0, 1.6, FRAMES)[:, None] * np.array([0.25, 1.0, 0.1]))
    seen = shapes @ rotations.transpose(0, 2, 1)
    seen /= np.sqrt(np.square(seen[..., :2]).sum(axis=2).mean())
    views = seen[..., :2] / (1 + INVERSE_FOCAL * seen[..., 2:])
    return rotations, Perspective(np.zeros((FRAMES, 2)), np.zeros(2), learning_sample=views, candidates=ANY)


def cameras_off(rotations: Floats, degrees: float) -> Floats:
    off = np.radians(degrees) * np.random.default_rng(1).normal(size=(len(rotations), 3))
    return np.asarray(exponential(off) @ rotations)


def found_from(hinge: tuple[Floats, Perspective], degrees: float, given: float | None = None) -> tuple[Learned, float]:
    """Return what is found from cameras that are wrong by so many degrees."""
    rotations, view = hinge
    start, view = cameras_off(rotations, degrees), replace(view, given=given)
    found = affine_iterations(view.learning_sample, start, np.ones(FRAMES), view, Refinement())
    assert found is not None
    return found


@pytest.fixture(scope="module")
def unknown(hinge: tuple[Floats, Perspective]) -> tuple[Learned, float]:
    """What is found from cameras that are wrong by 15°, without a focal length."""
    return found_from(hinge, 15.0)


@pytest.mark.parametrize("given", [None, INVERSE_FOCAL])
def test_cameras_and_sign_of_depth_follow_from_the_tracks(
    hinge: tuple[Floats, Perspective], unknown: tuple[Learned, float], given: float | None
) -> None:
    rotations, _ = hinge
    learned, inverse_focal = unknown if given is None else found_from(hinge, 15.0, given)
    assert inverse_focal == given if given is not None else 0.5 < inverse_focal / INVERSE_FOCAL < 2
    every = np.arange(FRAMES)
    assert np.degrees(angles_between(aligned(learned.rotations, rotations, every), rotations)).mean() < 6
    assert learned.scales == pytest.approx(1)


def test_the_result_hardly_depends_on_the_other_cameras(
    hinge: tuple[Floats, Perspective], unknown: tuple[Learned, float]
) -> None:
    one, two = found_from(hinge, 0.0), unknown
    every = np.arange(FRAMES)
    apart = angles_between(aligned(two[0].rotations, one[0].rotations, every), one[0].rotations)
    assert np.degrees(apart).max() < 0.5
    assert one[1] == two[1]


def test_a_more_probable_search_is_kept(hinge: tuple[Floats, Perspective]) -> None:
    rotations, view = hinge
    better = replace(view, inverse_focal=0.1, candidates=(Candidate(0.1, -np.inf),))
    assert affine_iterations(view.learning_sample, rotations, np.ones(FRAMES), better, Refinement()) is None


def test_a_stop_ends_the_iterations(hinge: tuple[Floats, Perspective]) -> None:
    rotations, view = hinge
    found = affine_iterations(
        view.learning_sample, rotations, np.ones(FRAMES), view, Refinement(should_stop=lambda: True)
    )
    assert found is None


def test_too_few_points_for_any_factorization_have_no_result(hinge: tuple[Floats, Perspective]) -> None:
    rotations, view = hinge
    few = view.learning_sample[:, :5]
    assert affine_iterations(few, rotations, np.ones(FRAMES), view, Refinement()) is None
