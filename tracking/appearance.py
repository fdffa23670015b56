"""Visibility from appearance: correlate patches of the template, deformed with the tracks, with a frame."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.flow import Bools, Floats, Grey, in_picture, sample

LEAST_CORRELATION = 0.6
"""Correlation below which a point is hidden: two thirds of the patch's variance (1 − .6²) are then unexplained, which closed flow cycles do
not reveal. On a rendered face behind a bar, .6 instead of .5 removes 8 % of the wrongly visible observations and .3 % of the right ones."""

LOST_NEIGHBOURS = 2
"""Number of hidden grid neighbours that hides a point too: it lies at the edge of an occluder, where flow mixes the two motions. On
rendered films with an occluder this removes a quarter to a half of the wrongly visible points and hides 2 to 3 % of the right ones.
At the edge of the grid one suffices, because points there slide along the object's outline: on a head that turns in front of a wall, 1.2
instead of 2.1 % of the visible observations are wrong by more than 2 px. On rendered faces this hides .7 % more of the right ones."""

PATCH_OFFSETS = np.stack(np.meshgrid(*[np.arange(-6, 7, 2, dtype=np.float32)] * 2), axis=-1).reshape(-1, 2)
"""Sample positions of a patch relative to its point, px: 7 × 7, two pixels apart."""

POINTS_AT_ONCE = 512
"""Points per block, so that their patches (100 KB per array) stay in a core's cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """The points of a template, their neighbours, and the patches around them."""

    points: Floats
    """Pixels of the template, shape `(P, 2)`."""

    neighbours: NDArray[np.int64]
    """Left, right, upper and lower neighbour of every point on the grid, shape `(P, 4)`; −1 where there is none."""

    inside: Floats
    """1 where a sample of a patch lies in the region, else 0, shape `(P, 49)`: what surrounds the object says nothing about it."""

    patches: Floats
    """Grey levels with their mean over the region removed, 0 outside it, shape `(P, 49)`."""

    noise: float
    """Variance of the template's noise, square grey levels."""

    @classmethod
    def of(cls, template: Grey, region: Bools, points: Floats, neighbours: NDArray[np.int64]) -> Appearance:
        """Cut the patches out of the region `(H, W)` of a template."""
        image, places = smooth(template), points[:, None] + PATCH_OFFSETS
        inside = (sample(region.astype(np.float32), places) > 0.5).astype(np.float32)
        return cls(points, neighbours, inside, _centred(sample(image, places), inside), noise_variance(template))

    def agrees(self, frame: Grey, points: Floats, visible: Bools, *, pool: ThreadPoolExecutor | None = None) -> Bools:
        """Compare a frame with the template at tracked points `(P, 2)`; return which visible points stay visible, shape `(P,)`.

        The patches follow the tracks' local affine maps, estimated from visible neighbours on the grid. The noise variance is added to the
        patches' own, so that two flat patches count as equal. Points outside the picture are hidden. The result does not depend on the
        number of threads in `pool`.
        """
        seen = np.zeros(len(points), dtype=bool)
        seen[visible] = self._resembles(frame, points, visible, visible, pool)
        return self._without_edges(seen) & in_picture(points, frame.shape)

    def found(self, frame: Grey, points: Floats, visible: Bools) -> Bools:
        """Compare a frame with the template at hidden points only.

        Return, of those in the picture, the visible points and the hidden ones that look like the template and do not lie beside points
        that stay hidden, see `LOST_NEIGHBOURS`.
        """
        alike = visible.copy()
        alike[~visible] = self._resembles(frame, points, ~visible, np.ones_like(visible), None)
        return (visible | self._without_edges(alike)) & in_picture(points, frame.shape)

    def _without_edges(self, seen: Bools) -> Bools:
        """Hide points that have `LOST_NEIGHBOURS` hidden neighbours, or one at the edge of the grid."""
        beside = self.neighbours >= 0
        lost = np.count_nonzero(beside & ~seen[self.neighbours], axis=1)
        return np.asarray(seen & (lost < np.where(beside.all(axis=1), LOST_NEIGHBOURS, LOST_NEIGHBOURS - 1)))

    def _resembles(
        self, frame: Grey, points: Floats, tested: Bools, trusted: Bools, pool: ThreadPoolExecutor | None
    ) -> Bools:
        """Return which of the points `tested (P,)` have patches like the template's; `trusted` ones determine the affine maps."""
        image, affine, some = smooth(frame), self._affine(points, trusted), np.flatnonzero(tested)
        return np.asarray(
            _by_blocks(
                lambda block: self._correlates(image, points[some[block]], affine[some[block]], some[block]),
                len(some),
                pool,
            ),
            dtype=bool,
        )

    def _correlates(self, image: Floats, points: Floats, affine: Floats, block: NDArray[np.intp]) -> Bools:
        """Return which points of one block have patches like the template's."""
        template, inside = self.patches[block], self.inside[block]
        floor = inside.sum(axis=1) * np.float32(self.noise + 1.0)
        patches = _centred(sample(image, points[:, None] + _offsets(affine)), inside)
        norms = (_dot(patches, patches) + floor) * (_dot(template, template) + floor)
        return np.asarray(_dot(patches, template) + floor >= LEAST_CORRELATION * np.sqrt(norms))

    def _affine(self, points: Floats, visible: Bools) -> Floats:
        """Estimate local affine maps from the differences to grid neighbours, shape `(P, 2, 2)`; identity where unknown."""
        affine = np.tile(np.eye(2, dtype=np.float32), (len(points), 1, 1))
        for axis in (0, 1):
            there, total = np.zeros_like(points), np.zeros_like(points[:, 0])
            for neighbour, sign in zip(self.neighbours[:, 2 * axis : 2 * axis + 2].T, (-1, 1), strict=True):
                usable = sign * ((neighbour >= 0) & visible[neighbour] & visible).astype(np.float32)
                there += usable[:, None] * (points[neighbour] - points)
                total += usable * (self.points[neighbour, axis] - self.points[:, axis])
            column = np.asarray(there / np.maximum(total, 1e-6)[:, None], dtype=np.float32)
            plausible = (total > 0) & (_dot(column, column) < 4)
            affine[plausible, :, axis] = column[plausible]
        return affine


def noise_variance(image: Grey) -> float:
    """Estimate an image's noise variance from the median response of a kernel that ignores planes and most edges (Immerkær 1996)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    response = np.abs(cv2.filter2D(image, cv2.CV_32F, kernel))
    return float((np.median(response) / 0.6745) ** 2 / 36)


def smooth(image: Grey) -> Floats:
    """Blur an image with a 3 × 3 binomial filter, as patches are compared."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (3, 3), 0), dtype=np.float32)


def _by_blocks(function: Callable[[slice], NDArray[Any]], count: int, pool: ThreadPoolExecutor | None) -> NDArray[Any]:
    """Concatenate a function's results for blocks of points; the blocks do not depend on the number of threads."""
    blocks = [slice(start, min(start + POINTS_AT_ONCE, count)) for start in range(0, max(count, 1), POINTS_AT_ONCE)]
    return np.concatenate(list(map(function, blocks) if pool is None else pool.map(function, blocks)))


def _offsets(affine: Floats) -> Floats:
    """Return the patches' sample positions relative to their points, shape `(P, 49, 2)`."""
    return np.asarray(PATCH_OFFSETS @ affine.transpose(0, 2, 1))


def _dot(first: Floats, second: Floats) -> Floats:
    return np.asarray(np.einsum("pk,pk->p", first, second))


def _centred(patches: Floats, inside: Floats) -> Floats:
    mean = _dot(patches, inside) / np.maximum(inside.sum(axis=1), 1)
    return np.asarray((patches - mean[:, None]) * inside)
