"""Selection of frames, and exclusion of sparsely observed points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, Mesh
from pliant.solver.agreement import check_seen
from pliant.solver.records import MIN_FRAMES

LISTED_POINTS = 10
"""Maximum number of point indices listed in a note."""

LEFT_OUT_LISTED = 1000
"""Maximum number of excluded points that the interpretation lists by index."""


def chosen_frames(text: str | None, num_frames: int, *, timed: bool = False) -> tuple[NDArray[np.intp], list[str]]:
    """Resolve the option `frames`, start:stop:step as Python counts.

    Raises
    ------
    InvalidInput
        Code no_frames_left, when fewer than three remain.
    """
    everything = np.arange(num_frames)
    if text is None:
        return everything, []
    start, stop, step = (int(part) if part else None for part in [*text.split(":"), ""][:3])
    frames = everything[slice(start, stop, step)]
    if len(frames) < MIN_FRAMES:
        raise InvalidInput(
            "no_frames_left", field="options.frames", expected=f"at least {MIN_FRAMES} of the {num_frames} frames",
            got=f"{len(frames)} by {text}", hint="Widen the range, or omit frames to use all of them.",
        )  # fmt: skip
    note = f"Frames {text}: {len(frames)} of {num_frames}, from {frames[0]} to {frames[-1]}"
    if step is not None and step > 1 and not timed:
        note += f"; one in {step}, so at the same fps the animation runs {step} times as fast"
    return frames, [f"{note}."]


def selected(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None, index: Any
) -> tuple[NDArray[np.generic], NDArray[np.float64] | None]:
    """Return points `(F, P, 2)` and visibility `(F, P)` at an index of frames and points."""
    return points[index], None if visible is None else visible[index]


def hide_sparsely_observed(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None, mesh: Mesh | None, options: Options
) -> tuple[NDArray[np.float64], NDArray[np.intp], list[str]]:
    """Set the weight of points that are visible in fewer frames than `min_seen` to 0.

    Points are `(F, P, 2)`, NaN where hidden; the mesh determines whether such points have neighbours to follow. Returns
    confidence `(F, P)`, 0 in every frame for these points; their indices; and notes with number, indices, and position in the
    result.

    Raises
    ------
    InvalidInput
        Code nothing_visible, if no point remains; too_little_seen, if none would with any `min_seen`.
    """
    confidence = np.ones(points.shape[:2]) if visible is None else np.array(visible, dtype=np.float64)
    confidence[~np.isfinite(points).all(axis=2)] = 0.0
    dropped = np.flatnonzero((confidence > 0).sum(axis=0) < options.min_seen)
    if len(dropped) == 0:
        return confidence, dropped, []
    if len(dropped) == points.shape[1] and confidence.any() and len(points) >= MIN_FRAMES:
        check_seen(confidence)
        raise InvalidInput(
            "nothing_visible", field="options.min_seen", expected=f"points that are visible in {options.min_seen} or more frames",
            got=f"none of {len(dropped)}", hint="Set min_seen lower.",
        )  # fmt: skip
    confidence[:, dropped] = 0.0
    shown = ", ".join(str(index) for index in dropped[:LISTED_POINTS]) + (" …" if len(dropped) > LISTED_POINTS else "")
    those = "1 point is" if len(dropped) == 1 else f"{len(dropped)} points are"
    which = f"point{'' if len(dropped) == 1 else 's'} {shown}"
    notes = [
        f"{those} visible in fewer than {options.min_seen} frames and excluded from the solve ({which}). "
        "Points keep their indices in the result."
    ]
    near = np.zeros(0, dtype=np.intp) if mesh is None else np.intersect1d(dropped, mesh.faces)
    if len(near):
        notes.append(f"{len(near)} of them follow their neighbours on the mesh.")
    if len(near) < len(dropped):
        notes.append(
            f"{len(dropped) - len(near)} of them belong to no face: their position is undetermined and their coordinates are meaningless."
        )
    return confidence, dropped, notes
