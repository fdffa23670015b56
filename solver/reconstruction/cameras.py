"""First stage: the cameras of the tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras import estimation
from pliant.solver.cameras.covariance_learning import LearningData, learn_covariance
from pliant.solver.cameras.depth_rounds import settled
from pliant.solver.cameras.estimation import CameraEstimate, given_cameras
from pliant.solver.cameras.joint_refinement import refine_cameras
from pliant.solver.cameras.planar_ambiguity import is_planar
from pliant.solver.limits import LEARNED_FRAMES
from pliant.solver.model.model_order import ModelOrder
from pliant.solver.monitor import Monitor, enter
from pliant.solver.pulse import pulses_to
from pliant.solver.reconstruction.long_films import extended
from pliant.solver.reconstruction.observations import Observations, OnStep, ShouldStop, check_fit, monitored, observe
from pliant.solver.records import Camera, Floats, KnownCamera, Step, Tracks, read_only
from pliant.solver.settings import Settings
from pliant.solver.stages import learning
from pliant.solver.tracks.frame_order import resolved_order
from pliant.solver.tracks.frame_selection import evenly_spread, informative_frames
from pliant.solver.tracks.noise import OUTLIER_SHARE

STAGES = (
    "completion", "multistart", "model_order", "starts", "perspective", "scales", "refinement", "covariance",
    "extension",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Cameras:
    """Cameras of all frames, and what the following stages need from their estimation."""

    camera: Camera
    """Rotations, scales, translations and lens. `solve_shapes` estimates the translations anew, together with the shapes."""

    outliers: float
    """Estimated share of gross outliers among the visible observations, before any was rejected."""

    reasons: dict[str, str]
    """One sentence for each choice."""

    warnings: tuple[str, ...]
    """Reasons to distrust the cameras."""

    rejected: NDArray[np.bool_] | None
    """Observations that were left out, shape `(F, P)`; None where `estimate_cameras` was given none."""

    stopped: bool
    """Whether a stop was requested; the cameras are then the best so far."""

    estimate: CameraEstimate
    """Internal: the cameras in normalized units."""

    data: LearningData | None
    """Internal: what the prior is learned from; None unless `settings.prior` is `gaussian`."""

    observations: Observations
    """Internal: the tracks in normalized units."""

    def __repr__(self) -> str:
        lens = "orthographic" if self.camera.focal is None else f"focal length {self.camera.focal:.4g}"
        return f"<Cameras of {len(self.camera.rotations)} frames, {lens}>"

    def project(self, shapes: Floats) -> Floats:
        """Return the image of shapes `(F, P, 3)`, shape `(F, P, 2)`, the tracks' unit."""
        return self.camera.project(shapes)


def estimate_cameras(
    tracks: Tracks,
    known: KnownCamera | None = None,
    *,
    settings: Settings | None = None,
    rejected: NDArray[np.bool_] | None = None,
    previous: Cameras | None = None,
    on_step: OnStep | None = None,
    should_stop: ShouldStop | None = None,
) -> Cameras:
    """Estimate the cameras of the tracks: the first stage of `solve`.

    Frames are taken in the order given. `solve` puts photographs in no order (`settings.order`) into an order of their own first.

    Parameters
    ----------
    tracks : Tracks
        F frames of P points.
    known : KnownCamera, optional
        Given cameras: rotations are kept, and what they leave open is estimated.
    settings : Settings, optional
        Of the whole reconstruction. With prior `gaussian` the cameras are refined jointly with a covariance of the shapes.
    rejected : ndarray of bool, shape (F, P), optional
        Observations to leave out, from `find_outliers`.
    previous : Cameras, optional
        Cameras estimated before outliers were rejected: their rank of the completion and their share of outliers are kept.
    on_step : callable, optional
        Called after units of work.
    should_stop : callable, optional
        Called between units of work; once it returns True, the best cameras so far are returned.

    Raises
    ------
    InvalidInput
        The given cameras do not fit the tracks, or the tracks show too little.
    InvalidSettings
        Settings and tracks contradict each other.
    """
    settings = settings if settings is not None else Settings()
    check_fit(tracks, None, known)
    settings, _ = resolved_order(tracks, settings)
    observations = observe(tracks, known, settings)
    if rejected is not None:
        observations = observations.without(rejected)
    monitor = monitored(tracks, known, settings, on_step, should_stop, only=STAGES)
    with pulses_to(monitor.pulse):
        found = cameras_of(observations, monitor, rejected=rejected, previous=previous)
    monitor.report(Step("finish", 1.0))
    return found


def cameras_of(
    observations: Observations,
    monitor: Monitor,
    *,
    rejected: NDArray[np.bool_] | None = None,
    previous: Cameras | None = None,
    expects_second: bool = False,
    silent: bool = False,
) -> Cameras:
    """Return the cameras of the observations.

    Parameters
    ----------
    observations, monitor
        The tracks, and where units of work are counted.
    rejected, previous
        As for `estimate_cameras`.
    expects_second : bool
        Adds a second round to the monitor's plan where the tracks have outliers.
    silent : bool
        Reports no steps besides the counted units.
    """
    shown, settings = informative_frames(observations.normalized.visible), observations.settings
    long = settings.gaussian and len(shown) > LEARNED_FRAMES
    # At equal distances, as the priors on motion assume.
    used = np.flatnonzero(shown)[:: -(-int(shown.sum()) // LEARNED_FRAMES)]
    estimate, data = _estimated(
        observations.at(used) if long else observations, monitor,
        previous=previous, expects_second=expects_second, silent=silent,
    )  # fmt: skip
    if long:
        assert data is not None
        estimate, covariance = learn_covariance(estimate, data, seed=settings.seed, should_stop=monitor)
        estimate, data = extended(estimate, covariance, used, observations, should_stop=monitor)
    return Cameras(
        camera_of(estimate, observations), estimate.outliers if previous is None else previous.outliers,
        estimate.reasons, estimate.warnings, rejected, monitor.stopped, estimate, data, observations,
    )  # fmt: skip


def _estimated(
    observations: Observations, monitor: Monitor, *, previous: Cameras | None, expects_second: bool, silent: bool
) -> tuple[CameraEstimate, LearningData | None]:
    """Return the cameras of films of at most `LEARNED_FRAMES` frames, and what their covariance is learned from."""
    settings, known, normalized = observations.settings, observations.known, observations.normalized
    estimate = _without_shapes(observations, monitor, 0 if previous is None else previous.estimate.rank, silent=silent)
    if previous is not None:
        estimate = replace(estimate, outliers=max(estimate.outliers, previous.estimate.outliers))
    elif expects_second and settings.gaussian and estimate.outliers > OUTLIER_SHARE:
        stages = learning(len(estimate.rotations), gaussian=True, known_cameras=known is not None)
        monitor.expect(stages, before="shapes")
    estimate = replace(estimate, perspective=observations.lens)
    shown = informative_frames(normalized.visible)
    data = None
    if settings.gaussian:
        # The pose signs of a plane are weakly determined; completed outliers are enough to flip them.
        corrupted_plane = estimate.outliers > OUTLIER_SHARE and is_planar(estimate.gram)
        scaled = observations.turning or (known is not None and known.scales is None)
        scaled = scaled and settings.estimates_scales and not (known is None and corrupted_plane)
        estimate, data = refine_cameras(
            estimate, shown, turning=observations.turning and not corrupted_plane,
            estimates_scales=scaled, seed=settings.seed, normalized=normalized,
            y_up=settings.y_up, should_stop=monitor,
        )  # fmt: skip
    elif observations.lens is not None:
        used = np.flatnonzero(shown)
        estimate = settled(
            estimate, normalized, used[evenly_spread(len(used), LEARNED_FRAMES)], model_order=ModelOrder(ordered=estimate.ordered),
            turning=observations.turning, should_stop=monitor,
        )  # fmt: skip
    return estimate, data


def _without_shapes(observations: Observations, monitor: Monitor, rank: int, *, silent: bool) -> CameraEstimate:
    enter(monitor, "completion")
    settings, normalized = observations.settings, observations.normalized
    if observations.known is not None:
        return given_cameras(normalized, observations.known, settings, rank=rank)
    on_step = None if silent else monitor.report
    return estimation.estimate_cameras(normalized, settings, on_step=on_step, should_stop=monitor, rank=rank)


def camera_of(estimate: CameraEstimate, observations: Observations) -> Camera:
    """Return an estimate in the tracks' unit."""
    normalized, view = observations.normalized, estimate.perspective
    camera = Camera(
        np.array(estimate.rotations, dtype=np.float64),
        np.array(estimate.scales, dtype=np.float64),
        normalized.centroid + normalized.unit * np.asarray(estimate.translations),
    )
    if view is not None:
        camera = replace(camera, principal_point=np.array(view.principal_point), y_up=view.signs[0] < 0)
    if view is not None and view.bends:
        focal = normalized.unit / abs(view.curvature)
        std = 0.0 if view.given is not None else focal * view.curvature_std / abs(view.curvature)
        camera = replace(camera, focal=focal, focal_std=std)
    for array in (camera.rotations, camera.scales, camera.translations, camera.principal_point):
        read_only(array)
    return camera
