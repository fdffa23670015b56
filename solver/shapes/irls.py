"""Iteratively reweighted least squares, as pure functions on a State: init → step → terminate.

Majorise–minimise: quadratics majorise the loss and the rank prior, and a few warm-started conjugate gradient iterations
decrease their sum. The energy cannot increase, however few iterations are run.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.energy.low_rank import rank_term
from pliant.solver.energy.objective import loss_of, prior, residuals_of, weights_of
from pliant.solver.energy.problem import Problem
from pliant.solver.errors import NotFinite
from pliant.solver.linear import block_tridiagonal
from pliant.solver.linear.conjugate_gradient import conjugate_gradient
from pliant.solver.linear.preconditioner import build_preconditioner
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Array, Floats
from pliant.solver.shapes.state import State
from pliant.solver.solution import Outcome
from pliant.solver.threads import SMALLEST, over_ranges

INNER_REDUCTION = 0.1
"""Largest relative residual at which an inner solve ends; more accuracy would be wasted, since the weights change next."""
NEGLIGIBLE = 0.1
"""Decrease of the energy that an inner solve may leave, relative to the decrease that ends the reweightings."""
MAX_INNER = 60
"""Maximum number of conjugate gradient iterations per reweighting."""
ROUNDING = float(np.finfo(np.float64).eps)
"""Energy, normalized units, below which the fit is exact: that of a single residual of the size of a rounding error under the L1 loss."""
SINGLE_REDUCTION = 1e-3
"""Smallest relative residual of an inner solve, and the smallest for which single precision is used."""


def init(problem: Problem, shapes: Array, translations: Floats) -> State:
    """Return the state at the starting shapes."""
    return _evaluated(problem, shapes.copy(), translations, None, reweighting=0)


def step(
    problem: Problem,
    state: State,
    *,
    tolerance: float = 0.0,
    should_stop: ShouldStop = never,
) -> State:
    """Do one reweighting: shapes for the weights of `state`, then translations, then new weights.

    Conjugate gradients solve for the correction to the shapes. It needs only one or two digits, so single precision is
    enough where `inner_precision` allows it. Gradient, sum and energy keep the problem's precision.

    The inner solve ends at the relative residual `state.reduction`, the share of the last decrease that the quadratic
    majoriser did not predict (Eisenstat, Walker 1996, choice 1): if the weights hardly change, an accurate solution is
    worthwhile. It also ends once its remaining decrease is negligible compared with `tolerance` times the energy.
    """
    operator = operator_at(problem, state)
    downhill = _downhill(problem, state, operator)
    should_stop()
    inner = operator.rounded(inner_precision(operator, state.reduction))
    precondition = build_preconditioner(inner)
    downhill = downhill.astype(inner.weights.dtype, copy=False)
    should_stop()
    solved = conjugate_gradient(
        inner.apply, downhill, precondition=precondition, reduction=state.reduction, max_iterations=MAX_INNER,
        negligible=NEGLIGIBLE * tolerance * abs(state.objective), should_stop=should_stop,
    )  # fmt: skip
    del downhill, precondition, inner  # before the next weights are allocated
    shapes = np.add(state.shapes, solved.x, out=solved.x if solved.x.dtype == state.shapes.dtype else None)
    should_stop()
    after = _evaluated(problem, shapes, state.translations, state.omega, reweighting=state.reweighting + 1)
    gained = state.objective - after.objective
    unforeseen = abs(gained - solved.decrease) / gained if gained > 0 else INNER_REDUCTION
    reduction = float(np.clip(unforeseen, SINGLE_REDUCTION, INNER_REDUCTION))
    return replace(after, iterations=solved.iterations, reduction=reduction)


def _downhill(problem: Problem, state: State, operator: Operator) -> Array:
    """Return minus half the gradient of the majorised energy, shape `(F, 3, P)`."""
    target = problem.points - state.translations[:, :, None].astype(problem.points.dtype)
    gradient = operator.gradient(state.shapes, target)
    return np.negative(gradient, out=gradient)


def inner_precision(operator: Operator, reduction: float) -> np.dtype[np.floating]:
    """Return single precision if it can reach the reduction and the equations are well conditioned, else the operator's.

    The Gaussian prior needs double precision because it spans ten orders of magnitude: its tridiagonal part is very stiff,
    and the precision along its modes is a small difference of large numbers.
    """
    if operator.quadratic is not None:
        return operator.weights.dtype
    if reduction < SINGLE_REDUCTION or not block_tridiagonal.fits(operator):
        return operator.weights.dtype
    return np.dtype(np.float32) if block_tridiagonal.suits_single_precision(operator) else operator.weights.dtype


def operator_at(problem: Problem, state: State) -> Operator:
    """Return the normal equations that majorise the energy at this state."""
    return Operator(
        problem.projections,
        state.omega,
        problem.bands,
        None if problem.laplacian is None else problem.laplacian.rounded(problem.points.dtype),
        problem.weights.spatial,
        state.rank,
        problem.quadratic,
    )


def terminate(before: State, after: State, *, tolerance: float, max_reweightings: int) -> Outcome | None:
    """Return the outcome of the solve, or None to continue; `after` is the step before `no_higher` is applied.

    Converged if the objective changes by at most `tolerance`, relative, over one reweighting; rejected if it rises by more.
    Changes of the objective of an exact fit are rounding.
    """
    negligible = tolerance * max(abs(before.objective), ROUNDING)
    if after.objective - before.objective > negligible:
        return Outcome.REJECTED
    if before.objective - after.objective <= negligible:
        return Outcome.CONVERGED
    if after.reweighting >= max_reweightings:
        return Outcome.MAX_REWEIGHTINGS
    return None


def no_higher(before: State, after: State) -> State:
    """Return `after`, or the shapes of `before` if rounding near convergence raised the energy."""
    if after.objective <= before.objective:
        return after
    return replace(before, reweighting=after.reweighting, iterations=after.iterations)


def _evaluated(
    problem: Problem, shapes: Array, translations: Floats, omega: Array | None, *, reweighting: int
) -> State:
    """Centre every frame's shape, in place, and return its state; without `problem.moving`, keep translations and centres.

    The translation compensates for the shift: the data term and AX are unchanged (rows of A sum to 0), and ‖HX‖ and the rank
    penalty cannot increase. If weights ω are given, the translations are first fitted to the residuals.
    """
    frames, kind = len(shapes), shapes.dtype.type
    translations, losses = translations.copy(), np.full(frames, np.inf)
    fresh = np.zeros(problem.points.shape, dtype=shapes.dtype)
    squared = np.zeros(problem.confidence.shape, dtype=shapes.dtype)

    def work(start: int, stop: int) -> None:
        for frame in range(start, stop):
            if not np.isfinite(np.vdot(shapes[frame], shapes[frame])):
                continue
            left = residuals_of(problem, shapes, translations, frame)
            if omega is not None and problem.moving:
                shift = _mean(left, omega[frame])
                left -= shift[:, None].astype(kind)
                translations[frame] += shift
            if problem.moving:
                middle = shapes[frame].mean(axis=1, dtype=np.float64)
                shapes[frame] -= middle[:, None].astype(kind)
                translations[frame] += problem.projections[frame].astype(np.float64) @ middle
            losses[frame] = loss_of(problem, left, frame)
            fresh[frame] = weights_of(problem, left, frame)
            np.einsum("cp,cp->p", left, left, out=squared[frame])

    over_ranges(work, frames, smallest=max(1, SMALLEST // shapes[0].size))
    value = float(losses.sum())
    value = value + prior(problem, shapes) if np.isfinite(value) else value
    if not np.isfinite(value):
        raise NotFinite(f"the energy became {value} after {reweighting} reweightings")
    seen = problem.confidence > 0
    return State(
        shapes=shapes, translations=translations, omega=fresh, rank=rank_term(shapes, problem.weights.low_rank),
        objective=value, residual=float(np.sqrt(np.median(squared if seen.all() else squared[seen]))),
        reweighting=reweighting, iterations=0, reduction=INNER_REDUCTION,
    )  # fmt: skip


def _mean(left: Array, weights: Array) -> Floats:
    """Return the weighted mean residual of a frame, shape `(2,)`; 0 where nothing is visible."""
    total = weights.sum(axis=1, dtype=np.float64)
    shift = np.einsum("cp,cp->c", weights, left, dtype=np.float64)
    return np.asarray(np.divide(shift, total, out=np.zeros_like(shift), where=total > 0))
