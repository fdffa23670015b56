"""Points to track: a grid over the textured part of the region, and its mesh."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.appearance import noise_variance
from pliant.tracking.flow import Bools, Floats, Grey

Ints = NDArray[np.int32]

GRID_STEPS = (4.0, 8.0)
"""Minimum and maximum default distance of neighbouring points, pixels of the tracker's frames. DIS has a match every 3 or 4 pixels
of its finest level, 6 or 8 of the frame, so a finer grid adds points but little motion."""

WANTED_POINTS = 4000
"""Target number of points for the default distance: the solver makes a mesh of this size in minutes on two cores."""

TEXTURE_WINDOW = 11
"""Side of the window in which texture is measured, pixels; the size of the patches that DIS compares."""

LEAST_TEXTURE = 0.25
"""Minimum mean squared slope in the direction of least texture, beyond that of noise, (grey levels / pixel)²: half a grey level per pixel,
the rounding of 8-bit film."""


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Points on a grid of the template."""

    points: Floats
    """Pixels of the tracker's template, shape `(P, 2)`."""

    grid: Ints
    """Point index of every cell, −1 where there is none, shape `(rows, columns)`."""


def default_step(region: Bools) -> float:
    """Choose the distance of neighbouring points from the region's area, in pixels of the mask."""
    return float(np.clip(np.sqrt(region.sum() / WANTED_POINTS), *GRID_STEPS))


def place(template: Grey, region: Bools, *, step: float, everywhere: bool = False) -> tuple[Seeds, float | None]:
    """Place points on a grid of `step` pixels inside a region, where there is texture or, with `everywhere`, in all cells.

    Single cells without texture between textured ones are kept, so that the mesh has no pinholes. Returns the points that belong to at
    least one face, and the share of the region's cells that have texture; None if no cell lies in the region.
    """
    height, width = template.shape
    x, y = (np.arange(min(step, side) / 2, side - 1, step) for side in (width, height))
    plane = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float32)
    column, row = np.round(plane).astype(int).transpose(2, 0, 1)
    inside = region[row, column]
    rough = textured(template)[row, column] & inside
    if everywhere:
        return number(plane, inside), 1.0
    closed = cv2.morphologyEx(rough.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    share = float(rough.sum() / inside.sum()) if inside.any() else None
    return number(plane, closed & inside), share


def textured(image: Grey) -> Bools:
    """Find the pixels whose surroundings have texture in every direction (second eigenvalue of the structure tensor)."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    # Sobel sums 8 slopes and the window averages; OpenCV scales grey levels of bytes by 255.
    least = (
        cv2.cornerMinEigenVal(smooth, TEXTURE_WINDOW, ksize=3)
        * (255.0 * TEXTURE_WINDOW * 4 / 8) ** 2
        / TEXTURE_WINDOW**2
    )
    # White noise of unit variance, blurred with a Gaussian of one pixel, has mean squared slope 1 / (8 π σ⁴).
    return np.asarray(least > LEAST_TEXTURE + 2 * noise_variance(image) / (8 * np.pi))


def number(plane: Floats, wanted: Bools) -> Seeds:
    """Assign numbers to the wanted cells that belong to a face, row by row; drop empty rows and columns."""
    square = wanted[:-1, :-1] & wanted[1:, :-1] & wanted[:-1, 1:] & wanted[1:, 1:]
    kept = np.zeros_like(wanted)
    for down in (0, 1):
        for right in (0, 1):
            kept[down : down + len(square), right : right + square.shape[1]] |= square
    grid = np.full(wanted.shape, -1, dtype=np.int32)
    grid[kept] = np.arange(int(kept.sum()))
    used = np.ix_(kept.any(axis=1), kept.any(axis=0))
    return Seeds(plane[kept], grid[used])


def quads(grid: Ints) -> Ints:
    """Return the faces `(T, 4)` of a grid, counter-clockwise in an image whose y points down."""
    faces = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.asarray(faces[(faces >= 0).all(axis=1)], dtype=np.int32)


def neighbours(grid: Ints, num_points: int) -> NDArray[np.int64]:
    """Return the left, right, upper and lower neighbour of every point, shape `(P, 4)`; −1 where there is none."""
    padded = np.pad(grid, 1, constant_values=-1)
    beside = np.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]], axis=-1)
    found = np.full((num_points, 4), -1, dtype=np.int64)
    found[grid[grid >= 0]] = beside[grid >= 0]
    return found


def keep(grid: Ints, wanted: Bools) -> tuple[Ints, NDArray[np.int64]]:
    """Drop points from a grid; return the renumbered grid and the old indices of the points that stay."""
    old = grid[grid >= 0]
    cells = np.zeros(grid.shape, dtype=bool)
    cells[grid >= 0] = wanted[old]
    plane = np.zeros((*grid.shape, 2), dtype=np.float32)
    plane[grid >= 0, 0] = old
    seeds = number(plane, cells)
    return seeds.grid, seeds.points[:, 0].astype(np.int64)
