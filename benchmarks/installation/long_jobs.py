"""A job that is long on any machine: what is killed, cancelled or frozen in mid solve must not be done before that.

Long by construction, not by size. The scale below which the loss is quadratic is so small that the weights of neighbouring
reweightings differ by orders of magnitude, so the energy goes on falling through all the reweightings that may be; the low-rank
prior keeps each one's inner solve at its upper bound of iterations; and the tolerance ends it only if nothing falls at all. The
cameras are given, so that the reweighting begins at once.
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
"""Options of a long job. Give it the tracks and rotations of `long_sequence`, and no mesh."""


def long_sequence() -> Sequence:
    """Return what a long job is given: few enough points for the first reweighting to be done soon, on a busy machine, too."""
    return face(60, 1500)
