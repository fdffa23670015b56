"""Input of the camera refinement: an estimate, and the tracks of the frames used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import of_frames
from pliant.solver.tracks.normalization import Normalized


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """An estimate, and the completed tracks of the frames used, divided by the starting scales."""

    estimate: CameraEstimate

    normalized: Normalized
    """The uncompleted tracks of all frames."""

    used: NDArray[np.intp]
    """Indices of the frames used, shape `(F',)`, increasing."""

    start_scales: Floats
    """Starting scales of all frames, shape `(F,)`."""

    gram: Floats
    """W Wᵀ / P, shape `(2F', 2F')`."""

    sample: Floats
    """Sampled points, shape `(F', S, 2)`."""

    @classmethod
    def of(
        cls, estimate: CameraEstimate, normalized: Normalized, used: NDArray[np.intp], start_scales: Floats
    ) -> Evidence:
        """Return the tracks of an estimate at the frames used, divided by the starting scales, shape `(F,)`."""
        wide = np.repeat(start_scales, 2)
        gram = of_frames(estimate.gram / np.outer(wide, wide), used)
        return cls(
            estimate, normalized, used, start_scales, gram, (estimate.sample / start_scales[:, None, None])[used]
        )

    def corrected(self, estimate: CameraEstimate) -> Evidence:
        """Return the evidence of an estimate with newly corrected tracks, at the same frames."""
        return Evidence.of(estimate, self.normalized, self.used, self.start_scales)

    @property
    def is_perspective(self) -> bool:
        """Whether the tracks show perspective, which makes the sign of depth observable."""
        return self.estimate.perspective is not None and self.estimate.perspective.is_perspective

    @property
    def rotations(self) -> Floats:
        """Rotations of the frames used, shape `(F', 3, 3)`."""
        return self.estimate.rotations[self.used]

    @property
    def projections(self) -> Floats:
        """First two rows of `rotations`, shape `(F', 2, 3)`."""
        return self.estimate.rotations[self.used, :2]
