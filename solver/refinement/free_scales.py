"""Per-frame scales, adopted if they clearly raise the likelihood of the tracks.

The likelihood penalises each mode of deformation, so it distinguishes a camera that zooms from a shape that grows
(`cameras.scale`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.cameras.scale import WIDEST, rigid_scales
from pliant.solver.model.marginal_likelihood import Scene, cameras_of, fit, start
from pliant.solver.records import Floats
from pliant.solver.refinement.learned import Learned, Refinement
from pliant.solver.tracks.frame_selection import between, evenly_spread, of_frames

SCALE_FRAMES = 120
"""Frames used to decide whether scales are free; with 60, chance gains on sequences of constant scale reach .054."""

SMOOTH_ITERATIONS = 120
"""L-BFGS iterations for scales with smooth modes, as many as in `SCALE_ROUNDS` refinements."""

SCALE_ROUNDS = 2
"""Refinements used to decide whether scales are free."""

MIN_SCALE_GAIN = 0.12
"""Decrease of the energy, per point and frame, required to free scales that vary from frame to frame. BIC for one
parameter per frame gives .075; constant scales gain up to .08 by chance, real scale changes .23 and more."""

SMOOTH_SCALE_SHARE = 0.4
"""Share of `MIN_SCALE_GAIN` required of slowly varying scales, which need fewer parameters: a swing of .05 over 60
frames gains .058, constant scales up to .04."""

MIN_SCALE_STD = 0.01
"""Standard deviation of log s below which scales stay 1."""


@dataclass(frozen=True, slots=True, eq=False)
class ScaleTrial:
    """Result of freeing the scales of some frames."""

    start: Floats | None
    """Scales of all frames to start from, mean logarithm 0; None if free scales gain no more than chance or are implausible."""

    reason: str
    """A sentence for the report."""

    fixed: Learned
    """Cameras and covariance of the frames compared, with scales of 1."""


def try_free_scales(gram: Floats, rotations: Floats, how: Refinement) -> ScaleTrial:
    """Compare free scales with scales of 1 on a subset of the frames, whatever `how.with_scales`.

    Free scales start from 1 and from the scales of a rigid shape. Where they mistake deformation for scale, the result is a worse
    minimum than with fixed scales, or nearly constant scales. If rotations are kept, the scales of a rigid shape are a poor start,
    because only they can absorb the deformation; scales fitted with smooth modes are a third start.
    """
    used = evenly_spread(len(rotations), SCALE_FRAMES)
    part, given, none = of_frames(gram, used), rotations[used], np.ones(len(used))
    starts = [none, rigid_scales(part, given)]
    if not how.turning:
        starts.append(_smooth_scales(part, given, how))
    even, *others = (how.learn(part, given, scales) for scales in starts)
    fixed = replace(how, with_scales=False).refine(part, even, rounds=SCALE_ROUNDS)
    free = replace(how, with_scales=True)
    runs = [free.refine(part, each, rounds=SCALE_ROUNDS) for each in (even, *others)]
    best = min(runs, key=lambda run: run.energy)
    gain, logs = fixed.energy - best.energy, np.log(best.scales)
    extent = f"from {best.scales.min():.3f} to {best.scales.max():.3f}"
    if logs.std() > WIDEST:
        return ScaleTrial(None, f"Every scale is 1: those found, {extent}, vary more than those of any camera.", fixed)
    share = _scale_gain_share(logs) if how.model_order.ordered else 1.0
    if not (gain > MIN_SCALE_GAIN * share and logs.std() > MIN_SCALE_STD):
        reason = (
            f"Every scale is 1: a scale per frame, {extent}, would gain {gain:.3f} in the log likelihood, no more than deformation "
            "alone does."
        )
        return ScaleTrial(None, reason, fixed)
    logs = between(used, logs, len(rotations))
    reason = f"Scales {extent} gain {gain:.3f} in the log likelihood per point and frame."
    return ScaleTrial(np.exp(logs - logs.mean()), reason, fixed)


def _smooth_scales(gram: Floats, rotations: Floats, how: Refinement) -> Floats:
    """Return the most probable scales for given rotations under smooth modes and large noise, shape `(F,)`."""
    scene = Scene.of(gram, rotations, with_scales=True, ordered=how.model_order.ordered)
    begun = start(scene, np.ones(len(rotations)))
    moved, _ = fit(scene, begun, iterations=SMOOTH_ITERATIONS, turning=False, should_stop=how.should_stop)
    return cameras_of(scene, moved)[1]


def _scale_gain_share(logs: Floats) -> float:
    """Return the share of `MIN_SCALE_GAIN` required: `SMOOTH_SCALE_SHARE` for slowly varying scales, up to 1 for independent ones."""
    rough = float(np.diff(logs).var()) / max(2 * float(logs.var()), np.finfo(float).tiny)
    return float(np.clip(3 * rough, SMOOTH_SCALE_SHARE, 1.0))
