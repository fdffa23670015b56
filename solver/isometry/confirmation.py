"""Checks of an isometric surface: two halves of the frames must lead to the same edge lengths, and it must bend.

A surface stretched along the viewing rays keeps its edge lengths for any images, because depth dominates them. The isometric inconsistency
I then has a false minimum, which can be deep and even single out a focal length. But these depths are arbitrary, so other frames lead to
other lengths. The edge lengths of a real sheet belong to one object, so disjoint sets of frames agree on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.isometry.extension import complete_anchors, flatten
from pliant.solver.isometry.focal_sweep import FocalSearch, Tried
from pliant.solver.isometry.homographies import off_homography
from pliant.solver.isometry.inextensible import maximum_depth
from pliant.solver.isometry.restarts import refine_with_restarts
from pliant.solver.model.so3 import rotations_of
from pliant.solver.records import Floats

DISAGREEMENT = 0.02
"""Maximum relative difference of edge lengths between half of the frames and all. Measured: paper .001, a comic page .002, paper with 1 px
of noise, 10 % outliers and 30 % hidden .003, rolled cylinder .002, made-up paper seen from up to 360° .002 to .007; a head that turns by
90° .03, an orthographic flag 1.6 and 5.9, a face 8.2 and 8.9."""

DECISIVE = 8.0
"""Minimum relative increase of I at the neighbouring focal lengths, divided by the disagreement of the halves, for a minimum that is not
clear by itself. Measured: a T-shirt on a line 500, a hanging leaf 12 and 13, made-up paper 40 to 1,400 where it is recovered well, 1 and 7
where not; an arm of three boxes 1.5 and 4.4, a sheet that tears, without perspective, 1.6. One that tears near the camera has 41, but is
recovered alike as a free surface (`reconstruction.surface`)."""


def disagreement(search: FocalSearch, chosen: Tried) -> float:
    """Return the relative difference of edge lengths between halves of the frames, each solved independently, and all frames.

    The larger one of the two halves; infinite if a half has fewer than two frames or no solution.
    """
    order = np.argsort(search.frames)
    found: list[float] = []
    for half in (order[::2], order[1::2]):
        graph = chosen.graph.of(half)
        depths = maximum_depth(graph, should_stop=search.should_stop) if len(half) >= 2 else None
        if depths is None:
            return np.inf
        found.append(
            unlike(refine_with_restarts(graph, depths, should_stop=search.should_stop).lengths, chosen.found.lengths)
        )
    return max(found)


def unlike(lengths: Floats, others: Floats) -> float:
    """Return Σ|s l_e − m_e| / Σ m_e over the edges with both lengths, s the median of m_e/l_e; infinite if there are none."""
    both = (lengths > 0) & (others > 0)
    if not both.any():
        return np.inf
    scaled = lengths[both] * float(np.median(others[both] / lengths[both]))
    return float(np.abs(scaled - others[both]).sum() / others[both].sum())


def deformation(points: Floats) -> float:
    """Return the RMS distance of shapes `(F, P, 3)` from the best-fitting rigid shape, relative to their RMS size."""
    centred = points - points.mean(axis=1, keepdims=True)
    aligned = centred @ rotations_of(centred)
    return float(np.sqrt(np.square(aligned - aligned.mean(axis=0)).sum() / np.square(centred).sum()))


@dataclass(frozen=True, slots=True)
class Bending:
    """How far the anchors bend, and their images differ from those of a plane, both relative to the size.

    Images of a sheet differ from images of a plane because the sheet bends; images of a solid differ because of its constant depth. A rigid
    solid also keeps all lengths, but it is better solved as a free surface: the error of a rigid face is .0002, and .05 as a sheet. A wrong
    focal length hardly matters: 26 made-up sheets, which bend .2 to 1 times as much as those of `benchmarks.accuracy.kinds`, with focal
    lengths .26 to 2.6 times the true one, deform by 1.5 to 10 times as much as their pictures differ from those of a plane.
    """

    deformation: float
    off: float

    @property
    def rigid(self) -> bool:
        """Whether the anchors are those of a rigid solid."""
        return self.deformation < self.off

    @property
    def words(self) -> str:
        """Why a rigid solid is rejected."""
        return (
            f"Rejected as an isometric sheet: it deforms by {self.deformation:.1%} of its size, while the pictures differ from those of a "
            f"plane by {self.off:.1%}, as those of a rigid solid do."
        )


def bending_of(search: FocalSearch, tried: Tried) -> Bending | None:
    """Return how far the anchors bend; None if they are not connected, or fewer than two frames show enough of them."""
    seen = tried.graph.seen
    template = flatten(search.edges, tried.found.lengths, seen.shape[1])
    if template is None:
        return None
    points, enough = complete_anchors(tried.found.depths[..., None] * tried.graph.rays, seen, template)
    if enough.sum() < 2:
        return None
    return Bending(deformation(points[enough]), off_homography(search.anchors.points[search.frames], seen))
