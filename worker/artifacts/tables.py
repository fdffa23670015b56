"""Metrics of every frame and of every point as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pliant.solver.evaluation.alignment import align, frobenius
from pliant.solver.tracks.matrix import centred
from pliant.worker.artifacts.geometry import Floats
from pliant.worker.artifacts.result import Result

Column = NDArray[np.floating] | NDArray[np.integer] | Iterable[float] | Iterable[str]


def write_frames_csv(result: Result, file: IO[bytes]) -> None:
    """Write one row per frame; truth columns only with ground truth, empty cells where nothing was visible."""
    residuals, seen, chosen = result.solution.residuals, result.inputs.tracks.visible, result.inputs.selection
    columns: dict[str, Column] = {
        "frame": np.arange(len(residuals)),
        **({} if chosen is None else {"source_frame": chosen.frames}),
        "seconds": result.times,
        "visible": (seen > 0).sum(axis=1),
        **_residuals(residuals, seen),
        "weight_mean": _mean(result.solution.weights, seen > 0),
    }
    truth = result.inputs.ground_truth
    if truth is not None and result.distances is not None:
        shapes = result.solution.shapes
        columns["e3d_sequence"] = align(shapes, truth.shapes, kind="sequence").relative
        columns["e3d_frame"] = align(shapes, truth.shapes, kind="frame").relative
        columns["e3d_frame_scaled"] = np.linalg.norm(result.distances, axis=1) / frobenius(centred(truth.shapes))
        columns["e3d_frame_similarity"] = align(shapes, truth.shapes, kind="frame_similarity").relative
        columns["distance_mean"] = result.distances.mean(axis=1)
        columns["distance_max"] = result.distances.max(axis=1)
    _write(file, columns)


def write_points_csv(result: Result, file: IO[bytes]) -> None:
    """Write one row per point, with its name if points have names; otherwise as `write_frames_csv`."""
    residuals, seen = result.solution.residuals.T, result.inputs.tracks.visible.T
    names, chosen = result.inputs.point_names, result.inputs.selection
    columns: dict[str, Column] = {
        "point": np.arange(len(residuals)),
        **({} if chosen is None else {"source_point": chosen.points}),
        **({} if names is None else {"name": names}),
        "visible": (seen > 0).sum(axis=1),
        **_residuals(residuals, seen),
        "weight_mean": _mean(result.solution.weights.T, seen > 0),
    }
    if result.distances is not None:
        columns["distance_mean"] = result.distances.mean(axis=0)
        columns["distance_max"] = result.distances.max(axis=0)
    _write(file, columns)


def _residuals(residuals: Floats, seen: Floats) -> dict[str, Column]:
    """Return the median of each row's visible residuals, and their RMS weighted with the confidence."""
    median = [
        float(np.median(row[some])) if some.any() else np.nan for row, some in zip(residuals, seen > 0, strict=True)
    ]
    return {"reprojection_median": median, "reprojection_rms": np.sqrt(_mean(np.square(residuals), seen))}


def _mean(values: Floats, weights: Floats | NDArray[np.bool_]) -> Floats:
    """Return the weighted mean of each row; NaN where all weights are 0."""
    total = np.einsum("nk,nk->n", values, weights)
    count = weights.sum(axis=1, dtype=np.float64)
    return np.asarray(np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0))


def _write(file: IO[bytes], columns: Mapping[str, Column]) -> None:
    """Write the columns, with numbers in the shortest form that restores them exactly."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    plain = (np.asarray(column).tolist() for column in columns.values())
    writer.writerows(["" if value != value else value for value in row] for row in zip(*plain, strict=True))
    text.detach()
