"""Error metrics. Each variant has its own name, because values of different variants are not comparable.

With S the reconstruction and G the ground truth, both centred in every frame:

=========================  =============================================================================================
`e3d_sequence`             one Q in O(3) for the sequence, no scale; mean over frames of ‖S_f Qᵀ − G_f‖_F / ‖G_f‖_F
`e3d_frame`                a rotation per frame and one mirror for the sequence; the same mean
`e3d_frame_similarity`     rotation, mirror and scale free in every frame; the same mean. It reproduces the figures of
                           Kumar et al. (2018, 2019) and later papers on dense tracks
`e3d_frame_scaled`         a rotation per frame, one mirror and one scale k for the sequence, k least squares:
                           mean over frames of ‖k S_f Q_fᵀ − G_f‖_F / ‖G_f‖_F with k = Σ_f ⟨S_f Q_fᵀ, G_f⟩ / Σ_f ‖S_f‖²
`size_ratio`               that k, the size of the truth divided by the result's: far from 1, their units differ, and only
                           the two metrics above have a meaning
`e3d_mocap`                Akhter et al. (2011), Gotardo and Martinez (2011): one Q in O(3);
                           `1/(σ F P) Σ_fp ‖Q s_fp − g_fp‖` with `σ = 1/(3F) Σ_f (σ_fx + σ_fy + σ_fz)`, the population
                           standard deviations of the true coordinates
`reprojection_median`,     median and RMS of `‖w_fp − project(s_fp)‖` over the visible entries, in the tracks' unit; the
`reprojection_rms`         RMS is weighted with confidence. `Camera.project` includes perspective
`coverage`                 share of positions within the central 90 % interval of `shapes_std`: their distance from the
                           truth after the alignment of `e3d_frame_scaled` is at most 4.3 k σ_fp. Calibrated: .90
`rotation_degrees`         mean angle between estimated and true rotations after one alignment of the world axes
`focal_error`              |φ − φ*| / φ* of the estimated φ and the true φ*; infinite where φ is infinite (orthography)
=========================  =============================================================================================

A low `e3d_frame_similarity` with a high `e3d_sequence` indicates frames that flip or drift: check both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pliant.solver.agreement import check_type
from pliant.solver.errors import InvalidInput
from pliant.solver.evaluation.alignment import Aligned, align
from pliant.solver.limits import frame_chunks
from pliant.solver.model.so3 import MIRROR, nearest
from pliant.solver.records import Camera, Floats, Tracks
from pliant.solver.solution import Solution

NINETY = 4.3
"""Half-width of the central 90 % interval of a position, in standard deviations. For normal errors of known σ it would be 1.645. The
estimated σ is off by a different factor in every solve, so the ratio of error to σ, pooled over solves, has longer tails. Chosen on the
calibration sequences of `benchmarks.trust`, clean and corrupted, with equal weights; on the other sequences it covers 90 % of positions."""


class Reprojection(NamedTuple):
    """Distance of the projected shapes from the visible tracks, the tracks' unit."""

    median: float
    """Median length of the residual."""

    rms: float
    """Root of the mean squared length, weighted with the confidence."""


def e3d_sequence(shapes: ArrayLike, truth: ArrayLike) -> float:
    """Relative error after one orthogonal matrix for the whole sequence, see the table above."""
    return float(align(shapes, truth, kind="sequence").relative.mean())


def e3d_frame(shapes: ArrayLike, truth: ArrayLike) -> float:
    """Relative error after a rotation per frame and one mirror, see the table above."""
    return float(align(shapes, truth, kind="frame").relative.mean())


def e3d_frame_similarity(shapes: ArrayLike, truth: ArrayLike) -> float:
    """Relative error after a similarity per frame, see the table above."""
    return float(align(shapes, truth, kind="frame_similarity").relative.mean())


def e3d_frame_scaled(shapes: ArrayLike, truth: ArrayLike) -> float:
    """Relative error after a rotation per frame, one mirror and one scale for the sequence, see the table above."""
    return float(align(shapes, truth, kind="frame_scaled").relative.mean())


def coverage(shapes_std: ArrayLike, shapes: ArrayLike, truth: ArrayLike) -> float:
    """Share of positions that lie within `NINETY` standard deviations of the truth, see the table above.

    Parameters
    ----------
    shapes_std : array_like, shape (F, P)
        Standard deviations, the unit of the shapes.
    shapes : array_like, shape (F, P, 3)
        Reconstruction.
    truth : array_like, shape (F, P, 3)
        Ground truth.

    Raises
    ------
    InvalidInput
        The standard deviations do not fit the shapes, or as for `e3d_frame_scaled`.
    """
    std, aligned = np.asarray(shapes_std, dtype=np.float64), align(shapes, truth, kind="frame_scaled")
    if std.shape != aligned.shapes.shape[:2]:
        raise InvalidInput(
            "wrong_shape", field="shapes_std", expected=f"(frames, points) = {aligned.shapes.shape[:2]}",
            got=str(std.shape), hint="Give one standard deviation for every position.",
        )  # fmt: skip
    return float((aligned.distances <= NINETY * aligned.scales[:, None] * std).mean())


def focal_error(camera: Camera, truth: float) -> float:
    """Relative error of the focal length, see the table above.

    Raises
    ------
    InvalidInput
        The true focal length is not positive and finite.
    """
    if not (np.isfinite(truth) and truth > 0):
        raise InvalidInput(
            "out_of_range", field="ground_truth.focal", expected="a positive, finite length", got=str(truth),
            hint="Give the focal length in the tracks' unit.",
        )  # fmt: skip
    return np.inf if camera.focal is None else abs(camera.focal - truth) / truth


def e3d_mocap(shapes: ArrayLike, truth: ArrayLike) -> float:
    """Error of Akhter et al. (2011): mean point distance over mean standard deviation of the truth, see the table above."""
    return _mocap(align(shapes, truth, kind="sequence"))


def reprojection(tracks: Tracks, solution: Solution) -> Reprojection:
    """Reprojection residual of the visible observations, computed independently of `Solution.residuals`."""
    squared = np.zeros_like(tracks.visible)
    for some in frame_chunks(*squared.shape):
        image = solution.camera.at(some).project(solution.shapes[some])
        squared[some] = np.square(tracks.points[some] - image).sum(axis=2)
    median = np.median(np.sqrt(squared[tracks.visible > 0]))
    return Reprojection(float(median), float(np.sqrt(np.average(squared, weights=tracks.visible))))


def rotation_degrees(rotations: ArrayLike, truth: ArrayLike) -> float:
    """Mean angle between two camera paths, degrees, after alignment of their world axes.

    Orthographic views do not determine the sign of depth: a path `R_f` and its mirror `J R_f J`, `J = diag(1, 1, −1)`,
    fit equally well, so the smaller of the two angles is returned.

    Parameters
    ----------
    rotations : array_like, shape (F, 3, 3)
        Estimated cameras, camera from world.
    truth : array_like, shape (F, 3, 3)
        True cameras, camera from world.

    Raises
    ------
    InvalidInput
        The arrays differ in shape or are not `(F, 3, 3)`.
    """
    ours, true = np.asarray(rotations, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if true.ndim != 3 or true.shape[1:] != (3, 3) or ours.shape != true.shape:
        raise InvalidInput(
            "wrong_shape", field="ground_truth.rotations", expected=f"(frames, 3, 3) like {ours.shape}",
            got=str(true.shape), hint="Give one full rotation matrix for every frame.",
        )  # fmt: skip
    return min(_mean_angle(ours, true), _mean_angle(MIRROR @ ours @ MIRROR, true))


def evaluate(
    solution: Solution,
    tracks: Tracks,
    truth: ArrayLike | None = None,
    true_rotations: ArrayLike | None = None,
    true_focal: float | None = None,
) -> dict[str, float]:
    """Return all metrics that the inputs allow, by name.

    Parameters
    ----------
    solution : Solution
        Result of the solve.
    tracks : Tracks
        Its input.
    truth : array_like, shape (F, P, 3), optional
        Ground truth shapes, the tracks' unit, in one world frame. If they are in each frame's camera axes, the metrics with one alignment
        for the sequence, `e3d_sequence` and `e3d_mocap`, are not meaningful.
    true_rotations : array_like, shape (F, 3, 3), optional
        Ground truth cameras.
    true_focal : float, optional
        Ground truth focal length, the tracks' unit.

    Returns
    -------
    dict of str to float
        Value of each metric.

    Raises
    ------
    InvalidInput
        Ground truth of the wrong shape, not finite, or without extent; `tracks` is not a `Tracks`.
    """
    check_type("tracks", tracks, Tracks, "Pass the input of the solve: evaluate(solution, tracks, truth).")
    fit = reprojection(tracks, solution)
    values = {"reprojection_median": fit.median, "reprojection_rms": fit.rms}
    if truth is not None:
        whole = align(solution.shapes, truth, kind="sequence")
        values["e3d_sequence"] = float(whole.relative.mean())
        values["e3d_frame"] = e3d_frame(solution.shapes, truth)
        scaled = align(solution.shapes, truth, kind="frame_scaled")
        values["e3d_frame_scaled"], values["size_ratio"] = float(scaled.relative.mean()), float(scaled.scales.mean())
        values["e3d_frame_similarity"] = e3d_frame_similarity(solution.shapes, truth)
        values["e3d_mocap"] = _mocap(whole)
        if solution.shapes_std is not None:
            values["coverage"] = coverage(solution.shapes_std, solution.shapes, truth)
    if true_rotations is not None:
        values["rotation_degrees"] = rotation_degrees(solution.camera.rotations, true_rotations)
    if true_focal is not None:
        values["focal_error"] = focal_error(solution.camera, true_focal)
    return values


def _mocap(aligned: Aligned) -> float:
    return float(aligned.distances.mean() / aligned.truth.std(axis=1).mean())


def _mean_angle(ours: Floats, true: Floats) -> float:
    turn = nearest(np.einsum("fji,fjk->ik", ours, true))
    left_over = (ours @ turn).transpose(0, 2, 1) @ true
    sine = np.linalg.norm(left_over - left_over.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8.0)
    cosine = (np.trace(left_over, axis1=1, axis2=2) - 1) / 2
    return float(np.degrees(np.arctan2(sine, cosine)).mean())
