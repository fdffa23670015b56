"""Compare tracks and shapes with the truth of a rendered film."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.solver.evaluation.alignment import align
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.tracking.rendering.rasterising import Floats
from pliant.tracking.rendering.rendered_film import RenderedFilm


@dataclass(frozen=True, slots=True)
class TrackAccuracy:
    """Accuracy of tracks against the truth."""

    median: float
    """Median distance from the truth over correctly visible observations, pixels."""

    p95: float
    """95th percentile of the same distances, pixels."""

    precision: float
    """Share of the observations marked visible that are visible."""

    recall: float
    """Share of the visible observations that are marked visible."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True motion of a film's tracked points; P counts only the points that lie on the object in the template."""

    on: NDArray[np.bool_]
    """Tracked points that lie on the object, shape `(N,)`."""

    tracks: Floats
    """Shape `(F, P, 2)`, pixels."""

    visible: NDArray[np.bool_]
    """Shape `(F, P)`."""

    shapes: Floats
    """Shape `(F, P, 3)`, camera axes."""

    @classmethod
    def of(cls, film: RenderedFilm, tracks: ArrayLike, template: int, frames: ArrayLike | None = None) -> Truth:
        """Follow the points of tracks `(F, N, 2)`, in the film's pixels, from their positions in row `template`.

        `frames (F,)` holds the film's frame number of each row; all frames by default.
        """
        found = np.asarray(tracks, dtype=np.float64)
        rows = np.arange(film.num_frames) if frames is None else np.asarray(frames, dtype=np.int64)
        true, seen, shapes = film.follow(found[template], int(rows[template]))
        on = np.asarray(np.isfinite(true).all(axis=(0, 2)))
        return cls(on, true[rows][:, on], seen[rows][:, on], shapes[rows][:, on])

    def track_accuracy(self, tracks: ArrayLike, visibility: ArrayLike) -> TrackAccuracy:
        """Compare tracks `(F, N, 2)` and visibility `(F, N)` of all tracked points with the truth."""
        marked = np.asarray(visibility, dtype=bool)[:, self.on]
        right = marked & self.visible
        error = np.linalg.norm(np.asarray(tracks)[:, self.on] - self.tracks, axis=2)[right]
        return TrackAccuracy(
            median=float(np.median(error)),
            p95=float(np.percentile(error, 95)),
            precision=float(right.sum() / max(marked.sum(), 1)),
            recall=float(right.sum() / max(self.visible.sum(), 1)),
        )

    def shape_error(self, shapes: ArrayLike, points: ArrayLike | None = None) -> float:
        """Return `e3d_frame_scaled`, because a film does not show absolute size.

        `points (K,)` are the indices among the N tracked points of those in `shapes (F, K, 3)`; all by default.
        """
        found = np.asarray(shapes, dtype=np.float64)
        chosen = np.arange(len(self.on)) if points is None else np.asarray(points, dtype=np.int64)
        place = np.cumsum(self.on) - 1
        known = self.on[chosen]
        ours, true = found[:, known], self.shapes[:, place[chosen[known]]]
        return e3d_frame(align(ours, true, kind="frame_scaled").scales[0] * ours, true)
