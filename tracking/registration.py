"""Register all grid points of a template jointly to a frame.

The image between four neighbouring points moves bilinearly with them (Szeliski and Coughlan, Spline-based image registration, 1997).
Gauss–Newton steps minimise the squared difference between the warped frame and the template, one or two pixels apart, plus the bending;
brightness and contrast are free within a window. Pixels are not smoothed first, because this would remove the detail that distinguishes
neighbouring positions. Points with little texture follow their neighbours, and no local affine maps have to be estimated from noisy tracks.
Every frame is compared with the same template, so errors do not accumulate over the frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.flow import Bools, Floats, Grey, sample
from pliant.tracking.seeding import LEAST_TEXTURE
from scipy import sparse
from scipy.sparse.linalg import cg

WINDOW = 21.0
"""Side of the window in which brightness and contrast are free, pixels. On a rendered face, registered once, 13, 21 and 31 give median
errors of .15, .13 and .13 px and root mean squares of .40, .37 and .37 px."""

BENDING = 0.04
"""Standard deviation of the motion's second differences over the distance of neighbouring points. On a rendered face of 640 × 480 pixels,
.03, .04 and .06 give median errors of .104, .106 and .116 px, and shape errors of .0146, .0129 and .0138. All constants here were chosen
on that face; films of a flag, a sphere and a paper served for checks only."""

EDGE = 2.0
"""Scale of the Cauchy loss on second differences, in standard deviations; it permits creases in the motion. It lowers the 95th percentile
of a rendered face's errors from 1.03 to .91 px and leaves the median unchanged."""

OUTLIER = 3.0
"""Scale of the Cauchy loss on brightness differences, in standard deviations. 6 instead of 3 gives errors 5 to 8 % larger."""

STEPS, ITERATIONS = 3, 15
"""Gauss–Newton steps, and conjugate-gradient iterations in each. In the second round, 4 steps give errors up to 2 % smaller on rendered
faces."""

MEDIAN_OF = 10_000
"""Residuals whose median gives their scale, at least; its standard error is then 1 %."""

LONGEST_STEP = 1.0
"""Maximum motion of a point in one step, px. Not tuned."""

DIFFERENCE = np.array([[1, -8, 0, 8, -1]], dtype=np.float32) / 12
"""Derivative of a row of pixels, exact for polynomials up to degree 4."""

UNLIKE = 0.36
"""Maximum unexplained share of the template's contrast around a point; above it (correlation below .8) the frame shows something else
there, and `refine` leaves the point where it was."""

ROUNDING = 1e-4
"""Minimum variance, square pixels."""

HOLD = 0.1
"""Precision of the pull towards the flow's positions, 1/px²: a standard deviation of 3 px. Not tuned; it keeps the system non-singular."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A grid of points in a template, and S samples in the cells whose four corners are points."""

    points: Floats
    """Pixels of the template, shape `(P, 2)`."""

    cells: Cells
    """The cells between four points, and the samples in them."""

    bending: sparse.csr_array
    """Second differences of a function of the points along rows, columns and diagonals, shape `(M, P)`."""

    full: Bools
    """Cells of the grid with a point at every corner, shape `(rows - 1, columns - 1)`."""

    normal: NormalEquations
    """Assembles the matrix of a Gauss–Newton step."""

    window: Window
    """Local means around the samples."""

    template: Floats
    """Grey levels at the samples, shape `(S,)`."""

    step: float
    """Distance of neighbouring points, pixels."""

    noise: float
    """Variance of the template's noise, square grey levels."""

    @classmethod
    def of(cls, template: Grey, points: Floats, grid: NDArray[np.int32], *, noise: float) -> Registration:
        """Prepare the registration of a template, a grey frame `(H, W)`.

        `points (P, 2)` are pixel positions on a regular grid; `grid (rows, columns)` holds their indices, −1 where there is none. `noise`
        is the variance of the frames' noise, square grey levels. The samples are about one pixel apart, at least 2 × 2 in a cell.
        """
        corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]], axis=-1)
        full = np.asarray((corners >= 0).all(axis=-1))
        corners = corners[full]
        step = float(np.median(points[corners[:, 1], 0] - points[corners[:, 0], 0]))
        cells, window, values = _samples(template, points, corners, full, step, 1.0)
        stencils = _stencils(grid)
        normal = NormalEquations.of(corners, stencils, len(points))
        return cls(points, cells, _bending(stencils, len(points)), full, normal, window, values, step, noise)

    def coarse(self, template: Grey, spacing: float) -> Registration:
        """Return the registration of the same template with samples about `spacing` pixels apart."""
        cells, window, values = _samples(template, self.points, self.cells.corners, self.full, self.step, spacing)
        return replace(self, cells=cells, window=window, template=values)

    def refine(
        self, frame: Grey, points: Floats, variance: Floats, visible: Bools, *, steps: int = STEPS
    ) -> tuple[Floats, Floats]:
        """Move visible points from given positions to where a frame matches the template; return points and variances.

        Variances are in square pixels. Points keep position and variance if no cell around them is visible as a whole; those around which
        the frame shows something else keep their position. The variance is that of the shift which would explain the remaining brightness
        difference: the mean squared residual around a point over the mean squared slope in the direction of least slope. It is right for
        errors of the motion model and too large for film noise, which averages out over the window.
        """
        shown = self._shown(visible)
        used = np.zeros(len(points), dtype=bool)
        used[self.cells.corners[shown]] = True
        if not used.any():
            return points, variance
        around, picture = self._surroundings(shown), _slopes(frame)
        moved = self._moved(around, picture, points, steps)
        left, unlike = self._remaining(around, picture, moved)
        matched = used & (unlike < UNLIKE)
        return np.where(matched[:, None], moved, points), np.where(used, left, variance)

    def spread(self, frame: Grey, points: Floats, visible: Bools, *, steps: int = STEPS) -> Floats:
        """Move visible points to where a frame matches the template, and hidden ones along with the least bending; return all.

        Without hidden points, or without visible ones, nothing moves.
        """
        shown = self._shown(visible)
        if visible.all() or not shown.any():
            return points
        return self._moved(self._surroundings(shown), _slopes(frame), points, steps)

    def _shown(self, visible: Bools) -> Bools:
        """Return the cells whose four corners are visible."""
        return np.asarray(visible[self.cells.corners].all(axis=1))

    def _surroundings(self, shown: Bools) -> _Surroundings:
        return _Surroundings.of(self, np.repeat(shown, len(self.template) // len(shown)).astype(np.float32))

    def _moved(self, around: _Surroundings, picture: Floats, points: Floats, steps: int) -> Floats:
        moved = points.astype(np.float32)
        for _ in range(steps):
            step = self._step(around, picture, moved, points)
            moved = moved + np.clip(step, -LONGEST_STEP, LONGEST_STEP).astype(np.float32)
        return moved

    def _remaining(self, around: _Surroundings, picture: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Return the variance of all points, square pixels, and the unexplained share of the template's contrast around them."""
        residual, across, down = self._compared(around, picture, points)
        parts = [across * across, across * down, down * down, residual * residual]
        xx, xy, yy, left = (self.cells.sums(around.mean(part)) for part in parts)
        least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
        shown = self.cells.sums(around.shown)
        variance = np.maximum(left, 0) / np.maximum(least, LEAST_TEXTURE * shown + 1e-6) + ROUNDING
        unlike = np.maximum(left, 0) / np.maximum(self.cells.sums(around.power), 1e-6)
        return np.asarray(variance, dtype=np.float32), np.asarray(unlike, dtype=np.float32)

    def _compared(self, around: _Surroundings, picture: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the residual at the samples, shape `(S,)`, and its derivatives across and down, for points `(P, 2)`."""
        grey, across, down = np.ascontiguousarray(sample(picture, self.cells.places(points)).reshape(-1, 3).T)
        residual, contrast = around.residual(grey)
        return residual, across / contrast, down / contrast

    def _step(self, around: _Surroundings, picture: Floats, moved: Floats, flowed: Floats) -> Floats:
        """Return one Gauss–Newton step of all points, shape `(P, 2)`."""
        residual, across, down = self._compared(around, picture, moved)
        some = residual[around.shown > 0]
        scale = 1.4826 * np.median(np.abs(some[:: max(1, len(some) // MEDIAN_OF)])) + np.float32(1e-3)
        weight = around.shown / (1 + (residual / (OUTLIER * scale)) ** 2) / scale**2
        bent, deviation = self.bending @ (moved - self.points), BENDING * self.step
        stiffness = (1 / (1 + (bent**2).sum(axis=1) / (EDGE * deviation) ** 2) / deviation**2).astype(np.float32)
        matrix = self.normal.matrix(self.cells.squares(weight, across, down), stiffness)
        pulled = weight * residual
        pull = -np.stack([self.cells.sums(pulled * slope) for slope in (across, down)], axis=1)
        pull -= self.bending.T @ (stiffness[:, None] * bent) + HOLD * (moved - flowed)
        solved, _ = cg(
            matrix,
            pull.ravel(),
            rtol=1e-2,
            maxiter=ITERATIONS,
            M=sparse.diags_array(1 / matrix.diagonal(), format="csr"),
        )
        return np.asarray(solved.reshape(-1, 2), dtype=np.float32)


def _samples(
    template: Grey, points: Floats, corners: NDArray[np.int32], full: Bools, step: float, spacing: float
) -> tuple[Cells, Window, Floats]:
    """Lay out samples about `spacing` pixels apart in the cells; return cells, window and the template's grey levels."""
    side = max(2, round(step / spacing))
    cells = Cells.of(corners, side, len(points))
    values = sample(template.astype(np.float32), cells.places(points)).ravel()
    return cells, Window.of(full, side, width=WINDOW / step), values


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """C cells between four points, each with the same `K` samples, whose positions are bilinear in the corners: S = C K."""

    corners: NDArray[np.int32]
    """Points at the corners of every cell, shape `(C, 4)`."""

    weights: Floats
    """Weights of the corners at the samples, shape `(K, 4)`."""

    products: Floats
    """Products of two corners' weights at the samples, shape `(K, 16)`."""

    gather: sparse.csr_array
    """Matrix that sums the cells' corners by point, shape `(P, 4 C)`."""

    @classmethod
    def of(cls, corners: NDArray[np.int32], side: int, num_points: int) -> Cells:
        """Lay out `side` × `side` samples in every cell."""
        inside = (np.arange(side) + 0.5) / side
        right, down = (axis.ravel() for axis in np.meshgrid(inside, inside))
        weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], axis=1)
        products = (weights[:, :, None] * weights[:, None, :]).reshape(-1, 16)
        return cls(corners, weights.astype(np.float32), products.astype(np.float32), _sums(corners.ravel(), num_points))

    def places(self, points: Floats) -> Floats:
        """Return the positions of the samples, shape `(C, K, 2)`, for points `(P, 2)`."""
        return np.stack([points[:, axis][self.corners] @ self.weights.T for axis in (0, 1)], axis=-1)

    def sums(self, values: Floats) -> Floats:
        """Return the weighted sums of sample values `(S,)` around every point, shape `(P,)`."""
        return np.asarray(self.gather @ (values.reshape(len(self.corners), -1) @ self.weights).ravel())

    def squares(self, weight: Floats, across: Floats, down: Floats) -> Floats:
        """Return the weighted squares x², xy and y² of slopes `(S,)`, summed over pairs of a cell's corners, shape `(3, 16 C)`."""
        products = np.stack([weight * across * across, weight * across * down, weight * down * down])
        return np.asarray((products.reshape(3, len(self.corners), -1) @ self.products).reshape(3, -1))


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Sums the matrix of a Gauss–Newton step over the N pairs of points that share a cell or a second difference."""

    cells: sparse.csr_array
    """Matrix that sums the cells' pairs of corners over the pairs of points, shape `(N, 16 C)`."""

    bending: sparse.csr_array
    """Matrix that sums the stiffness of the second differences over the pairs of points, shape `(N, M)`."""

    own: NDArray[np.intp]
    """Pairs of a point with itself, shape `(P,)`."""

    entries: NDArray[np.int64]
    """Entries of the matrix that hold a pair's 2 × 2 block, shape `(4, N)`."""

    pattern: tuple[NDArray[np.int32], NDArray[np.int32]]
    """Columns of the entries, and row pointers."""

    @classmethod
    def of(cls, corners: NDArray[np.int32], stencils: list[Stencil], num_points: int) -> NormalEquations:
        """Find the pairs of points, in rows of the first."""
        pairs = [_pairs(points, num_points) for points in (corners, *(stencil.points for stencil in stencils))]
        distinct, pair = np.unique(np.concatenate([one.ravel() for one in pairs]), return_inverse=True)
        of_cells, of_stencils = np.split(pair.ravel(), [pairs[0].size])
        counts = [len(stencil.points) for stencil in stencils]
        squares = [np.outer(stencil.values, stencil.values).ravel() for stencil in stencils]
        values = np.concatenate([np.tile(square, count) for square, count in zip(squares, counts, strict=True)])
        differences = np.repeat(np.arange(sum(counts)), np.repeat([square.size for square in squares], counts))
        bending = sparse.csr_array((values, (of_stencils, differences)), shape=(len(distinct), sum(counts)))
        first, second = np.divmod(distinct, num_points)
        width = np.bincount(first, minlength=num_points)
        before = np.cumsum(width) - width
        upper = 2 * np.arange(len(distinct)) + 2 * before[first]
        lower = upper + 2 * width[first]
        entries = np.stack([upper, upper + 1, lower, lower + 1])
        columns = np.zeros(4 * len(distinct), dtype=np.int32)
        columns[entries] = [2 * second, 2 * second + 1, 2 * second, 2 * second + 1]
        rows = np.append(0, np.cumsum(np.repeat(2 * width, 2))).astype(np.int32)
        return cls(_sums(of_cells, len(distinct)), bending, np.flatnonzero(first == second), entries, (columns, rows))

    def matrix(self, squares: Floats, stiffness: Floats) -> sparse.csr_array:
        """Return the matrix `(2P, 2P)` for `squares (3, 16 C)`, see `Cells.squares`, and the stiffness `(M,)` of second differences."""
        xx, xy, yy = (self.cells @ square for square in squares)
        held = self.bending @ stiffness
        held[self.own] += HOLD
        values = np.zeros(self.entries.size, dtype=np.float32)
        values[self.entries] = [xx + held, xy, xy, yy + held]
        return sparse.csr_array((values, *self.pattern), shape=(2 * len(self.own),) * 2)


@dataclass(frozen=True, slots=True, eq=False)
class Stencil:
    """A second difference at N places: the values of `L` points there, and their weights."""

    points: NDArray[np.int32]
    """Shape `(N, L)`."""

    values: Floats
    """Shape `(L,)`."""


def _pairs(points: NDArray[np.int32], num_points: int) -> NDArray[np.int64]:
    """Return the numbers `i P + j` of all pairs of points in every row of `points (N, L)`, shape `(N, L²)`."""
    length = points.shape[1]
    return np.repeat(points, length, axis=1).astype(np.int64) * num_points + np.tile(points, (1, length))


def _sums(rows: NDArray[np.integer[Any]], count: int) -> sparse.csr_array:
    """Return the matrix that sums values with the same row index."""
    columns = np.arange(len(rows))
    return sparse.csr_array((np.ones(len(rows), dtype=np.float32), (rows, columns)), shape=(count, len(rows)))


@dataclass(frozen=True, slots=True)
class Window:
    """Means over a window around every sample: the samples are pixels of a small picture, with gaps where there is no cell."""

    pixel: NDArray[np.int64]
    """Pixel of every sample, counted row by row, shape `(S,)`."""

    shape: tuple[int, int]
    """Shape of the picture."""

    side: int
    """Side of the window, an odd number of pixels."""

    @classmethod
    def of(cls, full: Bools, side: int, *, width: float) -> Window:
        """Lay out the samples of the full cells, `side` × `side` in each; `width` is the window's side in cells."""
        top, left = np.nonzero(full)
        within = np.arange(side * side)
        row = (top[:, None] * side + within // side).ravel()
        column = (left[:, None] * side + within % side).ravel()
        shape = full.shape[0] * side, full.shape[1] * side
        return cls(row * shape[1] + column, shape, 2 * round(width * side / 2) + 1)

    def mean(self, values: Floats) -> Floats:
        """Return the window means of values `(S,)`, with zero in the gaps."""
        picture = np.zeros(self.shape, dtype=np.float32)
        picture.reshape(-1)[self.pixel] = values
        blurred = cv2.boxFilter(picture, -1, (self.side, self.side), borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred.reshape(-1)[self.pixel], dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Surroundings:
    """The visible samples of the template around a frame's match, with local brightness removed."""

    window: Window
    shown: Floats
    """1 where a sample is visible, else 0, shape `(S,)`."""

    count: Floats
    """Visible share of each window."""

    template: Floats
    """Grey levels minus the windows' means, 0 where hidden."""

    power: Floats
    """Mean square of `template` in each window, plus the noise."""

    noise: np.float32

    @classmethod
    def of(cls, registration: Registration, shown: Floats) -> _Surroundings:
        window, noise = registration.window, np.float32(registration.noise + 1.0)
        count = window.mean(shown) + np.float32(1e-6)
        centred = (registration.template - window.mean(registration.template * shown) / count) * shown
        return cls(window, shown, count, centred, window.mean(centred * centred) / count + noise, noise)

    def mean(self, values: Floats) -> Floats:
        """Return means over the visible samples around every visible one, 0 elsewhere."""
        return self.shown * self.window.mean(values * self.shown) / self.count

    def residual(self, values: Floats) -> tuple[Floats, Floats]:
        """Return a frame's values `(S,)` minus the template, after matching brightness and contrast, and the contrast."""
        centred = (values - self.window.mean(values * self.shown) / self.count) * self.shown
        contrast = (self.window.mean(centred * self.template) / self.count + self.noise) / self.power
        contrast = np.clip(contrast, 0.5, 2.0)
        return centred / contrast - self.template, contrast


def _stencils(grid: NDArray[np.int32]) -> list[Stencil]:
    """Return the second differences along rows, columns and diagonals.

    The mixed one counts twice, as in the Frobenius norm of the second derivatives.
    """
    root = float(np.sqrt(2.0))
    stencils = (
        ((1.0, -2.0, 1.0), (grid[:, :-2], grid[:, 1:-1], grid[:, 2:])),
        ((1.0, -2.0, 1.0), (grid[:-2], grid[1:-1], grid[2:])),
        ((root, -root, -root, root), (grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:])),
    )
    found = []
    for values, cells in stencils:
        points = np.stack([cell.ravel() for cell in cells], axis=1)
        found.append(Stencil(points[(points >= 0).all(axis=1)], np.array(values, dtype=np.float32)))
    return found


def _bending(stencils: list[Stencil], num_points: int) -> sparse.csr_array:
    """Return the matrix of the second differences, shape `(M, P)`."""
    parts = [
        sparse.csr_array(
            (
                np.tile(one.values, len(one.points)),
                one.points.ravel(),
                np.arange(0, one.points.size + 1, len(one.values)),
            ),
            shape=(len(one.points), num_points),
        )
        for one in stencils
    ]
    return sparse.csr_array(sparse.vstack(parts))


def _slopes(frame: Grey) -> Floats:
    """Return a frame and its derivatives in x and y, shape `(H, W, 3)`."""
    across, down = (cv2.filter2D(frame, cv2.CV_32F, kernel) for kernel in (DIFFERENCE, DIFFERENCE.T))
    return np.asarray(cv2.merge([frame.astype(np.float32), across, down]))
