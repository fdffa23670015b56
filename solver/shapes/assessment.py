"""Standard deviations of the positions of a solution, and a verdict on how far to trust it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.cameras.planar_ambiguity import is_planar, on_one_line
from pliant.solver.energy.hyperparameters import noise_std
from pliant.solver.evaluation.trust import Trust, assess
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.pulse import ShouldStop, pulse
from pliant.solver.records import Floats, Tracks
from pliant.solver.refinement.focal_length import more_probable, unclear_perspective
from pliant.solver.shapes.held_out import held_out_error
from pliant.solver.shapes.jackknife import Changes, learning_changes
from pliant.solver.shapes.uncertainty import Pinhole, bounded_by_neighbours, position_std
from pliant.solver.solution import Solution
from pliant.solver.tracks.frame_selection import informative_frames

INFLATION = 1.4
"""Factor applied to the standard deviation from posterior and jackknife, for errors that both omit: model errors and other optima of the
cameras. With it, intervals of ± 4.3 standard deviations contain 91 % of the positions of the calibration sequences of
`benchmarks.trust`."""

SIZE_CORRELATION = 0.3
"""Standard deviation, relative to the deformation, of the part of it by which the object grows and shrinks. Estimated scales absorb this
part, because images cannot tell it from a change of the camera's distance. In eleven solves of faces, flags, an arm and a head, with
perspective and without, the error of log s was .09 to .53 of the deformation; on spheres .8 to 1.2, and on a balloon, whose swelling is
attributed to the scales altogether, 5."""


def assessed(
    solution: Solution,
    tracks: Tracks,
    confidence: Floats,
    estimate: CameraEstimate,
    covariance: ShapeCovariance | None,
    unit: float,
    *,
    turning: bool,
    free_scales: bool,
    seed: int,
    connected: bool,
    changes: Changes | None,
    centred: bool,
    given_weights: bool,
    should_stop: ShouldStop,
) -> Solution:
    """Return the solution with the standard deviations of its positions and the verdict on it.

    Parameters
    ----------
    solution : Solution
        In the tracks' unit.
    tracks : Tracks
        The tracks that were solved.
    confidence : ndarray, shape (F, P)
        Confidence of the observations used; 0 where hidden or rejected.
    estimate
        Cameras of the solve.
    covariance
        Prior of the solve. Without one no standard deviations are computed.
    unit : float
        The tracks' unit per normalized unit.
    turning : bool
        Whether the cameras were estimated.
    free_scales : bool
        Whether the scales were estimated.
    seed : int
        Seed of the random choices: visibility patterns, and folds of early stopping.
    connected : bool
        Whether sparsely observed points were placed on a surface with their neighbours; otherwise only the prior places them.
    changes : Changes or None
        Jackknife result for these cameras and this covariance; None computes it.
    centred : bool
        Whether the shapes contain all points of the object, so that their mean is its centre. Otherwise the centre is the origin.
    given_weights : bool
        Whether the user gave a weight of the priors.
    should_stop : callable
        Called between units of work; once it returns True, the jackknife is skipped.
    """
    std, held_out = None, None
    should_stop()
    confidence = np.asarray(confidence, dtype=np.float64)
    if covariance is not None:
        projections = estimate.projections
        pinhole = Pinhole.of(solution.camera, solution.shapes, unit)
        std = position_std(
            covariance, projections, confidence, noise_std=noise_std(covariance), pinhole=pinhole, seed=seed
        )
        del pinhole
        std *= unit
        should_stop()
        if connected:
            std = bounded_by_neighbours(std, solution.shapes, confidence)
        if changes is None:
            observed = confidence[:, estimate.sampled] > 0
            changes = learning_changes(
                estimate, covariance, observed, turning=turning, seed=seed, should_stop=should_stop
            )
        should_stop()
        np.hypot(std, changes.std_of(solution.shapes, unit, centred=centred), out=std)
        std *= INFLATION
        if free_scales and np.ptp(solution.camera.scales) > 0:
            with_size_std(std, solution.shapes, centred=centred)
        held_out = held_out_error(tracks, solution.shapes, solution.camera, confidence, covariance, unit=unit)
    should_stop()
    solution = replace(solution, shapes_std=std)
    trust = judged(
        solution, tracks, confidence, estimate, covariance, unit, held_out_error=held_out, given_weights=given_weights
    )
    return replace(solution, trust=trust)


def with_size_std(std: Floats, shapes: Floats, *, centred: bool) -> None:
    """Add the uncertainty of each frame's size to the standard deviations `(F, P)` of shapes `(F, P, 3)`, in place.

    The deformation is the RMS distance of the points from their mean positions, relative to the size of the mean shape; `centred` as for
    `assessed`.
    """
    mean, total = np.zeros(shapes.shape[1:]), 0.0
    for frame in shapes:  # one at a time, to limit memory
        pulse()
        own = frame - frame.mean(axis=0) if centred else frame
        mean += own / len(shapes)
        total += float(np.square(own).sum()) / len(shapes)
    rigid = float(np.square(mean).sum())
    relative = SIZE_CORRELATION * np.sqrt(max(total - rigid, 0.0) / max(rigid, np.finfo(float).tiny))
    for frame, each in zip(shapes, std, strict=True):
        pulse()
        own = frame - frame.mean(axis=0) if centred else frame
        np.hypot(each, relative * np.linalg.norm(own, axis=1), out=each)


def judged(
    solution: Solution,
    tracks: Tracks,
    confidence: Floats,
    estimate: CameraEstimate,
    covariance: ShapeCovariance | None,
    unit: float,
    *,
    held_out_error: float | None,
    given_weights: bool,
) -> Trust:
    """Return the verdict on a solution with standard deviations; arguments as for `assessed`."""
    return assess(
        solution,
        confidence,
        held_out_error=held_out_error,
        ordered=estimate.ordered,
        planar=is_planar(estimate.gram) or on_one_line(tracks),
        modes=0 if covariance is None else covariance.num_deforming(),
        depth_is_typical=estimate.depth_is_typical,
        shown=informative_frames(confidence),
        unclear_camera=_unclear_camera(estimate.perspective, unit),
        given_weights=given_weights,
    )


def _unclear_camera(view: Perspective | None, unit: float) -> str | None:
    """Return a sentence if the tracks favour another focal length than the given one, or hardly show whether there is perspective.

    `unit` is the tracks' unit per normalized unit.
    """
    other = None if view is None else more_probable(view)
    if other is not None:
        instead = f"A focal length of {unit / abs(other[0]):.4g}" if other[0] else "Orthography"
        return (
            f"{instead} explains the tracks better than the given focal length. Either the given one is wrong, or the object deforms in a "
            "way that resembles perspective. Check it; if it is certain, keep it."
        )
    found = None if view is None else unclear_perspective(view)
    if view is None or found is None:
        return None
    if view.is_perspective:
        return (
            "Perspective explains the tracks hardly better than orthography, so the focal length is uncertain. Give the focal length, or "
            "compare with camera=scaled_orthographic."
        )
    return (
        "Whether the tracks show perspective is unclear: it explains them slightly better than orthography, most of all with a focal "
        f"length of about {unit / abs(found):.4g}. Give the focal length, or compare with camera=perspective."
    )
