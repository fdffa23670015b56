"""Noise, gross outliers and hidden observations, added as in the experiments of the literature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.gallery.sequence import Sequence, refusal
from pliant.solver.records import Tracks


def corrupt(
    sequence: Sequence, *, noise: float = 0.0, outliers: float = 0.0, hidden: float = 0.0, seed: int = 0
) -> Sequence:
    """Corrupt the tracks of a sequence as `corrupt_tracks` does; the truth is unchanged and `outliers` marks the outliers.

    Parameters
    ----------
    sequence : Sequence
        Clean or already corrupted sequence.
    noise : float
        Standard deviation of the noise, relative to the largest coordinate.
    outliers : float
        Share of the observations moved to random positions.
    hidden : float
        Share of the observations to hide.
    seed : int
        Seed of noise, outliers and hidden observations.

    Raises
    ------
    InvalidInput
        Noise below 0, or a share outside [0, 1].
    """
    tracks, wrong = corrupt_tracks(sequence.tracks, noise=noise, outliers=outliers, hidden=hidden, seed=seed)
    return replace(sequence, tracks=tracks, outliers=(sequence.outliers | wrong) & (tracks.visible > 0))


def corrupt_tracks(
    tracks: Tracks, *, noise: float = 0.0, outliers: float = 0.0, hidden: float = 0.0, seed: int = 0
) -> tuple[Tracks, NDArray[np.bool_]]:
    """Add noise, outliers and hidden observations to tracks.

    Parameters
    ----------
    tracks : Tracks
        Clean or already corrupted tracks.
    noise : float
        r, for Gaussian noise of standard deviation `σ = r · max |W|` on every coordinate, W the tracks with every frame's
        centroid removed (Dai, Deng, He 2017, section 5, with r up to .05).
    outliers : float
        Share of the F·P observations moved to random positions, uniform over the bounding box of the centred sequence.
    hidden : float
        Share of the F·P observations to hide, chosen at random, in addition to those already hidden.
    seed : int
        Seed of noise, outliers and hidden observations.

    Returns
    -------
    tracks : Tracks
        Corrupted tracks.
    outliers : ndarray of bool, shape (F, P)
        Mask of their visible outliers.

    Raises
    ------
    InvalidInput
        Noise below 0, or a share outside [0, 1].
    """
    if not noise >= 0:
        raise refusal("noise", "a number from 0", noise)
    for name, share in (("outliers", outliers), ("hidden", hidden)):
        if not 0 <= share <= 1:
            raise refusal(name, "a share from 0 to 1", share)
    random = np.random.default_rng(seed)
    visible = tracks.visible.copy()
    seen = visible > 0
    counts = seen.sum(axis=1)[:, None]
    middles = (tracks.points * seen[..., None]).sum(axis=1) / np.maximum(counts, 1)
    centred = (tracks.points - middles[:, None]) * seen[..., None]
    largest = np.abs(centred).max()
    box = np.stack([centred.min(axis=(0, 1)), centred.max(axis=(0, 1))])
    points = centred + noise * largest * random.standard_normal(centred.shape)
    wrong = _pick(seen.shape, outliers, random)
    points[wrong] = random.uniform(box[0], box[1], (int(wrong.sum()), 2))
    visible[_pick(seen.shape, hidden, random)] = 0.0
    return Tracks.from_arrays(points + middles[:, None], visible), wrong & (visible > 0)


def _pick(shape: tuple[int, ...], share: float, random: np.random.Generator) -> NDArray[np.bool_]:
    """Return a mask with exactly round(share · F · P) entries set."""
    size = int(np.prod(shape))
    mask = np.zeros(size, dtype=bool)
    mask[random.choice(size, round(share * size), replace=False)] = True
    return mask.reshape(shape)
