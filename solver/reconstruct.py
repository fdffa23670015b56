"""`solve`: cameras first, then shapes by iteratively reweighted least squares."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.cameras.camera_choice import with_camera_choice
from pliant.solver.cameras.depth_rounds import settled
from pliant.solver.cameras.estimation import CameraEstimate, estimate_cameras, given_cameras
from pliant.solver.cameras.joint_refinement import informative_frames, learn, learned_frames
from pliant.solver.cameras.lens import given_lens
from pliant.solver.cameras.perspective import Perspective, orthographic
from pliant.solver.cameras.planar_ambiguity import is_planar
from pliant.solver.energy.objective import residuals
from pliant.solver.energy.problem import Problem
from pliant.solver.energy.robust_loss import largest_weight
from pliant.solver.errors import InvalidInput, InvalidSettings
from pliant.solver.isometry.surface import IsometricVerdict, isometric_surface
from pliant.solver.model.model_order import ModelOrder
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.monitor import Monitor, enter
from pliant.solver.records import (
    MIN_POINTS,
    Camera,
    Choices,
    Floats,
    KnownCamera,
    Mesh,
    Outcome,
    Solution,
    Step,
    Trace,
    Tracks,
    read_only,
)  # fmt: skip
from pliant.solver.settings import Settings
from pliant.solver.shapes.assessment import assessed
from pliant.solver.shapes.initialization import pseudo_inverse, uniform_solution
from pliant.solver.shapes.irls import init, no_higher, step, terminate
from pliant.solver.shapes.isometric_solution import centre_downwards, downwards, isometric_solution
from pliant.solver.shapes.outlier_rejection import reject_outliers
from pliant.solver.shapes.perspective_shapes import corrected_again, seen_in_perspective
from pliant.solver.shapes.setup import build_problem, with_bending
from pliant.solver.shapes.sparsely_observed import WELL_OBSERVED_SHARE, WellObserved, place_the_rest, well_observed
from pliant.solver.shapes.state import State
from pliant.solver.stages import learning, planned, settling
from pliant.solver.tracks.completion import seen_again
from pliant.solver.tracks.frame_order import as_they_came, content_order, differences, in_order, resolved_order
from pliant.solver.tracks.noise import OUTLIER_SHARE
from pliant.solver.tracks.normalization import Normalized, normalize

DEPTH_ROUNDS, DEPTH_SETTLED = 4, 1e-4
"""Maximum number of corrections of the tracks by the depths of the shapes, and the RMS change of the corrected
tracks, normalized units, below which they end."""


def solve(
    tracks: Tracks,
    mesh: Mesh | None = None,
    *,
    cameras: KnownCamera | None = None,
    settings: Settings | None = None,
    on_step: Callable[[Step], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Solution:
    """Reconstruct a shape for every frame.

    Parameters
    ----------
    tracks : Tracks
        F frames of P points.
    mesh : Mesh, optional
        Which points are neighbours; without it there is no smoothness in space.
    cameras : KnownCamera, optional
        Given cameras; None estimates them. Scales that are not given are estimated if the camera model has them.
    settings : Settings, optional
        Method, weights, precision; the defaults are meant to need no change.
    on_step : callable, optional
        Called after every unit of work.
    should_stop : callable, optional
        Called between units of work; once it returns True, the solve ends with `Outcome.STOPPED` and the last shapes.

    Raises
    ------
    InvalidInput
        Mesh or cameras do not fit the tracks, or the tracks show nothing.
    InvalidSettings
        The settings ask for what the mesh does not have.
    NotFinite
        The arithmetic overflowed.
    """
    settings = settings if settings is not None else Settings()
    _check_fit(tracks, mesh, cameras)
    settings, why = resolved_order(tracks, settings)
    monitor = _monitored(tracks, cameras, settings, on_step, should_stop)
    if settings.order == "film":
        return _with_reason(_solved(tracks, mesh, cameras, settings, monitor), why)
    order = content_order(differences(tracks))
    moved, cameras = in_order(tracks, cameras, order)
    return _with_reason(as_they_came(_solved(moved, mesh, cameras, settings, monitor), order), why)


def _with_reason(solution: Solution, why: str) -> Solution:
    choices = replace(solution.choices, reasons={**solution.choices.reasons, "order": why})
    return replace(solution, choices=choices)


def _solved(
    tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera | None, settings: Settings, monitor: Monitor
) -> Solution:
    """Solve frames in the order that they have; with `order` `any` no prior compares neighbours."""
    on_step, should_stop, report = monitor.report, monitor, monitor.report
    began = time.perf_counter()
    normalized = normalize(tracks)
    lens = given_lens(tracks, normalized, settings, cameras)
    verdict = _isometric(tracks, cameras, settings, should_stop)
    if verdict is not None and verdict.surface is not None:
        seconds = {"cameras": time.perf_counter() - began}
        solution = isometric_solution(tracks, verdict, settings, unit=normalized.unit, seconds=seconds)
        report(Step("finish", 1.0, max_reweightings=settings.max_reweightings))
        return solution
    estimate, covariance = _learned(normalized, cameras, settings, lens, on_step=on_step, should_stop=should_stop)
    report(Step("cameras", 0.0, max_reweightings=settings.max_reweightings))
    seconds = {"cameras": time.perf_counter() - began}

    began = time.perf_counter()
    flat = orthographic(normalized, estimate.perspective)
    start, outliers = _initialised(flat, estimate, covariance, mesh, settings), estimate.outliers
    if outliers > OUTLIER_SHARE and _resists(start.problem):
        start = _with_outliers_rejected(start, outliers, should_stop)
        cleaned = _cleaned(tracks, start)
        if cleaned is not None and not (should_stop is not None and should_stop()):
            again = time.perf_counter()
            estimate, covariance = _learned(
                cleaned, cameras, settings, given_lens(tracks, cleaned, settings, cameras),
                on_step=None, should_stop=should_stop, before=estimate,
            )  # fmt: skip
            seconds["cameras"] += time.perf_counter() - again
            began += time.perf_counter() - again
            normalized, flat = cleaned, orthographic(cleaned, estimate.perspective)
            start = _initialised(flat, estimate, covariance, mesh, settings)
        start = _with_outlier_reason(start, tracks, outliers)
    part, problem, choices, state = start.part, start.problem, start.choices, start.state
    report(_step_of("initialise", state, settings, normalized.unit))
    seconds["initialise"] = time.perf_counter() - began

    began = time.perf_counter()
    kept = None if part is None else part.kept
    history, outcome = _loop(problem, [state], settings, normalized.unit, report, should_stop)
    for _ in range(DEPTH_ROUNDS if estimate.perspective is not None and estimate.perspective.bends else 0):
        if outcome is Outcome.STOPPED:
            break
        problem, flat, changed = corrected_again(problem, history[-1], normalized, flat, estimate, kept)
        corrected = init(problem, history[-1].shapes, history[-1].translations)
        history.append(replace(corrected, reweighting=history[-1].reweighting))
        history, outcome = _loop(problem, history, settings, normalized.unit, report, should_stop)
        if changed < DEPTH_SETTLED:
            break
    if part is not None and covariance is not None:
        whole, _ = build_problem(flat, estimate, mesh, settings, covariance)
        problem, choices, history[-1] = _with_the_rest(part, whole, covariance, problem, choices, history[-1], outliers)
    seconds["shapes"] = time.perf_counter() - began

    began = time.perf_counter()
    if normalized.visible is not tracks.visible:  # outliers are reported, not hidden
        normalized = _as_given(normalized, tracks)
        problem = replace(
            problem, points=np.ascontiguousarray(normalized.points.transpose(0, 2, 1), dtype=problem.points.dtype)
        )
    outcome = Outcome.STOPPED if monitor() else outcome
    choices = with_camera_choice(
        choices, estimate.perspective, settings, unit=normalized.unit, given=cameras is not None
    )
    solution = finish(
        problem, history, outcome, normalized=normalized, estimate=estimate, choices=choices, seconds=seconds
    )
    if estimate.perspective is not None:
        solution = seen_in_perspective(solution, tracks, estimate.perspective, normalized.unit, kept)
    enter(should_stop, "trust")
    solution = assessed(
        solution, np.asarray(problem.confidence, dtype=np.float64), estimate, covariance, normalized.unit,
        turning=cameras is None and settings.refine_rotations, seed=settings.seed, should_stop=should_stop,
    )  # fmt: skip
    if monitor.stopped:
        solution = replace(solution, outcome=Outcome.STOPPED)
    if verdict is not None:
        solution = replace(solution, choices=_with_verdict(solution.choices, verdict, settings))
    seconds["finish"] = time.perf_counter() - began
    report(_step_of("finish", history[-1], settings, normalized.unit, fraction=1.0))
    return solution


def _isometric(
    tracks: Tracks, cameras: KnownCamera | None, settings: Settings, should_stop: Callable[[], bool] | None
) -> IsometricVerdict | None:
    """Return whether the surface is isometric; None where this is not tested."""
    if settings.surface == "isometric" and cameras is not None:
        raise InvalidSettings(
            "invalid_option", field="options.surface", expected="auto or free where rotations are given", got="'isometric'",
            hint="Leave the rotations out: an isometric surface gives its own cameras.",
        )  # fmt: skip
    if not _tries_isometry(cameras, settings):
        return None
    return isometric_surface(
        downwards(tracks) if settings.y_up else tracks, focal=settings.focal_length, principal_point=centre_downwards(settings),
        image_size=settings.image_size, required=settings.surface == "isometric", should_stop=should_stop,
    )  # fmt: skip


def _tries_isometry(cameras: KnownCamera | None, settings: Settings) -> bool:
    if settings.surface != "auto":
        return settings.surface == "isometric"
    # Without image size or focal length, I has false minima on cloth seen from afar.
    pinhole = settings.focal_length is not None or settings.image_size is not None
    return settings.gaussian and pinhole and cameras is None and settings.camera in {Settings().camera, "perspective"}


def _with_verdict(choices: Choices, verdict: IsometricVerdict, settings: Settings) -> Choices:
    """Return the choices with the reason for a free surface, and a warning if an isometric one was required."""
    warnings = choices.warnings
    if settings.surface == "isometric":
        warnings = (*warnings, f"The surface could not be taken as isometric and is free. {verdict.reason}")
    tried = tuple((each.focal, each.inconsistency) for each in verdict.candidates)
    return replace(
        choices, reasons={**choices.reasons, "surface": verdict.reason}, warnings=warnings, focal_lengths=tried
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Start of the main loop."""

    part: WellObserved | None
    """The well-observed points, to which the problem is restricted; None for all points."""

    problem: Problem
    choices: Choices
    state: State


def _learned(
    normalized: Normalized,
    cameras: KnownCamera | None,
    settings: Settings,
    lens: Perspective | None,
    *,
    on_step: Callable[[Step], None] | None,
    should_stop: Callable[[], bool] | None,
    before: CameraEstimate | None = None,
) -> tuple[CameraEstimate, ShapeCovariance | None]:
    """Return the cameras, and the covariance of the shapes if it is the prior; `before` is the estimate with outliers."""
    rank = 0 if before is None else before.rank
    enter(should_stop, "completion")
    if cameras is not None:
        estimate = given_cameras(normalized, cameras, settings, rank=rank)
    else:
        estimate = estimate_cameras(normalized, settings, on_step=on_step, should_stop=should_stop, rank=rank)
    if before is not None:
        estimate = replace(estimate, outliers=max(estimate.outliers, before.outliers))
    elif isinstance(should_stop, Monitor) and settings.gaussian and estimate.outliers > OUTLIER_SHARE:
        stages = learning(len(estimate.rotations), gaussian=True, known_cameras=cameras is not None)
        should_stop.expect(stages, before="shapes")
    estimate = replace(estimate, perspective=lens)
    shown = informative_frames(normalized.visible)
    if not settings.gaussian:
        if lens is not None:
            estimate = settled(
                estimate, normalized, learned_frames(shown), model_order=ModelOrder(ordered=estimate.ordered),
                turning=cameras is None and settings.refine_rotations,
                should_stop=should_stop,
            )  # fmt: skip
        return estimate, None
    # The pose signs of a plane are weakly determined; completed outliers are enough to flip them.
    corrupted_plane = estimate.outliers > OUTLIER_SHARE and is_planar(estimate.gram)
    return learn(
        estimate,
        shown,
        turning=cameras is None and settings.refine_rotations and not corrupted_plane,
        estimates_scales=settings.estimates_scales,
        seed=settings.seed,
        normalized=normalized,
        y_up=settings.y_up,
        should_stop=should_stop,
    )


def _initialised(
    normalized: Normalized,
    estimate: CameraEstimate,
    covariance: ShapeCovariance | None,
    mesh: Mesh | None,
    settings: Settings,
) -> _Start:
    part = None if covariance is None or settings.temporal_weight == 0 else well_observed(normalized, mesh)
    if part is None:
        problem, choices = build_problem(normalized, estimate, mesh, settings, covariance)
    else:
        problem, choices = build_problem(part.normalized, estimate, part.mesh, settings, covariance)
    return _Start(part, *with_bending(problem, choices, _start(problem, estimate, settings), settings))


def _resists(problem: Problem) -> bool:
    """Whether outliers are rejected: only with a Gaussian prior of positive weight."""
    return problem.quadratic is not None and problem.weights.temporal > 0


def _with_outliers_rejected(start: _Start, outliers: float, should_stop: Callable[[], bool] | None) -> _Start:
    kept, state = reject_outliers(start.problem, start.state, outliers, should_stop=should_stop)
    return replace(start, problem=kept, state=state)


def _cleaned(tracks: Tracks, start: _Start) -> Normalized | None:
    """Return the tracks with rejected observations hidden, to start again; None if none were rejected or too few points remain.

    An unrecognised outlier biases the completion and everything after it. Faces with 10 % outliers: .072 without a
    second start, .059 with it.
    """
    visible = _kept(tracks, start)
    if (visible == tracks.visible).all() or seen_again(visible) < MIN_POINTS:
        return None
    return normalize(Tracks.from_arrays(tracks.points, visible))


def _kept(tracks: Tracks, start: _Start) -> Floats:
    """Return the confidence of the tracks without rejected observations, shape `(F, P)`."""
    visible = np.array(tracks.visible)
    points = slice(None) if start.part is None else start.part.kept
    visible[:, points] = np.where(start.problem.confidence > 0, visible[:, points], 0.0)
    return visible


def _with_outlier_reason(start: _Start, tracks: Tracks, outliers: float) -> _Start:
    share = 1 - np.count_nonzero(_kept(tracks, start)) / np.count_nonzero(tracks.visible)
    reason = (
        f"{share:.1%} of what was seen is left out as gross outliers; {outliers:.1%} looked like it before the fit."
    )
    choices = replace(start.choices, reasons={**start.choices.reasons, "outliers": reason})
    return replace(start, choices=choices)


def _as_given(normalized: Normalized, tracks: Tracks) -> Normalized:
    """Return all observations in the unit and about the centroids of the remaining ones."""
    points = (tracks.points - normalized.centroid[:, None]) / normalized.unit
    return replace(normalized, points=np.where(tracks.visible[..., None] > 0, points, 0.0), visible=tracks.visible)


def _with_the_rest(
    part: WellObserved,
    whole: Problem,
    covariance: ShapeCovariance,
    problem: Problem,
    choices: Choices,
    state: State,
    outliers: float,
) -> tuple[Problem, Choices, State]:
    """Return problem, choices and state of all points, given those of the well-observed points."""
    confidence = whole.confidence.copy()
    confidence[:, part.kept] = problem.confidence
    whole = replace(whole, confidence=confidence)
    sparse, never = 1 - len(part.kept) / confidence.shape[1], float((confidence == 0).all(axis=0).mean())
    whole, state = place_the_rest(part, whole, covariance, state, spoiled=outliers > OUTLIER_SHARE)
    reason = (
        f"{sparse:.1%} of the points were seen in fewer than {WELL_OBSERVED_SHARE:.0%} of the frames ({never:.1%} in none): "
        "placed on the surface, then moved to their observations."
    )
    return whole, replace(choices, reasons={**choices.reasons, "sparsely_observed": reason}), state


def _loop(
    problem: Problem,
    history: list[State],
    settings: Settings,
    unit: float,
    report: Callable[[Step], None],
    should_stop: Callable[[], bool] | None,
) -> tuple[list[State], Outcome]:
    """Step until `terminate` returns an outcome. Only the newest state keeps its arrays."""
    if settings.method == "pseudo_inverse":
        return history, Outcome.CONVERGED
    while True:
        if should_stop is not None and should_stop():
            return history, Outcome.STOPPED
        before = history[-1]
        computed = step(problem, before, should_stop=should_stop)
        after = no_higher(before, computed)
        history[-1] = before.summary()
        history.append(after)
        share = settling(
            [state.objective for state in history], tolerance=settings.tolerance, most=settings.max_reweightings
        )
        report(_step_of("reweight", after, settings, unit, fraction=share))
        outcome = terminate(before, computed, tolerance=settings.tolerance, max_reweightings=settings.max_reweightings)
        if outcome is not None:
            return history, outcome


def finish(
    problem: Problem,
    history: list[State],
    outcome: Outcome,
    *,
    normalized: Normalized,
    estimate: CameraEstimate,
    choices: Choices,
    seconds: dict[str, float],
) -> Solution:
    """Turn the last state into a Solution in the tracks' unit."""
    state, unit = history[-1], normalized.unit
    left = residuals(problem, state.shapes, state.translations).astype(np.float64)
    seen = normalized.visible > 0
    length = np.where(seen, np.hypot(left[:, 0], left[:, 1]), 0.0)
    top = largest_weight(problem.loss, problem.weights.robust_scale)
    trust = np.where(seen, state.omega.mean(axis=1, dtype=np.float64) / top, 0.0)
    shapes = (state.shapes.transpose(0, 2, 1).astype(np.float64) @ problem.axes.T) * unit
    camera = Camera(
        np.array(estimate.rotations, dtype=np.float64),
        np.array(estimate.scales, dtype=np.float64),
        normalized.centroid + unit * state.translations,
    )
    trace = Trace(
        np.array([s.objective for s in history]),
        unit * np.array([s.residual for s in history]),
        np.array([s.iterations for s in history], dtype=np.int32),
    )
    residual = unit * length
    arrays: list[Floats] = [shapes, camera.rotations, camera.scales, camera.translations, residual, trust]
    for array in arrays:
        read_only(array)
    return Solution(shapes, camera, residual, np.clip(trust, 0.0, 1.0), trace, outcome, choices, seconds)


def _start(problem: Problem, estimate: CameraEstimate, settings: Settings) -> State:
    translations = np.array(estimate.translations, dtype=np.float64)
    if settings.method == "pseudo_inverse":
        return init(problem, pseudo_inverse(problem, translations), translations)
    return init(problem, uniform_solution(problem, translations), translations)


def _check_fit(tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera | None) -> None:
    if mesh is not None and mesh.num_points != tracks.num_points:
        raise InvalidInput(
            "mesh_mismatch", field="mesh", expected=f"{tracks.num_points} vertices, one for each point of the tracks",
            got=f"{mesh.num_points}", hint="Vertex i of the mesh must be point i of the tracks.",
        )  # fmt: skip
    if cameras is not None and len(cameras.rotations) != tracks.num_frames:
        raise InvalidInput(
            "camera_mismatch", field="rotations", expected=f"{tracks.num_frames} rotations, one for each frame of the tracks",
            got=f"{len(cameras.rotations)}", hint="Give one camera a frame, in the order of the frames.",
        )  # fmt: skip


def _step_of(stage: str, state: State, settings: Settings, unit: float, *, fraction: float = 0.0) -> Step:
    return Step(
        stage,
        fraction,
        reweighting=state.reweighting,
        max_reweightings=settings.max_reweightings,
        objective=state.objective,
        residual=unit * state.residual,
    )


def _monitored(
    tracks: Tracks,
    cameras: KnownCamera | None,
    settings: Settings,
    on_step: Callable[[Step], None] | None,
    should_stop: Callable[[], bool] | None,
) -> Monitor:
    """Return the monitor of the solve, with its plan."""
    plan = planned(
        tracks.num_frames, tracks.num_points, gaussian=settings.gaussian, known_cameras=cameras is not None,
        sheet=_tries_isometry(cameras, settings), hidden=not tracks.all_visible,
    )  # fmt: skip
    return Monitor(on_step, should_stop, plan=plan)
