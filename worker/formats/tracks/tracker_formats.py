"""Track formats of known programs and data sets, one record each.

Sources: each project's documented output at the time of writing. CoTracker `pred_tracks (B, T, N, 2)` and `pred_visibility`; TAPIR,
BootsTAPIR and LocoTrack `tracks (B, N, T, 2)` with `occlusion` and `expected_dist` logits; TAPNext `(B, T, N, 2)` with
`visible_logits` (y before x from its model, x before y from its demonstrations); TAP-Vid `points (N, T, 2)` with `occluded`;
AllTracker `trajs_e` and `visconfs_e`, or whole pictures `(B, T, 2, H, W)`; PIPs++ `trajs_e`; DOT `(B, T, H, W, 3)` or `(B, T, N, 3)`
with visibility as the third number; TAPVid-3D `tracks_xyz` in metres before the camera; MATLAB data sets of non-rigid structure from
motion `W`, `S`, `Rs`. Pliant's own tracker is recognised by `frame_indices`. DeepLabCut, SLEAP and MediaPipe: the array
names given by `reading.pose_tables`, `reading.pose_hdf5` and `reading.pose_json`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pliant.worker.formats.errors import AmbiguousInput
from pliant.worker.formats.point_names import ARRAY as NAMES
from pliant.worker.formats.records import Arrays

Order = Literal["frames_points", "points_frames"]
Third = Literal["visibility", "depth"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """Array names and layout of one track format."""

    name: str
    tracks: tuple[str, ...]
    """Names of the track array."""

    needs: tuple[str, ...] = ()
    """At least one of these arrays must be present; empty: no further array is required."""

    order: Order | None = "frames_points"
    """Documented axis order; None: detected from the data."""

    third: Third | None = None
    """Meaning of a third number per point; None: there are two numbers. `depth`: X, Y, Z in metres in front of the camera."""

    note: str = ""
    """Note for users of this format."""


OWN = "Pliant"
"""The output of `pliant track`; `film_tracks` reads its other arrays."""

DIALECTS = (
    Dialect(name=OWN, tracks=("tracks",), needs=("frame_indices",)),
    Dialect(name="CoTracker", tracks=("pred_tracks",)),
    Dialect(
        name="AllTracker", tracks=("trajs_e", "traj_maps_e"), needs=("visconfs_e", "visconf_maps_e"),
    ),
    Dialect(name="PIPs++", tracks=("trajs_e",)),
    Dialect(name="TAPVid-3D", tracks=("tracks_xyz", "tracks_XYZ"), third="depth"),
    Dialect(
        name="TAPNext", tracks=("tracks", "pred_tracks"), needs=("visible_logits",),
        note="TAPNext's model itself returns y before x. The coordinates are taken as x, y; if they are the model's own, "
        "set coordinate_order to yx.",
    ),
    Dialect(
        name="TAPIR, BootsTAPIR or LocoTrack", tracks=("tracks",), order="points_frames",
        needs=("occlusion", "occlusions", "occluded", "visibles", "expected_dist"),
    ),
    Dialect(name="TAP-Vid", tracks=("points", "target_points"), needs=("occluded",), order="points_frames"),
    Dialect(name="DOT", tracks=("tracks",), third="visibility"),
    Dialect(name="DeepLabCut", tracks=("deeplabcut",)),
    Dialect(
        name="SLEAP", tracks=("sleap",), note="The nodes of all instances count as points of one object.",
    ),
    Dialect(name="MediaPipe", tracks=("mediapipe",)),
    Dialect(name="one row a frame", tracks=("one_row_a_frame",)),
    Dialect(name="canonical", tracks=("tracks", "points")),
    Dialect(name="matrix", tracks=("W", "w", "W_obs", "data", "measurements")),
    Dialect(name="unnamed", tracks=("array", "arr_0")),
)  # fmt: skip
PLAIN = ("canonical", "matrix", "unnamed")
"""Names of the generic dialects."""

HIDING = ("occlusion", "occlusions", "occluded", "MD")
"""Names of arrays that mark hidden instead of visible points."""

VISIBILITY = (
    "visibility", "visible", "visibles", "pred_visibility", "vis", "mask", "vis_e", "visconfs_e", "visconf_maps_e", "visible_logits",
    *HIDING, "expected_dist", "likelihood",
)  # fmt: skip
CERTAINTY = ("confidence", "conf")
"""Names of arrays that multiply the visibility of the same file, if there is one."""

INTRINSICS = ("intrinsics", "fx_fy_cx_cy")
TRUE_SHAPES = ("shapes", "S", "S_gt", "Shat_gt", "S_GT", "P3_gt", "GT", "gt")
TRUE_ROTATIONS = ("rotations", "Rs", "R_gt", "Rs_gt", "R", "RO")

TRACKS = frozenset(name for dialect in DIALECTS for name in dialect.tracks)
KNOWN = TRACKS | {"frame_indices", NAMES, *VISIBILITY, *CERTAINTY, *INTRINSICS, *TRUE_SHAPES, *TRUE_ROTATIONS}
"""All array names that the track reader uses; other members of an npz are never inflated."""


def short_names(arrays: Arrays) -> Arrays:
    """Drop the names of enclosing structs: `data.W` becomes `W`.

    Raises
    ------
    AmbiguousInput
        Two structs contain track arrays of the same name.
    """
    shortened: Arrays = {}
    whole: dict[str, str] = {}
    for name, array in arrays.items():
        short = name.rsplit(".", 1)[-1]
        if short not in KNOWN:
            short = name
        if short in TRACKS and short in shortened and "." in name and "." in whole[short]:
            raise _two_of_one_name(whole[short], name)
        if short not in shortened or "." not in name:
            shortened[short], whole[short] = array, name
    return shortened


def recognise(arrays: Arrays) -> tuple[Dialect, str] | None:
    """Find the first dialect whose names and last axis fit, and the name of the track array."""
    for dialect in DIALECTS:
        for name in dialect.tracks:
            if name not in arrays or (dialect.needs and not any(need in arrays for need in dialect.needs)):
                continue
            shape = arrays[name].shape
            if dialect.third is not None and (len(shape) < 3 or shape[-1] != 3):
                continue
            return dialect, name
    return None


def _two_of_one_name(one: str, other: str) -> AmbiguousInput:
    choices: list[dict[str, Any]] = [{"layout": name, "options": {}} for name in (one, other)]
    return AmbiguousInput(
        field="tracks", expected="one track array", got=f"{one} and {other}",
        hint="Save the intended one in a separate file.", choices=choices,
    )  # fmt: skip
