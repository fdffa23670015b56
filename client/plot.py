"""Plots of a reconstruction; they need matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pliant.client.errors import BadArgument, PliantError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

MOST_POINTS = 5000
MOST_TRIANGLES = 30_000
"""Maximum number of points and triangles in one plot: points are subsampled, larger meshes are drawn as points."""

CLAY = np.array([0.85, 0.79, 0.71])
LIGHT = np.array([-0.5, -0.6, 0.62])
"""Direction of the light in the plot's axes: right, away from the viewer, up. Both sides of a surface are lit."""


def draw(
    shapes: NDArray[np.float64],
    faces: NDArray[np.int32],
    frames: int | Sequence[int],
    *,
    title: str,
    y_axis: str = "down",
) -> Figure:
    """Draw frames side by side at one scale, a number of evenly spaced ones or those listed: the lit surface, or points coloured by depth.

    Shapes `(F, P, 3)` have y down as in images, or up; they are drawn upright. Without faces, or with too many, only points are drawn.

    Raises
    ------
    PliantError
        matplotlib is not installed.
    BadArgument
        `frames` is neither a number of frames nor indices of frames.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as fault:
        raise PliantError("Plots need matplotlib: pip install matplotlib") from fault
    shown = _chosen(frames, len(shapes))
    triangles = split(faces)
    reach = 0.8 * np.abs(shapes).max()
    figure = Figure(figsize=(3.2 * len(shown), 3.4), layout="constrained")
    figure.suptitle(title)
    for place, frame in enumerate(shown, start=1):
        axes: Axes3D = figure.add_subplot(1, len(shown), place, projection="3d", proj_type="ortho")
        x, y, z = shapes[frame].T
        # matplotlib's third axis points up, its second one away from the viewer
        upright = np.stack([x, z, -y] if y_axis == "down" else [x, -z, y], axis=1)
        if 0 < len(triangles) <= MOST_TRIANGLES:
            _surface(axes, upright, triangles)
        else:
            _points(axes, upright, reach)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach), title=f"frame {frame}")
        axes.set_box_aspect((1, 1, 1), zoom=1.45)
        axes.view_init(elev=8, azim=-72)
        axes.set_axis_off()
    return figure


def _chosen(frames: int | Sequence[int], count: int) -> list[int]:
    """Return the indices of the frames to draw."""
    given = np.asarray(frames)
    if given.dtype.kind in "iu" and given.ndim == 0 and given >= 1:
        given = np.unique(np.linspace(0, count - 1, int(given)).round().astype(int))
    if given.dtype.kind not in "iu" or given.ndim != 1 or given.size == 0 or given.min() < 0 or given.max() >= count:
        raise BadArgument(
            f"frames: expected a number of frames, at least 1, or a list of frames from 0 to {count - 1}, got {frames!r}."
        )
    return [int(frame) for frame in given]


def split(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return triangles (T, 3); each quad becomes two."""
    if faces.shape[1] == 3:
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])


def _surface(axes: Axes3D, points: NDArray[np.float64], triangles: NDArray[np.int32]) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)
    lit = np.abs(normals @ LIGHT) / (lengths * np.linalg.norm(LIGHT))
    colours = np.clip(CLAY * (0.35 + 0.7 * lit[:, None]), 0, 1)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=colours, edgecolors=colours, linewidths=0.2))


def _points(axes: Axes3D, points: NDArray[np.float64], reach: float) -> None:
    x, y, z = points[:: max(1, len(points) // MOST_POINTS)].T
    axes.scatter(x, y, z, c=y, s=2, cmap="viridis", vmin=-reach, vmax=reach)
