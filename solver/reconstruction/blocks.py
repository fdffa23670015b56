"""Shapes of more points than fit into memory at once: block by block, each with a margin of its neighbours.

Given cameras, prior and translations, points are coupled by the bending of the surface alone, whose influence decays over some rings of
the mesh. A block therefore needs its surroundings only: overlapping blocks solved once (Toselli and Widlund, Domain
Decomposition Methods, 2005, chapter 1). Memory beyond the tracks and the result is that of one block. Frames are not centred within
blocks but at the end, over all points, and translations are those of the cameras.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.evaluation.trust import Trust, Verdict, assess
from pliant.solver.limits import BLOCK_OBSERVATIONS
from pliant.solver.mesh import Mesh
from pliant.solver.monitor import Monitor
from pliant.solver.reconstruction.cameras import Cameras
from pliant.solver.reconstruction.observations import monitored
from pliant.solver.reconstruction.prior import Prior
from pliant.solver.reconstruction.shapes import shapes_from
from pliant.solver.reconstruction.start import prepared, with_outlier_reason, with_outliers_rejected
from pliant.solver.records import Floats, Ints, Step, Tracks, read_only
from pliant.solver.settings import Settings
from pliant.solver.shapes.sparsely_observed import mesh_of
from pliant.solver.solution import Outcome, Solution, Trace

MARGIN = 16
"""Rings of neighbours around a block. Shapes of a face of 4,000 points in four blocks differ from those solved at once by .0034, .0019 and
.0020 of its size (RMS) with 2, 8 and 16 rings, with the smooth prior by .0052, .0035 and .0018."""

JUDGED_POINTS = 20_000
"""Points, evenly spread, by which the whole result is judged."""


def needs_blocks(tracks: Tracks, settings: Settings) -> bool:
    """Return whether the shapes are solved in blocks; a prior on the rank of all points together rules it out."""
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
) -> Solution:
    """Return the solution of all points; `seconds` are those of the stages so far."""
    began, whole = time.perf_counter(), _Whole(tracks)
    groups = blocks(tracks, -(-tracks.num_frames * tracks.num_points // BLOCK_OBSERVATIONS))
    for number, own in enumerate(groups):
        kept = with_margin(own, mesh, tracks.num_points)
        part = Tracks.from_arrays(tracks.points[:, kept], tracks.visible[:, kept])
        inner = _monitor_of(part, settings, monitor, number, len(groups))
        start = prepared(
            part,
            cameras,
            prior,
            None if mesh is None else mesh_of(mesh, kept),
            settings,
            moving=False,
            should_stop=inner,
        )
        start = with_outlier_reason(with_outliers_rejected(start, inner))
        solution = shapes_from(start, inner, seconds={})
        if settings.spatial_weight is None:  # one bending weight for all blocks
            settings = replace(settings, spatial_weight=solution.choices.spatial_weight)
        whole.add(solution, own, np.searchsorted(kept, own))
    solution = whole.solution(seconds={**seconds, "shapes": time.perf_counter() - began, "finish": 0.0})
    monitor.report(Step("finish", 1.0, objective=float(solution.trace.objective[-1])))
    return solution


def blocks(tracks: Tracks, count: int) -> list[NDArray[np.intp]]:
    """Return the sorted indices of the points of each block: strips of equal numbers of points across the longer side of the picture."""
    total = np.maximum(tracks.visible.sum(axis=0), np.finfo(float).tiny)
    mean = np.einsum("fp,fpc->pc", tracks.visible, tracks.points) / total[:, None]
    along = mean[:, int(np.argmax(np.ptp(mean, axis=0)))]
    return [np.sort(part) for part in np.array_split(np.argsort(along, kind="stable"), count)]


def with_margin(own: NDArray[np.intp], mesh: Mesh | None, num_points: int) -> NDArray[np.intp]:
    """Return the points of a block and of `MARGIN` rings around it, sorted."""
    inside = np.zeros(num_points, dtype=bool)
    inside[own] = True
    if mesh is not None:
        one, two = mesh.edges.T
        for _ in range(MARGIN):
            reached = one[inside[two]], two[inside[one]]
            inside[reached[0]] = inside[reached[1]] = True
    return np.flatnonzero(inside)


def _monitor_of(part: Tracks, settings: Settings, monitor: Monitor, number: int, count: int) -> Monitor:
    """Return the monitor of one block, whose steps are reported as those of the whole."""

    def on_step(step: Step) -> None:
        if step.stage != "finish" or step.fraction < 1:
            monitor.report_block(step, (number + step.fraction) / count)

    return monitored(part, None, settings, on_step, monitor, only=("shapes", "finish", "trust"))


class _Whole:
    """The result, filled block by block."""

    def __init__(self, tracks: Tracks) -> None:
        frames, points = tracks.num_frames, tracks.num_points
        self._tracks = tracks
        self._shapes = np.zeros((frames, points, 3))
        self._others: dict[str, Floats] = {}
        self._parts: list[Solution] = []

    def add(self, solution: Solution, own: NDArray[np.intp], places: NDArray[np.intp]) -> None:
        """Keep what belongs to the block's own points, `places` among those solved."""
        self._shapes[:, own] = solution.shapes[:, places]
        for name in ("residuals", "weights", "shapes_std", "inlier_probability"):
            array = getattr(solution, name)
            if array is not None:
                target = self._others.setdefault(name, np.zeros(self._shapes.shape[:2]))
                target[:, own] = array[:, places]
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
        """Return the solution of all points, centred per frame where the cameras are orthographic."""
        first, camera = self._parts[0], self._parts[0].camera
        if camera.focal is None:
            middle = self._shapes.mean(axis=1)
            self._shapes -= middle[:, None]
            moved = camera.scales[:, None] * np.einsum("fij,fj->fi", camera.rotations[:, :2], middle)
            camera = replace(camera, translations=camera.translations + moved)
        for array in (self._shapes, camera.translations, *self._others.values()):
            read_only(array)
        order = (Outcome.STOPPED, Outcome.REJECTED, Outcome.MAX_REWEIGHTINGS, Outcome.CONVERGED)
        found = {part.outcome for part in self._parts}
        solution = replace(
            first, shapes=self._shapes, camera=camera, seconds=seconds, trace=_summed([part.trace for part in self._parts]),
            outcome=next(each for each in order if each in found), **self._others,  # type: ignore[arg-type]
        )  # fmt: skip
        return replace(solution, trust=self._judged(solution, first.trust))

    def _judged(self, solution: Solution, example: Trust | None) -> Trust | None:
        if example is None:
            return None
        some = slice(None, None, -(-self._tracks.num_points // JUDGED_POINTS))
        std, weights = solution.shapes_std, self._tracks.visible[:, some]
        parts = [part.trust for part in self._parts if part.trust is not None]
        held_out = [trust.held_out_error for trust in parts if trust.held_out_error is not None]
        judged = assess(
            solution.shapes[:, some], solution.camera.rotations, solution.residuals[:, some], weights,
            scales=solution.camera.scales, shapes_std=None if std is None else std[:, some],
            held_out_error=float(np.median(held_out)) if held_out else None, ordered=example.degrees_per_frame is not None,
        )  # fmt: skip
        reasons = dict.fromkeys(each for trust in (judged, *parts) for each in trust.reasons)
        worst = max((trust.verdict for trust in (judged, *parts)), key=list(Verdict).index)
        interval = None if any(trust.interval is None for trust in parts) else judged.interval
        return replace(judged, verdict=worst, reasons=tuple(reasons), interval=interval)


def _summed(traces: list[Trace]) -> Trace:
    """Return the history of all blocks as if they had been solved side by side: a block that has ended keeps its values."""
    longest = max(len(trace.objective) for trace in traces)

    def padded(values: Floats | Ints, fill: float | None = None) -> Floats:
        return np.append(values, np.full(longest - len(values), values[-1] if fill is None else fill))

    return Trace(
        np.sum([padded(trace.objective) for trace in traces], axis=0),
        np.median([padded(trace.residual) for trace in traces], axis=0),
        np.sum([padded(trace.iterations, 0) for trace in traces], axis=0).astype(np.int32),
    )
