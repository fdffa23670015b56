"""How fast this machine is at the moment, against the core on which the times of the stages were measured."""

from __future__ import annotations

import time

import numpy as np

SIZE, PIECES = 60, 5
"""Order of a matrix as in the stage of the cameras for 30 frames, and how often it is inverted for one measurement."""

PIECE_SECONDS = 1e-4
"""Processor seconds of a piece where the solve of a film takes as long as planned. Three solves of 30 and 40 frames with a known
image size, on an idle machine at half the speed of the plan's core, gave 7.2e-5 to 1.02e-4. The upper end is taken, since the
threads of the tracker run beside the measurement; chosen on the film of `benchmarks.installation.progress`."""


class MachinePace:
    """Mean of the measurements so far: 1 where stages take as long as planned, 2 on a machine that needs twice the time.

    For plans of work that has not begun; during a solve, `Pace` of its stages learns more.
    """

    def __init__(self) -> None:
        self._matrix = np.eye(SIZE) + 1 / (1 + np.add.outer(np.arange(SIZE), np.arange(SIZE)))
        self._spent, self._pieces = 0.0, 0

    def measure(self) -> float:
        """Measure for half a millisecond; return the mean of all measurements."""
        self._piece()  # brings code and matrix into the caches
        began = time.thread_time()
        for _ in range(PIECES):
            self._piece()
        self._spent += time.thread_time() - began
        self._pieces += PIECES
        return self._spent / (self._pieces * PIECE_SECONDS)

    def _piece(self) -> None:
        factor = np.linalg.inv(np.linalg.cholesky(self._matrix))
        (factor.T @ factor @ self._matrix).sum()
