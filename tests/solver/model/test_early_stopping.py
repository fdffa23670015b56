"""Early stopping: learning ends when held-out points become less probable, and only then."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver.model import early_stopping
from pliant.solver.model.early_stopping import learn_with_early_stopping
from pliant.solver.model.expectation_maximisation import ModelOrder, learned
from pliant.solver.model.model_order import MIN_JUDGED_POINTS, held_out_nll
from pliant.solver.model.random_walk import random_walk
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import exponential

FRAMES = 40
TIME = np.linspace(0, 1, FRAMES)
PAIRS = exponential(np.stack([0.2 * np.sin(7 * TIME), 1.2 * np.sin(9 * TIME), 0.3 * TIME], axis=1))[:, :2]


def drawn(points: int, *, modes: int, drift: float, seed: int = 0) -> np.ndarray:
    """Images of points, shape (F, P, 2), that deform along `modes` smooth modes and a random walk."""
    waves = np.stack([0.5 / (1 + k) * np.sin((k + 1) * np.pi * TIME + k) for k in range(modes)], axis=1)
    random = np.random.default_rng(seed)
    middle = random.standard_normal((points, 3)) * np.sqrt([0.2, 0.4, 0.6])
    walk = np.linalg.cholesky(drift * random_walk(FRAMES, ordered=True))
    deform = np.einsum("fk,pkc->fpc", waves, random.standard_normal((points, modes, 3)))
    deform += np.einsum("fg,pgc->fpc", walk, random.standard_normal((points, FRAMES, 3)))
    return np.einsum("fic,fpc->fpi", PAIRS, middle + deform) + 1e-4 * random.standard_normal((FRAMES, points, 2))


def rows(images: np.ndarray) -> np.ndarray:
    return images.transpose(0, 2, 1).reshape(2 * FRAMES, -1)


def gram_of(images: np.ndarray) -> np.ndarray:
    return rows(images) @ rows(images).T / images.shape[1]


def both(images: np.ndarray) -> tuple[ShapeCovariance, ShapeCovariance, str]:
    """The covariance with early stopping, the fully learned one, and the reason."""
    found, why = learn_with_early_stopping(images, gram_of(images), PAIRS, ModelOrder())
    return found, learned(gram_of(images), PAIRS, ModelOrder()), why


def test_early_stopping_avoids_overfitting_the_given_points() -> None:
    found, whole, why = both(drawn(30, modes=12, drift=0.03))
    other = rows(drawn(1000, modes=12, drift=0.03, seed=1))
    assert held_out_nll(found, PAIRS, other) < held_out_nll(whole, PAIRS, other) - 0.5
    assert "more would make held-out points less probable" in why


@pytest.mark.parametrize(
    ("points", "modes", "drift"),
    [(30, 2, 1e-6), (2 * FRAMES, 12, 0.03), (MIN_JUDGED_POINTS - 1, 12, 0.03)],
    ids=["few modes are all there is", "as many points as image coordinates", "too few to deal out"],
)
@pytest.mark.slow
def test_learning_runs_to_the_end_without_evidence_of_overfitting(points: int, modes: int, drift: float) -> None:
    found, whole, why = both(drawn(points, modes=modes, drift=drift))
    np.testing.assert_array_equal(found.over_frames(), whole.over_frames())
    assert "learned in" not in why


def test_a_large_sample_is_not_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_stopping, "MAX_SAMPLE_POINTS", 30)
    _, _, why = both(drawn(30, modes=12, drift=0.03))
    assert "learned in" not in why


def test_a_reduced_number_of_modes_is_reported() -> None:
    images = drawn(200, modes=2, drift=1e-6)
    _, why = learn_with_early_stopping(images, gram_of(images), PAIRS, ModelOrder(max_modes=4))
    assert why.endswith("more than 4 modes, learned from some points, do not make other points more probable.")


def test_a_stop_ends_the_scoring(monkeypatch: pytest.MonkeyPatch) -> None:
    images = drawn(30, modes=12, drift=0.03)
    judged: list[float] = []

    def counted(*given: Any) -> float:
        judged.append(held_out_nll(*given))
        return judged[-1]

    monkeypatch.setattr(early_stopping, "held_out_nll", counted)
    learn_with_early_stopping(images, gram_of(images), PAIRS, ModelOrder(), should_stop=lambda: True)
    assert len(judged) == 2 * early_stopping.FOLDS, "one round of either way"
