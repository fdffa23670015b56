"""Refinement of depths so that edges keep their lengths from frame to frame.

Minimise Σ_fe ρ(√w_fe (b_fe ‖x_fi − x_fj‖ − l_e)) over log depths ζ and edge lengths l, x_fi = exp(ζ_fi) r_fi, with weights w from the
confidences of i and j. b is the length along the surface relative to the distance of the ends (`arc_lengths`), 1 unless known. ρ is the
soft-L1 loss ε² (√(1 + (r/ε)²) − 1), which limits the influence of observations that do not move with the surface. Σ l_e is kept constant,
which fixes the free scale. Gauss–Newton steps with Levenberg–Marquardt damping. Only the lengths couple the frames, so the depths of each
frame are eliminated from the normal equations (Triggs et al., "Bundle Adjustment – A Modern Synthesis", 2000, section 6.1), and conjugate
gradients solve the reduced equations of the lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.isometry.inextensible import SurfaceGraph
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

CONVERGED = 1e-4
"""Relative decrease of the objective below which refinement ends."""

EASE = 0.75
"""ε, the residual at which the loss turns from L2 to L1, relative to the median |residual| at the start."""

MIN_EASE = 1e-4
"""Minimum ε relative to the mean edge length: exact data are fitted by plain least squares."""

MOST_DAMPED = 1e4
"""Maximum damping relative to the diagonal; if no step with less lowers the cost, refinement ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Isometry:
    """Depths, edge lengths, and their inconsistency."""

    depths: Floats
    """Shape `(F, A)`; 0 where hidden."""

    lengths: Floats
    """l_e, shape `(E,)`, the depths' unit; 0 where the ends are never visible together."""

    inconsistency: float
    """I = Σ |L_fe − median_f L_e| / Σ L_fe."""


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """One iterate."""

    log_depths: Floats
    lengths: Floats
    residuals: Floats
    jacobian: sparse.csr_matrix
    cost: float


def edge_lengths(graph: SurfaceGraph, depths: Floats) -> Floats:
    """Return L_fe = b_fe ‖x_fi − x_fj‖, shape `(F, E)`, NaN where an end is hidden."""
    points = depths[..., None] * graph.rays
    lengths = np.linalg.norm(points[:, graph.edges[:, 0]] - points[:, graph.edges[:, 1]], axis=2)
    if graph.arc_ratios is not None:
        lengths = graph.arc_ratios * lengths
    return np.where(graph.seen[:, graph.edges[:, 0]] & graph.seen[:, graph.edges[:, 1]], lengths, np.nan)


def typical(lengths: Floats) -> Floats:
    """Return the median over frames of lengths `(F, E)`, ignoring NaN; 0 for edges that are never visible."""
    result = np.zeros(lengths.shape[1])
    ever = np.isfinite(lengths).any(axis=0)
    result[ever] = np.nanmedian(lengths[:, ever], axis=0)
    return result


def inconsistency(lengths: Floats) -> float:
    """Return I = Σ |L_fe − median_f L_e| / Σ L_fe over the edges visible in two or more frames; infinite if there are none."""
    used = lengths[:, np.isfinite(lengths).sum(axis=0) >= 2]
    total = float(np.nansum(used))
    return float(np.nansum(np.abs(used - typical(used)))) / total if total > 0 else float("inf")


def residuals(graph: SurfaceGraph, log_depths: Floats, lengths: Floats) -> tuple[Floats, sparse.csr_matrix]:
    """Return √w (b ‖x_fi − x_fj‖ − l_e) of every pair `(N,)`, and its Jacobian `(N, O + E)` in O visible log depths and E lengths.

    Parameters
    ----------
    graph : SurfaceGraph
        F frames of A points.
    log_depths : shape (O,)
        ζ of the visible observations, frame by frame.
    lengths : shape (E,)
        l_e.
    """
    frame, edge = graph.pairs
    first, second = graph.ends
    points = np.exp(log_depths)[:, None] * graph.rays[graph.seen]
    apart = points[first] - points[second]
    if graph.arc_ratios is not None:
        apart *= graph.arc_ratios[frame, edge, None]
    length = np.maximum(np.linalg.norm(apart, axis=1), np.finfo(np.float64).tiny)
    along = apart / length[:, None]
    if graph.arc_ratios is not None:
        along *= graph.arc_ratios[frame, edge, None]
    towards = (np.einsum("ni,ni->n", along, points[first]), -np.einsum("ni,ni->n", along, points[second]))
    row, root = np.arange(len(edge)), np.sqrt(graph.weights)
    values = np.concatenate([root * each for each in (*towards, -np.ones(len(edge)))])
    columns = np.concatenate([first, second, len(log_depths) + edge])
    size = (len(edge), len(log_depths) + len(lengths))
    return root * (length - lengths[edge]), sparse.csr_matrix((values, (np.tile(row, 3), columns)), shape=size)


def refine(graph: SurfaceGraph, depths: Floats, *, iterations: int = 30, should_stop: ShouldStop = never) -> Isometry:
    """Return depths with nearly constant edge lengths, close to the given ones.

    Parameters
    ----------
    graph : SurfaceGraph
        Must have at least one visible edge.
    depths : shape (F, A)
        Starting depths, positive where visible.
    iterations : int
        Maximum number of Gauss–Newton steps.
    should_stop : callable, optional
        Called between steps; once it returns True, the best depths so far are returned.
    """
    lengths = typical(edge_lengths(graph, depths))
    floor = 1e-6 * float(depths.max())
    log_depths = np.log(np.maximum(depths[graph.seen], floor))
    ease = ease_of(residuals(graph, log_depths, lengths)[0], lengths)
    here, damping = _at(graph, log_depths, lengths, ease), 1e-3
    for _ in range(iterations):
        if should_stop():
            break
        after, damping = _lower(graph, here, damping, ease)
        if after is None:
            break
        settled = here.cost - after.cost <= CONVERGED * here.cost
        here = after
        if settled:
            break
    found = np.zeros(depths.shape)
    found[graph.seen] = np.exp(here.log_depths)
    return Isometry(found, here.lengths, inconsistency(edge_lengths(graph, found)))


def _at(graph: SurfaceGraph, log_depths: Floats, lengths: Floats, ease: float) -> _Point:
    left, jacobian = residuals(graph, log_depths, lengths)
    return _Point(log_depths, lengths, left, jacobian, float(losses_of(left, ease).sum()))


def ease_of(left: Floats, lengths: Floats) -> float:
    """Return ε of the loss for the residuals at the start."""
    return max(EASE * float(np.median(np.abs(left))), MIN_EASE * float(lengths[lengths > 0].mean()))


def losses_of(left: Floats, ease: float) -> Floats:
    """Return ρ of every residual."""
    return np.asarray(ease**2 * (np.hypot(1.0, left / ease) - 1))


def weights_of(left: Floats, ease: float) -> Floats:
    """Return the weight of every residual in the least squares that replace ρ."""
    return np.asarray(1 / np.hypot(1.0, left / ease))


def _lower(graph: SurfaceGraph, here: _Point, damping: float, ease: float) -> tuple[_Point | None, float]:
    """Return the next iterate of lower cost, or None if no step lowers it, and the damping of the next step."""
    weighted = sparse.csr_matrix(sparse.diags(weights_of(here.residuals, ease)) @ here.jacobian)
    normal = (here.jacobian.T @ weighted).tocsr()
    gradient = weighted.T @ here.residuals
    factor = 0.1  # 1 after a failed step, so that the damping that succeeds is kept
    while damping <= MOST_DAMPED:
        move = gauss_newton_step(graph, normal, gradient, damping)
        log_depths = here.log_depths + move[: len(here.log_depths)]
        lengths = here.lengths + move[len(here.log_depths) :]
        total = float(lengths.sum())
        if total > 0:  # back to the scale of the start
            scale = float(here.lengths.sum()) / total
            with np.errstate(over="ignore", invalid="ignore"):  # depths too large to be represented are no decrease
                after = _at(graph, log_depths + np.log(scale), lengths * scale, ease)
            if after.cost < here.cost:
                return after, max(factor * damping, 1e-8)
        damping, factor = 10 * damping, 1.0
    return None, damping


def gauss_newton_step(graph: SurfaceGraph, normal: sparse.csr_matrix, gradient: Floats, damping: float) -> Floats:
    """Solve (N + damping · diag N) x = −g for x of shape `(O + E,)`; 1e-12 of the largest entry is added to the diagonal.

    Depths are eliminated exactly, frame by frame, and lengths found by conjugate gradients, to a relative residual of 1e-3. With the damped
    blocks A of the depths and D of the lengths (diagonal), and B between them, the lengths solve (D − BᵀA⁻¹B) l = BᵀA⁻¹g_ζ − g_l.
    """
    diagonal = normal.diagonal()
    diagonal += damping * diagonal + 1e-12 * float(diagonal.max())
    count = int(graph.seen.sum())
    between, weights = normal[:count, count:], diagonal[count:]
    across = between.T.tocsr()
    inverse = np.linalg.inv(blocks_of(graph, normal[:count, :count], diagonal[:count]))

    def eliminated(right: Floats) -> Floats:
        wide = np.zeros(graph.seen.shape)
        wide[graph.seen] = right
        return np.asarray((inverse @ wide[:, :, None])[:, :, 0][graph.seen])

    def multiply(x: Floats) -> Floats:
        return np.asarray(weights * x - across @ eliminated(between @ x))

    shape = (len(weights), len(weights))
    reduced = LinearOperator(shape, matvec=multiply, dtype=np.float64)
    scaled = LinearOperator(shape, matvec=lambda x: x / weights, dtype=np.float64)
    lengths, _ = cg(reduced, across @ eliminated(gradient[:count]) - gradient[count:], rtol=1e-3, maxiter=100, M=scaled)
    return np.concatenate([-eliminated(gradient[:count] + between @ lengths), lengths])


def blocks_of(graph: SurfaceGraph, depths: sparse.csr_matrix, diagonal: Floats) -> Floats:
    """Return the block of every frame, shape `(F, A, A)`, from the equations of the visible depths; 1 on the diagonal of hidden ones."""
    frames, anchors = graph.seen.shape
    frame, anchor = np.nonzero(graph.seen)
    entries = depths.tocoo()
    blocks = np.zeros((frames, anchors, anchors))
    blocks[:, np.arange(anchors), np.arange(anchors)] = 1.0
    blocks[frame[entries.row], anchor[entries.row], anchor[entries.col]] = entries.data
    blocks[frame, anchor, anchor] = diagonal
    return blocks
