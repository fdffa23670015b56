"""First stage: estimate the cameras of the tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.agreement import check_agreement, seen_again
from pliant.solver.cameras import estimation
from pliant.solver.cameras.estimation import CameraEstimate, given_cameras
from pliant.solver.cameras.planar_ambiguity import is_planar
from pliant.solver.errors import singular_refused
from pliant.solver.evaluation.trust import turned
from pliant.solver.limits import LEARNED_FRAMES, learned_stride
from pliant.solver.model.expectation_maximisation import ModelOrder
from pliant.solver.monitor import Monitor, enter
from pliant.solver.pulse import ShouldStop, pulses_to
from pliant.solver.reconstruction.long_films import extended
from pliant.solver.reconstruction.observations import Observations, OnStep, monitored, observe
from pliant.solver.records import MIN_POINTS, Camera, Floats, KnownCamera, Step, Tracks
from pliant.solver.refinement.covariance_learning import LearningData, learn_covariance
from pliant.solver.refinement.depth_rounds import correct_perspective
from pliant.solver.refinement.evidence import Evidence
from pliant.solver.refinement.joint_refinement import refine_cameras
from pliant.solver.refinement.learned import Refinement
from pliant.solver.refinement.observed import Observed, cross_fitted
from pliant.solver.settings import Settings
from pliant.solver.stages import stage_of
from pliant.solver.threads import serial_blas
from pliant.solver.tracks.frame_order import resolved_order
from pliant.solver.tracks.frame_selection import evenly_spread, informative_frames
from pliant.solver.tracks.noise import OUTLIER_SHARE

STAGES = (
    "completion", "multistart", "model_order", "starts", "perspective", "scales", "refinement", "observations",
    "covariance", "extension",
)  # fmt: skip

MIN_CAMERA_TURN = 10.0
"""Largest angle between two viewing directions, degrees, below which the cameras carry a warning."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Cameras:
    """Cameras of all frames, with the data that the following stages need."""

    camera: Camera
    """Rotations, scales, translations and lens. `solve_shapes` re-estimates the translations together with the shapes."""

    outlier_share: float
    """Estimated share of gross outliers among the visible observations."""

    reasons: dict[str, str]
    """One sentence for each choice, by name."""

    warnings: tuple[str, ...]
    """Reasons to distrust the cameras."""

    stopped: bool
    """Whether a stop was requested; the cameras are then the best so far."""

    # For the following stages only, and without docstrings, so that they are not in the reference.
    estimate: CameraEstimate  # the cameras in normalized units
    data: LearningData | None  # for learning the prior; None unless `settings.prior` is `gaussian`
    observations: Observations  # the tracks in normalized units

    def __repr__(self) -> str:
        lens = "orthographic" if self.camera.focal is None else f"focal length {self.camera.focal:.4g}"
        return f"<Cameras of {len(self.camera.rotations)} frames, {lens}>"

    def project(self, shapes: Floats) -> Floats:
        """Return the image, shape `(F, P, 2)`, of shapes `(F, P, 3)`, both in the tracks' unit unless scales were given."""
        return self.camera.project(shapes)


def estimate_cameras(
    tracks: Tracks,
    known: KnownCamera | None = None,
    *,
    settings: Settings | None = None,
    on_step: OnStep | None = None,
    should_stop: ShouldStop | None = None,
) -> Cameras:
    """Estimate the cameras of the tracks: the first stage of `solve`.

    Frames are used in the order given. For unordered photographs (`settings.order`), `solve` sorts the frames by content first.

    Parameters
    ----------
    tracks : Tracks
        F frames of P points.
    known : KnownCamera, optional
        Given cameras: their rotations are kept, and missing parameters are estimated.
    settings : Settings, optional
        Settings of the reconstruction. With prior `gaussian` the cameras are refined jointly with a covariance of the shapes.
    on_step : callable, optional
        Called after units of work.
    should_stop : callable, optional
        Called between units of work; once it returns True, the best cameras so far are returned.

    Raises
    ------
    InvalidInput
        The given cameras do not match the tracks, too few observations are visible, or tracks or cameras are no valid records.
    InvalidSettings
        Settings and tracks contradict each other.
    NotFinite
        Rounding errors made equations singular.
    """
    settings = settings if settings is not None else Settings()
    check_agreement(tracks, None, known, settings)
    settings, _ = resolved_order(tracks, settings)
    observations = observe(tracks, known, settings)
    monitor = monitored(tracks, known, settings, on_step, should_stop, only=STAGES)
    with serial_blas(), pulses_to(monitor.pulse), singular_refused():
        found = cameras_of(observations, monitor)
    monitor.report(Step("finish", 1.0))
    return found


def cameras_of(observations: Observations, monitor: Monitor) -> Cameras:
    """Return the cameras of the observations; `monitor` counts units of work and may request a stop."""
    shown, settings = informative_frames(observations.normalized.visible), observations.settings
    long = settings.gaussian and settings.order == "film" and learned_stride(len(shown)) > 1
    # Evenly spaced, as the motion priors assume.
    used = np.flatnonzero(shown)[:: learned_stride(int(shown.sum()))] if long else np.arange(len(shown))
    part = observations.at(used) if long else observations
    estimate = _without_shapes(part, monitor)
    has_outliers = settings.gaussian and estimate.outlier_share > OUTLIER_SHARE and not monitor()
    if has_outliers:
        observations, estimate = _without_outliers(estimate, observations, part, used, monitor)
        part = observations.at(used) if long else observations
    estimate, data = _with_shapes(estimate, part, monitor)
    if has_outliers:  # every observation is judged again when the shapes are computed
        observations = observations.with_all()
    if long:
        assert data is not None
        estimate, covariance = learn_covariance(estimate, data, seed=settings.seed, should_stop=monitor)
        estimate, data = extended(estimate, covariance, used, observations, should_stop=monitor)
    if observations.known is None:
        estimate = replace(estimate, warnings=turn_warnings(estimate.rotations))
    return Cameras(
        camera_of(estimate, observations), estimate.outlier_share, estimate.reasons, estimate.warnings, monitor.stopped,
        estimate, data, observations,
    )  # fmt: skip


def turn_warnings(rotations: Floats) -> tuple[str, ...]:
    """Return a warning if estimated rotations `(F, 3, 3)` hardly differ; a roll about the viewing direction shows no depth."""
    if turned(rotations) >= MIN_CAMERA_TURN:
        return ()
    return ("The camera hardly turns around the object: the tracks do not determine depth. Treat it as a guess.",)


def _without_outliers(
    estimate: CameraEstimate,
    observations: Observations,
    part: Observations,
    used: NDArray[np.intp],
    monitor: Monitor,
) -> tuple[Observations, CameraEstimate]:
    """Return the observations without the outliers of the sampled points, and cameras re-estimated from them.

    The multistart starts from completed tracks, in which completion has followed some outliers. Error on a walk with 5 % outliers: .13 to
    .19, but .25 if the multistart is not repeated. The refinement does not see these outliers either: completion would follow some again.
    Face scans from 5 half-sizes away with 10 % outliers: .009, but .054 if it does. If too few observations would remain, both are
    returned unchanged.
    """
    seed = observations.settings.seed
    shown = np.flatnonzero(informative_frames(part.normalized.visible))
    observed = Observed.of(part.normalized, estimate, shown)
    probability, outlier_share = cross_fitted(observed, estimate, shown, seed=seed, should_stop=monitor)
    found = np.zeros(observations.tracks.visible.shape, dtype=bool)
    found[np.ix_(used[shown], observed.chosen)] = (observed.confidence > 0) & (probability < 0.5)
    if seen_again(np.where(found[used], 0.0, part.normalized.visible)) < MIN_POINTS:
        return observations, estimate
    inliers = observations.without(found)
    if observations.known is None:
        monitor.expect([stage_of("multistart", len(used))], before="model_order")
    again = _without_shapes(inliers.at(used) if len(used) < len(found) else inliers, monitor, estimate.rank)
    return inliers, replace(again, outlier_share=outlier_share)


def _with_shapes(
    estimate: CameraEstimate, observations: Observations, monitor: Monitor
) -> tuple[CameraEstimate, LearningData | None]:
    """Return the cameras refined jointly with the shapes of at most `LEARNED_FRAMES` frames, and the data for the prior."""
    settings, known, normalized = observations.settings, observations.known, observations.normalized
    estimate = replace(estimate, perspective=observations.lens)
    shown = informative_frames(normalized.visible)
    data = None
    if settings.gaussian:
        if estimate.filling is not None:
            monitor.expect([stage_of("observations", len(shown))], before="covariance")
        # The pose signs of a plane are weakly determined; completed outliers are enough to flip them.
        corrupted_plane = estimate.outlier_share > OUTLIER_SHARE and is_planar(estimate.gram)
        scaled = observations.turning or (known is not None and observations.known_scales is None)
        scaled = scaled and settings.estimates_scales and not (known is None and corrupted_plane)
        estimate, data = refine_cameras(
            estimate, normalized, shown, turning=observations.turning and not corrupted_plane, estimates_scales=scaled,
            seed=settings.seed, y_up=settings.y_up, should_stop=monitor,
        )  # fmt: skip
    elif observations.lens is not None:
        used = np.flatnonzero(shown)
        some = used[evenly_spread(len(used), LEARNED_FRAMES)]
        how = Refinement(ModelOrder(ordered=estimate.ordered), turning=observations.turning, should_stop=monitor)
        estimate = correct_perspective(Evidence.of(estimate, normalized, some, estimate.scales), how).estimate
    return estimate, data


def _without_shapes(observations: Observations, monitor: Monitor, rank: int = 0) -> CameraEstimate:
    """Return cameras estimated without a model of the shapes; `rank` is the rank of an earlier completion, if any."""
    enter(monitor, "completion")
    settings, normalized = observations.settings, observations.normalized
    if observations.known is not None:
        return given_cameras(
            normalized,
            observations.known,
            settings,
            rank=rank,
            perspective=observations.lens is not None,
            should_stop=monitor,
        )
    return estimation.estimate_cameras(normalized, settings, should_stop=monitor, rank=rank)


def camera_of(estimate: CameraEstimate, observations: Observations) -> Camera:
    """Return the cameras of an estimate in the tracks' unit."""
    normalized, view = observations.normalized, estimate.perspective
    camera = Camera(
        np.array(estimate.rotations, dtype=np.float64),
        np.array(estimate.scales, dtype=np.float64) * observations.world_scale,
        normalized.centroid + normalized.unit * estimate.translations,
        y_up=observations.settings.y_up,
    )
    if view is not None:
        camera = replace(camera, principal_point=np.array(view.principal_point))
    if view is not None and view.is_perspective:
        focal = normalized.unit / abs(view.inverse_focal)
        camera = replace(camera, focal=focal, focal_std=view.focal_std(normalized.unit))
    return camera
