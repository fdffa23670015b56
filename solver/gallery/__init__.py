"""Synthetic sequences with known truth, for demonstrations, tests and benchmarks.

All take any number of frames and points, and are deterministic for a given seed::

    face(F, P)      a face whose brows, lids, cheeks, lips and jaw move; open, smooth, with sharp local motion at the mouth
    flag(F, P)      cloth that waves without stretching; open, large bending, one full-size travelling wave
    talk(F, P)      the same face; its motion has the same pace in films of any length
    sphere(F, P)    a closed body that expands and bulges while the camera circles it; half of it is always hidden

Axes are those of an image: x right, y down, z away from the viewer; the unit is a pixel.
"""

from pliant.solver.gallery.corruption import corrupt, corrupt_tracks
from pliant.solver.gallery.face import face
from pliant.solver.gallery.flag import flag
from pliant.solver.gallery.sequence import Sequence
from pliant.solver.gallery.sphere import sphere
from pliant.solver.gallery.talk import talk

__all__ = ["Sequence", "corrupt", "corrupt_tracks", "face", "flag", "sphere", "talk"]
