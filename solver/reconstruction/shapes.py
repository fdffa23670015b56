"""Third stage: solve for the shapes by iteratively reweighted least squares."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from pliant.solver.monitor import Monitor
from pliant.solver.reconstruction.camera_report import with_camera_choice
from pliant.solver.reconstruction.solution import finish
from pliant.solver.reconstruction.start import Start
from pliant.solver.reconstruction.unused_settings import without_effect
from pliant.solver.records import Step
from pliant.solver.shapes.assessment import assessed
from pliant.solver.shapes.inliers import with_inlier_probability
from pliant.solver.shapes.irls import init, no_higher, step, terminate
from pliant.solver.shapes.jackknife import Changes
from pliant.solver.shapes.perspective_shapes import corrected_again, seen_in_perspective
from pliant.solver.shapes.setup import build_problem
from pliant.solver.shapes.sparsely_observed import WELL_OBSERVED_SHARE, place_the_rest
from pliant.solver.shapes.state import State
from pliant.solver.solution import Outcome, Solution
from pliant.solver.tracks.noise import OUTLIER_SHARE

DEPTH_ROUNDS, DEPTH_SETTLED = 4, 1e-4
"""Maximum number of corrections of the tracks with the depths of the shapes, and the RMS change of the corrected tracks,
normalized units, below which they end."""


def shapes_from(start: Start, monitor: Monitor, *, seconds: dict[str, float], changes: Changes | None) -> Solution:
    """Return the solution computed from a start; `seconds` is the time per stage so far, `changes` is as for `assessed`."""
    monitor.enter("shapes")
    monitor.report(_step_of("initialise", start.state, start))
    began = time.perf_counter()
    history, start = [start.state], replace(start, state=start.state.summary())  # so that no step keeps its arrays
    start, history, outcome = _minimised(start, history, monitor)
    start, history[-1] = _with_the_rest(start, history[-1])
    seconds = {**seconds, "shapes": time.perf_counter() - began}
    began = time.perf_counter()
    solution = _finished(start, history, outcome, monitor, changes)
    monitor.report(_step_of("finish", history[-1], start, fraction=1.0))
    return replace(solution, seconds={**seconds, "finish": time.perf_counter() - began})


def _minimised(start: Start, history: list[State], monitor: Monitor) -> tuple[Start, list[State], Outcome]:
    """Return the start, its tracks corrected for perspective with the depths of the shapes, the history, and the outcome."""
    view = start.estimate.perspective
    corrections = DEPTH_ROUNDS if view is not None and view.is_perspective else 0
    if corrections > 0:
        monitor.expect([replace(monitor.current, name="corrections")], before="finish")
    history, outcome = _loop(start, history, monitor)
    for _ in range(corrections):
        if outcome in (Outcome.STOPPED, Outcome.MAX_REWEIGHTINGS):
            break
        monitor.enter("corrections")
        problem, flat, changed = corrected_again(
            start.problem, history[-1], start.observations.normalized, start.flat, start.estimate, start.kept
        )
        start = replace(start, problem=problem, flat=flat)
        corrected = init(problem, history[-1].shapes, history[-1].translations)
        history.append(replace(corrected, reweighting=history[-1].reweighting))
        history, outcome = _loop(start, history, monitor)
        if changed < DEPTH_SETTLED:
            break
    return start, history, outcome


def _loop(start: Start, history: list[State], monitor: Monitor) -> tuple[list[State], Outcome]:
    """Step until `terminate` returns an outcome. Only the newest state keeps its arrays."""
    settings = start.settings
    if settings.method == "pseudo_inverse":
        return history, Outcome.CONVERGED
    while True:
        if monitor():
            return history, Outcome.STOPPED
        before = history[-1]
        computed = step(start.problem, before, tolerance=settings.tolerance, should_stop=monitor)
        after = no_higher(before, computed)
        history[-1] = before.summary()
        history.append(after)
        monitor.report(_step_of("reweight", after, start))
        outcome = terminate(before, computed, tolerance=settings.tolerance, max_reweightings=settings.max_reweightings)
        if outcome is not None:
            return history, outcome


def _with_the_rest(start: Start, state: State) -> tuple[Start, State]:
    """Return start and state of all points, given those of the well-observed points."""
    part, covariance = start.part, start.covariance
    if part is None or covariance is None:
        return start, state
    whole, _ = build_problem(start.flat, start.estimate, start.mesh, start.settings, covariance)
    confidence = whole.confidence.copy()
    confidence[:, part.kept] = start.problem.confidence
    whole = replace(whole, confidence=confidence, moving=start.problem.moving)
    sparse, never = 1 - len(part.kept) / confidence.shape[1], float((confidence == 0).all(axis=0).mean())
    whole, state = place_the_rest(part, whole, covariance, state, spoiled=start.outlier_share > OUTLIER_SHARE)
    reason = (
        f"{sparse:.1%} of the points were seen in fewer than {WELL_OBSERVED_SHARE:.0%} of the frames ({never:.1%} in none): "
        "placed on the surface, then moved to their observations."
    )
    choices = replace(start.choices, reasons={**start.choices.reasons, "sparsely_observed": reason})
    return replace(start, problem=whole, choices=choices), state


def _finished(
    start: Start, history: list[State], outcome: Outcome, monitor: Monitor, changes: Changes | None
) -> Solution:
    """Return the solution in the tracks' unit, with standard deviations, inlier probabilities and verdict."""
    observations, estimate, problem = start.observations, start.estimate, start.problem
    tracks, normalized = observations.tracks, observations.normalized
    outcome = Outcome.STOPPED if monitor() else outcome
    choices = with_camera_choice(
        start.choices, estimate.perspective, start.settings, unit=normalized.unit, known=observations.known
    )
    unused = without_effect(
        start.settings, with_mesh=start.mesh is not None, known_cameras=observations.known is not None
    )
    choices = replace(choices, warnings=(*choices.warnings, *unused))
    monitor.enter("finish")
    monitor()
    solution = finish(
        problem, history, outcome, normalized=normalized, estimate=estimate, choices=choices, y_up=start.settings.y_up
    )
    history[-1] = history[-1].summary()
    if estimate.perspective is not None:
        centre = start.kept if problem.moving else None
        solution = seen_in_perspective(solution, tracks, estimate.perspective, normalized.unit, centre)
    confidence = np.asarray(problem.confidence, dtype=np.float64)
    monitor()
    solution = with_inlier_probability(
        solution, tracks, confidence, full_confidence=normalized.full_confidence, loss=problem.loss, should_stop=monitor
    )
    monitor.enter("trust")
    # With weight 0 the prior was not used for the shapes, so it does not describe their errors.
    covariance = start.covariance if problem.weights.temporal > 0 else None
    solution = assessed(
        solution, tracks, confidence, estimate, covariance, normalized.unit,
        turning=observations.turning, free_scales=observations.known_scales is None,
        seed=start.settings.seed, connected=start.part is not None or problem.weights.spatial > 0, changes=changes,
        centred=problem.moving, given_weights=start.settings.gives_weights, should_stop=monitor,
    )  # fmt: skip
    return replace(solution, outcome=Outcome.STOPPED) if monitor.stopped else solution


def _step_of(stage: str, state: State, start: Start, *, fraction: float = 0.0) -> Step:
    return Step(
        stage,
        fraction,
        reweighting=state.reweighting,
        max_reweightings=start.settings.max_reweightings,
        objective=state.objective,
        residual=start.flat.unit * state.residual,
    )
