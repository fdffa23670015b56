"""A synthetic face that talks without repetition, at a pace that does not depend on the number of frames."""

from __future__ import annotations

import numpy as np
from pliant.solver.gallery.face import Expression, express
from pliant.solver.gallery.layout import Kind, disc
from pliant.solver.gallery.relief import neutral
from pliant.solver.gallery.sequence import Sequence, about, film
from pliant.solver.records import Floats

PERIODS = np.array([[83.0, 41.0], [23.0, 13.1], [59.0, 31.7], [47.0, 29.3], [37.0, 19.9]])
"""Periods, frames, of the two waves whose mean is the strength of an expression; their least common multiples are large."""

HEAD = ((18.0, 211.0), (8.0, 17.3))
"""Amplitude in degrees and period in frames of the slow and the fast component of the head's turn; nod and roll are scaled from these."""


def talk(num_frames: int = 300, num_points: int = 300, *, mesh: Kind = "grid", seed: int = 0) -> Sequence:
    """Return a sequence of a face that talks and shakes its head, at the same pace in films of any length.

    The face is the one of `face`. Expressions and head follow waves with periods in frames, so longer films contain more motion, not slower
    motion: the head shakes with a period of 17 frames.

    Parameters
    ----------
    num_frames : int
        F, number of frames.
    num_points : int
        P, number of points.
    mesh : str
        "grid" or "triangles".
    seed : int
        Seed of the phases.

    Raises
    ------
    InvalidInput
        F < 3, P < 4, or an unknown mesh.
    """
    flat, neighbours = disc(num_points, mesh)
    rest = neutral(flat * (1.0, -1.0))
    random = np.random.default_rng(seed)
    phases, turns = random.uniform(0, 2 * np.pi, PERIODS.shape), random.uniform(0, 2 * np.pi, (3, 2))

    def surface(time: float) -> Floats:
        waves = 0.5 + 0.5 * np.sin(2 * np.pi * time * (num_frames - 1) / PERIODS + phases).mean(axis=1)
        smile, jaw, brows, blink, pucker = waves
        return express(rest, Expression(smile, jaw, brows, blink**4, max(0.0, pucker - smile))) * (1.0, -1.0, -1.0)

    return film("talk", surface, neighbours, _head(num_frames, turns), scale_change=0.0, self_occlusion=False)


def _head(num_frames: int, phases: Floats) -> Floats:
    """Return the cameras, shape `(F, 3, 3)`; nod and roll have 0.7 and 0.3 times the amplitudes of the turn."""
    frames = np.arange(num_frames)[:, None]
    amplitudes, periods = np.radians([each[0] for each in HEAD]), np.array([each[1] for each in HEAD])
    turn, nod, roll = (
        share * (amplitudes * np.sin(2 * np.pi * frames / (stretch * periods) + phase)).sum(axis=1)
        for share, stretch, phase in zip((1.0, 0.7, 0.3), (1.0, 1.3, 1.7), phases, strict=True)
    )
    return np.asarray(about(2, roll) @ about(0, nod) @ about(1, turn))
