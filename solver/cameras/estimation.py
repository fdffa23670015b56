"""Cameras from tracks: rotation, scale and translation of every frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from pliant.solver.cameras.factorization import Upgrade, upgrade
from pliant.solver.cameras.multistart import CANDIDATES, Candidate, carried, depth, frames_used, gram_of, held, race
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.cameras.planar_ambiguity import is_flat, on_its_sides
from pliant.solver.cameras.scale import rigid_evidence, rigid_scales
from pliant.solver.model.so3 import angles_between, start_at_identity
from pliant.solver.records import Floats, KnownCamera, Step, read_only
from pliant.solver.settings import Settings
from pliant.solver.tracks.completion import Completed, Filling, complete
from pliant.solver.tracks.normalization import Normalised

SHARE = 0.03
"""Fraction reported at the end, beside what is counted by `should_stop` (`solver.monitor`)."""

HARDLY = np.radians(10.0)
"""Largest turn between any frame and the first below which the user is warned."""

NEARLY = 0.05
"""Energy, after the first heat, above the lowest up to which a factorization's own cameras are a start for the refinement with the
shapes. Measured: the false one that flattens a shark is .10 above, one that bends a face .34; true ones up to .05."""

TOO_DEEP = 4.0
"""Mean squared depth of the closed form, normalised units, from which cameras are no start: they hardly turn. Measured: a horse seen
from its short side 1.8, false cameras of ten faces 144."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate:
    """The cameras, and how they were found."""

    rotations: Floats
    """Camera from world, shape `(F, 3, 3)`; the first is the identity."""

    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0."""

    translations: Floats
    """Correction to the centroid, normalised units, shape `(F, 2)`."""

    basis_size: int
    """K of the factorization; 0 for given cameras."""

    gram: Floats
    """W Wᵀ / P of the completed tracks, shape `(2F, 2F)`, normalised units; empty where nothing asks for it."""

    sample: Floats
    """Some points of the completed tracks, centred, shape `(F, S, 2)`, normalised units; empty where nothing asks for it."""

    rivals: tuple[tuple[int, Floats], ...] = ()
    """K and rotations `(F, 3, 3)`, not refined, of the factorizations that are about as probable."""

    outliers: float = 0.0
    """Share of the seen entries that completion replaced as gross outliers."""

    rank: int = 0
    """Columns of the basis that filled the holes; 0 when nothing was filled."""

    filling: Filling | None = None
    """How hidden entries and outliers were replaced; None: nothing was."""

    perspective: Perspective | None = None
    """What is known about perspective; None: it is not considered. With κ ≠ 0, `gram`, `sample` and `translations` are those of the
    corrected tracks."""

    reasons: dict[str, str] = field(default_factory=dict)
    """One sentence for each choice."""

    warnings: tuple[str, ...] = ()
    """What the user should know before trusting the result."""


def estimate_cameras(
    normalised: Normalised,
    settings: Settings,
    *,
    on_step: Callable[[Step], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    rank: int = 0,
) -> CameraEstimate:
    """Return the cameras of the tracks, without anything known about the shapes.

    Parameters
    ----------
    normalised : Normalised
        Centred tracks; hidden entries and gross outliers are filled first.
    settings : Settings
        `camera`, `basis_size`, `refine_rotations`, `seed`.
    on_step : callable, optional
        Told after completion and after every factorization; fractions run from 0 to `SHARE`.
    should_stop : callable, optional
        Asked between units of work; once it says True, the best cameras so far are returned.
    rank : int
        Of the completion, as an earlier estimate from these tracks had it; 0 chooses it.
    """
    tell = on_step if on_step is not None else _silent
    completed = complete(normalised, seed=settings.seed, rank=rank)
    tell(Step("cameras", 0.4 * SHARE))
    scales, scale_reason = rigid_evidence(completed.gram, settings)
    gram = completed.gram / np.outer(np.repeat(scales, 2), np.repeat(scales, 2))
    used = frames_used(len(scales))
    part = gram_of(gram, used)
    upgrades: list[Upgrade] = []
    entries: list[Candidate] = []
    for size in _sizes(completed, settings):
        if entries and should_stop is not None and should_stop():
            break
        upgrades.append(upgrade(gram, size))
        entries.append(
            held(
                part, _thinned(upgrades[-1], used), np.ones(len(part) // 2), with_scales=False, should_stop=should_stop
            )
        )
        tell(Step("cameras", (0.4 + 0.04 * len(entries)) * SHARE))
    best, ran = min(entries, key=lambda candidate: candidate.energy), entries
    if settings.refine_rotations:
        best, ran = race(part, entries, should_stop=should_stop)
    own = next(each for each in upgrades if each.basis_size == best.basis_size)
    tell(Step("cameras", 0.8 * SHARE))
    rotations, refined = _everywhere(own.rotations, best, used, settings)
    rivals: tuple[tuple[int, Floats], ...] = ()
    if settings.refine_rotations and is_flat(gram):
        rotations, sheet = on_its_sides(gram, rotations, should_stop=should_stop)
        refined = f"{refined} {sheet}"
    elif settings.refine_rotations:
        rivals = _rivals(upgrades, ran, part, used)
    read_only(rotations)
    read_only(scales)
    tell(Step("cameras", SHARE))
    reasons = {"basis_size": _why(ran, best, settings), "scales": scale_reason, "rotations": refined}
    return CameraEstimate(
        rotations, scales, completed.translations, best.basis_size, completed.gram, completed.sample,
        rivals, completed.outliers, completed.rank, completed.filling, None, reasons, _warnings(rotations),
    )  # fmt: skip


def restarted(estimate: CameraEstimate, size: int, rotations: Floats) -> CameraEstimate:
    """Return the estimate with the rotations of the factorization with K = `size`, as they came."""
    known = estimate.reasons.get("basis_size", "")
    why = f"{known} With the shapes, the rotations of K = {size} as they came lead to more probable motion."
    return replace(
        estimate,
        rotations=rotations,
        basis_size=size,
        reasons={**estimate.reasons, "basis_size": why.strip()},
        warnings=_warnings(rotations),
    )


def _rivals(upgrades: list[Upgrade], ran: list[Candidate], gram: Floats, used: slice) -> tuple[tuple[int, Floats], ...]:
    """Return K and rotations of the factorizations that the first heat led to nearly the lowest energy, if not far too deep."""
    lowest = min(candidate.energy for candidate in ran)
    near = {each.basis_size for each in ran if not each.steadied and each.energy <= lowest + NEARLY}
    return tuple(
        (each.basis_size, each.rotations)
        for each in upgrades
        if each.basis_size in near and depth(gram, each.rotations[used]) < TOO_DEEP
    )


def _everywhere(before: Floats, best: Candidate, used: slice, settings: Settings) -> tuple[Floats, str]:
    """Return the rotations of all frames, given those of the frames that raced, and a sentence."""
    if not settings.refine_rotations:
        return before, "Rotations are those of the factorization."
    after = carried(before, best.cameras[0], used)
    if not np.isfinite(after).all():
        return before, "A refinement was tried and refused: it left the finite numbers."
    after = start_at_identity(after)
    turn = float(np.degrees(angles_between(after, before).mean()))
    how = ", from a steadied start" if best.steadied else ""
    return after, f"Refined by variable projection{how}; rotations moved by {turn:.2f}° on average."


def _thinned(full: Upgrade, used: slice) -> Upgrade:
    return Upgrade(full.basis_size, full.rotations[used], full.scales[used], full.residual)


def given_cameras(normalised: Normalised, known: KnownCamera, settings: Settings, *, rank: int = 0) -> CameraEstimate:
    """Return given cameras as an estimate; scales that are not given are estimated if the camera model has them.

    They are then those with which one rigid shape explains the tracks best: Σ_f ‖W_f − s_f R_f S‖². Shrinking them all gains
    nothing, for S grows in return.

    Where scales are known, the prior does not ask for the tracks' Gram matrix, and translations are found with the shapes, the tracks
    are not completed: that could take longer than the shapes. Measured with half of the points hidden: shapes the same to four digits.
    `rank` is as for `estimate_cameras`.
    """
    frames = len(known.rotations)
    exact = known.scales is not None or settings.camera == "orthographic"
    if exact and not settings.gaussian and settings.method != "pseudo_inverse":
        completed = Completed(np.zeros((0, 0)), np.zeros((frames, 0, 2)), np.zeros((frames, 2)), 0, 0.0)
    else:
        completed = complete(normalised, seed=settings.seed, rank=rank)
    if known.scales is not None:
        scales, reason = np.array(known.scales), "Rotations and scales were given."
    elif settings.zooming:
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
        outliers=completed.outliers,
        rank=completed.rank,
        filling=completed.filling,
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
        return f"K = {size} as set."
    tried = ", ".join(f"{each.basis_size}{' steadied' if each.steadied else ''}: {each.energy:.3f}" for each in ran)
    return (
        f"K = {size} leads to the most probable motion under the steadiest camera (negative log-likelihood: {tried})."
    )


def _warnings(rotations: Floats) -> tuple[str, ...]:
    if angles_between(rotations, rotations[:1]).max() >= HARDLY:
        return ()
    return ("The camera hardly turns about the object: depth cannot be told from the tracks and is a guess.",)


def _silent(_: Step) -> None:
    pass
