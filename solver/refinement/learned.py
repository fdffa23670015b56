"""Cameras with the shape covariance learned for them, and their refinement by the marginal likelihood."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.model.expectation_maximisation import ModelOrder, annealed, learned
from pliant.solver.model.marginal_likelihood import Motion, Scene, cameras_of, covariances_of, fit, metric_of, root_of
from pliant.solver.model.shape_covariance import AXIS_VARIANCE_FLOOR, NOISE_VARIANCE_FLOOR, ShapeCovariance
from pliant.solver.model.so3 import exponential, logarithm
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, projections_of
from pliant.solver.tracks.frame_selection import between
from pliant.solver.tracks.matrix import centred, columns, gram_of

REFINEMENT_PRIOR_WEIGHT = 0.01
"""Weight of the camera-motion prior: less is needed once the covariance is known."""

LEAST_NOISE = 1e-12
"""Minimum of σ² after subtraction of its floor, which the likelihood adds back; normalized units squared."""

START_EM_ROUNDS = 90
"""Maximum number of EM rounds before a refinement; the L-BFGS that follows gains more in the same time. Errors of faces of 99
frames with 60, 90 and 150 rounds: .0146, .0132, .0138, differences that may be chance."""

ROTATION_ITERATIONS = 60
"""L-BFGS iterations per refinement of the rotations."""


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """Cameras and the covariance learned for them."""

    rotations: Floats
    """Shape `(F, 3, 3)`."""

    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0."""

    covariance: ShapeCovariance

    energy: float
    """Energy of `model.marginal_likelihood`, without a penalty on modes; infinite before the first refinement."""

    @property
    def projections(self) -> Floats:
        """Shape `(F, 2, 3)`, see `projections_of`."""
        return projections_of(self.rotations, self.scales)

    @property
    def scaled(self) -> bool:
        """Whether any scale differs from 1."""
        return bool((self.scales != 1).any())


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What a refinement changes, how it learns the covariance, and when it stops."""

    model_order: ModelOrder = field(default_factory=ModelOrder)
    """Maximum number of modes, and the starting noise."""

    turning: bool = True
    """False keeps the rotations, except for the sign of depth."""

    with_scales: bool = False
    """Whether scales are refined; False keeps them at 1."""

    should_stop: ShouldStop = never
    """Called between units of work; once it returns True, the best so far is returned."""

    def learn(self, gram: Floats, rotations: Floats, scales: Floats, *, iterations: int = START_EM_ROUNDS) -> Learned:
        """Return given cameras and a covariance learned for them from scratch, in at most `iterations` EM rounds.

        Parameters
        ----------
        gram : array, shape (2F, 2F)
            W Wᵀ / P of centred, complete tracks, normalized units.
        rotations : array, shape (F, 3, 3)
            Camera from world.
        scales : array, shape (F,)
            Relative to those by which the tracks are divided.
        iterations : int
            Maximum number of EM rounds.
        """
        covariance = learned(
            gram, projections_of(rotations, scales), self.model_order, iterations=iterations, should_stop=self.should_stop
        )  # fmt: skip
        return Learned(rotations, scales, covariance, np.inf)

    def anneal(self, images: Floats, rotations: Floats, scales: Floats, *, iterations: int) -> Learned:
        """Return what `learn` returns by annealing alone, without stops, from orthographic tracks `(F, S, 2)`."""
        rows = columns(centred(images))
        covariance = annealed(
            gram_of(rows), projections_of(rotations, scales), self.model_order, iterations=iterations
        )  # fmt: skip
        return Learned(rotations, scales, covariance, np.inf)

    def refine(self, gram: Floats, found: Learned, *, rounds: int) -> Learned:
        """Return cameras and covariance after `rounds` calls of `refine_once`, fewer after a stop."""
        for _ in range(rounds):
            if self.should_stop():
                break
            found = self.refine_once(gram, found)
        return found

    def refine_once(self, gram: Floats, found: Learned, *, factor: Floats | None = None) -> Learned:
        """Return cameras and covariance of higher likelihood, by L-BFGS from `found`; `gram` and `factor` as for `scene_at`."""
        ordered = found.covariance.ordered
        scene = scene_at(gram, found.rotations, with_scales=self.with_scales, ordered=ordered, factor=factor)
        motion = motion_of(scene, found)
        moved = fit(
            scene, motion, iterations=ROTATION_ITERATIONS, turning=self.turning, metric=metric_of(scene, motion),
            should_stop=self.should_stop,
        )  # fmt: skip
        return moved_to(scene, found, *moved)


def scene_at(
    gram: Floats, rotations: Floats, *, with_scales: bool, ordered: bool, factor: Floats | None = None
) -> Scene:
    """Return the scene whose cameras at zero turn are `rotations`; without the camera-motion prior if unordered.

    `factor`, shape `(2F, r)`, replaces a Gram matrix that would be too large; `gram` is then empty.
    """
    return Scene(
        gram, rotations, with_scales=with_scales, prior_weight=REFINEMENT_PRIOR_WEIGHT if ordered else 0.0,
        noise_std_floor=NOISE_VARIANCE_FLOOR**0.5, smoothness=0.0, ordered=ordered,
        factor=np.zeros((0, 0)) if factor is None else factor,
    )  # fmt: skip


def motion_of(scene: Scene, found: Learned) -> Motion:
    """Return the parameters of the likelihood that describe `found`."""
    covariance = found.covariance
    return Motion(
        np.zeros((len(found.rotations), 3)), np.log(found.scales), covariance.modes,
        root_of(covariance.mean_covariance), root_of(covariance.axis_covariance),
        0.5 * np.log([max(covariance.noise_variance - scene.noise_std_floor**2, LEAST_NOISE), covariance.walk_variance]),
    )  # fmt: skip


def moved_to(scene: Scene, found: Learned, moved: Motion, energy: float) -> Learned:
    """Return the cameras and covariance that the parameters of the likelihood describe."""
    mean_covariance, axis_covariance, noise, walk_variance = covariances_of(scene, moved)
    axis_covariance = axis_covariance + AXIS_VARIANCE_FLOOR * np.trace(axis_covariance) / 3 * np.eye(3)
    size = np.trace(axis_covariance) / 3
    better = replace(
        found.covariance,
        mean_covariance=mean_covariance,
        axis_covariance=axis_covariance / size,
        modes=moved.modes * np.sqrt(size),
        walk_variance=walk_variance * size,
        noise_variance=noise,
    )
    return Learned(*cameras_of(scene, moved), better, energy)


def to_all_frames(found: Learned, used: NDArray[np.intp], rotations: Floats) -> Learned:
    """Return cameras and covariance of all frames, given those at the frames used and previous rotations of all frames.

    Changes of rotation, logarithms of scales and modes are interpolated.
    """
    if len(used) == len(rotations):
        return found
    turns = logarithm(found.rotations @ rotations[used].transpose(0, 2, 1))
    return Learned(
        exponential(between(used, turns, len(rotations))) @ rotations,
        np.exp(between(used, np.log(found.scales), len(rotations))),
        found.covariance.stretched(used, len(rotations)),
        found.energy,
    )
