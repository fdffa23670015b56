"""Lengths along the surface instead of the distances between the ends of edges, which are shorter where the surface bends.

Splines through the anchors map the template to space. An edge is a line on the template, and its length the length of the spline's curve
there. Lengths and depths depend on each other, so they are refined in turn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.isometry.extension import flatten
from pliant.solver.isometry.inextensible import SurfaceGraph
from pliant.solver.isometry.refinement import Isometry, refine
from pliant.solver.isometry.splines import partial_splines, spline_basis
from pliant.solver.limits import CHUNK_OBSERVATIONS
from pliant.solver.pulse import ShouldStop, never, pulse
from pliant.solver.records import Floats

ROUNDS = 2
"""Number of refinements, each with the lengths along the surface of the one before. On rolled sheets, a second one reduces errors of exact
tracks by a tenth to a fifth; the error of recorded paper is .0182 with one and .0181 with two."""

PIECES = 4
"""Chords per edge; the error of its length along the surface falls with the square of this number. Measured in
`benchmarks.accuracy.sensitivity`: with 2 the error of a rolled sheet is larger by 14 %, with 8 smaller by 4 %."""


def refine_along_surface(graph: SurfaceGraph, found: Isometry, *, should_stop: ShouldStop = never) -> Isometry:
    """Return depths with nearly constant lengths along the surface, close to the given ones.

    These are returned unchanged if the graph is not connected.
    """
    for _ in range(ROUNDS):
        ratios = None if should_stop() else arc_chord_ratios(graph, found)
        if ratios is None:
            break
        found = refine(replace(graph, arc_ratios=ratios), found.depths, should_stop=should_stop)
    return found


def arc_chord_ratios(graph: SurfaceGraph, found: Isometry) -> Floats | None:
    """Return the lengths of the edges along the surface relative to the distances of their ends, shape `(F, E)`.

    They are 1 in frames without points. None if the graph is not connected.
    """
    template = flatten(graph.edges, found.lengths, graph.seen.shape[1])
    if template is None:
        return None
    share = np.linspace(0, 1, PIECES + 1)[:, None, None]
    on_edges = (1 - share) * template[graph.edges[:, 0]] + share * template[graph.edges[:, 1]]
    basis = spline_basis(on_edges.reshape(-1, 2), template)
    points = found.depths[..., None] * graph.rays
    ratios = np.ones((len(points), len(graph.edges)))
    together = max(1, CHUNK_OBSERVATIONS // len(basis))
    for first in range(0, len(points), together):
        pulse()
        some = slice(first, first + together)
        curves = basis @ partial_splines(template, points[some], graph.seen[some])
        curves = curves.reshape(len(curves), PIECES + 1, -1, 3)
        along = np.linalg.norm(np.diff(curves, axis=1), axis=3).sum(axis=1)
        across = np.linalg.norm(curves[:, -1] - curves[:, 0], axis=2)
        np.divide(along, across, out=ratios[some], where=across > 0)
    return ratios
