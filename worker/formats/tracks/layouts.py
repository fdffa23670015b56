"""Detection of the axes of a track array: documented layouts are preferred, otherwise temporal smoothness decides.

Points move little between frames, while the points of one frame are spread over the picture. The correct layout therefore has the
smallest mean step in time relative to the spread of the coordinates. If rows of a matrix are assigned to x and y in the wrong order,
x and y are neighbouring frames of one coordinate and almost equal, which is detected by their correlation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.solver.limits import MAX_COORDINATE
from pliant.solver.records import MIN_FRAMES, MIN_POINTS
from pliant.worker.formats.errors import AmbiguousInput
from pliant.worker.formats.tracks.third_rows import as_triples, has_three_blocks, three_rows
from pliant.worker.formats.tracks.tracker_formats import Dialect

CONTRADICTED = 5.0
"""Ratio of temporal smoothness above which another layout replaces the documented one."""

MIN_SMOOTHNESS_RATIO = 1.3
"""Ratio of temporal smoothness by which the best undocumented layout must exceed the next."""

ALIKE = 0.98
"""Correlation of x and y over the points, in the median frame, above which both are the same coordinate."""

COMPARED_POINTS = 96

LEAST_FINITE = 0.01
"""Share of positions below which they show no smoothness; if fewer are visible, the hidden ones count, too."""

MANY_FRAMES = 10_000
"""Maximum length of the frame axis. A longer axis lists pixels, whose neighbours are closer than consecutive frames."""

OF_ANY_ORDER = ("matrix", "unnamed")
"""Dialects whose arrays of three axes have no documented order."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One interpretation of an array as tracks."""

    layout: str
    """Description, e.g. `W (2F, P), rows interleaved`."""

    order: str
    """Option `layout` that selects it."""

    rows: str | None
    """Option `rows` that selects it, for matrices."""

    points: NDArray[np.generic]
    """A view of shape `(F, P, 2)`."""

    @property
    def options(self) -> dict[str, str]:
        """The options that select this reading."""
        return {"layout": self.order} | ({} if self.rows is None else {"rows": self.rows})


def readings(name: str, array: NDArray[np.generic]) -> list[Reading]:
    """Return all interpretations of an array as `(F, P, 2)`."""
    found: list[Reading] = []
    if array.ndim == 3:
        for axis in [axis for axis in (2, 1, 0) if array.shape[axis] == 2]:
            moved = np.moveaxis(array, axis, 2)
            letters = ["F", "P"]
            for order, points in (("frames_points", moved), ("points_frames", moved.transpose(1, 0, 2))):
                spelled = list(letters if order == "frames_points" else letters[::-1])
                spelled.insert(axis, "2")
                found.append(Reading(f"{name} ({', '.join(spelled)})", order, None, points))
    if array.ndim == 2:
        for order, matrix, spelled_matrix in (
            ("frames_points", array, "(2F, P)"),
            ("points_frames", array.T, "(P, 2F)"),
        ):
            if matrix.shape[0] % 2:
                continue
            pairs = matrix.reshape(matrix.shape[0] // 2, 2, matrix.shape[1]).transpose(0, 2, 1)
            halves = matrix.reshape(2, matrix.shape[0] // 2, matrix.shape[1]).transpose(1, 2, 0)
            word = "rows" if order == "frames_points" else "columns"
            found.append(Reading(f"{name} {spelled_matrix}, {word} interleaved", order, "interleaved", pairs))
            found.append(Reading(f"{name} {spelled_matrix}, {word} stacked", order, "stacked", halves))
    return found


def usable(found: list[Reading]) -> list[Reading]:
    """Return the readings with enough frames and points, and not too many frames if there are others; the first as a last resort."""
    fit = [one for one in found if _is_enough(one)]
    return [one for one in fit if one.points.shape[0] <= MANY_FRAMES] or fit or found[:1]


def roughness(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None = None, *, spread: float | None = None
) -> float:
    """Return the mean step in time over the spread of the visible coordinates, for a sample; infinite if x and y are the same.

    `spread` replaces that of these points, to compare interpretations of one matrix by their steps.
    """
    sample = _sample(points, visible)
    if np.isfinite(sample).all(axis=2).mean() < LEAST_FINITE:
        return float("inf")
    spread = _spread(sample) if spread is None else spread
    with np.errstate(invalid="ignore", divide="ignore"):
        step = _step(sample)
        centred = sample - np.nanmean(sample, axis=(0, 1))
        x, y = centred[..., 0], centred[..., 1]
        usable = np.isfinite(sample).all(axis=2).sum(axis=1) >= MIN_POINTS
        x, y = (
            x[usable] - np.nanmean(x[usable], axis=1, keepdims=True),
            y[usable] - np.nanmean(y[usable], axis=1, keepdims=True),
        )
        alike = np.nansum(x * y, axis=1) / np.sqrt(np.nansum(x * x, axis=1) * np.nansum(y * y, axis=1))
    if len(alike) and np.isfinite(alike).any() and np.nanmedian(np.abs(alike)) > ALIKE:
        return float("inf")
    return float(step / spread) if spread > 0 else float("inf")


def _sample(points: NDArray[np.generic], visible: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the coordinates of some points in the first frames, NaN where they are not finite, too large or hidden."""
    chosen = _sampled(points.shape[1])
    sample = np.asarray(points[: 4 * COMPARED_POINTS][:, chosen], dtype=np.float64)
    sample = np.where(np.isfinite(sample) & (np.abs(sample) <= MAX_COORDINATE), sample, np.nan)
    if visible is not None:
        hidden = visible[: len(sample), chosen] == 0
        if hidden.mean() < 1 - LEAST_FINITE:
            sample[hidden] = np.nan
    return sample


def _spread(sample: NDArray[np.float64]) -> float:
    """Return the standard deviation of the coordinates `(F, P, 2)`, mean of x and y; NaN if none is known."""
    if not np.isfinite(sample).any(axis=(0, 1)).all():
        return float("nan")
    return float(np.nanstd(sample, axis=(0, 1)).mean())


def _spreads(found: list[Reading]) -> dict[str, float]:
    """Return the smaller spread of each order of a matrix: rows of x that are read as y are spread as far as x is from y."""
    spreads: dict[str, float] = {}
    for one in found:
        spread = _spread(_sample(one.points, None))
        if spread > 0:
            spreads[one.order] = min(spread, spreads.get(one.order, spread))
    return spreads


def _sampled(count: int) -> NDArray[np.intp]:
    """Return the indices of the points that are compared."""
    return np.unique(np.linspace(0, count - 1, COMPARED_POINTS).round().astype(np.intp))


def _step(sample: NDArray[np.float64]) -> float:
    """Return the mean step of the coordinates `(F, P, 2)` between neighbouring frames, or between those that show a point if none do."""
    steps = np.diff(sample, axis=0)
    if not np.isfinite(steps).any():
        steps = np.concatenate(
            [np.diff(path[np.isfinite(path).all(axis=1)], axis=0) for path in sample.transpose(1, 0, 2)]
        )
    return float(np.nanmean(np.abs(steps))) if np.isfinite(steps).any() else float("inf")


def choose(
    name: str, array: NDArray[np.generic], *, dialect: Dialect, options: Options,
    visibility: Callable[[Reading], NDArray[np.float64] | None],
) -> tuple[Reading, list[str]]:  # fmt: skip
    """Select the interpretation that the options request, that is documented, or that the data indicate; return it and notes.

    The array has no batch axis. The documented layout of the dialect is used unless another is five times smoother in time. `visibility`
    returns the visibility `(F, P)` of an interpretation, None without one.

    Raises
    ------
    InvalidInput
        Code wrong_shape if none fits, or three rows per frame fit better; too_few_frames or too_few_points if every one has too few.
    AmbiguousInput
        Several interpretations fit.
    """
    every = readings(name, array)
    documented_axes = array.ndim != 3 or (dialect.name not in OF_ANY_ORDER and array.shape[2] == 2)
    order = dialect.order if documented_axes else None
    if array.ndim == 3 and options.layout == "auto":
        _check_documented(name, array, every, order)
    allowed = [one for one in usable(every) if _is_allowed(one, options)]
    if not allowed:
        raise InvalidInput(
            "wrong_shape", field="tracks", expected="(frames, points, 2) or a matrix of 2·frames rows, with 3 frames and 4 points or more",
            got=f"{name} of shape {array.shape}", hint="Transpose or reshape the array; check the options layout and rows.",
        )  # fmt: skip
    _check_size(name, array, allowed[0])
    if len(allowed) == 1:
        return allowed[0], []
    spreads = _spreads(allowed) if array.ndim == 2 else {}
    costs = {one.layout: roughness(one.points, visibility(one), spread=spreads.get(one.order)) for one in allowed}
    ranked = sorted(allowed, key=lambda one: costs[one.layout])
    documented = [one for one in ranked if order in (None, one.order) or options.layout != "auto"] or ranked
    if array.ndim == 2 and options.rows == "auto":
        cost, spread = costs[documented[0].layout], spreads.get(order or documented[0].order)
        _check_triples(name, array, documented[0], order=order, cost=cost, spread=spread, visibility=visibility)
    best, others = documented[0], documented[1:]
    known = np.isfinite(costs[best.layout]) or not others or not np.isfinite(array).any()  # `Tracks` refuses the last
    clear = known and all(costs[other.layout] >= MIN_SMOOTHNESS_RATIO * costs[best.layout] for other in others)
    if clear and costs[best.layout] <= CONTRADICTED * costs[ranked[0].layout]:
        notes = [_comparison(best, others[0], costs)] if others else []
        frames, count = best.points.shape[:2]
        if ranked[0].order != best.order and frames > count:
            notes.append(
                f"{_comparison(best, ranked[0], costs)} There are more frames than points: if they are swapped, set {_ways(ranked[:1])}."
            )
        return best, notes
    choices: list[dict[str, Any]] = [
        {"layout": one.layout, "options": one.options, "evidence": _evidence(costs[one.layout])} for one in ranked
    ]
    raise AmbiguousInput(
        field="tracks", expected="tracks whose layout is certain", got=f"{name} of shape {array.shape}, which can be read as "
        + " or ".join(one.layout for one in ranked), hint=f"Set the options of the correct one: {_ways(ranked)}.", choices=choices,
    )  # fmt: skip


def _is_enough(reading: Reading) -> bool:
    frames, count = reading.points.shape[:2]
    return bool(frames >= MIN_FRAMES and count >= MIN_POINTS)


def _check_documented(name: str, array: NDArray[np.generic], found: list[Reading], order: str | None) -> None:
    """Refuse an array that has too few frames or points in its documented order, but not in the other one."""
    documented = [one for one in found if one.order == order]
    others = [one for one in found if one.order != order and _is_enough(one)]
    if not documented or not others or _is_enough(documented[0]):
        return
    raise _too_few(name, array, documented[0], or_else=f"; if it is {others[0].layout}, set {_ways(others[:1])}")


def _check_triples(
    name: str, array: NDArray[np.generic], best: Reading, *, order: str | None, cost: float, spread: float | None,
    visibility: Callable[[Reading], NDArray[np.float64] | None],
) -> None:  # fmt: skip
    """Refuse a matrix in which x, y and a third number of each frame fit better than its best interpretation as x and y."""
    order = order or best.order
    matrix = array if order == "frames_points" else array.T
    if len(matrix) % 3:
        return
    blocks = best.order != order or best.rows == "stacked"
    if blocks and np.isfinite(cost) and has_three_blocks(matrix[:, _sampled(matrix.shape[1])]):
        raise three_rows(name, array, "stacked")
    triples = Reading(name, order, "interleaved", as_triples(matrix))
    if MIN_SMOOTHNESS_RATIO * roughness(triples.points, visibility(triples), spread=spread) < cost:
        raise three_rows(name, array, "interleaved")


def _check_size(name: str, array: NDArray[np.generic], reading: Reading) -> None:
    """Refuse an array without a reading of enough frames and points, and state how it was read, unless it was used as it is."""
    if reading.points.shape == array.shape:
        return  # `Tracks` refuses it, also after a selection
    if not _is_enough(reading):
        raise _too_few(name, array, reading, or_else=", or save the array as (frames, points, 2)")


def _too_few(name: str, array: NDArray[np.generic], reading: Reading, *, or_else: str) -> InvalidInput:
    """Return the error for a reading with too few frames or points."""
    frames, count = reading.points.shape[:2]
    what, number, least = ("frames", frames, MIN_FRAMES) if frames < MIN_FRAMES else ("points", count, MIN_POINTS)
    return InvalidInput(
        "too_few_frames" if what == "frames" else "too_few_points", field="tracks", expected=f"at least {least} {what}",
        got=f"{number} in {name} of shape {array.shape}, read as {reading.layout}",
        hint=f"Track {'a longer clip' if what == 'frames' else 'more points'}{or_else}.",
    )  # fmt: skip


def _ways(readings: list[Reading]) -> str:
    """Return the options of each reading, in the order of the readings."""
    return " or ".join(", ".join(f"{name}={value}" for name, value in one.options.items()) for one in readings)


def _is_allowed(reading: Reading, options: Options) -> bool:
    return options.layout in ("auto", reading.order) and (
        reading.rows is None or options.rows in ("auto", reading.rows)
    )


def _comparison(best: Reading, other: Reading, costs: dict[str, float]) -> str:
    return f"Read as {best.layout} ({_evidence(costs[best.layout])}), not as {other.layout} ({_evidence(costs[other.layout])})."


def _evidence(cost: float) -> str:
    if not np.isfinite(cost):
        return "x and y would be the same coordinate, or no point is seen twice"
    return f"mean step in time: {cost:.3g} of the coordinates' spread"
