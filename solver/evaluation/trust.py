"""How far a result can be trusted, without ground truth: an expected error and a verdict with its reasons.

The expected error is the root of the mean variance of the positions over the size of the shapes. The variance is that of the posterior
(`shapes.uncertainty`) and of a jackknife over parts of the object (`shapes.jackknife`), since cameras and prior are estimated from the
same tracks. The verdict adds signs of failure that a wrong model does not show by itself: tracks that the shapes do not explain, a
camera that hardly turned around the object, a sheet whose pose signs are ambiguous, positions that no frame shows.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats

INTERVAL = (0.35, 3.6)
"""Factors around the expected error: about the 10 and 90 % quantiles of true over expected error on the sequences for calibration of
`benchmarks.trust`, of which they hold 45 in 56; they hold 55 in 71 of the others, where the expected error is more often too large."""

POOR, BAD = 0.2, 1.8
"""Upper end of the expected error, share of the size, from which a result is to be used with care, and not to be used. With the first no
solve of `benchmarks.trust` with an error above .15 is `good`; the second is an expected error of half the size, and white noise has 3 to
4."""

LOOSE, LOST = 0.08, 0.25
"""Median distance of visible observations from the projected shapes, share of the size: the same two degrees. Tracker noise of 5 % leaves
.06. Where the prior has as many modes as frames, anything is fitted: `LOST_HELD_OUT` recognises that."""

NARROW, STILL = 20.0, 5.0
"""Degrees of turn between the two most different views: the same two degrees. Depth error grows as the inverse of the turn."""

UNTOLD = 1.0
"""Radians that the camera turns in a frame per share of its size that the shape changes in it, both medians over a film, below which
rotation and deformation are hard to tell apart. With fewer frames a second both grow alike: the ratio is a property of the motion. Solves
of `benchmarks.trust` below 1 have errors of .05 and more."""

LOOSE_HELD_OUT, LOST_HELD_OUT = 0.08, 0.25
"""Median distance of held-out observations from their prediction, share of the size: the same two degrees. White noise, which is fitted to
.04, has .7; tracks with noise of 2 % of the largest coordinate have .03 to .07, ten face scans with 10 % outliers and 30 % hidden .08."""

FLEXIBLE = 0.5
"""Modes of deformation per frame from which the motion hardly determines depth: every second frame has a shape of its own."""

HIDDEN_SHARE, UNSEEN_SHARE = 0.6, 0.9
"""Share of positions without an observation: the same two degrees."""


class Verdict(StrEnum):
    """Whether a result can be used."""

    GOOD = "good"
    WITH_CARE = "with_care"
    DO_NOT_USE = "do_not_use"


@dataclass(frozen=True, slots=True)
class Trust:
    """What a result says about its own accuracy."""

    verdict: Verdict
    reasons: tuple[str, ...]
    """A sentence with a figure for each sign that made the verdict worse than good; the gravest first."""

    expected_error: float | None
    """Expected `e3d_frame`, share of the object's size; None where the prior has no posterior."""

    interval: tuple[float, float] | None
    """Holds the true error in nearly eight of ten solves; None where the model behind it is not believed."""

    turn_degrees: float
    """Angle between the two most different viewing directions, degrees, at most 90: opposite directions count as the same."""

    residual: float
    """Median distance of visible observations from the projected shapes, share of the size."""

    hidden: float
    """Share of positions that no observation shows."""

    held_out_error: float | None = None
    """Median distance of observations from their prediction by a tenth of the frames less (`shapes.held_out`), share of the size; None
    without a posterior."""

    degrees_per_frame: float | None = None
    """Median angle between the viewing directions of consecutive frames, degrees; None for photographs in no order."""

    deformation_per_frame: float | None = None
    """Median over consecutive frames of the root mean square motion of the points in world axes, share of the size; None likewise."""

    @property
    def sentence(self) -> str:
        """The expected error and what depth rests on, in words."""
        rests = f"depth rests on {self.turn_degrees:.0f}° of turn"
        if self.expected_error is None:
            return f"The error is not estimated; {rests}."
        if self.interval is None:
            return f"Expected error at least {_share(self.expected_error)}; {rests}."
        return f"Expected error about {_share(self.expected_error)}; {rests}."


def assess(
    shapes: Floats,
    rotations: Floats,
    residuals: Floats,
    visible: Floats,
    *,
    scales: Floats,
    shapes_std: Floats | None,
    held_out_error: float | None = None,
    ordered: bool = True,
    planar: bool = False,
    modes: int = 0,
    depth_is_typical: bool = False,
) -> Trust:
    """Return the verdict on a result.

    Parameters
    ----------
    shapes : ndarray, shape (F, P, 3)
        The tracks' unit.
    rotations : ndarray, shape (F, 3, 3)
        Camera from world.
    residuals : ndarray, shape (F, P)
        Distances of the observations from the projected shapes, the tracks' unit.
    visible : ndarray, shape (F, P)
        Confidence of the observations that were used; 0 where hidden or rejected.
    scales : ndarray, shape (F,)
        Image units per unit of the shapes.
    shapes_std : ndarray, shape (F, P), or None
        Posterior standard deviations, the unit of the shapes.
    held_out_error : float or None
        Median distance of held-out observations from their prediction, share of the size.
    ordered : bool
        The frames are those of a film.
    planar : bool
        The tracks are those of a sheet, so that its pose signs are weakly determined.
    modes : int
        Modes of deformation of the prior.
    depth_is_typical : bool
        The extent of depth rests on a prior and not on the tracks.
    """
    size = size_of(shapes)
    pulse()
    seen = visible > 0
    expected = None if shapes_std is None else float(np.sqrt(np.square(shapes_std).mean())) / size
    bounded = expected is not None and not (planar or depth_is_typical)
    interval = (INTERVAL[0] * expected, INTERVAL[1] * expected) if expected is not None and bounded else None
    relative = (residuals / scales[:, None])[seen]
    pulse()
    residual = float(np.median(relative)) / size if relative.size else np.inf
    turn = turned(rotations)
    hidden = 1.0 - float(seen.mean())
    unseen = f"{hidden:.0%} of the positions are not seen and drawn from their surroundings."
    found = [
        _sign(residual, LOOSE, LOST, f"The shapes miss the tracks by {_percent(residual)} of the object's size."),
        _sign(-turn, -NARROW, -STILL, f"The camera turned by {turn:.0f}° only; depth needs {NARROW:.0f}° or more."),
        _sign(hidden, HIDDEN_SHARE, UNSEEN_SHARE, unseen),
    ]
    if expected is not None:
        upper = INTERVAL[1] * expected
        large = f"may be as large as {_share(upper)}" if bounded else f"is expected to be at least {_share(expected)}"
        found.append(_sign(upper, POOR, BAD, f"The error {large}."))
    if held_out_error is not None:
        far = f"{_percent(held_out_error)} of the object's size"
        sentence = f"Observations that were left out are {far} from where the others predict them."
        found.append(_sign(held_out_error, LOOSE_HELD_OUT, LOST_HELD_OUT, sentence))
    turning, deforming = per_frame(shapes, rotations) if ordered else (None, None)
    if turning is not None and deforming is not None:
        found += _untold(turning, deforming)
    off = off_plane(shapes) if planar else None
    found += _doubts(modes, len(shapes), off=off, turn=turn if depth_is_typical else None)
    signs = sorted((sign for sign in found if sign[0] is not Verdict.GOOD), key=lambda sign: -_SEVERITY[sign[0]])
    verdict = signs[0][0] if signs else Verdict.GOOD
    return Trust(
        verdict, tuple(sentence for _, sentence in signs), expected, interval, turn, residual, hidden,
        held_out_error, turning, deforming,
    )  # fmt: skip


def _untold(turning: float, deforming: float) -> list[tuple[Verdict, str]]:
    """Return the reason where the shape changes by more in a frame than the camera turns."""
    if np.radians(turning) >= UNTOLD * deforming:
        return []
    sentence = (
        f"The camera turns by {turning:.2g}° in a frame, while the shape changes by {_percent(deforming)} of its size, as much as "
        f"{np.degrees(deforming):.2g}° would: rotation and deformation are hard to tell apart."
    )
    return [(Verdict.WITH_CARE, sentence)]


def _doubts(modes: int, frames: int, *, off: float | None, turn: float | None) -> list[tuple[Verdict, str]]:
    """Return the reasons to doubt the model itself, which the standard deviations do not include.

    `off` is how far a sheet is from its plane, `turn` that of an object whose depth is typical; None where they are not.
    """
    found: list[tuple[Verdict, str]] = []
    if modes > FLEXIBLE * frames:
        sentence = (
            f"{modes} modes of deformation in {frames} frames: the motion hardly determines depth. Use more frames."
        )
        found.append((Verdict.WITH_CARE, sentence))
    if off is not None:
        sentence = f"A thin sheet, {_percent(off)} of its size off its plane; the motion hardly shows bending."
        found.append((Verdict.WITH_CARE, sentence))
    if turn is not None:
        sentence = (
            f"With {turn:.0f}° of turn the tracks hardly show how deep the object is; its depth is one that is usual for its width. Let it "
            "turn further."
        )
        found.append((Verdict.WITH_CARE, sentence))
    return found


def size_of(shapes: Floats) -> float:
    """Return the root mean square distance of the points from their frame's mean point; positive."""
    squares = []
    for frame in shapes:  # one at a time, for its memory
        pulse()
        squares.append(float(np.square(frame - frame.mean(axis=0)).sum()))
    return max(float(np.sqrt(np.sum(squares) / max(shapes.shape[0] * shapes.shape[1], 1))), np.finfo(float).tiny)


def off_plane(shapes: Floats) -> float:
    """Return the root mean square distance of the points from the plane that fits their frame best, share of the size, median of frames."""
    some = shapes[:: max(1, len(shapes) // 100)]
    spreads = [np.linalg.eigvalsh(np.cov(frame.T, bias=True)) for frame in some]
    return float(
        np.median([np.sqrt(max(spread[0], 0.0) / spread.sum()) if spread.sum() > 0 else 0.0 for spread in spreads])
    )


def per_frame(shapes: Floats, rotations: Floats) -> tuple[float | None, float | None]:
    """Return degrees of turn and share of the size that the shape changes, medians over consecutive frames; None for one frame."""
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
    """Return the largest angle between two viewing directions, degrees; opposite views of an orthographic camera count as one."""
    directions = rotations[:: max(1, len(rotations) // 500), 2]
    cosines = np.abs(directions @ directions.T)
    return float(np.degrees(np.arccos(np.clip(cosines.min(), 0.0, 1.0))))


_SEVERITY = {Verdict.GOOD: 0, Verdict.WITH_CARE: 1, Verdict.DO_NOT_USE: 2}


def _sign(value: float, care: float, never: float, sentence: str) -> tuple[Verdict, str]:
    if value >= never:
        return Verdict.DO_NOT_USE, sentence
    return (Verdict.WITH_CARE if value >= care else Verdict.GOOD), sentence


def _share(share: float) -> str:
    return f"{_percent(share)} of the object's size"


def _percent(share: float) -> str:
    if share >= 1:
        return f"{float(f'{100 * share:.2g}'):.0f} %"  # two digits: 390 %
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"
