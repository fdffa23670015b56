"""Baseline minimisers of the solver's energy, as a competent reader of the paper would write them.

Each takes the problem as built by the solver (normalised tracks, cameras, weights λ, Laplacian) and initial shapes, whose cost is not
counted, and runs until the energy is at most `target` or `cap` seconds have passed:

    gradient_descent       the paper's iteration: gradient of eq. 9, exact line search, new L1 weights in every iteration
    conjugate_gradients    SciPy's CG with a Jacobi preconditioner on the explicit sparse normal equations, inside the
                           same reweighting as ours
    direct                 SciPy's sparse LU of the same equations, for sizes where the factor fits
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from pliant.solver.energy.objective import loss_of, prior, residuals_of
from pliant.solver.energy.problem import Problem
from pliant.solver.energy.robust_loss import loss_weights
from pliant.solver.threads import SMALLEST, over_ranges
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg, splu


@dataclass
class Run:
    """History of one baseline."""

    seconds: list[float] = field(default_factory=list)
    objective: list[float] = field(default_factory=list)
    iterations: int = 0
    reached: bool = False

    def note(self, began: float, value: float, target: float) -> bool:
        """Append a sample; return whether the target is reached."""
        self.seconds.append(time.perf_counter() - began)
        self.objective.append(value)
        self.reached = value <= target
        return self.reached


def gradient_descent(
    problem: Problem, shapes: np.ndarray, translations: np.ndarray, *, target: float, cap: float
) -> Run:
    """Steepest descent with exact line search on the reweighted energy.

    Fully vectorised. The smoothness part of the gradient is linear, so its value at the new shapes follows from its value along the step:
    one sparse product per iteration instead of two.
    """
    run, began = Run(), time.perf_counter()
    smooth = _smoothness_gradient(problem)
    rows = problem.projections
    points = problem.points - translations[:, :, None]
    shapes = shapes.copy()
    bend = smooth(shapes)
    image = np.matmul(rows, shapes)
    while run.seconds == [] or run.seconds[-1] < cap:
        left = points - image
        omega = loss_weights(left, problem.confidence, loss=problem.loss, scale=problem.weights.robust_scale)
        gradient = bend - np.matmul(rows.transpose(0, 2, 1), omega * left)
        steep, along = smooth(gradient), np.matmul(rows, gradient)
        curvature = np.vdot(gradient, steep) + np.vdot(along, omega * along)
        step = np.vdot(gradient, gradient) / curvature
        shapes -= step * gradient
        bend -= step * steep
        image -= step * along
        run.iterations += 1
        if run.iterations % 10 == 0 and run.note(began, _energy(problem, shapes, translations), target):
            break
    return run


def conjugate_gradients(
    problem: Problem, shapes: np.ndarray, translations: np.ndarray, *, target: float, cap: float, reduction: float = 0.1
) -> Run:
    """Reweight; solve the explicit normal equations with SciPy's CG, warm-started; repeat."""
    return _reweight(problem, shapes, translations, target=target, cap=cap, inner=_scipy_cg(reduction, cap))


def direct(problem: Problem, shapes: np.ndarray, translations: np.ndarray, *, target: float, cap: float) -> Run:
    """Reweight; factor the explicit normal equations with SuperLU; repeat."""

    def inner(
        fixed: sparse.csr_array, data: sparse.csr_array, right: np.ndarray, _: np.ndarray, run: Run, __: float
    ) -> np.ndarray:
        run.iterations += 1
        try:
            factor = splu((fixed + data).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        except SystemError as error:  # SuperLU's error when memory runs out
            raise MemoryError("the sparse factor does not fit") from error
        return factor.solve(right)

    return _reweight(problem, shapes, translations, target=target, cap=cap, inner=inner)


def normal_matrix(problem: Problem) -> sparse.csr_array:
    """Assemble λ1 HᵀH ⊗ I + λ2 I ⊗ AᵀA, for unknowns in the order frame, coordinate, point."""
    frames, _, points = problem.points.shape
    order, weights = len(problem.bands) - 1, problem.weights
    steps = sparse.csr_array(np.diff(np.eye(frames), n=order, axis=0))
    matrix = sparse.csr_array(
        weights.temporal * sparse.kron(steps.T @ steps, sparse.eye_array(3 * points), format="csr")
    )
    if problem.laplacian is not None and weights.spatial > 0:
        bend = sparse.csr_array(weights.spatial * (problem.laplacian.matrix.T @ problem.laplacian.matrix))
        matrix = matrix + _repeated(bend, 3 * frames)
    return sparse.csr_array(matrix)


def _repeated(block: sparse.csr_array, times: int) -> sparse.csr_array:
    """Return I ⊗ block, as `sparse.kron` but without its coordinate-format intermediate, which needs several times the memory."""
    size, entries = block.shape[0], block.nnz
    kind = np.int32 if times * max(entries, size) < 2**31 else np.int64
    shift = np.arange(times, dtype=kind)[:, None]
    columns = (block.indices.astype(kind)[None] + size * shift).ravel()
    starts = np.append((block.indptr[:-1].astype(kind)[None] + entries * shift).ravel(), kind(times * entries))
    return sparse.csr_array((np.tile(block.data, times), columns, starts), shape=(times * size,) * 2)


def data_matrix(problem: Problem, omega: np.ndarray) -> sparse.csr_array:
    """Assemble s² Rᵀ diag(ω) R: nine entries for every observation."""
    frames, _, points = omega.shape
    blocks = np.einsum("fik,fil,fip->fklp", problem.projections, problem.projections, omega)
    start = (3 * points) * np.arange(frames)[:, None, None, None]
    column = np.arange(points)
    row = np.broadcast_to(start + points * np.arange(3)[:, None, None] + column, blocks.shape)
    col = np.broadcast_to(start + points * np.arange(3)[None, :, None] + column, blocks.shape)
    size = 3 * frames * points
    return sparse.coo_array((blocks.ravel(), (row.ravel(), col.ravel())), shape=(size, size)).tocsr()


Inner = Callable[[sparse.csr_array, sparse.csr_array, np.ndarray, np.ndarray, Run, float], np.ndarray]


def _reweight(
    problem: Problem, shapes: np.ndarray, translations: np.ndarray, *, target: float, cap: float, inner: Inner
) -> Run:
    run, began = Run(), time.perf_counter()
    fixed = normal_matrix(problem)
    points = problem.points - translations[:, :, None]
    while run.seconds == [] or run.seconds[-1] < cap:
        left = _residuals(problem, shapes, translations)
        omega = loss_weights(left, problem.confidence, loss=problem.loss, scale=problem.weights.robust_scale)
        right = np.matmul(problem.projections.transpose(0, 2, 1), omega * points).ravel()
        solved = inner(fixed, data_matrix(problem, omega), right, shapes.ravel(), run, began)
        shapes = solved.reshape(shapes.shape)
        if run.note(began, _energy(problem, shapes, translations), target):
            break
    return run


def _scipy_cg(reduction: float, cap: float) -> Inner:
    def inner(
        fixed: sparse.csr_array, data: sparse.csr_array, right: np.ndarray, start: np.ndarray, run: Run, began: float
    ) -> np.ndarray:
        diagonal = fixed.diagonal() + data.diagonal()
        size = len(right)
        # Two products instead of one: assembling the sum for each reweighting costs more than it saves.
        matrix = LinearOperator((size, size), matvec=lambda x: fixed @ x + data @ x, dtype=right.dtype)
        jacobi = LinearOperator((size, size), matvec=lambda x: x / diagonal, dtype=right.dtype)
        enough = reduction * float(np.linalg.norm(right - matrix @ start))
        latest = start

        def count(x: np.ndarray) -> None:
            nonlocal latest
            run.iterations += 1
            latest = x
            if time.perf_counter() - began > cap:
                raise TimeoutError

        with contextlib.suppress(TimeoutError):  # keep the last iterate and end the run
            latest, _ = cg(matrix, right, x0=start, rtol=0.0, atol=enough, maxiter=2000, M=jacobi, callback=count)
        return latest

    return inner


def _smoothness_gradient(problem: Problem) -> Callable[[np.ndarray], np.ndarray]:
    frames, _, points = problem.points.shape
    order, weights = len(problem.bands) - 1, problem.weights
    steps = np.diff(np.eye(frames), n=order, axis=0)
    temporal = sparse.csr_array(weights.temporal * (steps.T @ steps))
    spatial = None
    if problem.laplacian is not None and weights.spatial > 0:
        spatial = sparse.csr_array(weights.spatial * (problem.laplacian.matrix.T @ problem.laplacian.matrix))

    def apply(shapes: np.ndarray) -> np.ndarray:
        result = (temporal @ shapes.reshape(frames, -1)).reshape(shapes.shape)
        if spatial is not None:
            for row, out in zip(shapes.reshape(-1, points), result.reshape(-1, points), strict=True):
                out += spatial @ row
        return result

    return apply


def _energy(problem: Problem, shapes: np.ndarray, translations: np.ndarray) -> float:
    return _objective(problem, shapes, _residuals(problem, shapes, translations))


def _residuals(problem: Problem, shapes: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Return w − s R x − t, shape `(F, 2, P)`, normalized units; undefined where hidden."""
    left = np.empty_like(problem.points, dtype=shapes.dtype)

    def work(start: int, stop: int) -> None:
        for frame in range(start, stop):
            left[frame] = residuals_of(problem, shapes, translations, frame)

    over_ranges(work, len(shapes), smallest=max(1, SMALLEST // shapes[0].size))
    return left


def _objective(problem: Problem, shapes: np.ndarray, residual: np.ndarray) -> float:
    """Return E = Σ v ρ(r) + λ1 ‖HX‖² + λ2 ‖AX‖² (Dai, Deng, He 2017, eq. 7) + rank penalty."""
    parts = np.zeros(len(shapes))

    def work(start: int, stop: int) -> None:
        for frame in range(start, stop):
            parts[frame] = loss_of(problem, residual[frame], frame)

    over_ranges(work, len(shapes), smallest=max(1, SMALLEST // shapes[0].size))
    return float(parts.sum()) + prior(problem, shapes)
