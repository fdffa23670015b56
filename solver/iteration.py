"""The minimisation, as four pure functions on a State: init → step → terminate → finish.

Majorise–minimise: the loss and the rank prior are replaced by the quadratics that touch them from above, and conjugate
gradients, warm-started, lower the sum for a few iterations. Whatever they reach, the energy itself cannot have risen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pliant.solver.conjugate_gradient import conjugate_gradient
from pliant.solver.energy import objective, residuals
from pliant.solver.errors import NotFinite
from pliant.solver.loss import loss_weights
from pliant.solver.low_rank import rank_term
from pliant.solver.operator import Operator
from pliant.solver.precondition import build_preconditioner
from pliant.solver.records import Floats, Outcome
from pliant.solver.state import Array, Problem, State

INNER_REDUCTION = 0.1
"""Inner solves reduce the residual by this factor: more is wasted on weights that are about to change."""
MAX_INNER = 60
"""Upper bound on conjugate-gradient iterations in one reweighting."""


def init(problem: Problem, shapes: Array, translations: Floats) -> State:
    """Evaluate the start."""
    shapes, translations = _centred(problem, shapes, translations)
    return _evaluated(problem, shapes, translations, reweighting=0, iterations=0)


def step(
    problem: Problem,
    state: State,
    *,
    reduction: float = INNER_REDUCTION,
    max_inner: int = MAX_INNER,
    should_stop: Callable[[], bool] | None = None,
) -> State:
    """Lower the energy once: shapes for the weights of `state`, then translations, then new weights."""
    operator = operator_at(problem, state)
    target = problem.points - state.translations[:, :, None].astype(problem.points.dtype)
    solved = conjugate_gradient(
        operator.apply, operator.right_hand_side(target), state.shapes, precondition=build_preconditioner(operator),
        reduction=reduction, max_iterations=max_inner, should_stop=should_stop,
    )  # fmt: skip
    shapes = solved.x
    left = residuals(problem, shapes, state.translations)
    total = state.omega.sum(axis=2, dtype=np.float64)
    shift = np.einsum("fcp,fcp->fc", state.omega, left, dtype=np.float64)
    translations = state.translations + np.divide(shift, total, out=np.zeros_like(shift), where=total > 0)
    shapes, translations = _centred(problem, shapes, translations)
    return _evaluated(problem, shapes, translations, reweighting=state.reweighting + 1, iterations=solved.iterations)


def operator_at(problem: Problem, state: State) -> Operator:
    """Return the normal equations that majorise the energy at this state."""
    return Operator(
        problem.projections,
        state.omega,
        problem.bands,
        problem.laplacian,
        problem.weights.spatial,
        state.rank,
        problem.quadratic,
    )


def terminate(before: State, after: State, *, tolerance: float, max_reweightings: int) -> Outcome | None:
    """Return how the solve ended, or None to go on.

    Converged when the objective's relative change over one reweighting is below `tolerance`.
    """
    if before.objective - after.objective <= tolerance * abs(before.objective):
        return Outcome.CONVERGED
    if after.reweighting >= max_reweightings:
        return Outcome.MAX_REWEIGHTINGS
    return None


def no_higher(before: State, after: State) -> State:
    """Return `after`, unless rounding at the very end let its energy rise: then the shapes of `before` stand."""
    if after.objective <= before.objective:
        return after
    return replace(before, reweighting=after.reweighting, iterations=after.iterations)


def _centred(problem: Problem, shapes: Array, translations: Floats) -> tuple[Array, Floats]:
    """Move each frame's shape to its centroid; the translation takes up what the camera sees of the move.

    The data term does not notice, AX neither (rows of A sum to 0), and ‖HX‖ and the rank penalty cannot grow by it.
    """
    middle = shapes.mean(axis=2, dtype=np.float64)
    moved = translations + np.einsum("fic,fc->fi", problem.projections.astype(np.float64), middle)
    return shapes - middle[:, :, None].astype(shapes.dtype), moved


def _evaluated(problem: Problem, shapes: Array, translations: Floats, *, reweighting: int, iterations: int) -> State:
    left = residuals(problem, shapes, translations)
    weights = problem.weights
    whole = bool(np.isfinite(np.vdot(shapes, shapes)))
    value = objective(problem, shapes, left) if whole else np.inf
    if not np.isfinite(value):
        raise NotFinite(f"the energy became {value} after {reweighting} reweightings")
    seen = problem.confidence > 0
    return State(
        shapes=shapes,
        translations=translations,
        omega=loss_weights(left, problem.confidence, loss=problem.loss, scale=weights.robust_scale),
        rank=rank_term(shapes, weights.low_rank, weights.rank_floor),
        objective=value,
        residual=float(np.median(np.hypot(left[:, 0][seen], left[:, 1][seen]))),
        reweighting=reweighting,
        iterations=iterations,
    )
