"""The scale of every frame, for a camera that zooms or moves in depth.

A uniform change of size is also a deformation, so a smaller residual alone is no evidence for scales. They are
adopted here if one rigid shape explains almost all of the tracks; `refinement.free_scales` adopts them if the likelihood of
the tracks, which penalises each mode of deformation, is clearly higher with scales.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.cameras.factorization import leading_eigenpairs, upgrade
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats, mean_scale, projections_of
from pliant.solver.settings import Settings

SCALE_SHARE = 0.85
"""Minimum share of the residual of a rigid shape under orthography, beyond that of an affine camera, that scales must
explain to be adopted. Measured: .98 on a rigid real scene, .76 on real bending paper (true scales vary) and .78 on faces
(true scales are constant). The last two cannot be separated; the threshold exceeds both, so in doubt scales stay constant."""

RIGID_ENOUGH = 0.01
"""Maximum residual of the scaled rigid shape, relative to the variance of the tracks, for scales to be adopted."""

ALTERNATIONS = 30
"""Alternations of rigid shape and scales."""

WIDEST = 0.3
"""Maximum standard deviation of the logarithm of the scales for them to be adopted."""


def rigid_evidence(gram: Floats, settings: Settings) -> tuple[Floats, str]:
    """Return the scales, `(F,)`, if a rigid shape determines them, else ones; and a sentence with the reason."""
    frames = len(gram) // 2
    none = np.ones(frames)
    if settings.camera == "orthographic":
        return none, "Orthographic cameras, as set."
    rotations = upgrade(gram, 1).rotations
    scales = rigid_scales(gram, rotations)
    total = float(np.trace(gram))
    affine = 1 - float(leading_eigenpairs(gram, 3)[0].sum()) / total
    without, with_them = _unexplained(gram, rotations, none) / total, _unexplained(gram, rotations, scales) / total
    share = (without - with_them) / max(without - affine, 1e-12)
    if share > SCALE_SHARE and with_them < RIGID_ENOUGH and np.log(scales).std() < WIDEST:
        return (
            scales,
            f"Scales from {scales.min():.3f} to {scales.max():.3f} explain {share:.0%} of the residual of orthography.",
        )
    return (
        none,
        f"Every scale is 1: a scale per frame would explain {max(share, 0):.0%} of the residual of orthography, no more than deformation.",
    )


def _unexplained(gram: Floats, rotations: Floats, scales: Floats) -> float:
    basis = np.linalg.qr(projections_of(rotations, scales).reshape(len(gram), 3))[0]
    return float(np.trace(gram) - np.trace(basis.T @ gram @ basis))


def rigid_scales(gram: Floats, rotations: Floats) -> Floats:
    """Return the scales with which one rigid shape explains the tracks best, given the rotations; mean logarithm 0."""
    frames = len(rotations)
    scales = np.ones(frames)
    for _ in range(ALTERNATIONS):
        pulse()
        rows = projections_of(rotations, scales).reshape(2 * frames, 3)
        pseudo = np.linalg.pinv(rows)
        shape_gram, cross = pseudo @ gram @ pseudo.T, (gram @ pseudo.T).reshape(frames, 2, 3)
        pair = rotations[:, :2]
        hit = np.einsum("fij,fij->f", pair, cross)
        size = np.einsum("fij,jk,fik->f", pair, shape_gram, pair)
        scales = np.maximum(hit, 1e-3 * size) / np.maximum(size, np.finfo(float).tiny)
        typical = np.median(scales)  # a frame without visible points has no scale
        scales = np.clip(scales, 1e-2 * typical + 1e-12, 1e2 * typical + 1e-12)
        scales = np.asarray(scales / mean_scale(scales))
    return scales
