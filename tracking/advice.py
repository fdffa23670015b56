"""Warnings about a film or its tracks that may spoil a reconstruction, with advice on what to film instead."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver.storage import let_go
from pliant.tracking.decoding.film import Film
from pliant.tracking.survey import Survey

FEW_FRAMES = 10
"""Frames below which a film rarely holds enough motion for a shape."""

STILL_SHARE = 0.01
"""Share of the region's size below which motion counts as none: about the track noise on a region of 50 pixels."""

UNCERTAIN, MANY_UNCERTAIN = 1.5, 0.05
"""Standard deviation of a position, pixels of the tracker's frames, above which the picture fits the template poorly there, and the share
of such visible positions from which there is a warning. On six rendered films the share is .19, .25 and .08 where 5 to 14 % of the visible
positions are off by more than 3 pixels, and at most .014 where fewer than .5 % are."""

MANY_LEFT_OUT = 0.1
"""Share of the points left out from which there is a warning. Not tuned."""

UNEVEN = 1.5
"""Ratio of longest to median time between frames above which the rate counts as variable."""


def warnings_unread(*, whole: bool = False, region_frame: int = 0, frames: int = 0) -> list[str]:
    """Return the warnings that need no look at the pictures: `whole` if there is no region, `frames` to track, 0 if unknown."""
    notes = []
    if whole:
        notes.append(
            "No region was given, so everything in the picture is tracked, background included. Draw around the object."
        )
    if whole and region_frame != 0:
        notes.append("region_frame has no effect without a region.")
    if 0 < frames < FEW_FRAMES:
        notes.append(f"Only {frames} frames are tracked. Film two seconds or more, while the object turns.")
    return notes


def warnings_before(
    film: Film,
    found: Survey,
    start: int,
    stop: int,
    *,
    whole: bool,
    rough: float,
    region_frame: int = 0,
    lost_in_middle: int | None = None,
) -> list[str]:
    """Return warnings about the film in rows `start` to `stop`: region, shots, length, frame rate, and texture in a share `rough`.

    `lost_in_middle` is the template's row if `planning.plan.Plan.lost_in_middle`, else None.
    """
    notes = warnings_unread(whole=whole, region_frame=region_frame)
    if found.cuts:
        count, first = len(found.cuts), found.indices[found.cuts[0]]
        cuts = f"a cut (at frame {first})" if count == 1 else f"{count} cuts (the first at frame {first})"
        notes.append(
            f"The film has {cuts}. Only frames {found.indices[start]} to {found.indices[stop - 1]} are tracked. "
            "Film the object in one take."
        )
    if found.broken_tail:
        notes.append(
            f"The film states {film.stated_frames} frames but ends after {found.indices[-1] + 1}: it was trimmed, or its end is "
            "damaged or missing."
        )
    notes += warnings_unread(frames=stop - start)
    steps = np.diff(found.times[start:stop])
    if film.container in ("mp4", "matroska", "avi", "gif") and steps.max() > UNEVEN * np.median(steps):
        notes.append("The time between frames varies; frame_times holds the true times.")
    if lost_in_middle is not None:
        notes.append(
            "The region was mostly lost on the way to the middle of the film, so points are followed from frame "
            f"{found.indices[lost_in_middle]}. Far from this frame the tracks are less accurate. Draw the region on a frame in the middle."
        )
    if rough < 0.5:
        notes.append(
            f"Only {rough:.0%} of the region has texture; the mesh has holes elsewhere. Film in focus and in good light, or "
            "give the surface a pattern."
        )
    return notes


def warnings_of(
    tracks: NDArray[np.float32],
    visible: NDArray[np.bool_],
    variance: NDArray[np.float32],
    template: int,
    *,
    placed: int,
    least_seen: float,
) -> list[str]:
    """Return warnings about the tracks: little motion, many points hidden, left out or uncertain.

    Parameters
    ----------
    tracks : array, shape (F, P, 2)
        The points that were kept.
    visible : array, shape (F, P)
        Where they are visible.
    variance : array, shape (F, P)
        Variance of the positions, square pixels of the tracker's frames.
    template : int
        Index of the template.
    placed : int
        Number of points placed in the template.
    least_seen : float
        Share of the frames in which the points that were kept are visible.
    """
    notes = []
    size = float(np.hypot(*np.ptp(tracks[template], axis=0)))
    lowest, highest = tracks[template].copy(), tracks[template].copy()
    shown = unsure = 0
    for points, seen, doubt in zip(tracks, visible, variance, strict=True):  # one frame at a time, to save memory
        np.minimum(lowest, points, out=lowest, where=seen[:, None])
        np.maximum(highest, points, out=highest, where=seen[:, None])
        shown += int(np.count_nonzero(seen))
        unsure += int(np.count_nonzero(doubt[seen] > UNCERTAIN**2))
        let_go(tracks, visible, variance)
    if np.median(np.linalg.norm(highest - lowest, axis=1)) < STILL_SHARE * size:
        notes.append(
            "Nothing moves in this film, so it holds no information about depth. Turn the object by 30° or more to both sides, "
            "or walk around it."
        )
    if shown < 0.5 * visible.size:
        notes.append(
            f"The points are visible in only {shown / visible.size:.0%} of the frames. Turn the object less far, keep hands out of the "
            "picture, or move more slowly."
        )
    left_out = 1 - visible.shape[1] / placed
    if left_out >= MANY_LEFT_OUT:
        notes.append(
            f"{left_out:.0%} of the points were left out, because they are visible in less than {least_seen:.0%} of the frames: the mesh "
            "has no surface there. Use a template_frame in which these parts look as in most of the film, or film them for longer."
        )
    uncertain = unsure / max(shown, 1)
    if uncertain >= MANY_UNCERTAIN:
        notes.append(
            f"In {uncertain:.0%} of the visible positions, the picture fits the template poorly; these points may be off by several "
            "pixels, and the shapes follow them. Film closer, sharper or in better light, choose a surface without a repeating pattern, or "
            "select frames in which the surface changes less."
        )
    return notes
