"""A job that is long on any machine, so that it cannot finish before a fault hits it.

It is long by construction, not by size. The scale below which the loss is quadratic is so small that weights change by orders of magnitude
between reweightings, so the energy keeps falling until the last of them; the low-rank prior keeps each inner solve at its maximum number of
iterations; and the tolerance ends the solve only if nothing falls at all. Cameras are given, so that reweighting starts at once.
"""

from __future__ import annotations

from pliant.solver.gallery import Sequence, face

LONG: dict[str, object] = {
    "max_reweightings": 1000,
    "tolerance": 1e-300,
    "prior": "smooth+low_rank",
    "robust_scale": 1e-9,
    "refine_rotations": False,
}
"""Options of a long job; submit them with the tracks and rotations of `long_sequence` and no mesh."""


def long_sequence() -> Sequence:
    """Return the sequence of a long job, small enough that its first reweighting ends soon even on a busy machine."""
    return face(60, 1500)
