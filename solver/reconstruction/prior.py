"""Second stage: learn the prior of the shapes from the tracks and their cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.agreement import check_tracks, check_type
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.lens import given_lens
from pliant.solver.energy.hyperparameters import noise_std
from pliant.solver.errors import InvalidInput, singular_refused
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import ShouldStop, pulses_to
from pliant.solver.reconstruction.cameras import STAGES, Cameras, cameras_of
from pliant.solver.reconstruction.observations import OnStep, monitored
from pliant.solver.records import Floats, KnownCamera, Step, Tracks
from pliant.solver.refinement.covariance_learning import learn_covariance
from pliant.solver.refinement.depth_rounds import with_depth_map
from pliant.solver.shapes.jackknife import Changes, learning_changes
from pliant.solver.threads import serial_blas

MAKE_ESTIMATE = "Use estimate_cameras(tracks), or estimate_cameras(tracks, known) for given cameras."


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Prior:
    """A Gaussian over the path of a point through all frames: x_p ~ N(0, 1 1ᵀ ⊗ A₀ + C ⊗ A₁).

    A₀ (3×3) is the covariance of a point's mean position. A₁ (3×3, trace 3) is the covariance of its deformation over the axes, and
    C = L Lᵀ + τ T over the frames, with modes L (F×k) and a random walk T. World axes, relative to each frame's centroid.
    """

    unit: float
    """The tracks' unit per normalized unit."""

    reason: str
    """One sentence on the choice of the modes."""

    stopped: bool
    """Whether a stop was requested; the prior is then the best so far."""

    # For the following stages only, and without docstrings, so that they are not in the reference.
    normalized: ShapeCovariance  # the covariance in normalized units
    estimate: CameraEstimate  # the cameras that the prior was learned with
    world_scale: float  # the tracks' unit per unit of the shapes

    def __repr__(self) -> str:
        frames, modes = self.normalized.modes.shape
        return f"<Prior of {frames} frames: {modes} modes, noise {self.noise_std:.3g}>"

    @property
    def _world_unit(self) -> float:
        return self.unit / self.world_scale

    @property
    def mean_covariance(self) -> Floats:
        """A₀, shape `(3, 3)`, in squared units of the shapes."""
        return np.asarray(self.normalized.mean_covariance * self._world_unit**2)

    @property
    def axis_covariance(self) -> Floats:
        """A₁, shape `(3, 3)`, trace 3, dimensionless."""
        return np.array(self.normalized.axis_covariance)

    @property
    def modes(self) -> Floats:
        """L, shape `(F, k)`, in the shapes' unit: standard deviation per frame of the deformation that each mode explains."""
        return np.asarray(self.normalized.modes * self._world_unit)

    @property
    def walk_variance(self) -> float:
        """τ, in squared units of the shapes."""
        return float(self.normalized.walk_variance * self._world_unit**2)

    @property
    def covariance(self) -> Floats:
        """C, shape `(F, F)`, in squared units of the shapes."""
        return np.asarray(self.normalized.over_frames() * self._world_unit**2)

    @property
    def noise_std(self) -> float:
        """σ, noise standard deviation of an image coordinate used to solve for the shapes, in the tracks' unit."""
        return noise_std(self.normalized) * self.unit


def learn_prior(
    tracks: Tracks,
    cameras: Cameras,
    *,
    seed: int | None = None,
    on_step: OnStep | None = None,
    should_stop: ShouldStop | None = None,
) -> Prior:
    """Learn the Gaussian prior of the shapes by expectation maximisation: the second stage of `solve`.

    Parameters
    ----------
    tracks : Tracks
        F frames of P points.
    cameras : Cameras
        Cameras estimated from these tracks; they are not changed. For given cameras call `estimate_cameras(tracks, known)`.
    seed : int, optional
        Seed of the random choice of held-out points; None uses the seed in the cameras' settings.
    on_step : callable, optional
        Called after units of work.
    should_stop : callable, optional
        Called between units of work; once it returns True, the best prior so far is returned.

    Raises
    ------
    InvalidInput
        The cameras were estimated from other tracks or are no `Cameras`, or the tracks are no valid `Tracks`.
    NotFinite
        Rounding errors made equations singular.
    """
    check_tracks(tracks)
    check_type("cameras", cameras, Cameras, MAKE_ESTIMATE)
    given = cameras.observations.tracks
    if given is not tracks and not (
        np.array_equal(given.points, tracks.points) and np.array_equal(given.visible, tracks.visible)
    ):
        raise InvalidInput(
            "camera_mismatch", field="cameras", expected="cameras estimated from these tracks", got="those of other tracks",
            hint="Call estimate_cameras with these tracks, or give rotations as a KnownCamera.",
        )  # fmt: skip
    if cameras.data is None:
        cameras = _with_learning_data(cameras, should_stop)
    observations = cameras.observations
    monitor = monitored(
        tracks, observations.known, observations.settings, on_step, should_stop, only=("model_order", "covariance")
    )
    with serial_blas(), pulses_to(monitor.pulse), singular_refused():
        found = prior_of(cameras, monitor, seed=observations.settings.seed if seed is None else seed)
    monitor.report(Step("finish", 1.0))
    return found


def _with_learning_data(cameras: Cameras, should_stop: ShouldStop | None) -> Cameras:
    """Return the cameras with the data for learning the prior, which estimates for other priors lack."""
    settings = replace(
        cameras.observations.settings, method="robust", preset="auto", prior="gaussian", focal=None, field_of_view=None
    )
    camera, observations = cameras.camera, cameras.observations
    centre = None if camera.focal is None else (float(camera.principal_point[0]), float(camera.principal_point[1]))
    known = KnownCamera(camera.rotations, camera.scales / observations.world_scale, camera.focal, centre)
    lens = given_lens(observations.normalized, settings, known)
    monitor = monitored(observations.tracks, known, settings, None, should_stop, only=STAGES)
    with serial_blas(), pulses_to(monitor.pulse), singular_refused():
        return cameras_of(replace(observations, settings=settings, known=known, lens=lens), monitor)


def prior_of(cameras: Cameras, monitor: Monitor, *, seed: int) -> Prior:
    """Return the prior of cameras that have their learning data."""
    assert cameras.data is not None
    estimate, covariance = learn_covariance(cameras.estimate, cameras.data, seed=seed, should_stop=monitor)
    observations = cameras.observations
    return Prior(
        observations.normalized.unit,
        estimate.reasons["modes"],
        monitor.stopped,
        covariance,
        estimate,
        observations.world_scale,
    )


def estimate_with(cameras: Cameras, prior: Prior) -> CameraEstimate:
    """Return the cameras with the depth map of the prior, for the correction of perspective."""
    if prior.estimate.rotations is cameras.estimate.rotations:
        return prior.estimate
    reasons = {**cameras.estimate.reasons, "modes": prior.reason}
    rotations, scales = cameras.estimate.rotations, cameras.estimate.scales
    if np.array_equal(rotations, prior.estimate.rotations) and np.array_equal(scales, prior.estimate.scales):
        return replace(prior.estimate, reasons=reasons, warnings=cameras.warnings)  # with completed tracks
    estimate = replace(cameras.estimate, reasons=reasons)
    return with_depth_map(estimate, prior.normalized, rotations, scales)


def changes_of(tracks: Tracks, cameras: Cameras, prior: Prior, *, seed: int, should_stop: ShouldStop) -> Changes:
    """Return the jackknife result of the tracks that the cameras were estimated from.

    Parameters
    ----------
    tracks : Tracks
        These tracks, if the cameras came `without_points`; otherwise not used.
    cameras : Cameras
        Estimated from these tracks.
    prior : Prior
        Learned with the cameras.
    seed : int
        Seed of the folds of early stopping.
    should_stop : callable
        Called between refinements.
    """
    estimate, own = estimate_with(cameras, prior), cameras.observations.normalized
    chosen = estimate.sampled
    if own.points.shape[1] == 0:
        some = Tracks.from_arrays(tracks.points[:, chosen], tracks.visible[:, chosen])
        own, chosen = cameras.observations.of(some).normalized, np.arange(len(chosen))
    points, visible = own.points[:, chosen], own.visible[:, chosen]
    observed = visible > 0
    if estimate.filling is not None:
        observed &= ~estimate.filling.outliers(points, visible)
    return learning_changes(
        estimate, prior.normalized, observed, turning=cameras.observations.turning, seed=seed, should_stop=should_stop
    )
