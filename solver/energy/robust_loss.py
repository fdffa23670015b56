"""Losses of the data term and the weights of their majorising quadratics.

Iteratively reweighted least squares is a majorise–minimise method: each loss is concave in r² and so lies below its
tangent ω(r₀) r² + constant with ω(r) = ρ'(r) / 2r. Any decrease of the weighted problem therefore decreases the loss.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.records import Array


def loss_value(residual: Array, confidence: Array, *, loss: str, scale: float) -> float:
    """Return Σ v ρ(r).

    Parameters
    ----------
    residual : array, shape (F, 2, P)
        r, in normalized units.
    confidence : array, shape (F, P)
        v in [0, 1].
    loss : {"l1", "l2", "huber"}
        `l1`: √(r² + ε²) − ε per coordinate, as in the paper. `l2`: r². `huber`: r² up to δ, then 2δr − δ², with r the
        length of the residual.
    scale : float
        ε or δ, normalized units.
    """
    if loss == "l2":
        return float(np.einsum("fcp,fcp,fp->", residual, residual, confidence, dtype=np.float64))
    if loss == "l1":
        # Rationalised to avoid the cancellation in √(r² + ε²) − ε for small residuals.
        squared = residual * residual
        value = squared / (np.sqrt(squared + scale * scale) + scale)
        return float(np.einsum("fcp,fp->", value, confidence, dtype=np.float64))
    length = np.sqrt((residual * residual).sum(axis=1))
    value = np.where(length <= scale, length * length, 2 * scale * length - scale * scale)
    return float(np.einsum("fp,fp->", value, confidence, dtype=np.float64))


def loss_weights(residual: Array, confidence: Array, *, loss: str, scale: float) -> Array:
    """Return v ω(r), the weights of r² in the majorising quadratic, shape `(F, 2, P)`."""
    spread = np.broadcast_to(confidence[:, None, :], residual.shape)
    if loss == "l2":
        return np.array(spread)
    if loss == "l1":
        weights: Array = spread / (2 * np.sqrt(residual * residual + scale * scale))
        return weights
    length = np.sqrt((residual * residual).sum(axis=1, keepdims=True))
    weights = spread * (scale / np.maximum(length, scale))
    return weights


def largest_weight(loss: str, scale: float) -> float:
    """Return ω(0), the weight of an observation with zero residual."""
    return 1 / (2 * scale) if loss == "l1" else 1.0
