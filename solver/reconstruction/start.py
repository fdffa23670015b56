"""Initialisation of the third stage: the problem, least-squares shapes, and the rejection of gross outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.solver.agreement import MAKE_MESH, MAKE_SETTINGS, check_mesh, check_tracks, check_type
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import orthographic
from pliant.solver.energy.problem import Problem
from pliant.solver.errors import InvalidInput, InvalidSettings, numeric, shape_text, singular_refused, wrong_input
from pliant.solver.limits import MAX_COORDINATE
from pliant.solver.mesh import Mesh
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import ShouldStop, pulses_to
from pliant.solver.reconstruction.cameras import Cameras
from pliant.solver.reconstruction.observations import Observations, OnStep, monitored
from pliant.solver.reconstruction.prior import MAKE_ESTIMATE, Prior, estimate_with
from pliant.solver.records import Choices, Floats, Step, Tracks
from pliant.solver.settings import Settings
from pliant.solver.shapes.initialization import pseudo_inverse, uniform_solution
from pliant.solver.shapes.irls import init
from pliant.solver.shapes.outlier_rejection import gross_outliers
from pliant.solver.shapes.setup import build_problem, with_bending
from pliant.solver.shapes.sparsely_observed import WellObserved, well_observed
from pliant.solver.shapes.state import State
from pliant.solver.threads import serial_blas
from pliant.solver.tracks.noise import OUTLIER_SHARE
from pliant.solver.tracks.normalization import Normalized


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Problem and initial state of the minimisation."""

    observations: Observations
    mesh: Mesh | None
    settings: Settings

    flat: Normalized
    """The tracks corrected for perspective; the normalized tracks under orthographic cameras."""

    estimate: CameraEstimate
    covariance: ShapeCovariance | None

    outlier_share: float
    """Estimated share of gross outliers among the visible observations."""

    part: WellObserved | None
    """The well-observed points, to which the problem is restricted; None for all points."""

    problem: Problem
    choices: Choices
    state: State

    @property
    def kept(self) -> NDArray[np.intp] | None:
        """Indices of the points of the problem; None for all points."""
        return None if self.part is None else self.part.kept

    def confidence(self) -> Floats:
        """Return the confidence of the tracks without rejected observations, shape `(F, P)`."""
        visible = np.array(self.observations.normalized.visible)
        points = slice(None) if self.part is None else self.part.kept
        visible[:, points] = np.where(self.problem.confidence > 0, visible[:, points], 0.0)
        return visible

    def rejected(self) -> NDArray[np.bool_]:
        """Return the visible observations that are not used, shape `(F, P)`."""
        return np.asarray((self.observations.tracks.visible > 0) & (self.confidence() == 0))


def find_outliers(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior,
    mesh: Mesh | None = None,
    *,
    settings: Settings | None = None,
    on_step: OnStep | None = None,
    should_stop: ShouldStop | None = None,
) -> NDArray[np.bool_]:
    """Find the gross outliers, which `solve_shapes` rejects: observations more probably outliers than not.

    The probability is computed from the cameras, the prior and the other observations of the point.

    Parameters
    ----------
    tracks : Tracks
        Tracks over the frames of the cameras.
    cameras : Cameras
        From `estimate_cameras`.
    prior : Prior
        From `learn_prior`.
    mesh : Mesh, optional
        Which points are neighbours; None for no smoothness in space.
    settings : Settings, optional
        Method, loss, weights; None uses the settings of the cameras.
    on_step : callable, optional
        Called after units of work.
    should_stop : callable, optional
        Called between units of work; once it returns True, the outliers found so far are returned.

    Returns
    -------
    ndarray of bool, shape (F, P)
        All False if the estimated share of outliers, `cameras.outlier_share`, is 0.5 % or less.

    Raises
    ------
    InvalidInput
        Mesh, cameras or prior do not match the tracks, these are no valid `Tracks`, or an argument has another type.
    InvalidSettings
        The settings select another prior than the given one.
    NotFinite
        Rounding errors made equations singular.
    """
    check_tracks(tracks)
    check_types(cameras, prior, mesh, settings)
    used = cameras.observations.settings if settings is None else settings
    monitor = monitored(tracks, None, used, on_step, should_stop, only=("shapes",))
    with serial_blas(), pulses_to(monitor.pulse), singular_refused():
        found = begin(tracks, cameras, prior, mesh, used, monitor).rejected()
    monitor.report(Step("finish", 1.0))
    return found


def begin(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior | None,
    mesh: Mesh | None,
    settings: Settings,
    monitor: Monitor,
    *,
    shapes: Floats | None = None,
    moving: bool = True,
    bending: float | None = None,
) -> Start:
    """Return the start of the minimisation with gross outliers rejected; parameters and errors as for `prepared` and `warm`.

    The initial shapes are `shapes`, if given and of lower energy, and least-squares ones otherwise.
    """
    start = prepared(tracks, cameras, prior, mesh, settings, moving=moving, bending=bending, should_stop=monitor)
    start = _without_outliers(start, monitor)
    return start if shapes is None else warm(start, shapes)


def prepared(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior | None,
    mesh: Mesh | None,
    settings: Settings,
    *,
    moving: bool,
    bending: float | None = None,
    bends: NDArray[np.bool_] | None = None,
    should_stop: ShouldStop,
) -> Start:
    """Return the start of the minimisation, before outlier rejection; less converged once `should_stop` returns True.

    `moving` is as in `Problem`; `bending` is λ2 if automatic in the settings, None to compute it from the initial shapes of the points
    `bends`, shape `(P,)`, by default of all.

    Raises
    ------
    InvalidInput
        Mesh, cameras or prior do not match the tracks.
    InvalidSettings
        The settings select another prior than the given one.
    """
    observations = cameras.observations.of(tracks)
    check_mesh(tracks, mesh, settings)
    if prior is None:
        estimate, covariance = cameras.estimate, None
        settings = without_learned_prior(settings)
    else:
        _check_prior(prior, tracks, settings)
        estimate, covariance = estimate_with(cameras, prior), prior.normalized
    flat = orthographic(observations.normalized, estimate.perspective)
    should_stop()
    part = None if covariance is None or settings.temporal_weight == 0 else well_observed(flat, mesh)
    if part is None:
        problem, choices = build_problem(flat, estimate, mesh, settings, covariance)
    else:
        problem, choices = build_problem(part.normalized, estimate, part.mesh, settings, covariance)
    problem = replace(problem, moving=moving)
    should_stop()
    state = _initial(problem, estimate, settings, should_stop)
    should_stop()
    return Start(
        observations, mesh, settings, flat, estimate, covariance, cameras.outlier_share, part,
        *with_bending(
            problem, choices, state, settings, bending=bending, bends=bends if bends is None or part is None else bends[part.kept]
        ),
    )  # fmt: skip


def _check_prior(prior: Prior, tracks: Tracks, settings: Settings) -> None:
    """Check that a learned prior is what the settings select, and has as many frames as the tracks."""
    if not settings.gaussian:
        raise InvalidSettings(
            "invalid_option", field="settings.prior", expected="gaussian, with method robust and preset auto, with a learned prior",
            got=f"prior {settings.prior}, method {settings.method}, preset {settings.preset}",
            hint="Pass prior=None for the priors that are not learned.",
        )  # fmt: skip
    frames = len(prior.normalized.modes)
    if frames != tracks.num_frames:
        raise InvalidInput(
            "camera_mismatch", field="prior", expected=f"a prior of {tracks.num_frames} frames, as many as the tracks have",
            got=f"{frames}", hint="Learn the prior from tracks of the same frames.",
        )  # fmt: skip


def _initial(problem: Problem, estimate: CameraEstimate, settings: Settings, should_stop: ShouldStop) -> State:
    translations = np.array(estimate.translations, dtype=np.float64)
    if settings.method == "pseudo_inverse":
        return init(problem, pseudo_inverse(problem, translations), translations)
    return init(problem, uniform_solution(problem, translations, should_stop=should_stop), translations)


def warm(start: Start, shapes: Floats) -> Start:
    """Return the start with its state at given shapes `(F, P, 3)`, world axes, the tracks' unit, if their energy is lower.

    From absurdly large shapes, whose residuals leave the observations hardly any weight, the minimisation would stop far from the minimum.
    """
    part = shapes if start.kept is None else shapes[:, start.kept]
    problem = start.problem
    coordinates = (part / start.flat.unit) @ np.linalg.inv(problem.axes).T
    there = np.ascontiguousarray(coordinates.transpose(0, 2, 1), dtype=problem.points.dtype)
    given = init(problem, there, start.state.translations)
    return replace(start, state=given) if given.objective < start.state.objective else start


def check_types(cameras: Cameras, prior: Prior | None, mesh: Mesh | None, settings: Settings | None) -> None:
    """Check that the arguments of a stage are records of the expected classes, e.g. no mesh in place of the prior.

    Raises
    ------
    InvalidInput
        Code `wrong_type`.
    """
    check_type("cameras", cameras, Cameras, MAKE_ESTIMATE)
    for field, value, kind, make in (
        ("prior", prior, Prior, "Use learn_prior(tracks, cameras), or None for a prior that is not learned."),
        ("mesh", mesh, Mesh, MAKE_MESH),
        ("settings", settings, Settings, MAKE_SETTINGS),
    ):
        if value is not None:
            check_type(field, value, kind, make)


def start_shapes(start: ArrayLike, observations: Observations) -> Floats:
    """Return initial shapes as an array after checking that they match the tracks.

    Parameters
    ----------
    start : array_like, shape (F, P, 3)
        World axes and unit.
    observations : Observations
        The tracks.

    Raises
    ------
    InvalidInput
        The array has the wrong type or shape, or a coordinate is not finite or beyond `MAX_COORDINATE` RMS radii of the tracks.
    """
    hint = "Pass a solution of these tracks."
    shapes = numeric(start, "start", hint).astype(np.float64)
    expected = (*observations.tracks.visible.shape, 3)
    reach = MAX_COORDINATE * observations.normalized.unit / observations.world_scale
    if shapes.shape != expected:
        raise wrong_input("start", "wrong_shape", f"shapes {expected}", shape_text(shapes), hint)
    if not (np.abs(shapes) <= reach).all():  # also rejects NaN
        got = f"one of {np.abs(shapes).max():.3g}" if np.isfinite(shapes).all() else "values that are not finite"
        raise wrong_input("start", "out_of_range", f"finite coordinates within ±{reach:.3g}", got, hint)
    return shapes


def without_learned_prior(settings: Settings) -> Settings:
    """Return the settings with smoothness in time instead of the Gaussian prior."""
    return replace(settings, prior="smooth", order="film") if settings.gaussian else settings


def _without_outliers(start: Start, monitor: Monitor) -> Start:
    """Return the start without gross outliers, and with a sentence on their share; unchanged without a learned prior or with hardly any."""
    problem, covariance, filling, estimate = start.problem, start.covariance, start.estimate.filling, start.estimate
    if covariance is None or problem.weights.temporal == 0 or start.outlier_share <= OUTLIER_SHARE:
        return start
    if filling is not None:
        found = gross_outliers(
            start.flat if start.part is None else start.part.normalized,
            estimate.projections,
            estimate.translations, covariance, filling, share=start.outlier_share, should_stop=monitor,
        )  # fmt: skip
        kept = np.where(found, 0, problem.confidence).astype(problem.confidence.dtype)
        without = replace(problem, confidence=kept) if kept.any() else problem
        start = replace(start, problem=without, state=init(without, start.state.shapes, start.state.translations))
    seen = int(np.count_nonzero(start.observations.tracks.visible))
    reason = outlier_reason(seen - int(np.count_nonzero(start.confidence())), seen, start.outlier_share)
    return replace(start, choices=replace(start.choices, reasons={**start.choices.reasons, "outliers": reason}))


def outlier_reason(rejected: int, seen: int, expected: float) -> str:
    """Return a sentence on the rejected share of the visible observations and the expected share."""
    return f"{rejected / seen:.1%} of the visible observations are rejected as gross outliers; {expected:.1%} were expected."
