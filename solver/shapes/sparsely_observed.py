"""Points that are seldom or never seen: left out of the minimisation, then drawn along the surface and moved to what was seen of them.

Hardly anything holds such a point but its prior, which says that it is somewhere about the middle, and its neighbours. In the
minimisation it would go where those want it at the pace of diffusion, and wherever a patch of such points lies the prior would win:
it takes every point by itself. Therefore in two steps, from the shapes of the points that are seen often enough:

- the surface is closed: among all positions of the others, those of least ‖A X‖² + μ Σ ‖x_i − x_j‖², the second sum over edges: a thin
  plate through their neighbours, under a little tension, for a plate alone that hangs on an edge goes on at its slope without end;
- what was seen of a point, if anything, moves it off the plate. About its mean position its path has the learned covariance; the mean is
  near the plate and not just anywhere in the body. With Σ for both, and K = ΠΣΠᵀ + diag(λ1/ω) over its observations r, it is moved by
  the conditional mean Σ Πᵀ K⁻¹ r: kriging, the plate for its trend (Cressie, Statistics for Spatial Data, 1993, section 3.4). It meets
  what was seen and follows the modes of the body elsewhere.

Where the tracks have gross outliers, those of such a point are found first, one after the other: the observation that is the least
probable given the others of its point, from the closed form of leaving one out (Dubrule, "Cross validation of kriging in a unique
neighborhood", 1983). Of four observations one that is an outlier bends any fit to all of them; it does not bend the one without it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.energy.problem import Problem
from pliant.solver.energy.robust_loss import loss_weights
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.operators.mesh_laplacian import Matrix
from pliant.solver.records import MIN_POINTS, Floats, Mesh
from pliant.solver.shapes.irls import init
from pliant.solver.shapes.outlier_rejection import GROSS
from pliant.solver.shapes.state import State
from pliant.solver.threads import over_ranges
from pliant.solver.tracks.normalization import Normalised
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

SELDOM = 0.25
"""A point is seldom seen below this share of the frames. Measured on turning bodies: .15 to .35 alike."""

MOST = 0.5
"""Where more of the points are seldom seen, tracks come and go, and all of them are needed together."""

TENSION = 1.0
"""μ: felt beyond some three rings of neighbours. Measured on four bodies: 1 to 10 alike; at .01 patches hung on an edge fly off."""

LOOSE = 1e-6
"""Ridge beside AᵀA, whose diagonal is about 150: points that hang on nothing stay in the middle."""

ROUNDING = 1e-10
"""Share added to the diagonal of K, against rounding."""

TINY = float(np.finfo(np.float64).tiny)

ROUNDS = 3
"""Reweightings of the deviations."""

DOUBT = 5.0
"""Standard deviations beyond which an observation does not belong to the others of its point, if it is further than `GROSS` from where
they expect it. Measured, 6 % outliers, known cameras, three draws: animated head .103, .095, .103 with a fit to all of them, .068, .057,
.056 without those in doubt; galloping horse .248, .273, .350, and .058, .061, .058. At 6 head .059, .057, .056, horse .058, .064, .065."""

NEAR = 0.1
"""Share of the variance of the body's mean positions that a point's has off the plate. With all of it the little that was seen of a
point may put its depth anywhere, as far as noise carries it. Measured, all against this share: noise of .01, known cameras, galloping
horse .104 → .072, animated head .0741 → .0655, speaking head .0313 → .0282, dancer .152 → .150; clean, estimated cameras, .0562 → .0537,
.0519 → .0524, .0221 → .0222, .124 → .122. With .3 noise costs horse .083 and head .067, with .03 .072 and .072. What the modes hold of the
mean counts as such: estimated cameras leave much of it to them."""


@dataclass(frozen=True, slots=True, eq=False)
class OftenSeen:
    """The points that are seen often enough, as a sequence of their own."""

    normalised: Normalised
    mesh: Mesh
    """Faces, or cells of the grid, whose corners are all among them."""

    kept: NDArray[np.intp]
    """Which points they are, ascending."""

    pull: Matrix
    """√μ times the differences along the edges of the whole surface, shape `(E, P)`."""


def often_seen(normalised: Normalised, mesh: Mesh | None) -> OftenSeen | None:
    """Return the points that are seen often enough; None if that is all, hardly any, or if there is no surface to draw the rest on."""
    if mesh is None or (len(mesh.faces) == 0 and mesh.grid is None):
        return None
    count = normalised.visible.shape[1]
    kept = np.flatnonzero((normalised.visible > 0).mean(axis=0) >= SELDOM)
    if len(kept) == count or len(kept) < max(MIN_POINTS, (1 - MOST) * count):
        return None
    part = Normalised(normalised.points[:, kept], normalised.visible[:, kept], normalised.centroid, normalised.unit)
    return OftenSeen(part, _mesh_of(mesh, kept), kept, TENSION**0.5 * _differences(mesh))


def draw_the_rest(
    part: OftenSeen, problem: Problem, covariance: ShapeCovariance, state: State, *, spoiled: bool = False
) -> tuple[Problem, State]:
    """Return the problem without gross outliers and the state of all points, its energy and counts those of the points of the part.

    Parameters
    ----------
    part : OftenSeen
        Which points have been found.
    problem : Problem
        Of all points, with the Gaussian prior of `covariance`.
    covariance : ShapeCovariance
        Σ of the paths.
    state : State
        Of the points of the part.
    spoiled : bool
        Whether there are gross outliers to leave out.
    """
    shapes = np.zeros((len(problem.points), 3, problem.points.shape[2]))
    shapes[:, :, part.kept] = state.shapes
    seen = np.flatnonzero((problem.confidence > 0).any(axis=0))
    energy = part.pull if problem.laplacian is None else sparse.vstack([problem.laplacian.matrix, part.pull])
    close_surface(shapes, part.kept, energy)
    confidence = problem.confidence.astype(np.float64)
    kriging = Kriging.of(problem, covariance, state.translations)
    _meet_what_was_seen(kriging, shapes, confidence, np.setdiff1d(seen, part.kept), spoiled=spoiled)
    problem = replace(problem, confidence=confidence)
    if len(seen) < problem.points.shape[2]:
        close_surface(shapes, seen, energy)
    whole = init(problem, shapes.astype(problem.points.dtype), state.translations)
    return problem, replace(
        whole, objective=state.objective, reweighting=state.reweighting, iterations=state.iterations
    )


def close_surface(shapes: Floats, known: NDArray[np.intp], energy: Matrix) -> None:
    """Put all other points where ‖E X‖² is least.

    Parameters
    ----------
    shapes : array, shape (F, 3, P)
        Right at the known points; the others are written to.
    known : array of int
        Which points are known.
    energy : sparse array, shape (R, P)
        E: A, and what is to be small besides.
    """
    unknown = np.setdiff1d(np.arange(shapes.shape[2]), known)
    matrix = sparse.csc_array(energy, dtype=np.float64)
    there, elsewhere = matrix[:, unknown], matrix[:, known]
    normal = sparse.csc_array(there.T @ there + LOOSE * sparse.eye_array(len(unknown)))
    flat = shapes.reshape(-1, shapes.shape[2])
    drawn = splu(normal).solve(np.asarray(-(there.T @ (elsewhere @ flat[:, known].T))))
    shapes[:, :, unknown] = drawn.T.reshape(shapes.shape[0], 3, len(unknown))


@dataclass(frozen=True, slots=True, eq=False)
class Kriging:
    """The conditional mean of one point's path, given what was seen of it and a trend."""

    problem: Problem
    translations: Floats

    reach: Floats
    """Σ Πᵀ: what an observation, frame and image axis, says of the path, shape `(3F, 2F)`."""

    image: Floats
    """Π Σ Πᵀ, shape `(2F, 2F)`."""

    scatter: float
    """Variance of what belongs where it is expected: of noise, and of what is not gross."""

    @classmethod
    def of(cls, problem: Problem, covariance: ShapeCovariance, translations: Floats) -> Kriging:
        """Multiply the covariances out, once for all points."""
        frames, rows = len(problem.points), problem.projections.astype(np.float64)
        moving = covariance.over_frames()
        near = NEAR * (moving.mean() + covariance.axes()[1])
        moving = moving - moving.mean(axis=0) - moving.mean(axis=1)[:, None] + moving.mean()  # about a path's mean
        each = moving + near[:, None, None]
        reach = np.einsum("gic,cfg->fcgi", rows, each).reshape(3 * frames, 2 * frames)
        image = np.einsum("fic,fcm->fim", rows, reach.reshape(frames, 3, -1)).reshape(2 * frames, 2 * frames)
        return cls(problem, translations, reach, image, max(covariance.noise, (GROSS / 3) ** 2))

    def left(self, point: int, path: Floats) -> Floats:
        """Return the residuals of a path `(F, 3, 1)`, shape `(F, 2, 1)`."""
        image = np.matmul(self.problem.projections, path) + self.translations[:, :, None]
        return np.asarray(self.problem.points[:, :, point : point + 1] - image, dtype=np.float64)

    def moved(self, point: int, confidence: Floats, trend: Floats) -> Floats:
        """Return the path, `(F, 3, 1)`, of the trend and the observations of some confidence `(F, 1)`."""
        weights = self.problem.weights
        there = np.repeat(confidence[:, 0] > 0, 2)
        if not there.any():
            return trend
        off, path = self.left(point, trend).reshape(-1)[there], trend
        for _ in range(ROUNDS):
            omega = loss_weights(
                self.left(point, path), confidence, loss=self.problem.loss, scale=weights.robust_scale
            ).reshape(-1)[there]
            matrix = self.image[np.ix_(there, there)]
            matrix[np.diag_indices_from(matrix)] *= 1 + ROUNDING
            matrix[np.diag_indices_from(matrix)] += weights.temporal / np.maximum(omega, TINY)
            path = trend + (self.reach[:, there] @ linalg.solve(matrix, off, assume_a="pos")).reshape(trend.shape)
        return path

    def doubtful(self, point: int, confidence: Floats, trend: Floats) -> NDArray[np.intp]:
        """Return the frames whose observations do not belong to the others of the point.

        With K = ΠΣΠᵀ + scatter, y = K⁻¹ r and Bᵢ the 2×2 block of K⁻¹ at observation i, the others expect it Bᵢ⁻¹ yᵢ from
        where it is, and the square of the standard deviations between is yᵢᵀ Bᵢ⁻¹ yᵢ.
        """
        off, there = self.left(point, trend)[:, :, 0], np.flatnonzero(confidence[:, 0] > 0)
        while len(there):
            rows = np.stack([2 * there, 2 * there + 1], axis=1).ravel()
            each = np.arange(len(there))
            inverse = np.linalg.inv(self.image[np.ix_(rows, rows)] + self.scatter * np.eye(len(rows)))
            blocks = inverse.reshape(len(there), 2, len(there), 2)[each, :, each]
            weighed = (inverse @ off[there].reshape(-1)).reshape(-1, 2)
            apart = np.linalg.solve(blocks, weighed[:, :, None])[:, :, 0]
            doubt = np.where(np.hypot(*apart.T) > GROSS, (apart * weighed).sum(axis=1), 0.0)
            worst = int(doubt.argmax())
            if doubt[worst] <= DOUBT**2:
                break
            there = np.delete(there, worst)
        return np.setdiff1d(np.flatnonzero(confidence[:, 0] > 0), there)


def _meet_what_was_seen(
    kriging: Kriging, shapes: Floats, confidence: Floats, points: NDArray[np.intp], *, spoiled: bool
) -> None:
    """Move some points of the shapes to their observations, in place; gross outliers lose their confidence, in place, too."""

    def work(start: int, stop: int) -> None:
        for point in points[start:stop]:
            one = slice(point, point + 1)
            trend = shapes[:, :, one].copy()
            if spoiled:
                confidence[kriging.doubtful(point, confidence[:, one], trend), point] = 0
            shapes[:, :, one] = kriging.moved(point, confidence[:, one], trend)

    over_ranges(work, len(points), smallest=64)


def _differences(mesh: Mesh) -> Matrix:
    """Return x ↦ x_i − x_j along every edge, shape `(E, P)`."""
    edges = mesh.edges
    rows, ones = np.arange(len(edges)), np.ones(len(edges))
    values, places = np.concatenate([ones, -ones]), (np.concatenate([rows, rows]), edges.T.ravel())
    return sparse.csr_array((values, places), shape=(len(edges), mesh.num_points))


def _mesh_of(mesh: Mesh, kept: NDArray[np.intp]) -> Mesh:
    """Return the mesh of the kept points, numbered anew: a grid with more holes, or the faces that are left."""
    number = np.full(mesh.num_points + 1, -1, dtype=np.int32)  # the last entry stands for −1, a hole
    number[kept] = np.arange(len(kept))
    if mesh.grid is not None:
        return Mesh.from_grid(number[mesh.grid])
    faces = number[mesh.faces]
    return Mesh.from_faces(faces[(faces >= 0).all(axis=1)], len(kept))
