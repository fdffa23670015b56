"""Who writes tracks how: one row for each program or data set whose files are known.

Sources: each project's documented output at the time of writing — CoTracker `pred_tracks (B, T, N, 2)`; TAPIR, BootsTAPIR and
LocoTrack `tracks (B, N, T, 2)` with logits; TAPNext `(B, T, N, 2)`; AllTracker and PIPs++ `trajs_e`; DOT with a third coordinate that
is visibility; TAPVid-3D `tracks_XYZ`; MATLAB data sets of non-rigid structure from motion `W`, `S`, `Rs`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pliant.worker.formats.records import Arrays

Order = Literal["frames_points", "points_frames"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """One way to name and lay out tracks."""

    name: str
    tracks: tuple[str, ...]
    """Names that the track array goes by."""

    needs: tuple[str, ...] = ()
    """At least one of these must be there too; none: nothing more is needed."""

    order: Order | None = "frames_points"
    """Axis order by documentation; None: from the data."""

    last: int = 2
    """Length of the last axis: 2 = x, y; 3 = x, y, visibility or X, Y, Z."""

    spatial: bool = False
    """The track array holds 3-D points in the camera's frame, projected with `intrinsics`."""

    unit_square: bool = False
    """Coordinates are divided by (width − 1, height − 1)."""


DIALECTS = (
    Dialect(name="CoTracker", tracks=("pred_tracks",)),
    Dialect(name="AllTracker", tracks=("trajs_e",), needs=("visconfs_e",)),
    Dialect(name="PIPs++", tracks=("trajs_e",)),
    Dialect(name="TAPVid-3D", tracks=("tracks_XYZ", "tracks_xyz"), last=3, spatial=True),
    Dialect(name="TAPNext", tracks=("tracks",), needs=("visible_logits",)),
    Dialect(
        name="TAPIR, BootsTAPIR or LocoTrack", tracks=("tracks",), order="points_frames",
        needs=("occlusion", "occlusions", "occluded", "visibles", "expected_dist"),
    ),
    Dialect(name="DOT", tracks=("tracks",), last=3, unit_square=True),
    Dialect(name="canonical", tracks=("tracks", "points")),
    Dialect(name="matrix", tracks=("W", "w", "W_obs", "data", "measurements")),
    Dialect(name="unnamed", tracks=("array", "arr_0")),
)  # fmt: skip

VISIBILITY = (
    "visibility", "visible", "visibles", "pred_visibility", "vis", "mask", "vis_e", "visconfs_e", "visible_logits",
    "occlusion", "occlusions", "occluded", "expected_dist",
)  # fmt: skip
INTRINSICS = ("intrinsics", "fx_fy_cx_cy")
TRUE_SHAPES = ("shapes", "S", "S_gt", "Shat_gt", "S_GT", "P3_gt", "GT", "gt")
TRUE_ROTATIONS = ("rotations", "Rs", "R_gt", "Rs_gt", "R", "RO")

KNOWN = frozenset(
    [name for dialect in DIALECTS for name in dialect.tracks]
    + [*VISIBILITY, *INTRINSICS, *TRUE_SHAPES, *TRUE_ROTATIONS]
)
"""Every name that a reader of tracks looks at; other members of an npz are never inflated."""


def short_names(arrays: Arrays) -> Arrays:
    """Drop the names of enclosing structs, where what is left is unique: `data.W` becomes `W`."""
    shortened: Arrays = {}
    for name, array in arrays.items():
        short = name.rsplit(".", 1)[-1]
        shortened.setdefault(short if short in KNOWN else name, array)
    return shortened


def recognise(arrays: Arrays) -> tuple[Dialect, str] | None:
    """Find the first dialect whose names and last axis fit, and the name of the track array."""
    for dialect in DIALECTS:
        for name in dialect.tracks:
            if name not in arrays or (dialect.needs and not any(need in arrays for need in dialect.needs)):
                continue
            shape = arrays[name].shape
            if dialect.last == 3 and (len(shape) < 3 or shape[-1] != 3):
                continue
            return dialect, name
    return None
