"""Pictures of a reconstruction, with matplotlib where it is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pliant.client.errors import PliantError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_POINTS = 5000
"""Points drawn in one picture at most; more only make it slower."""


def draw(shapes: NDArray[np.float64], frames: int, *, title: str) -> Figure:
    """Draw evenly spread frames side by side, all to one scale, depth as colour.

    Parameters
    ----------
    shapes : ndarray, shape (F, P, 3)
        World axes, y down as in images; drawn with y up.
    frames : int
        How many pictures; at most F.

    Raises
    ------
    PliantError
        matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as fault:
        raise PliantError("Plots need matplotlib: pip install matplotlib") from fault
    shown = np.unique(np.linspace(0, len(shapes) - 1, max(1, frames)).round().astype(int))
    points = shapes[:, :: max(1, shapes.shape[1] // MOST_POINTS)]
    reach = np.abs(points).max()
    figure = Figure(figsize=(3.2 * len(shown), 3.4), layout="constrained")
    figure.suptitle(title)
    for place, frame in enumerate(shown, start=1):
        axes = figure.add_subplot(1, len(shown), place, projection="3d")
        x, y, z = points[frame].T
        axes.scatter(x, z, -y, c=z, s=2, cmap="viridis", vmin=-reach, vmax=reach)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach), title=f"frame {frame}")
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=10, azim=-75)
    return figure
