"""Current speed of this machine, relative to the core on which the stage times were measured."""

from __future__ import annotations

import time

import numpy as np

SIZE, PIECES = 60, 5
"""Order of the matrix, as in the camera stage for 30 frames, and number of inversions per measurement."""

PIECE_SECONDS = 1e-4
"""CPU seconds of one inversion on a machine where solving a film takes as long as planned. Three solves of 30 and 40 frames with a
known image size, on an idle machine at half the speed of the plan's core, gave 7.2e-5 to 1.02e-4. The upper end is used because
tracker threads run during the measurement; chosen on the film of `benchmarks.installation.progress`."""


class MachinePace:
    """Mean ratio of measured to planned time: 1 if stages take as long as planned, 2 if they take twice as long.

    It scales plans of work that has not begun; during a solve, the pace of `pliant.solver.monitor` is more accurate.
    """

    def __init__(self) -> None:
        self._matrix = np.eye(SIZE) + 1 / (1 + np.add.outer(np.arange(SIZE), np.arange(SIZE)))
        self._spent, self._pieces = 0.0, 0

    def measure(self) -> float:
        """Measure for about half a millisecond; return the mean ratio of all measurements so far."""
        self._piece()  # warms up the caches
        began = time.thread_time()
        for _ in range(PIECES):
            self._piece()
        self._spent += time.thread_time() - began
        self._pieces += PIECES
        return self._spent / (self._pieces * PIECE_SECONDS)

    def _piece(self) -> None:
        factor = np.linalg.inv(np.linalg.cholesky(self._matrix))
        (factor.T @ factor @ self._matrix).sum()
