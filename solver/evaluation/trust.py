"""Assessment of a result without ground truth: an expected error, and a verdict with reasons.

The expected error is the root mean variance of the positions divided by the size of the shapes. The variance is the sum of the posterior
variance (`shapes.uncertainty`) and that of a jackknife over compact regions (`shapes.jackknife`), because cameras and prior are estimated
from the same tracks; that of isometric surfaces is from a bootstrap (`isometry.deviations`). The verdict adds signs of failure that the
variance of a wrong model does not show: tracks that the shapes do not explain, a camera that hardly turned around the object, a sheet whose
pose signs are ambiguous, and positions that no frame shows.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pliant.solver.pulse import pulse
from pliant.solver.records import Camera, Floats
from pliant.solver.solution import Solution

INTERVAL = (0.35, 3.6)
"""Ends of the interval for the error, relative to the expected error: about the 10 and 90 % quantiles of true over expected error on the
calibration sequences of `benchmarks.trust` when they were chosen. Now they contain 50 of 58, and 54 of 74 of the other sequences; in 20 of
the other 28 solves the error is smaller. In `benchmarks.accuracy.kinds` the intervals contain 30 of 58; 27 errors are larger."""

POOR, BAD = 0.2, 1.8
"""Upper end of the error interval, relative to the size, from which the verdict is `with_care` and `do_not_use`. With `POOR`, no solve of
`benchmarks.trust` with an error above .15 is `good`. `BAD` is an expected error of half the size; white noise reaches 3 to 4."""

LOOSE, LOST = 0.08, 0.25
"""Median distance of visible observations from the projected shapes, relative to the size, for the same two verdicts. Tracker noise of 5 %
leaves .06. A prior with as many modes as frames fits anything; `LOST_HELD_OUT` detects that."""

NARROW, STILL = 20.0, 5.0
"""Angle between the two most different views, degrees, for the same two verdicts. The error of depth grows as the inverse of the angle.
Below `NARROW` the expected error is a lower bound: if the camera hardly moves, deformation is taken for a turn, which the standard
deviations do not include. The four solves of `benchmarks.trust` in between whose body stands still have errors of 5 to 7 times the
expected one."""

LEAST_TURN = 1.0
"""Rotation of the camera per frame, radians, divided by the deformation per frame, relative to the size (medians over a film), below which
rotation and deformation are hard to separate. A lower frame rate increases both alike, so the ratio is a property of the motion. Solves of
`benchmarks.trust` below 1 have errors of .05 and more."""

LOOSE_HELD_OUT, LOST_HELD_OUT = 0.08, 0.25
"""Median distance of held-out observations from their prediction, relative to the size, for the same two verdicts. White noise, which is
fitted to .04, has .7; tracks with noise of 2 % of the largest coordinate .03 to .07; ten face scans with 10 % outliers, 30 % hidden .08."""

OUTWEIGHED = 3.0
"""Median distance of observations from the projected shapes, in standard deviations of the noise, above which given weights let the priors
outweigh the tracks; Gaussian noise has 1.2. A face of 20 × 200, clean and with noise: 2.5 and less where the error is inside its interval,
3.3 and more where it is above. Shown on a talking face, a flag and a sphere of 20 × 200, clean and with noise of .01: it names every solve
of the face whose error the weights raise to .14 and more, and, on the clean flag, two whose error they hardly change; those of the sphere
are wrong with any weight."""

NO_POSTERIOR = "Only the learned prior, the default, estimates the error. Here nothing shows how far depth is off; compare with it."
"""Reason of a free surface whose prior is not the learned one, or has weight 0. On clean recorded sequences with estimated cameras
(`benchmarks.accuracy`), errors of the method `pseudo_inverse` are .19 to .73, those of the smooth prior .002 to .17."""

UNESTIMATED = "The solve was stopped before its error was estimated."
"""Reason of an isometric surface without standard deviations."""

FLEXIBLE = 0.5
"""Modes of deformation per frame above which the motion hardly determines depth: one independent shape every second frame."""

HIDDEN_SHARE, UNSEEN_SHARE = 0.6, 0.9
"""Share of positions without an observation, for the same two verdicts."""


class Verdict(StrEnum):
    """Whether a result can be used."""

    GOOD = "good"
    """None of the criteria for the other verdicts applies."""

    WITH_CARE = "with_care"
    """Parts may be wrong; `Trust.reasons` says why."""

    DO_NOT_USE = "do_not_use"
    """Depth or shape is probably wrong; `Trust.reasons` says why."""


Sign = tuple[Verdict, str]
"""A verdict and the sentence that is the reason for it."""


@dataclass(frozen=True, slots=True)
class Trust:
    """Estimated accuracy of a result."""

    verdict: Verdict
    """Whether the result can be used."""

    reasons: tuple[str, ...]
    """Sentences with figures that explain why the verdict is not `good`, the most serious first."""

    expected_error: float | None
    """Expected `e3d_frame`, relative to the object's size; None for free surfaces without a posterior."""

    interval: tuple[float, float] | None
    """Interval that contains the true error in three of four solves of `benchmarks.trust`.

    Where a motion of the camera would explain the deformation as well, the error can be larger: the interval contains
    about half of those in `benchmarks.accuracy.kinds`. None without a posterior, where the model is doubtful, or
    below `NARROW` degrees of turn.
    """

    turn_degrees: float
    """Angle between the two most different viewing directions, degrees, at most 90, because opposite directions count as equal."""

    residual: float
    """Median distance of visible observations from the projected shapes, relative to the size."""

    hidden: float
    """Share of positions without an observation."""

    held_out_error: float | None = None
    """Median distance of observations from their prediction without a tenth of the frames (`shapes.held_out`), relative to the size; None
    without a posterior."""

    degrees_per_frame: float | None = None
    """Median angle between the viewing directions of consecutive frames, degrees; None for unordered photographs."""

    deformation_per_frame: float | None = None
    """Median over consecutive frames of the points' RMS motion in world axes, relative to the size; None for unordered photographs."""

    depth_from_lengths: bool = False
    """Whether constant edge lengths, not the turn of the camera, determine depth: an isometric surface."""

    @property
    def sentence(self) -> str:
        """Summary of the expected error and of what determines depth."""
        rests = (
            "depth rests on constant lengths"
            if self.depth_from_lengths
            else f"depth rests on {self.turn_degrees:.0f}° of turn"
        )
        if self.expected_error is None:
            return f"The error is not estimated; {rests}."
        if self.interval is None:
            return f"Expected error at least {_share(self.expected_error)}; {rests}."
        return f"Expected error about {_share(self.expected_error)}; {rests}."


def assess(
    solution: Solution,
    visible: Floats,
    *,
    held_out_error: float | None,
    ordered: bool,
    planar: bool,
    modes: int,
    depth_is_typical: bool,
    shown: NDArray[np.bool_],
    unclear_camera: str | None,
    given_weights: bool = False,
) -> Trust:
    """Return the verdict on a solution.

    Parameters
    ----------
    solution : Solution
        With standard deviations, unless its prior has no posterior.
    visible : ndarray, shape (F, P)
        Confidence of the observations used; 0 where hidden or rejected.
    held_out_error : float or None
        Median distance of held-out observations from their prediction, relative to the size.
    ordered : bool
        Whether the frames are in the order of a film.
    planar : bool
        Whether the tracks show a sheet, whose pose signs are weakly determined.
    modes : int
        Number of modes of deformation of the prior that exceed the noise.
    depth_is_typical : bool
        Whether a prior, not the tracks, determines the extent of depth.
    shown : ndarray of bool, shape (F,)
        Frames that show enough points for a camera of their own.
    unclear_camera : str or None
        Sentence that states why the camera model is in doubt; None if it is not.
    given_weights : bool
        Whether the user gave a weight of the priors, which the standard deviations do not count.
    """
    shapes, rotations = solution.shapes, solution.camera.rotations
    size = size_of(shapes)
    pulse()
    expected = _expected(solution)
    residual, hidden = _fit(solution, visible, size)
    turn = turned(rotations[shown])
    outweighed = given_weights and expected is not None and residual * size > OUTWEIGHED * solution.choices.noise
    bounded = not (planar or depth_is_typical or turn < NARROW or outweighed)
    turning, deforming = per_frame(shapes, rotations) if ordered else (None, None)
    found = [
        *_observation_signs(residual, hidden),
        _sign(
            -turn,
            -NARROW,
            -STILL,
            f"The estimated cameras turn by only {turn:.0f}°; depth needs {NARROW:.0f}° or more.",
        ),
        *_frame_signs(shown, frames_behind(solution.camera, shapes), ordered=ordered),
        *_error_signs(expected, held_out_error, bounded=bounded),
        *_motion_signs(turning, deforming),
        *_model_signs(
            modes, len(shapes), off=off_plane(shapes) if planar else None, turn=turn if depth_is_typical else None
        ),
    ]
    if outweighed:
        found.append((Verdict.WITH_CARE, _outweighed(residual)))
    if unclear_camera is not None:
        found.append((Verdict.WITH_CARE, unclear_camera))
    verdict, reasons = _most_serious_first(found)
    interval = _interval(expected) if bounded else None
    return Trust(
        verdict, reasons, expected, interval, turn, residual, hidden, held_out_error, turning, deforming,
    )  # fmt: skip


def assess_isometric(solution: Solution, *, ordered: bool, doubted: bool) -> Trust:
    """Return the verdict on the solution of an isometric surface, whose weights are those of the observations used.

    Constant edge lengths, not the turn of the camera, determine its depth. Each warning of the solution is a reason for `with_care`.

    Parameters
    ----------
    solution : Solution
        With standard deviations, unless the solve was stopped before they were computed.
    ordered : bool
        Whether the frames are in the order of a film.
    doubted : bool
        Whether the evidence for constant lengths or the focal length is weak. Then the expected error is a lower bound.
    """
    shapes, rotations = solution.shapes, solution.camera.rotations
    expected, (residual, hidden) = _expected(solution), _fit(solution, solution.weights, size_of(shapes))
    turning, deforming = per_frame(shapes, rotations) if ordered else (None, None)
    warned = [(Verdict.WITH_CARE, warning) for warning in solution.choices.warnings]
    errors = (
        [(Verdict.WITH_CARE, UNESTIMATED)] if expected is None else _error_signs(expected, None, bounded=not doubted)
    )
    verdict, reasons = _most_serious_first([*warned, *_observation_signs(residual, hidden), *errors])
    return Trust(
        verdict, reasons, expected, None if doubted else _interval(expected), turned(rotations), residual, hidden,
        degrees_per_frame=turning, deformation_per_frame=deforming, depth_from_lengths=True,
    )  # fmt: skip


def _expected(solution: Solution) -> float | None:
    """Return the expected error, relative to the size; None without standard deviations."""
    std = solution.shapes_std
    return None if std is None else float(np.sqrt(np.square(std).mean())) / size_of(solution.shapes)


def _interval(expected: float | None) -> tuple[float, float] | None:
    return None if expected is None else (INTERVAL[0] * expected, INTERVAL[1] * expected)


def _outweighed(residual: float) -> str:
    return (
        f"With the given weights, the shapes miss the tracks by {_percent(residual)} of the object's size, more than "
        f"{OUTWEIGHED:.0f} times the noise: the priors outweigh the tracks. Lower temporal_weight and spatial_weight, or leave them out."
    )


def frames_behind(camera: Camera, shapes: Floats) -> NDArray[np.bool_]:
    """Return a mask of the frames in which points lie behind a perspective camera, shape `(F,)`."""
    if camera.focal is None:
        return np.zeros(len(shapes), dtype=bool)
    return np.asarray(camera.depths(shapes).min(axis=1) <= -camera.focal)


def _fit(solution: Solution, visible: Floats, size: float) -> tuple[float, float]:
    """Return the median residual of the observations used, relative to the size, and the share of positions without one."""
    used = visible > 0
    pulse()
    relative = (solution.residuals / solution.camera.scales[:, None])[used]
    pulse()
    return float(np.median(relative)) / size if relative.size else np.inf, 1.0 - float(used.mean())


def _observation_signs(residual: float, hidden: float) -> list[Sign]:
    return [
        _sign(residual, LOOSE, LOST, f"The shapes miss the tracks by {_percent(residual)} of the object's size."),
        _sign(
            hidden, HIDDEN_SHARE, UNSEEN_SHARE,
            f"{hidden:.0%} of the positions are hidden and interpolated from their surroundings.",
        ),
    ]  # fmt: skip


def _frame_signs(shown: NDArray[np.bool_], behind: NDArray[np.bool_], *, ordered: bool) -> list[Sign]:
    """Return the reasons in single frames: points behind the camera, and hardly a point visible."""
    found = []
    if behind.any():
        which = _frames(behind, ordered=ordered)
        found.append((Verdict.DO_NOT_USE, f"In {which}, points of the shape lie behind the camera."))
    if not shown.all():
        which = _frames(~shown, ordered=ordered)
        sentence = f"Almost no points are visible in {which}, so the shapes there are guesses. Leave these frames out."
        found.append((Verdict.WITH_CARE, sentence))
    return found


def _error_signs(expected: float | None, held_out_error: float | None, *, bounded: bool) -> list[Sign]:
    """Return the reasons in the expected error, which is a lower bound unless `bounded`, and in the error of left-out observations."""
    found = []
    if expected is None:
        found.append((Verdict.WITH_CARE, NO_POSTERIOR))
    else:
        upper = INTERVAL[1] * expected
        large = f"may be as large as {_share(upper)}" if bounded else f"is expected to be at least {_share(expected)}"
        found.append(_sign(upper, POOR, BAD, f"The error {large}."))
    if held_out_error is not None:
        far = f"{_percent(held_out_error)} of the object's size"
        sentence = f"Observations that were left out are {far} from where the others predict them."
        found.append(_sign(held_out_error, LOOSE_HELD_OUT, LOST_HELD_OUT, sentence))
    return found


def _most_serious_first(found: list[Sign]) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict and its reasons."""
    signs = sorted((sign for sign in found if sign[0] is not Verdict.GOOD), key=lambda sign: -_SEVERITY[sign[0]])
    return signs[0][0] if signs else Verdict.GOOD, tuple(sentence for _, sentence in signs)


def _frames(chosen: NDArray[np.bool_], *, ordered: bool) -> str:
    """Return how many frames are chosen and, in a film, which is the first."""
    count = int(chosen.sum())
    first = f" (the first is frame {int(np.argmax(chosen))})" if ordered else ""
    return f"{count} of {len(chosen)} frames{first}"


def _motion_signs(turning: float | None, deforming: float | None) -> list[Sign]:
    """Return the reason, if the shape changes more per frame than the camera turns (`LEAST_TURN`)."""
    if turning is None or deforming is None or np.radians(turning) >= LEAST_TURN * deforming:
        return []
    sentence = (
        f"The camera turns by {turning:.2g}° in a frame, while the shape changes by {_percent(deforming)} of its size, as much as "
        f"{np.degrees(deforming):.2g}° would: rotation and deformation are hard to tell apart."
    )
    return [(Verdict.WITH_CARE, sentence)]


def _model_signs(modes: int, frames: int, *, off: float | None, turn: float | None) -> list[Sign]:
    """Return the reasons to doubt the model itself, which the standard deviations do not include.

    `off` is the distance of a sheet from its plane, relative to its size; `turn` is the angle of turn, degrees, of an object whose depth a
    prior determines. Each is None where it does not apply.
    """
    found = []
    if modes > FLEXIBLE * frames:
        found.append(
            f"{modes} modes of deformation in {frames} frames: the motion hardly determines depth. Use more frames."
        )
    if off is not None:
        found.append(
            f"The tracks are nearly those of a plane and hardly show bending; the surface is {_percent(off)} of its size off its plane."
        )
    if turn is not None:
        found.append(
            f"A turn of {turn:.0f}° hardly determines the object's depth; a depth typical for its width is assumed. Let it turn further."
        )
    return [(Verdict.WITH_CARE, sentence) for sentence in found]


def size_of(shapes: Floats) -> float:
    """Return the root mean square distance of the points from their frame's mean point; positive."""
    squares = []
    for frame in shapes:  # one at a time, to limit memory
        pulse()
        squares.append(float(np.square(frame - frame.mean(axis=0)).sum()))
    return max(float(np.sqrt(np.sum(squares) / max(shapes.shape[0] * shapes.shape[1], 1))), np.finfo(float).tiny)


def off_plane(shapes: Floats) -> float:
    """Return the RMS distance of the points from their frame's best-fitting plane, relative to the size, as a median over frames."""
    some = shapes[:: max(1, len(shapes) // 100)]
    spreads = [np.linalg.eigvalsh(np.cov(frame.T, bias=True)) for frame in some]
    return float(
        np.median([np.sqrt(max(spread[0], 0.0) / spread.sum()) if spread.sum() > 0 else 0.0 for spread in spreads])
    )


def per_frame(shapes: Floats, rotations: Floats) -> tuple[float | None, float | None]:
    """Return turn, degrees, and change of shape, relative to the size, as medians over consecutive frames; None for one frame."""
    if len(shapes) < 2:
        return None, None
    directions, steps = rotations[:, 2], []
    cosines = np.abs((directions[1:] * directions[:-1]).sum(axis=1))
    for before, after in itertools.pairwise(shapes):
        pulse()
        moved = after - before
        steps.append(np.square(moved - moved.mean(axis=0)).sum(axis=1).mean())
    turning = float(np.degrees(np.median(np.arccos(np.clip(cosines, 0.0, 1.0)))))
    return turning, float(np.sqrt(np.median(steps))) / size_of(shapes)


def turned(rotations: Floats) -> float:
    """Return the largest angle between two viewing directions, degrees; opposite directions count as equal."""
    directions = rotations[:: max(1, len(rotations) // 500), 2]
    cosines = np.abs(directions @ directions.T)
    return float(np.degrees(np.arccos(np.clip(cosines.min(), 0.0, 1.0))))


_SEVERITY = {Verdict.GOOD: 0, Verdict.WITH_CARE: 1, Verdict.DO_NOT_USE: 2}


def _sign(value: float, care: float, never: float, sentence: str) -> Sign:
    if value >= never:
        return Verdict.DO_NOT_USE, sentence
    return (Verdict.WITH_CARE if value >= care else Verdict.GOOD), sentence


def _share(share: float) -> str:
    return f"{_percent(share)} of the object's size"


def _percent(share: float) -> str:
    if share >= 1:
        return f"{float(f'{100 * share:.2g}'):.0f} %"  # two digits: 390 %
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"
