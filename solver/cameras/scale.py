"""The scale of every frame: a camera that zooms, or moves in depth.

Shrinking and growing is a deformation like any other, so that scales which explain more prove nothing by themselves. Two things do:
where one rigid shape explains all but nothing of the tracks, its scales are measured; and where the likelihood of the tracks, which
pays for every mode of deformation, is clearly higher with scales (`pliant.solver.cameras.joint_refinement`).
"""

from __future__ import annotations

import numpy as np
from pliant.solver.cameras.factorization import upgrade
from pliant.solver.records import Floats
from pliant.solver.settings import Settings

SCALE_SHARE = 0.85
"""Scales are adopted where they explain at least this share of what one rigid shape under orthography leaves, an affine camera's
share apart. Measured: .98 on a rigid real scene; but .76 on real bending paper and .78 on faces whose camera has no scale, which
this cannot tell apart: between them, no scale is the smaller mistake."""

RIGID_ENOUGH = 0.01
"""And where the rest, relative to the tracks' variance, is below this: only then can one shape measure them."""

WIDEST = 0.3
"""And where the standard deviation of their logarithm is below this: no camera zooms more by accident."""


def rigid_evidence(gram: Floats, settings: Settings) -> tuple[Floats, str]:
    """Return the scales where the tracks show them beyond doubt, else 1; deformation must not pass for a zooming camera."""
    frames = len(gram) // 2
    none = np.ones(frames)
    if settings.camera == "orthographic":
        return none, "Plain orthography as set."
    rotations = upgrade(gram, 1).rotations
    scales = rigid_scales(gram, rotations)
    total = float(np.trace(gram))
    affine = float(np.linalg.eigvalsh(gram)[:-3].sum()) / total
    without, with_them = _unexplained(gram, rotations, none) / total, _unexplained(gram, rotations, scales) / total
    share = (without - with_them) / max(without - affine, 1e-12)
    if share > SCALE_SHARE and with_them < RIGID_ENOUGH and np.log(scales).std() < WIDEST:
        return (
            scales,
            f"Scales from {scales.min():.3f} to {scales.max():.3f} explain {share:.0%} of what orthography leaves.",
        )
    return (
        none,
        f"Every scale is 1: scales explain {max(share, 0):.0%} of what orthography leaves, too little to tell from deformation.",
    )


def _unexplained(gram: Floats, rotations: Floats, scales: Floats) -> float:
    basis = np.linalg.qr((rotations[:, :2] * scales[:, None, None]).reshape(len(gram), 3))[0]
    return float(np.trace(gram) - np.trace(basis.T @ gram @ basis))


def rigid_scales(gram: Floats, rotations: Floats, *, rounds: int = 30) -> Floats:
    """Return the scales with which one rigid shape explains the tracks best, given the rotations; mean logarithm 0."""
    frames = len(rotations)
    scales = np.ones(frames)
    for _ in range(rounds):
        rows = (rotations[:, :2] * scales[:, None, None]).reshape(2 * frames, 3)
        pseudo = np.linalg.pinv(rows)
        shape_gram, cross = pseudo @ gram @ pseudo.T, (gram @ pseudo.T).reshape(frames, 2, 3)
        pair = rotations[:, :2]
        hit = np.einsum("fij,fij->f", pair, cross)
        size = np.einsum("fij,jk,fik->f", pair, shape_gram, pair)
        scales = np.maximum(hit, 1e-3 * size) / np.maximum(size, np.finfo(float).tiny)
        typical = np.median(scales)  # a frame that shows nothing has no scale
        scales = np.clip(scales, 1e-2 * typical + 1e-12, 1e2 * typical + 1e-12)
        scales = np.asarray(scales / np.exp(np.log(scales).mean()))
    return scales
