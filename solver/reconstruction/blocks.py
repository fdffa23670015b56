"""Shapes of more points than fit into memory at once: block by block, each with a margin of neighbouring points.

Given cameras, prior and translations, only the bending of the surface couples points, and its influence decays over a few rings of the
mesh. Overlapping blocks therefore need to be solved only once (Toselli and Widlund, Domain Decomposition Methods, 2005, chapter 1). Beyond
the tracks and the result, the memory needed is that of one block. Translations are those of the cameras; frames are centred over all points
at the end, not within blocks. Quantities of the whole object are computed once: the weight of bending and the jackknife of cameras and
prior.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.solver.evaluation.trust import Trust
from pliant.solver.limits import BLOCK_OBSERVATIONS
from pliant.solver.mesh import Mesh
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import pulse
from pliant.solver.reconstruction.cameras import Cameras
from pliant.solver.reconstruction.observations import monitored
from pliant.solver.reconstruction.prior import Prior, changes_of, estimate_with
from pliant.solver.reconstruction.shapes import shapes_from
from pliant.solver.reconstruction.start import begin, outlier_reason, prepared
from pliant.solver.records import Choices, Floats, Ints, Step, Tracks
from pliant.solver.settings import Settings
from pliant.solver.shapes.assessment import judged
from pliant.solver.shapes.sparsely_observed import mesh_of
from pliant.solver.solution import Outcome, Solution, Trace
from pliant.solver.storage import allocated, let_go

MARGIN = 4
"""Rings of neighbours around a block. For a face of 20 × 4,000 in four blocks with 2, 4, 8 and 16 rings, shapes differ from those solved at
once by .00020, .00005, .00004 and .00004 of its size (RMS), for 20 × 20,000 by .00027, .00015, .00005 and .00005; with the smooth prior by
.003 to .004 with any of them, because of where the reweightings end."""

JUDGED_POINTS = 20_000
"""Maximum number of points, at equal steps of the index, from which the verdict on the result is computed."""

CHOSEN_BY_BLOCK = ("temporal_weight", "spatial_weight", "robust_scale", "noise")
"""Choices that are made from the points of a block, unless cameras and learned prior determine them."""

START_SHARE = 0.07
"""Share of the run time spent on computing the weight of bending from the blocks' initial shapes; measured on 50 × 200,000."""


def needs_blocks(tracks: Tracks, settings: Settings) -> bool:
    """Return whether the shapes are solved in blocks; not with a low-rank prior, which couples all points, or the pseudo-inverse."""
    separable = settings.prior != "smooth+low_rank" and settings.method != "pseudo_inverse"
    return separable and tracks.num_frames * tracks.num_points > BLOCK_OBSERVATIONS


def shapes_in_blocks(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior | None,
    mesh: Mesh | None,
    settings: Settings,
    monitor: Monitor,
    *,
    seconds: dict[str, float],
    start: Floats | None,
    scratch: str | Path | None,
) -> Solution:
    """Return the solution of all points; `seconds` is the time per stage so far, `start` and `scratch` are as for `solve_shapes`."""
    began, whole = time.perf_counter(), _Whole(tracks, cameras, prior, settings, scratch)
    groups = blocks(tracks, -(-tracks.num_frames * tracks.num_points // BLOCK_OBSERVATIONS))
    edges = np.zeros((0, 2), dtype=np.int32) if mesh is None else mesh.edges
    pulse()
    bending = _bending(tracks, cameras, prior, mesh, groups, settings, monitor)
    changes = None if prior is None else changes_of(tracks, cameras, prior, seed=settings.seed, should_stop=monitor)
    for number, own in enumerate(groups):
        kept = with_margin(own, edges, tracks.num_points)
        part, surface = _part(tracks, kept), None if mesh is None else mesh_of(mesh, kept)
        inner = _monitor_of(part, settings, monitor, number, len(groups))
        first = None if start is None else start[:, kept]
        begun = [begin(part, cameras, prior, surface, settings, inner, shapes=first, moving=False, bending=bending)]
        solution = shapes_from(begun.pop(), inner, seconds={}, changes=changes)
        whole.add(solution, own, np.searchsorted(kept, own))
        del part, surface, solution  # before the next block
    solution = whole.solution(seconds={**seconds, "shapes": time.perf_counter() - began, "finish": 0.0})
    monitor.report(Step("finish", 1.0, objective=float(solution.trace.objective[-1])))
    return solution


def _part(tracks: Tracks, kept: NDArray[np.intp]) -> Tracks:
    points = tracks.points[:, kept]
    pulse()
    return Tracks.from_arrays(points, tracks.visible[:, kept])


def _bending(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior | None,
    mesh: Mesh | None,
    groups: list[NDArray[np.intp]],
    settings: Settings,
    monitor: Monitor,
) -> float | None:
    """Return λ2 of the whole surface from the initial shapes of all blocks; None if it is not estimated.

    λ2 is the inverse of a mean over the points, which a few sharp features dominate, so a sample would not suffice. Blocks
    have their margins here, too: without its neighbours, the surface seems to bend less at the border.
    """
    if mesh is None or prior is None or settings.spatial_weight is not None:
        return None
    total = 0.0
    for number, own in enumerate(groups):
        kept = with_margin(own, mesh.edges, tracks.num_points)
        weight = prepared(
            _part(tracks, kept), cameras, prior, mesh_of(mesh, kept), settings, moving=False, bends=np.isin(kept, own),
            should_stop=monitor,
        ).problem.weights.spatial  # fmt: skip
        if monitor.stopped or not weight > 0:
            return None
        total += len(own) / weight
        monitor.report_block(Step("initialise", 0.0), START_SHARE * (number + 1) / len(groups))
        let_go(tracks.points, tracks.visible)
    return tracks.num_points / total


def blocks(tracks: Tracks, count: int) -> list[NDArray[np.intp]]:
    """Return the sorted indices of the points of each block; block sizes differ by at most two.

    The points are bisected across the longer side of their mean image positions, recursively, so that blocks are about as wide as high and
    have short borders. Points that no frame shows have no position: they are dealt to all blocks, since a block of them alone has no data.
    """
    total = tracks.visible.sum(axis=0)
    mean = np.einsum("fp,fpc->pc", tracks.visible, tracks.points)
    seen, never = np.flatnonzero(total), np.flatnonzero(total == 0)
    mean[seen] /= total[seen, None]
    count = min(count, len(seen))
    return [
        np.sort(np.concatenate([part, never[number::count]])) for number, part in enumerate(_divided(seen, mean, count))
    ]


def _divided(points: NDArray[np.intp], mean: Floats, count: int) -> list[NDArray[np.intp]]:
    if count <= 1:
        return [points]
    own, first = mean[points], count // 2
    along = own[:, int(np.argmax(np.ptp(own, axis=0)))]
    ordered, cut = points[np.argsort(along, kind="stable")], round(len(points) * first / count)
    return _divided(ordered[:cut], mean, first) + _divided(ordered[cut:], mean, count - first)


def with_margin(own: NDArray[np.intp], edges: Ints, num_points: int) -> NDArray[np.intp]:
    """Return the sorted points of a block and of `MARGIN` rings of neighbours around it."""
    inside = np.zeros(num_points, dtype=bool)
    inside[own] = True
    one, two = edges.T
    for _ in range(MARGIN):
        reached = one[inside[two]], two[inside[one]]
        inside[reached[0]] = inside[reached[1]] = True
    return np.flatnonzero(inside)


def _copy(values: Floats, places: NDArray[np.intp], *, onto: Floats, own: NDArray[np.intp]) -> None:
    """Copy the points `places` to the points `own`, with a pulse per frame: writing to a temporary file is slow."""
    for row, found in zip(onto, values, strict=True):
        pulse()
        row[own] = found[places]


def _monitor_of(part: Tracks, settings: Settings, monitor: Monitor, number: int, count: int) -> Monitor:
    """Return a monitor for one block that reports its steps as progress of the whole solve."""

    def on_step(step: Step) -> None:
        if step.stage == "cameras":  # the cameras of all blocks are known
            step = replace(step, stage="initialise")
        if step.stage != "finish" or step.fraction < 1:
            monitor.report_block(step, START_SHARE + (1 - START_SHARE) * (number + step.fraction) / count)

    return monitored(part, None, settings, on_step, monitor, only=("shapes", "finish", "trust"))


class _Whole:
    """The result, filled block by block."""

    def __init__(
        self, tracks: Tracks, cameras: Cameras, prior: Prior | None, settings: Settings, scratch: str | Path | None
    ) -> None:
        frames, points = tracks.num_frames, tracks.num_points
        self._tracks, self._cameras, self._prior, self._scratch = tracks, cameras, prior, scratch
        self._given_weights = settings.gives_weights
        self._shapes = allocated((frames, points, 3), scratch)
        self._others: dict[str, Floats] = {}
        self._seen = self._rejected = 0
        self._parts: list[Solution] = []

    def add(self, solution: Solution, own: NDArray[np.intp], places: NDArray[np.intp]) -> None:
        """Store the results of the block's own points; `places` are their indices among the points solved."""
        _copy(solution.shapes, places, onto=self._shapes, own=own)
        for name in ("residuals", "weights", "shapes_std", "inlier_probability"):
            array = getattr(solution, name)
            if array is not None:
                if name not in self._others:
                    self._others[name] = allocated(self._shapes.shape[:2], self._scratch)
                _copy(array, places, onto=self._others[name], own=own)
        if solution.inlier_probability is not None:
            own_probability = solution.inlier_probability[:, places]
            self._rejected += int(np.count_nonzero(own_probability == 0))
            self._seen += int(np.count_nonzero(np.isfinite(own_probability)))
        let_go(self._shapes, *self._others.values(), self._tracks.points, self._tracks.visible)
        none = np.zeros((0, 0))
        self._parts.append(
            replace(
                solution,
                shapes=np.zeros((0, 0, 3)),
                residuals=none,
                weights=none,
                shapes_std=None,
                inlier_probability=None,
            )
        )

    def solution(self, *, seconds: dict[str, float]) -> Solution:
        """Return the solution of all points, centred per frame."""
        first, middle = self._parts[0], np.zeros((len(self._shapes), 3))
        for shape, mean in zip(self._shapes, middle, strict=True):
            pulse()
            mean[:] = shape.mean(axis=0)
            shape -= mean
        camera = first.camera.centred_on(middle)
        let_go(self._shapes)
        order = (Outcome.STOPPED, Outcome.REJECTED, Outcome.MAX_REWEIGHTINGS, Outcome.CONVERGED)
        found = {part.outcome for part in self._parts}
        solution = replace(
            first, shapes=self._shapes, camera=camera, seconds=seconds, trace=_summed([part.trace for part in self._parts]),
            outcome=next(each for each in order if each in found), **self._others,  # type: ignore[arg-type]
        )  # fmt: skip
        return replace(solution, choices=self._choices(), trust=self._judged(solution))

    def _choices(self) -> Choices:
        """Return the choices, with medians of those that each block makes, and the warnings and reasons of all blocks."""
        every = [part.choices for part in self._parts]
        values = {name: float(np.median([getattr(each, name) for each in every])) for name in CHOSEN_BY_BLOCK}
        reasons = _merged([each.reasons for each in every])
        if "outliers" in reasons:
            reasons["outliers"] = outlier_reason(self._rejected, self._seen, self._cameras.outlier_share)
        if len({each.temporal_weight for each in every}) > 1:
            reasons["weights"] = f"Medians of {len(every)} blocks of points. The first: {every[0].reasons['weights']}"
        warnings = tuple(dict.fromkeys(warning for each in every for warning in each.warnings))
        return replace(every[0], reasons=reasons, warnings=warnings, **values)  # type: ignore[arg-type]

    def _judged(self, solution: Solution) -> Trust:
        """Return the verdict on all points, computed from at most `JUDGED_POINTS` of them."""
        some = slice(None, None, -(-self._tracks.num_points // JUDGED_POINTS))
        prior, std = self._prior, solution.shapes_std
        held_out = [part.trust.held_out_error for part in self._parts if part.trust is not None]
        left_out = [error for error in held_out if error is not None]
        tracks = Tracks.from_arrays(self._tracks.points[:, some], self._tracks.visible[:, some])
        confidence = tracks.visible
        if solution.inlier_probability is not None:
            confidence = np.where(solution.inlier_probability[:, some] > 0, confidence, 0.0)  # 0 where rejected
        few = replace(
            solution, shapes=solution.shapes[:, some], residuals=solution.residuals[:, some],
            shapes_std=None if std is None else std[:, some],
        )  # fmt: skip
        return judged(
            few, tracks, confidence, self._cameras.estimate if prior is None else estimate_with(self._cameras, prior),
            None if prior is None else prior.normalized, self._cameras.observations.normalized.unit,
            held_out_error=float(np.median(left_out)) if left_out else None, given_weights=self._given_weights,
        )  # fmt: skip


def _merged(reasons: list[dict[str, str]]) -> dict[str, str]:
    """Return the reasons that all blocks agree on; of those that differ between blocks, the first one, named as such."""
    merged: dict[str, str] = {}
    for name in dict.fromkeys(name for each in reasons for name in each):
        every = [each.get(name) for each in reasons]
        first = next(each for each in every if each is not None)
        alike = all(each == first for each in every)
        merged[name] = first if alike else f"In one of {len(reasons)} blocks of points: {first}"
    return merged


def _summed(traces: list[Trace]) -> Trace:
    """Return the history of all blocks as if solved in parallel; a block that has ended keeps its last values."""
    longest = max(len(trace.objective) for trace in traces)

    def padded(values: Floats | Ints, fill: float | None = None) -> Floats:
        return np.append(values, np.full(longest - len(values), values[-1] if fill is None else fill))

    return Trace(
        np.sum([padded(trace.objective) for trace in traces], axis=0),
        np.median([padded(trace.residual) for trace in traces], axis=0),
        np.sum([padded(trace.iterations, 0) for trace in traces], axis=0).astype(np.int32),
    )
