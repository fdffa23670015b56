"""What the refinement of cameras works on: an estimate, and the tracks of the frames used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import of_frames


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """An estimate, and the completed tracks of the frames used, divided by the scales of the start."""

    estimate: CameraEstimate

    used: NDArray[np.intp]
    """Shape `(F',)`, increasing."""

    start_scales: Floats
    """Of all frames, shape `(F,)`."""

    gram: Floats
    """Shape `(2F', 2F')`."""

    sample: Floats
    """Shape `(F', S, 2)`."""

    @classmethod
    def of(cls, estimate: CameraEstimate, used: NDArray[np.intp], start_scales: Floats) -> Evidence:
        """Return the tracks of an estimate at the frames used, divided by the scales of the start, shape `(F,)`."""
        wide = np.repeat(start_scales, 2)
        gram = of_frames(estimate.gram / np.outer(wide, wide), used)
        return cls(estimate, used, start_scales, gram, (estimate.sample / start_scales[:, None, None])[used])

    def corrected(self, estimate: CameraEstimate) -> Evidence:
        """Return an estimate whose tracks are corrected for other depths, at the same frames."""
        return Evidence.of(estimate, self.used, self.start_scales)

    @property
    def bends(self) -> bool:
        """Whether perspective is found, which distinguishes the signs of depth."""
        return self.estimate.perspective is not None and self.estimate.perspective.bends

    @property
    def rotations(self) -> Floats:
        """Of the frames used, shape `(F', 3, 3)`."""
        return np.asarray(self.estimate.rotations)[self.used]

    @property
    def projections(self) -> Floats:
        """Their first two rows, shape `(F', 2, 3)`."""
        return np.asarray(self.estimate.rotations)[self.used, :2]
