"""Sparsely observed points: excluded from the minimisation, placed on the surface, moved to their observations.

Only its neighbours and its prior, whose mean is the centre of the body, constrain a sparsely observed point. In the
minimisation it would approach its neighbours as slowly as diffusion, and in a patch of such points the prior, which acts
on each point separately, would dominate. The points are therefore placed in two steps, given the shapes of the
well-observed points:

    1. Close the surface: the unknown positions minimise ‖A X‖² + μ Σ ‖x_i − x_j‖², with the second sum over edges. This is a thin
       plate under tension; without tension, a plate attached at one edge only continues its slope without bound.
    2. Move each point to its observations by simple kriging with the plate as trend (Cressie, Statistics for Spatial Data, 1993,
       section 3.4). Its path about its mean has the learned covariance; the variance of the mean is reduced to keep it near the plate.
       With Σ the sum of both and K = ΠΣΠᵀ + diag(λ1/ω), residuals r are corrected by the conditional mean Σ Πᵀ K⁻¹ r.

Gross outliers are rejected one at a time: the observation that is least probable given the other observations of its
point, by the closed form of leave-one-out (Dubrule, "Cross validation of kriging in a unique neighborhood", 1983). A
single outlier among four observations distorts any fit to all of them, but not the leave-one-out prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.energy.problem import Problem
from pliant.solver.energy.robust_loss import loss_weights
from pliant.solver.mesh import Mesh
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.operators.aggregation import Matrix
from pliant.solver.records import MIN_POINTS, Floats
from pliant.solver.shapes.irls import init
from pliant.solver.shapes.state import State
from pliant.solver.threads import over_ranges
from pliant.solver.tracks.normalization import Normalized
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

WELL_OBSERVED_SHARE = 0.25
"""Minimum share of the frames that show a well-observed point. On rotating bodies .15 to .35 give about the same error."""

MIN_OUTLIER_DISTANCE = 0.05
"""Distance from the prediction, normalized units, below which an observation is never rejected."""

MAX_SPARSE_SHARE = 0.5
"""Share of sparsely observed points above which all points are fitted together, because tracks then start and end throughout."""

TENSION = 1.0
"""μ, weight of the differences along edges; effective beyond about three rings of neighbours. On four bodies 1 to 10 give
about the same error; at .01, patches attached at one edge only diverge."""

SURFACE_RIDGE = 1e-6
"""Ridge added to AᵀA, whose diagonal is about 150; it places unconnected points at the centre."""

PATH_RIDGE = 1e-10
"""Relative ridge on the diagonal of K, against rounding."""

SMALLEST_WEIGHT = float(np.finfo(np.float64).tiny)

PATH_REWEIGHTINGS = 3
"""Reweightings of a point's residuals in kriging."""

MAX_DEVIATION = 5.0
"""Distance from the leave-one-out prediction, in standard deviations, beyond which an observation is rejected if it also
exceeds `MIN_OUTLIER_DISTANCE`. On a galloping horse with 6 % outliers the error is .25 to .35 without rejection, .06 with
it."""

MEAN_VARIANCE_SHARE = 0.1
"""Variance of a point's mean position about the surface, relative to that of the body's mean positions. At 1, a few noisy
observations do not determine depth: on a galloping horse with noise of .01 the error is .104 at 1 and .072 at .1; .03 to
.1 give about the same error."""


@dataclass(frozen=True, slots=True, eq=False)
class WellObserved:
    """The well-observed points as a separate sequence."""

    normalized: Normalized
    mesh: Mesh
    """Faces or grid cells with well-observed corners only."""

    kept: NDArray[np.intp]
    """Indices of the points, ascending."""

    pull: Matrix
    """√μ times the differences along the edges of the whole surface, shape `(E, P)`."""


def well_observed(normalized: Normalized, mesh: Mesh | None) -> WellObserved | None:
    """Return the well-observed points; None if these are all points, if they are too few, or without a mesh."""
    if mesh is None or (len(mesh.faces) == 0 and mesh.grid is None):
        return None
    count = normalized.visible.shape[1]
    kept = np.flatnonzero((normalized.visible > 0).mean(axis=0) >= WELL_OBSERVED_SHARE)
    if len(kept) == count or len(kept) < max(MIN_POINTS, (1 - MAX_SPARSE_SHARE) * count):
        return None
    part = replace(normalized, points=normalized.points[:, kept], visible=normalized.visible[:, kept])
    return WellObserved(part, mesh_of(mesh, kept), kept, TENSION**0.5 * _differences(mesh))


def place_the_rest(
    part: WellObserved, problem: Problem, covariance: ShapeCovariance, state: State, *, spoiled: bool
) -> tuple[Problem, State]:
    """Return the problem without gross outliers and the state of all points; energy and counts are those of `state`.

    Parameters
    ----------
    part : WellObserved
        The well-observed points.
    problem : Problem
        Problem of all points, with the Gaussian prior of `covariance`.
    covariance : ShapeCovariance
        Prior of the paths.
    state : State
        State of the well-observed points.
    spoiled : bool
        Whether to reject gross outliers.
    """
    shapes = np.zeros((len(problem.points), 3, problem.points.shape[2]))
    shapes[:, :, part.kept] = state.shapes
    seen = np.flatnonzero((problem.confidence > 0).any(axis=0))
    energy = part.pull if problem.laplacian is None else sparse.vstack([problem.laplacian.matrix, part.pull])
    close_surface(shapes, part.kept, energy)
    confidence = problem.confidence.astype(np.float64)
    kriging = Kriging.of(problem, covariance, state.translations)
    _fit_observations(kriging, shapes, confidence, np.setdiff1d(seen, part.kept), spoiled=spoiled)
    problem = replace(problem, confidence=confidence)
    if len(seen) < problem.points.shape[2]:
        close_surface(shapes, seen, energy)
    whole = init(problem, shapes.astype(problem.points.dtype), state.translations)
    return problem, replace(
        whole, objective=state.objective, reweighting=state.reweighting, iterations=state.iterations
    )


def close_surface(shapes: Floats, known: NDArray[np.intp], energy: Matrix) -> None:
    """Set the unknown points, in place, to the positions that minimise ‖E X‖².

    Parameters
    ----------
    shapes : array, shape (F, 3, P)
        Positions of the known points; the others are overwritten.
    known : array of int
        Indices of the known points.
    energy : sparse array, shape (R, P)
        E: the rows of A and any other terms to minimise.
    """
    unknown = np.setdiff1d(np.arange(shapes.shape[2]), known)
    matrix = sparse.csc_array(energy, dtype=np.float64)
    there, elsewhere = matrix[:, unknown], matrix[:, known]
    normal = sparse.csc_array(there.T @ there + SURFACE_RIDGE * sparse.eye_array(len(unknown)))
    flat = shapes.reshape(-1, shapes.shape[2])
    drawn = splu(normal).solve(np.asarray(-(there.T @ (elsewhere @ flat[:, known].T))))
    shapes[:, :, unknown] = drawn.T.reshape(shapes.shape[0], 3, len(unknown))


@dataclass(frozen=True, slots=True, eq=False)
class Kriging:
    """Simple kriging: the conditional mean of a point's path, given its observations and a trend."""

    problem: Problem
    covariance: ShapeCovariance
    translations: Floats

    mean: Floats
    """Covariance of a path with its own mean, C 1 / F, shape `(F,)`."""

    near: Floats
    """Variance of a path's mean about the surface along each axis, shape `(3,)`."""

    @classmethod
    def of(cls, problem: Problem, covariance: ShapeCovariance, translations: Floats) -> Kriging:
        """Compute what all points share."""
        mean = covariance.times(np.full((len(problem.points), 1), 1 / len(problem.points)))[:, 0]
        return cls(problem, covariance, translations, mean, MEAN_VARIANCE_SHARE * (mean.mean() + covariance.axes()[1]))

    @property
    def scatter(self) -> float:
        """Variance of an inlier about its prediction."""
        return max(self.covariance.noise_variance, (MIN_OUTLIER_DISTANCE / 3) ** 2)

    def columns(self, frames: NDArray[np.intp]) -> Floats:
        """Return the covariance over frames of a path about its mean, with the positions in n of them, shape `(F, n)`."""
        unit = np.zeros((len(self.mean), len(frames)))
        unit[frames, np.arange(len(frames))] = 1.0
        return np.asarray(self.covariance.times(unit) - self.mean[frames] - self.mean[:, None] + self.mean.mean())

    def image(self, frames: NDArray[np.intp], columns: Floats) -> Floats:
        """Return Π Σ Πᵀ of n frames, shape `(2n, 2n)`."""
        rows = self.problem.projections[frames].reshape(-1, 3).astype(np.float64)
        moving = np.repeat(np.repeat(columns[frames], 2, axis=0), 2, axis=1)
        return np.asarray((rows @ rows.T) * moving + (rows * self.near) @ rows.T)

    def left(self, point: int, path: Floats) -> Floats:
        """Return the residuals, shape `(F, 2, 1)`, of a point for a path `(F, 3, 1)`."""
        image = np.matmul(self.problem.projections, path) + self.translations[:, :, None]
        return np.asarray(self.problem.points[:, :, point : point + 1] - image, dtype=np.float64)

    def moved(self, point: int, confidence: Floats, trend: Floats) -> Floats:
        """Return the conditional mean path, `(F, 3, 1)`, given a trend and observations with confidence `(F, 1)`."""
        weights, there = self.problem.weights, np.flatnonzero(confidence[:, 0] > 0)
        if len(there) == 0:
            return trend
        off, path, columns = self.left(point, trend)[there].reshape(-1), trend, self.columns(there)
        image, rows = self.image(there, columns), self.problem.projections[there].astype(np.float64)
        for _ in range(PATH_REWEIGHTINGS):
            omega = loss_weights(
                self.left(point, path), confidence, loss=self.problem.loss, scale=weights.robust_scale
            )[there].reshape(-1)
            matrix = image.copy()
            matrix[np.diag_indices_from(matrix)] *= 1 + PATH_RIDGE
            matrix[np.diag_indices_from(matrix)] += weights.temporal / np.maximum(omega, SMALLEST_WEIGHT)
            weighed = linalg.solve(matrix, off, assume_a="pos").reshape(-1, 2)
            pulled = np.einsum("gi,gic->gc", weighed, rows)
            path = trend + (columns @ pulled + self.near * pulled.sum(axis=0))[:, :, None]
        return path

    def inconsistent(self, point: int, confidence: Floats, trend: Floats) -> NDArray[np.intp]:
        """Return the frames whose observations are inconsistent with the point's other observations.

        With K = ΠΣΠᵀ + `scatter` I, y = K⁻¹ r and Bᵢ the 2×2 block of K⁻¹ at observation i, the leave-one-out residual is
        Bᵢ⁻¹ yᵢ, and its squared Mahalanobis length is yᵢᵀ Bᵢ⁻¹ yᵢ (Dubrule 1983).
        """
        off, there = self.left(point, trend)[:, :, 0], np.flatnonzero(confidence[:, 0] > 0)
        image = self.image(there, self.columns(there)).reshape(len(there), 2, len(there), 2)
        while len(there):
            each = np.arange(len(there))
            square = image.reshape(2 * len(there), -1)
            inverse = np.linalg.inv(square + self.scatter * np.eye(len(square)))
            blocks = inverse.reshape(len(there), 2, len(there), 2)[each, :, each]
            weighed = (inverse @ off[there].reshape(-1)).reshape(-1, 2)
            apart = np.linalg.solve(blocks, weighed[:, :, None])[:, :, 0]
            deviation = np.where(np.hypot(*apart.T) > MIN_OUTLIER_DISTANCE, (apart * weighed).sum(axis=1), 0.0)
            worst = int(deviation.argmax())
            if deviation[worst] <= MAX_DEVIATION**2:
                break
            there, image = np.delete(there, worst), np.delete(np.delete(image, worst, axis=0), worst, axis=2)
        return np.setdiff1d(np.flatnonzero(confidence[:, 0] > 0), there)


def _fit_observations(
    kriging: Kriging, shapes: Floats, confidence: Floats, points: NDArray[np.intp], *, spoiled: bool
) -> None:
    """Move points to their observations and set the confidence of gross outliers to 0, both in place."""

    def work(start: int, stop: int) -> None:
        for point in points[start:stop]:
            one = slice(point, point + 1)
            trend = shapes[:, :, one].copy()
            if spoiled:
                confidence[kriging.inconsistent(point, confidence[:, one], trend), point] = 0
            shapes[:, :, one] = kriging.moved(point, confidence[:, one], trend)

    over_ranges(work, len(points), smallest=64)


def _differences(mesh: Mesh) -> Matrix:
    """Return the matrix of x ↦ x_i − x_j along every edge, shape `(E, P)`."""
    edges = mesh.edges
    rows, ones = np.arange(len(edges)), np.ones(len(edges))
    values, places = np.concatenate([ones, -ones]), (np.concatenate([rows, rows]), edges.T.ravel())
    return sparse.csr_array((values, places), shape=(len(edges), mesh.num_points))


def mesh_of(mesh: Mesh, kept: NDArray[np.intp]) -> Mesh:
    """Return the mesh of the points kept, renumbered: a grid with more holes, or the faces with all corners kept."""
    number = np.full(mesh.num_points + 1, -1, dtype=np.int32)  # index −1, a hole, selects the last entry
    number[kept] = np.arange(len(kept))
    if mesh.grid is not None:
        return Mesh.from_grid(number[mesh.grid])
    faces = number[mesh.faces]
    return Mesh.from_faces(faces[(faces >= 0).all(axis=1)], len(kept))
