"""Cameras from tracks: rotation, scale and translation of every frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.factorization import Upgrade, upgrades
from pliant.solver.cameras.multistart import (
    CANDIDATES,
    MULTISTART_FRAMES,
    Candidate,
    carried,
    continued,
    depth,
    run_multistart,
    with_fixed_rotations,
)
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.cameras.planar_ambiguity import is_planar, resolve_pose_signs
from pliant.solver.cameras.scale import rigid_evidence, rigid_scales
from pliant.solver.model.so3 import angles_between, start_at_identity
from pliant.solver.monitor import enter
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, KnownCamera, projections_of, read_only
from pliant.solver.settings import Settings
from pliant.solver.tracks.completion import Completed, Filling, complete
from pliant.solver.tracks.frame_selection import every_nth, of_frames
from pliant.solver.tracks.normalization import Normalized

MAX_HYPOTHESIS_GAP = 0.05
"""Maximum energy above the lowest after the first round at which the unrefined cameras of a factorization remain a hypothesis
for the refinement with shapes: true cameras lie up to .05 above, false ones .10 and more. In that refinement another candidate
must be better by this margin: on the walk and the 99 face scans the best one gains less than .02 and raises the error by 21 and
13 %; on a small face it gains .10 and the error falls to .4."""

MAX_START_DEPTH_VARIANCE = 4.0
"""Mean squared depth of the closed form, normalized units squared, above which cameras are rejected as a hypothesis because they
hardly rotate: 1.8 for a horse seen from its short side, 144 for false cameras of faces."""


@dataclass(frozen=True, slots=True, eq=False)
class OtherCameras:
    """Alternative rotations, which may be more probable than the estimate once the shapes are known."""

    basis_size: int
    """K of the factorization."""

    rotations: Floats
    """Shape `(F, 3, 3)`."""

    description: str
    """Noun phrase for the report that names what distinguishes them."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate:
    """The cameras and how they were found."""

    rotations: Floats
    """Camera from world, shape `(F, 3, 3)`; the first is the identity unless the cameras are given."""

    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0 unless given."""

    translations: Floats
    """Correction to the centroid, normalized units, shape `(F, 2)`."""

    basis_size: int
    """K of the factorization; 0 for given cameras."""

    gram: Floats
    """W Wᵀ / P of the completed tracks, shape `(2F, 2F)`, normalized units squared; empty if not needed. In long films that of the F'
    frames learned from, shape `(2F', 2F')`."""

    sample: Floats
    """Sampled points of the completed tracks, centred, shape `(F, S, 2)`, normalized units; empty if not needed."""

    hypotheses: tuple[OtherCameras, ...] = ()
    """About equally probable alternatives: unrefined cameras of factorizations, or a planar object with other pose signs."""

    outlier_share: float = 0.0
    """Share of the visible entries that completion replaced as gross outliers."""

    rank: int = 0
    """Columns of the basis that filled hidden entries; 0 if nothing was filled."""

    filling: Filling | None = None
    """How hidden entries and outliers were replaced; None if nothing was."""

    perspective: Perspective | None = None
    """The perspective correction; None if perspective is not considered. With κ ≠ 0, `gram`, `sample` and
    `translations` are those of the corrected tracks."""

    ordered: bool = True
    """True for a film, False for photographs in no order."""

    reasons: dict[str, str] = field(default_factory=dict)
    """One sentence per choice."""

    warnings: tuple[str, ...] = ()
    """Reasons to distrust the result."""

    candidates: tuple[OtherCameras, ...] = ()
    """All candidates of the multistart; refinement with the shapes may rank them differently."""

    sampled: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """Indices of the points of `sample`, shape `(S,)`."""

    depth_is_typical: bool = False
    """Whether the prior, not the tracks, determines the extent of depth (`refinement.bas_relief`)."""

    @property
    def projections(self) -> Floats:
        """Shape `(F, 2, 3)`, see `projections_of`."""
        return projections_of(self.rotations, self.scales)


def estimate_cameras(
    normalized: Normalized,
    settings: Settings,
    *,
    should_stop: ShouldStop = never,
    rank: int = 0,
) -> CameraEstimate:
    """Estimate the cameras from the tracks, without a model of the shapes.

    Parameters
    ----------
    normalized : Normalized
        Centred tracks; hidden entries and gross outliers are filled first.
    settings : Settings
        `camera`, `basis_size`, `refine_rotations`, `seed`.
    should_stop : callable, optional
        Called between units of work; once it returns True, the best cameras so far are returned.
    rank : int
        Number of basis columns of the completion, from an earlier estimate of these tracks; 0 selects it.
    """
    ordered = settings.order != "any"
    completed = complete(normalized, seed=settings.seed, rank=rank, should_stop=should_stop)
    enter(should_stop, "factorization")
    scales, scale_reason = rigid_evidence(completed.gram, settings)
    should_stop()
    gram = completed.gram / np.outer(np.repeat(scales, 2), np.repeat(scales, 2))
    used = every_nth(len(scales), MULTISTART_FRAMES)
    part = of_frames(gram, used)
    sizes = _sizes(completed, settings)
    enter(should_stop, "multistart")
    factorized, entries = _factorized(gram, part, used, sizes, ordered=ordered, should_stop=should_stop)
    best, ran = min(entries, key=lambda candidate: candidate.energy), entries
    if settings.refine_rotations:
        best, ran = run_multistart(part, entries, ordered=ordered, should_stop=should_stop)
    own = {each.basis_size: each.rotations for each in factorized}
    rotations, refined = _everywhere(gram, own[best.basis_size], best, used, settings, should_stop)
    compared = ran if settings.refine_rotations else []
    alternative = None
    if settings.refine_rotations and is_planar(gram):
        turned, alternative, sides = resolve_pose_signs(gram, rotations, ordered=ordered, should_stop=should_stop)
        refined = f"{refined} {sides}"
        if alternative is not None or turned is not rotations:
            rotations, compared = turned, []
    hypotheses = _hypotheses(factorized, compared, part, used)
    if alternative is not None:
        hypotheses = (OtherCameras(best.basis_size, alternative, "reversed poses of some frames"),)
    candidates = tuple(
        _from_factorization(
            each.basis_size, _everywhere(gram, own[each.basis_size], each, used, settings, should_stop)[0]
        )
        for each in compared
    )
    read_only(rotations)
    read_only(scales)
    reasons = {"basis_size": _why(ran, best, settings), "scales": scale_reason, "rotations": refined}
    return CameraEstimate(
        rotations, scales, completed.translations, best.basis_size, completed.gram, completed.sample,
        hypotheses, completed.outlier_share, completed.rank, completed.filling, None, ordered, reasons,
        candidates=candidates, sampled=completed.sampled,
    )  # fmt: skip


def _factorized(
    gram: Floats,
    part: Floats,
    used: NDArray[np.intp],
    sizes: list[int],
    *,
    ordered: bool,
    should_stop: ShouldStop,
) -> tuple[list[Upgrade], list[Candidate]]:
    """Return the factorization for every K of `sizes`, and from each a multistart candidate at the frames used."""
    factorized: list[Upgrade] = []
    entries: list[Candidate] = []
    for each in upgrades(gram, sizes):
        factorized.append(each)
        entries.append(
            with_fixed_rotations(
                part,
                each.rotations[used],
                each.basis_size,
                smooth_start=False,
                ordered=ordered,
                should_stop=should_stop,
            )
        )
        if should_stop():
            break
    return factorized, entries


def with_other_cameras(estimate: CameraEstimate, other: OtherCameras) -> CameraEstimate:
    """Return the estimate with other rotations."""
    known = estimate.reasons.get("basis_size", "")
    why = f"{known} With the shapes, {other.description} lead to more probable motion."
    return replace(
        estimate,
        rotations=other.rotations,
        basis_size=other.basis_size,
        reasons={**estimate.reasons, "basis_size": why.strip()},
    )


def _from_factorization(size: int, rotations: Floats) -> OtherCameras:
    return OtherCameras(size, rotations, f"other rotations, from K = {size},")


def _hypotheses(
    factorized: list[Upgrade], ran: list[Candidate], gram: Floats, used: NDArray[np.intp]
) -> tuple[OtherCameras, ...]:
    """Return the cameras of factorizations with nearly the lowest energy after the first round and without excessive depth."""
    lowest = min((candidate.energy for candidate in ran), default=np.inf)
    near = {each.basis_size for each in ran if not each.smooth_start and each.energy <= lowest + MAX_HYPOTHESIS_GAP}
    return tuple(
        _from_factorization(each.basis_size, each.rotations)
        for each in factorized
        if each.basis_size in near and depth(gram, each.rotations[used]) < MAX_START_DEPTH_VARIANCE
    )


def _everywhere(
    gram: Floats,
    before: Floats,
    best: Candidate,
    used: NDArray[np.intp],
    settings: Settings,
    should_stop: ShouldStop,
) -> tuple[Floats, str]:
    """Return the rotations of all frames, from those at the frames of the multistart, and a sentence.

    Refinement hardly leaves a factorization, so its corrections are carried over. A smooth start does leave it.
    """
    if not settings.refine_rotations:
        return before, "Rotations are those of the factorization."
    found = best.cameras[0]
    if best.smooth_start:
        after = continued(gram, before, found, used, should_stop=should_stop)
    else:
        after = carried(before, found, used)
    if not np.isfinite(after).all():
        return before, "The refinement was rejected: it led to values that are not finite."
    after = start_at_identity(after)
    turn = float(np.degrees(angles_between(after, before).mean()))
    how = ", from a smooth-camera start" if best.smooth_start else ""
    return after, f"Refined by variable projection{how}; rotations moved by {turn:.2f}° on average."


def given_cameras(
    normalized: Normalized,
    known: KnownCamera,
    settings: Settings,
    *,
    rank: int = 0,
    perspective: bool = False,
    should_stop: ShouldStop = never,
) -> CameraEstimate:
    """Return given cameras as an estimate; missing scales are estimated if the camera model has them.

    Estimated scales minimise the residual of one rigid shape, Σ_f ‖W_f − s_f R_f S‖². A common factor of all scales has no
    effect, because S compensates for it. With the Gaussian prior, scales are 1 here, and `refinement.joint_refinement` frees
    them if the likelihood gains: a rigid shape would mistake deformation for a change of scale.

    Completion can take longer than the shapes. It is skipped if scales are known, the prior does not need the tracks' Gram
    matrix and translations are estimated with the shapes, but not with `perspective`, which needs the depths of completed
    tracks. `rank` is as for `estimate_cameras`.
    """
    frames = len(known.rotations)
    exact = known.scales is not None or settings.camera == "orthographic"
    if exact and not perspective and not settings.gaussian and settings.method != "pseudo_inverse":
        completed = Completed(np.zeros((0, 0)), np.zeros((frames, 0, 2)), np.zeros((frames, 2)), 0, 0.0)
    else:
        completed = complete(normalized, seed=settings.seed, rank=rank, should_stop=should_stop)
    if known.scales is not None:
        scales, reason = np.array(known.scales), "Rotations and scales were given."
    elif settings.gaussian and settings.estimates_scales:
        scales, reason = np.ones(frames), "Rotations were given."
    elif settings.estimates_scales:
        scales = rigid_scales(completed.gram, known.rotations)
        reason = "Rotations were given; scales were estimated."
    else:
        scales, reason = np.ones(frames), "Rotations were given; orthography has no scales."
    return CameraEstimate(
        known.rotations,
        scales,
        completed.translations,
        0,
        completed.gram,
        completed.sample,
        outlier_share=completed.outlier_share,
        rank=completed.rank,
        filling=completed.filling,
        sampled=completed.sampled,
        ordered=settings.order != "any",
        reasons={"camera": reason},
    )


def _sizes(completed: Completed, settings: Settings) -> list[int]:
    limit = max(1, min(len(completed.gram) // 3, completed.sample.shape[1] // 3))
    if settings.basis_size is not None:
        return [min(settings.basis_size, limit)]
    return [size for size in CANDIDATES if size <= limit]


def _why(ran: list[Candidate], best: Candidate, settings: Settings) -> str:
    size = best.basis_size
    if settings.basis_size is not None:
        return f"K = {size}, as set."
    tried = ", ".join(
        f"{each.basis_size}{' with a smooth start' if each.smooth_start else ''}: {each.energy:.3f}" for each in ran
    )
    return f"K = {size} leads to the most probable motion of object and camera (negative log likelihood: {tried})."
