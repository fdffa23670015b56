"""The modes of the Gaussian prior in the preconditioner, with one weight per frame.

Block elimination (`linear.block_tridiagonal`) inverts N, the block-tridiagonal part, with individual observation weights.
Woodbury's identity adds the modes: (N − V Vᵀ)⁻¹ = N⁻¹ + N⁻¹V (I − VᵀN⁻¹V)⁻¹ VᵀN⁻¹. With the mean weight of each frame,
the second term is one matrix Z Zᵀ for all points; `linear.deflation` corrects it for points with other weights. The cost
is linear in the number of frames and quadratic in the number of modes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.linear import block_tridiagonal
from pliant.solver.operators.gauss_markov import over_blocks
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.records import Array

LEAST = 1e-12
"""Floor of the eigenvalues of I − VᵀN⁻¹V; about the ratio of noise to the variance of an unobserved mode."""


@dataclass(frozen=True, slots=True, eq=False)
class MeanModes:
    """The factor Z, shape `(3F, k)`."""

    along: Array

    @classmethod
    def of(cls, operator: Operator, stiffness: float = 0.0) -> MeanModes:
        """Compute Z for an operator with a Gaussian prior; `stiffness` is the mean diagonal of the spatial term."""
        assert operator.quadratic is not None
        frames, sizes = len(operator.projections), [each.shape[1] for each in operator.quadratic.modes]
        cuts = np.cumsum([0, *sizes])
        columns = np.zeros((frames, 3, cuts[-1]))
        for axis, modes in enumerate(operator.quadratic.modes):
            columns[:, axis, cuts[axis] : cuts[axis + 1]] = modes
        mean = operator.weights.mean(axis=2, dtype=np.float64)
        alike = replace(
            operator,
            projections=operator.projections.astype(np.float64),
            weights=np.broadcast_to(mean[:, :, None], (frames, 2, cuts[-1])),
            laplacian=None,
        )
        pushed = block_tridiagonal.build(alike, np.full(cuts[-1], stiffness))(columns).reshape(3 * frames, -1)
        values, vectors = np.linalg.eigh(np.eye(cuts[-1]) - columns.reshape(3 * frames, -1).T @ pushed)
        return cls((pushed @ (vectors / np.sqrt(np.maximum(values, LEAST)))).astype(operator.weights.dtype))

    def add(self, r: Array, out: Array) -> None:
        """Add Z Zᵀ r to `out`, both of shape `(F, 3, P)`."""
        flat, into = r.reshape(len(self.along), -1), out.reshape(len(self.along), -1)

        def work(span: slice) -> None:
            into[:, span] += self.along @ (self.along.T @ flat[:, span])

        over_blocks(work, flat.shape[1], rows=len(self.along))
