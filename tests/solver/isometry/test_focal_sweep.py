"""The search for the focal length of a sheet, and the criteria for accepting isometry, with I as a function of the focal length."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pliant.solver.isometry import focal_sweep
from pliant.solver.isometry.anchors import Anchors
from pliant.solver.isometry.focal_sweep import FocalSearch, Tried
from pliant.solver.isometry.refinement import Isometry
from pliant.solver.pulse import never


def with_inconsistencies(monkeypatch: pytest.MonkeyPatch, of_focal: Callable[[float], float]) -> list[float]:
    """Let I be a function of the focal length; return the list of those that are tried."""
    focals: list[float] = []

    def tried_at(search: object, focal: float, near: object) -> Tried:
        focals.append(focal)
        return Tried(focal, SEARCH.graph(focal), Isometry(np.ones((2, 3)), np.ones(3), of_focal(focal)))

    monkeypatch.setattr(focal_sweep, "tried_at", tried_at)
    monkeypatch.setattr(FocalSearch, "begun", lambda search, focal: search)
    monkeypatch.setattr(focal_sweep, "_along_surface", lambda search, tried: (search, tried))
    return focals


SEARCH = FocalSearch(
    Anchors(np.ones((2, 3, 2)), np.ones((2, 3)), 0.0, False),
    edges=np.zeros((1, 2), np.intp), seen=np.ones((2, 3), bool), frames=np.arange(2), centre=np.zeros(2), should_stop=never,
)  # fmt: skip


DIAGONAL = 1200.0


@pytest.mark.parametrize("true", [0.21, 0.36, 0.67, 1.9, 4.3, 5.5])
def test_the_focal_sweep_finds_a_minimum_and_tries_its_neighbours(monkeypatch: pytest.MonkeyPatch, true: float) -> None:
    with_inconsistencies(monkeypatch, lambda focal: 0.002 + 0.02 * float(np.log(focal / (true * DIAGONAL))) ** 2)
    tried = focal_sweep.sweep(SEARCH, 0.8 * DIAGONAL, DIAGONAL, given=False)
    least = focal_sweep.least_of(tried)
    assert least.focal == pytest.approx(true * DIAGONAL, rel=0.05)
    assert focal_sweep.judged(tried, least).clear


def test_no_other_isometry_is_tried_if_the_first_is_not_worthwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    with_inconsistencies(monkeypatch, lambda focal: 0.002 + 0.02 * float(np.log(focal / 700)) ** 2)
    for worth in (False, True):
        judged: list[float] = []

        def worthwhile(first: focal_sweep.Tried, worth: bool = worth, judged: list[float] = judged) -> bool:
            judged.append(first.focal)
            return worth

        tried = focal_sweep.sweep(SEARCH, 0.8 * DIAGONAL, DIAGONAL, given=False, worthwhile=worthwhile)
        assert judged == [0.8 * DIAGONAL]
        assert (len(tried) == 1) == (not worth)


def test_the_focal_sweep_starts_where_the_surface_is_not_stretched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretched surfaces have a small I at focal lengths that are far too long."""

    def inconsistency(focal: float) -> float:
        return 0.001 if focal > 800 else 0.002 + 0.02 * float(np.log(focal / 400)) ** 2

    focals = with_inconsistencies(monkeypatch, inconsistency)
    monkeypatch.setattr(focal_sweep, "_stretched", lambda graph, found: found.inconsistency == 0.001)
    tried = focal_sweep.sweep(SEARCH, 0.8 * DIAGONAL, DIAGONAL, given=False)
    assert focal_sweep.least_of(tried).focal == pytest.approx(400, rel=0.05)
    assert min(each.found.inconsistency for each in tried) > 0.001
    focals.clear()
    monkeypatch.setattr(focal_sweep, "_stretched", lambda graph, found: True)
    tried = focal_sweep.sweep(SEARCH, 0.8 * DIAGONAL, DIAGONAL, given=False)
    assert tried[0].focal == focals[0]
    shortest = focal_sweep.FOCAL_RANGE[0] * DIAGONAL
    assert shortest / focal_sweep.FOCAL_STEP < min(focals) <= shortest


def test_a_given_focal_length_is_kept_where_the_surface_is_stretched(monkeypatch: pytest.MonkeyPatch) -> None:
    given = 0.8 * DIAGONAL
    with_inconsistencies(monkeypatch, lambda focal: 0.002 + 0.02 * float(np.log(focal / 400)) ** 2)
    monkeypatch.setattr(focal_sweep, "_stretched", lambda graph, found: found.inconsistency > 0.01)
    tried = focal_sweep.sweep(SEARCH, given, DIAGONAL, given=True)
    assert tried[0].focal == given
    assert all(each.found.inconsistency <= 0.01 for each in tried[1:])
    assert all(each.focal != given for each in focal_sweep.sweep(SEARCH, given, DIAGONAL, given=False))


@pytest.mark.parametrize("given", [0.1, 0.15, 7.0, 20.0])
def test_an_improbable_focal_length_is_compared_with_others(monkeypatch: pytest.MonkeyPatch, given: float) -> None:
    with_inconsistencies(monkeypatch, lambda focal: 0.002 + 0.02 * float(np.log(focal / 800)) ** 2)
    tried = focal_sweep.sweep(SEARCH, given * DIAGONAL, DIAGONAL, given=True)
    assert tried[0].focal == given * DIAGONAL
    assert focal_sweep.least_of(tried).focal == pytest.approx(800, rel=0.25)


@pytest.mark.parametrize("power", [2.0, -2.0])
def test_the_focal_sweep_ends_one_step_beyond_its_range(monkeypatch: pytest.MonkeyPatch, power: float) -> None:
    focals = with_inconsistencies(monkeypatch, lambda focal: 0.02 * (focal / 1000) ** power)
    focal_sweep.sweep(SEARCH, 0.8 * DIAGONAL, DIAGONAL, given=True)
    low, high = (DIAGONAL * bound for bound in focal_sweep.FOCAL_RANGE)
    assert [focal for focal in focals if not low <= focal <= high] == focals[-1:]


@pytest.mark.parametrize("floor", [0.0, 0.0015])
def test_no_minimum_is_refined_that_would_not_be_accepted(monkeypatch: pytest.MonkeyPatch, floor: float) -> None:
    def flat(focal: float) -> float:
        return floor + 0.0004 * float(np.log(focal / 500)) ** 2 + (0.02 if focal > 2000 else 0.0)

    focals = with_inconsistencies(monkeypatch, flat)
    tried = focal_sweep.sweep(SEARCH, 2.0 * DIAGONAL, DIAGONAL, given=False)
    steps = np.log(np.array(focals) / focals[0]) / np.log(focal_sweep.FOCAL_STEP)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    verdict = focal_sweep.judged(tried, focal_sweep.least_of(tried))
    assert not verdict.clear


@pytest.mark.parametrize("longer", [True, False])
def test_longer_focal_lengths_are_tried_with_lengths_along_the_surface(
    monkeypatch: pytest.MonkeyPatch, longer: bool
) -> None:
    """Distances make long focal lengths seem consistent, and are compared only with shorter ones."""
    true, measured = (800.0 if longer else 500.0), [False]
    focals = with_inconsistencies(
        monkeypatch,
        lambda focal: 0.002 + 0.02 * float(np.log(focal / true)) ** 2 if measured[0] else 20.0 / max(focal, true - 200),
    )
    tried_with_distances: list[float] = []

    def along_surface(search: FocalSearch, tried: list[Tried]) -> tuple[FocalSearch, list[Tried]]:
        if not measured[0]:
            tried_with_distances.extend(focals)
        measured[0] = True
        return search, [found for each in tried if (found := focal_sweep.tried_at(search, each.focal, None))]

    monkeypatch.setattr(focal_sweep, "_along_surface", along_surface)
    tried = focal_sweep.sweep(SEARCH, 640.0, DIAGONAL, given=False)
    assert max(tried_with_distances) == 640.0
    assert focal_sweep.least_of(tried).focal == pytest.approx(true, rel=0.05)


def test_lengths_that_change_at_every_focal_length_are_not_those_of_a_sheet(monkeypatch: pytest.MonkeyPatch) -> None:
    with_inconsistencies(monkeypatch, lambda focal: 0.05 + 0.02 * float(np.log(focal / 500)) ** 2)
    tried = focal_sweep.sweep(SEARCH, 500.0, DIAGONAL, given=True)
    verdict = focal_sweep.judged(tried, focal_sweep.least_of(tried))
    words = "its edge lengths change by 5.0% or more, whatever the focal length"
    assert verdict == focal_sweep.Judgement(0.0, False, words)


@pytest.mark.parametrize(
    ("curve", "clear", "evidence"),
    [
        (lambda far: 0.002 + 0.03 * far**2, True, True),
        (lambda far: 0.01 + 0.006 * far**2, False, True),  # a ratio of 1.1
        (lambda far: 0.0001 + 0.001 * far**2, False, True),  # a large ratio, but a small increase
        (lambda far: 0.01 + 0.001 * far**2, False, False),
        (lambda far: 0.003 + 0.002 * far, False, False),  # falls to one side
        (lambda far: 0.002 + 0.03 * min(far**2, (far - 2) ** 2 + 0.01), False, False),  # two minima
    ],
)  # fmt: skip
def test_a_minimum_is_clear_or_weak_evidence_or_none(
    monkeypatch: pytest.MonkeyPatch, curve: Callable[[float], float], clear: bool, evidence: bool
) -> None:
    with_inconsistencies(monkeypatch, lambda focal: max(1e-5, curve(float(np.log(focal / 700)))))
    tried = [focal_sweep.tried_at(SEARCH, 700 * focal_sweep.FOCAL_STEP**step, None) for step in range(-3, 7)]
    assert all(tried)
    judgement = focal_sweep.judged(tried, focal_sweep.least_of(tried))  # type: ignore[arg-type]
    assert (judgement.clear, judgement.ratio > 0) == (clear, evidence)
    assert judgement.words.startswith("Taken" if evidence else "its edge lengths")
