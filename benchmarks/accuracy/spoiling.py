"""Synthetic tracker errors in pixels: white noise, slow drift, tracks that begin and end anywhere, outliers, hidden points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver import Tracks
from pliant.solver.gallery import corrupt_tracks
from scipy.spatial import cKDTree

LIFE_SHARE = 1 / 3
"""Mean life of a track, as a share of the film."""

JUMPING_SHARE = 0.05
"""Share of the tracks that jump to a neighbour once in their life."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spoiling:
    """Errors to add to tracks."""

    noise: float = 0.0
    """Standard deviation of white noise, px."""

    drift: float = 0.0
    """Standard deviation of each track's random-walk step, px per frame."""

    births: bool = False
    """Whether tracks begin and end anywhere, and some jump to a neighbour."""

    outliers: float = 0.0
    """Share of observations moved to a random place in the object's bounding box."""

    hidden: float = 0.0
    """Share of observations hidden at random."""


SPOILINGS = {
    "clean": Spoiling(),
    "noise": Spoiling(noise=1.0),
    "drift": Spoiling(drift=0.1),
    "births": Spoiling(births=True),
    "outliers": Spoiling(outliers=0.1),
    "hidden": Spoiling(hidden=0.3),
    "all": Spoiling(noise=1.0, drift=0.1, outliers=0.1, hidden=0.3),
}
"""By name; `all` combines 10 % outliers, 30 % hidden, noise of 1 px and drift."""


def spoiled(tracks: Tracks, spoiling: Spoiling, *, seed: int = 0) -> Tracks:
    """Return tracks `(F, P, 2)` in pixels with these errors."""
    random = np.random.default_rng(seed)
    points, visible = tracks.points.copy(), tracks.visible.copy()
    if spoiling.births:
        points = _jumped(points, random)
        visible = visible * _alive(tracks.num_frames, tracks.num_points, random)
    if spoiling.drift > 0:
        steps = spoiling.drift * random.standard_normal(points.shape)
        steps[0] = 0.0
        points = points + steps.cumsum(axis=0)
    points = points + spoiling.noise * random.standard_normal(points.shape)
    if spoiling.outliers == spoiling.hidden == 0:
        return Tracks.from_arrays(points, visible)
    found, _ = corrupt_tracks(
        Tracks.from_arrays(points, visible), outliers=spoiling.outliers, hidden=spoiling.hidden, seed=seed
    )
    return found


def _alive(frames: int, count: int, random: np.random.Generator) -> np.ndarray:
    """Return visibility `(F, P)`: each track is one run of frames of exponential length, clipped to the film."""
    life = np.maximum(random.exponential(LIFE_SHARE * frames, count), 2.0)
    birth = random.uniform(1 - life, frames - 1)
    frame = np.arange(frames)[:, None]
    return (frame >= birth) & (frame <= birth + life)


def _jumped(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return the points, with `JUMPING_SHARE` of them following their nearest neighbour from a random frame on."""
    frames, count = points.shape[:2]
    result = points.copy()
    for track in random.choice(count, round(JUMPING_SHARE * count), replace=False):
        at = int(random.integers(1, frames))
        _, near = cKDTree(points[at]).query(points[at, track], k=2)
        other = int(near[near != track][0])
        result[at:, track] = points[at:, other]
    return result
