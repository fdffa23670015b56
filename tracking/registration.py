"""Where a frame shows the points of a template: all points of the grid are registered together.

The picture between four neighbouring points moves bilinearly with them (Szeliski and Coughlan, Spline-based image registration, 1997).
Gauss–Newton steps minimise the squared difference between the moved picture and the template at every pixel, plus the bending of the
motion; brightness and contrast are free within a window. Pixels are not smoothed first, which would remove what tells neighbouring places
apart. A point with little texture follows its neighbours, and no local affine map has to be estimated from noisy tracks. Every frame is
compared with the same template, so that errors do not accumulate over the frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.appearance import cut
from pliant.tracking.flow import Bools, Floats, Grey
from pliant.tracking.seeding import LEAST_TEXTURE
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

WINDOW = 21.0
"""Side of the window in which brightness and contrast are free, pixels. On a rendered face, registered once, 13, 21 and 31 have median
errors of .15, .13 and .13 px and root mean squares of .40, .37 and .37 px."""

BENDING = 0.04
"""Standard deviation of the motion's second differences over the distance of neighbouring points. On a rendered face of 640 × 480 pixels
.03, .04 and .06 have median errors of .104, .106 and .116 px, and errors of the shapes of .0146, .0129 and .0138. All constants here were
chosen on that face; films of a flag, a sphere and a paper were only measured."""

EDGE = 2.0
"""Standard deviations beyond which a second difference counts less and less, so that the motion may have creases (Cauchy). It lowers the
95th percentile of a rendered face's errors from 1.03 to .91 px; the median stays."""

OUTLIER = 3.0
"""Standard deviations beyond which a difference of brightness counts less and less (Cauchy). 6 instead of 3 has errors 5 to 8 % larger."""

STEPS, ITERATIONS = 4, 15
"""Gauss–Newton steps, and iterations of conjugate gradients in each. In the second round, 3 and 8 steps have errors 2 % larger and
2 % smaller on a rendered face."""

LONGEST_STEP = 1.0
"""Pixels that a point moves at most in one step. Not tuned."""

DIFFERENCE = np.array([[1, -8, 0, 8, -1]], dtype=np.float32) / 12
"""Derivative of a row of pixels, exact for polynomials of fourth degree."""

UNLIKE = 0.36
"""Share of the template's contrast around a point that may remain unexplained; above it (correlation below .8) the frame shows something
else there, and the point stays where it was."""

ROUNDING = 1e-4
"""Least variance, square pixels."""

HOLD = 0.1
"""Precision of the flow's places where nothing else is known, 1/px²: a deviation of 3 px. Not tuned; it keeps the system regular."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A grid of points in a template, and what is compared between them: S places in the cells whose four corners are points."""

    points: Floats
    """Pixels of the template, shape `(P, 2)`."""

    cells: Cells
    """The squares between four points, and the places in them."""

    bending: sparse.csr_array
    """Second differences of a function of the points along rows, columns and diagonals, shape `(M, P)`."""

    window: Window
    """Means around the places."""

    template: Floats
    """Grey levels at the places, shape `(S,)`."""

    step: float
    """Distance of neighbouring points, pixels."""

    noise: float
    """Variance of the template's noise, square grey levels."""

    @classmethod
    def of(cls, template: Grey, points: Floats, grid: NDArray[np.int32], *, noise: float) -> Registration:
        """Prepare the registration of a template, a grey frame `(H, W)`.

        Points `(P, 2)` are pixels on a regular grid `(rows, columns)` of their indices, −1 where there is none. `noise` is the
        variance of the frames' noise, square grey levels.
        """
        corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]], axis=-1)
        full = np.asarray((corners >= 0).all(axis=-1))
        corners = corners[full]
        step = float(np.median(points[corners[:, 1], 0] - points[corners[:, 0], 0]))
        side = max(2, round(step))
        cells = Cells.of(corners, side, len(points))
        window = Window.of(full, side, width=WINDOW / step)
        values = cut(template.astype(np.float32), cells.places(points)[:, None])[:, 0]
        return cls(points, cells, _bending(grid, len(points)), window, values, step, noise)

    def refine(
        self, frame: Grey, points: Floats, variance: Floats, visible: Bools, *, steps: int = STEPS
    ) -> tuple[Floats, Floats]:
        """Move visible points from where flow leads to where a frame matches the template; return points and variances of the matches.

        Variances are in square pixels. Points that are not visible keep place and variance, as do those around which the frame
        shows something else. The variance is that of the shift which would explain the remaining difference of brightness, the
        mean squared residual around a point over the mean squared slope in the direction of least slope. Errors of the motion
        model make it that large; noise of the film, which averages out over the window, makes it too large.
        """
        shown = np.asarray(visible[self.cells.corners].all(axis=1))
        used = np.zeros(len(points), dtype=bool)
        used[self.cells.corners[shown]] = True
        if not used.any():
            return points, variance
        around = _Surroundings.of(self, np.repeat(shown, len(self.template) // len(shown)).astype(np.float32))
        picture, moved = _slopes(frame), points.astype(np.float32)
        for _ in range(steps):
            step = self._step(around, picture, moved, points)
            moved = moved + np.clip(step, -LONGEST_STEP, LONGEST_STEP).astype(np.float32)
        left, unlike = self._remaining(around, picture, moved)
        believed = used & (unlike < UNLIKE)
        return np.where(believed[:, None], moved, points), np.where(believed, left, variance)

    def _remaining(self, around: _Surroundings, picture: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Return the variance of all points, square pixels, and the share of the template's contrast that the frame does not explain."""
        values = cut(picture, self.cells.places(points)[:, None])[:, 0]
        residual, contrast = around.residual(values[:, 0])
        across, down = (values[:, 1:] / contrast[:, None]).T
        parts = [across * across, across * down, down * down, residual * residual]
        xx, xy, yy, left = (self.cells.sums(around.mean(part)) for part in parts)
        least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
        shown = self.cells.sums(around.shown)
        variance = np.maximum(left, 0) / np.maximum(least, LEAST_TEXTURE * shown + 1e-6) + ROUNDING
        unlike = np.maximum(left, 0) / np.maximum(self.cells.sums(around.power), 1e-6)
        return np.asarray(variance, dtype=np.float32), np.asarray(unlike, dtype=np.float32)

    def _step(self, around: _Surroundings, picture: Floats, moved: Floats, flowed: Floats) -> Floats:
        """Return the step of all points, shape `(P, 2)`."""
        values = cut(picture, self.cells.places(moved)[:, None])[:, 0]
        residual, contrast = around.residual(values[:, 0])
        slopes = values[:, 1:] / contrast[:, None]
        scale = 1.4826 * float(np.median(np.abs(residual[around.shown > 0]))) + 1e-3
        weight = (around.shown / (1 + (residual / (OUTLIER * scale)) ** 2) / scale**2).astype(np.float32)
        data = self.cells.normal(weight, slopes)
        bent, deviation = self.bending @ (moved - self.points), BENDING * self.step
        stiffness = (1 / (1 + (bent**2).sum(axis=1) / (EDGE * deviation) ** 2) / deviation**2).astype(np.float32)
        pulled = (weight * residual)[:, None] * slopes
        pull = -np.stack([self.cells.sums(pulled[:, axis]) for axis in (0, 1)], axis=1)
        pull -= self.bending.T @ (stiffness[:, None] * bent) + HOLD * (moved - flowed)

        def matvec(x: Floats) -> Floats:
            field = x.reshape(-1, 2)
            held = self.bending.T @ (stiffness[:, None] * (self.bending @ field)) + HOLD * field
            return np.asarray(data @ x + held.ravel())

        diagonal = data.diagonal() + np.repeat((self.bending.multiply(self.bending)).T @ stiffness, 2) + HOLD
        size = (len(diagonal),) * 2
        solved, _ = cg(
            LinearOperator(size, matvec=matvec, dtype=np.float32), pull.ravel(), rtol=1e-2, maxiter=ITERATIONS,
            M=LinearOperator(size, matvec=lambda x: x / diagonal, dtype=np.float32),
        )  # fmt: skip
        return np.asarray(solved.reshape(-1, 2), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The squares between four points; all have the same `K` places, whose positions follow the corners bilinearly: S = C K."""

    corners: NDArray[np.int32]
    """Points at the corners of every cell, shape `(C, 4)`."""

    weights: Floats
    """Of the corners at the places, shape `(K, 4)`."""

    products: Floats
    """Of two corners' weights at the places, shape `(K, 16)`."""

    gather: sparse.csr_array
    """Sums the cells' corners over the points, shape `(P, 4 C)`."""

    pairs: sparse.csr_array
    """Sums the cells' pairs of corners over the N pairs of points that share a cell, shape `(N, 16 C)`."""

    pattern: tuple[NDArray[np.int32], NDArray[np.int32]]
    """Columns and row pointers of these pairs in a matrix of P × P blocks."""

    @classmethod
    def of(cls, corners: NDArray[np.int32], side: int, num_points: int) -> Cells:
        """Lay out `side` × `side` places in every cell."""
        inside = (np.arange(side) + 0.5) / side
        right, down = (axis.ravel() for axis in np.meshgrid(inside, inside))
        weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], axis=1)
        products = (weights[:, :, None] * weights[:, None, :]).reshape(-1, 16)
        pairs = np.repeat(corners, 4, axis=1).astype(np.int64) * num_points + np.tile(corners, (1, 4))
        distinct, entry = np.unique(pairs, return_inverse=True)
        rows = np.bincount(distinct // num_points, minlength=num_points)
        pattern = (distinct % num_points).astype(np.int32), np.append(0, np.cumsum(rows)).astype(np.int32)
        return cls(
            corners, weights.astype(np.float32), products.astype(np.float32), _sums(corners.ravel(), num_points),
            _sums(entry.ravel(), len(distinct)), pattern,
        )  # fmt: skip

    def places(self, points: Floats) -> Floats:
        """Return where the places lie, shape `(S, 2)`, given the points `(P, 2)`."""
        return np.asarray((self.weights @ points[self.corners]).reshape(-1, 2))

    def sums(self, values: Floats) -> Floats:
        """Return the sums of values `(S,)` over the places around every point, by its weights there, shape `(P,)`."""
        return np.asarray(self.gather @ (values.reshape(len(self.corners), -1) @ self.weights).ravel())

    def normal(self, weight: Floats, slopes: Floats) -> sparse.bsr_array:
        """Return the matrix of the normal equations, shape `(2P, 2P)`, of residuals with the given weights `(S,)` and slopes `(S, 2)`."""
        across, down = slopes.T
        xx, xy, yy = (
            self.pairs @ ((weight * product).reshape(len(self.corners), -1) @ self.products).ravel()
            for product in (across * across, across * down, down * down)
        )
        blocks = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
        return sparse.bsr_array((blocks, *self.pattern), shape=(2 * self.gather.shape[0],) * 2)


def _sums(rows: NDArray[np.integer[Any]], count: int) -> sparse.csr_array:
    """Return the matrix that adds the values of equal rows."""
    columns = np.arange(len(rows))
    return sparse.csr_array((np.ones(len(rows), dtype=np.float32), (rows, columns)), shape=(count, len(rows)))


@dataclass(frozen=True, slots=True)
class Window:
    """Means over a window around every place: the places are pixels of a small picture, with gaps where there is no cell."""

    pixel: NDArray[np.int64]
    """Of every place, counted row by row, shape `(S,)`."""

    shape: tuple[int, int]
    """Of the picture."""

    side: int
    """Of the window, an odd number of pixels."""

    @classmethod
    def of(cls, full: Bools, side: int, *, width: float) -> Window:
        """Lay out the places of the cells that are full, `side` × `side` in each; `width` in cells."""
        top, left = np.nonzero(full)
        within = np.arange(side * side)
        row = (top[:, None] * side + within // side).ravel()
        column = (left[:, None] * side + within % side).ravel()
        shape = full.shape[0] * side, full.shape[1] * side
        return cls(row * shape[1] + column, shape, 2 * round(width * side / 2) + 1)

    def mean(self, values: Floats) -> Floats:
        """Return the window's means of values `(S,)`, zero counting where there is no place."""
        picture = np.zeros(self.shape, dtype=np.float32)
        picture.reshape(-1)[self.pixel] = values
        blurred = cv2.boxFilter(picture, -1, (self.side, self.side), borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred.reshape(-1)[self.pixel], dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Surroundings:
    """The template with brightness and contrast removed, over the places that a frame shows."""

    window: Window
    shown: Floats
    """1 or 0, shape `(S,)`."""

    count: Floats
    """Shares of the windows that are shown."""

    template: Floats
    """Grey levels without the windows' means, 0 where nothing is shown."""

    power: Floats
    """Mean square of these, and the noise."""

    noise: np.float32

    @classmethod
    def of(cls, registration: Registration, shown: Floats) -> _Surroundings:
        window, noise = registration.window, np.float32(registration.noise + 1.0)
        count = window.mean(shown) + np.float32(1e-6)
        centred = (registration.template - window.mean(registration.template * shown) / count) * shown
        return cls(window, shown, count, centred, window.mean(centred * centred) / count + noise, noise)

    def mean(self, values: Floats) -> Floats:
        """Return means over the shown places around every shown one, 0 elsewhere."""
        return self.shown * self.window.mean(values * self.shown) / self.count

    def residual(self, values: Floats) -> tuple[Floats, Floats]:
        """Return a frame's values `(S,)` less the template, brightness and contrast adapted, and the contrast."""
        centred = (values - self.window.mean(values * self.shown) / self.count) * self.shown
        contrast = (self.window.mean(centred * self.template) / self.count + self.noise) / self.power
        contrast = np.clip(contrast, 0.5, 2.0)
        return centred / contrast - self.template, contrast


def _bending(grid: NDArray[np.int32], num_points: int) -> sparse.csr_array:
    """Return `Registration.bending`; the mixed difference counts twice, as in the Frobenius norm of the second derivatives."""
    root = float(np.sqrt(2.0))
    stencils = (
        ((1.0, -2.0, 1.0), (grid[:, :-2], grid[:, 1:-1], grid[:, 2:])),
        ((1.0, -2.0, 1.0), (grid[:-2], grid[1:-1], grid[2:])),
        ((root, -root, -root, root), (grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:])),
    )
    parts = []
    for values, cells in stencils:
        points = np.stack([cell.ravel() for cell in cells], axis=1)
        points = points[(points >= 0).all(axis=1)]
        pointers = np.arange(0, points.size + 1, len(values))
        data = np.tile(np.array(values, dtype=np.float32), len(points))
        parts.append(sparse.csr_array((data, points.ravel(), pointers), shape=(len(points), num_points)))
    return sparse.csr_array(sparse.vstack(parts))


def _slopes(frame: Grey) -> Floats:
    """Return a frame and its derivatives in x and y, shape `(H, W, 3)`."""
    image = frame.astype(np.float32)
    across, down = (cv2.filter2D(image, cv2.CV_32F, kernel) for kernel in (DIFFERENCE, DIFFERENCE.T))
    return np.asarray(cv2.merge([image, across, down]))
