"""Alignment of a reconstruction with the ground truth, as the error metrics of the literature require.

Each is an orthogonal Procrustes problem (Schönemann 1966): with both shapes centred, `Q = U Vᵀ` from the singular value
decomposition of the 3×3 matrix `Gᵀ S` minimises `‖S Qᵀ − G‖_F` over O(3); for a rotation the smallest singular
direction changes sign where `det(U Vᵀ) < 0` (Kabsch 1976, Umeyama 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pliant.solver.errors import InvalidInput
from pliant.solver.model.so3 import MIRROR, nearest
from pliant.solver.records import Floats
from pliant.solver.tracks.matrix import centred

Kind = Literal["sequence", "frame", "frame_scaled", "frame_similarity"]


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """An aligned reconstruction and its ground truth, both centred in every frame."""

    shapes: Floats
    """`scales_f · S_f · transforms_fᵀ`, shape `(F, P, 3)`, the truth's unit."""

    truth: Floats
    """Centred ground truth, shape `(F, P, 3)`, its own unit."""

    transforms: Floats
    """Applied orthogonal matrices, shape `(F, 3, 3)`; the same in every frame for `sequence`."""

    scales: Floats
    """Shape `(F,)`; 1 unless the alignment is `frame_scaled` or `frame_similarity`."""

    @property
    def distances(self) -> Floats:
        """Distance of every point from its true position, shape `(F, P)`, the truth's unit."""
        return np.asarray(np.linalg.norm(self.shapes - self.truth, axis=2))

    @property
    def relative(self) -> Floats:
        """`‖S_f − G_f‖_F / ‖G_f‖_F` of every frame, shape `(F,)`."""
        return frobenius(self.shapes - self.truth) / frobenius(self.truth)


def align(shapes: ArrayLike, truth: ArrayLike, *, kind: Kind = "frame") -> Aligned:
    """Centre both in every frame and align `shapes` with `truth` by the transformations of `kind`.

    Parameters
    ----------
    shapes : array_like, shape (F, P, 3)
        Reconstruction, any unit.
    truth : array_like, shape (F, P, 3)
        Ground truth, any unit (that of `shapes`, unless `kind` is `frame_similarity`).
    kind : {'sequence', 'frame', 'frame_scaled', 'frame_similarity'}
        `sequence`: one matrix of O(3) for the sequence, minimising `Σ_f ‖S_f Qᵀ − G_f‖²`.
        `frame`: a rotation per frame, and for the sequence a mirror or none, whichever fits better.
        `frame_scaled`: as `frame`, with one scale for the sequence, minimising `Σ_f ‖k S_f Q_fᵀ − G_f‖²`.
        `frame_similarity`: rotation, mirror and scale free in every frame.

    Raises
    ------
    InvalidInput
        The arrays differ in shape, are not `(F, P, 3)` or not finite, or a frame of the truth has no extent.
    """
    moved, fixed = _centred_pair(shapes, truth)
    if kind == "sequence":
        one = procrustes(np.einsum("fpi,fpj->ij", fixed, moved))
        transforms = np.broadcast_to(one, (len(moved), 3, 3)).copy()
        return Aligned(moved @ transforms.transpose(0, 2, 1), fixed, transforms, np.ones(len(moved)))
    if kind in ("frame", "frame_scaled"):
        plain, mirrored = (_rotate_frames(moved, fixed, mirror=mirror) for mirror in (np.eye(3), MIRROR))
        if kind == "frame_scaled":
            plain, mirrored = _scaled(plain), _scaled(mirrored)
        return plain if plain.relative.mean() <= mirrored.relative.mean() else mirrored
    products = fixed.transpose(0, 2, 1) @ moved
    transforms = procrustes(products)
    overlap = np.einsum("fij,fij->f", transforms, products)
    energy = frobenius(moved) ** 2
    scales = np.divide(overlap, energy, out=np.zeros_like(energy), where=energy > 0)
    turned = scales[:, None, None] * (moved @ transforms.transpose(0, 2, 1))
    return Aligned(turned, fixed, transforms, scales)


def procrustes(products: Floats) -> Floats:
    """Return the orthogonal Q that maximises `tr(Qᵀ M)` for every 3×3 matrix M, shape `(…, 3, 3)`; `so3.nearest` returns rotations only.

    Parameters
    ----------
    products : array, shape (…, 3, 3)
        `M = Gᵀ S` for shapes whose rows are points.
    """
    left, _, right = np.linalg.svd(products)
    return np.asarray(left @ right)


def frobenius(shapes: Floats) -> Floats:
    """Return the Frobenius norm of every frame, shape `(F,)`."""
    return np.asarray(np.sqrt(np.einsum("fpi,fpi->f", shapes, shapes)))


def _rotate_frames(moved: Floats, fixed: Floats, *, mirror: Floats) -> Aligned:
    products = fixed.transpose(0, 2, 1) @ moved @ mirror
    transforms = nearest(products) @ mirror
    return Aligned(moved @ transforms.transpose(0, 2, 1), fixed, transforms, np.ones(len(moved)))


def _scaled(aligned: Aligned) -> Aligned:
    """Return the alignment with the scale that minimises the squared error over the sequence."""
    energy = float(np.vdot(aligned.shapes, aligned.shapes))
    scale = float(np.vdot(aligned.shapes, aligned.truth)) / energy if energy > 0 else 0.0
    return Aligned(
        scale * aligned.shapes, aligned.truth, aligned.transforms, np.full(len(aligned.shapes), scale)
    )  # fmt: skip


def _centred_pair(shapes: ArrayLike, truth: ArrayLike) -> tuple[Floats, Floats]:
    moved = np.asarray(shapes, dtype=np.float64)
    fixed = np.asarray(truth, dtype=np.float64)
    if fixed.ndim != 3 or fixed.shape[2] != 3:
        raise _wrong("ground_truth.shapes", "wrong_shape", "(frames, points, 3)", str(fixed.shape))
    if moved.shape != fixed.shape:
        raise _wrong("ground_truth.shapes", "wrong_shape", str(moved.shape), str(fixed.shape))
    for name, array in (("shapes", moved), ("ground_truth.shapes", fixed)):
        if not np.isfinite(array).all():
            raise _wrong(name, "not_finite", "finite numbers", f"{int((~np.isfinite(array)).sum())} that are not")
    fixed = centred(fixed)
    if not (frobenius(fixed) > 0).all():
        flat = int(np.flatnonzero(frobenius(fixed) == 0)[0])
        raise _wrong(
            "ground_truth.shapes", "no_extent", "points that differ in every frame", f"one point in frame {flat}"
        )
    return centred(moved), fixed


def _wrong(name: str, code: str, expected: str, got: str) -> InvalidInput:
    hint = "Ground truth must hold one finite (P, 3) shape for every frame of the tracks, in the same point order."
    return InvalidInput(code, field=name, expected=expected, got=got, hint=hint)
