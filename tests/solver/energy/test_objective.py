"""The energy and its normal equations against dense twins and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import Mesh
from pliant.solver.energy import low_rank
from pliant.solver.energy.problem import Problem
from pliant.solver.linear import block_tridiagonal
from pliant.solver.model.random_walk import walk_bands
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.mesh_laplacian import build_laplacian
from pliant.solver.shapes.irls import init, inner_precision, no_higher, operator_at, step
from pliant.solver.shapes.state import State
from waving_sheet import sheet, small_problem, triangulated, with_weights

GRID = sheet()[1]
HOLED = np.where((GRID % 9 == 4) & (GRID > 18) & (GRID < 45), -1, GRID)


def renumbered(grid: np.ndarray) -> np.ndarray:
    """Renumber the remaining cells without gaps."""
    result = np.full(grid.shape, -1)
    result[grid >= 0] = np.arange((grid >= 0).sum())
    return result


MESHES = {"none": None, "grid": Mesh.from_grid(GRID), "triangles": triangulated(GRID)}


def started(problem: Problem, seed: int = 3) -> State:
    random = np.random.default_rng(seed)
    frames, _, count = problem.points.shape
    return init(problem, random.standard_normal((frames, 3, count)), 0.1 * random.standard_normal((frames, 2)))


def dense_energy(problem: Problem, shapes: np.ndarray, translations: np.ndarray) -> float:
    """Eq. 7 by its definition, loop by loop."""
    w, total = problem.weights, 0.0
    for f in range(len(shapes)):
        for p in range(shapes.shape[2]):
            r = problem.points[f, :, p] - problem.projections[f] @ shapes[f, :, p] - translations[f]
            v = problem.confidence[f, p]
            if problem.loss == "l2":
                total += v * (r @ r)
            elif problem.loss == "l1":
                total += v * sum(np.sqrt(c * c + w.robust_scale**2) - w.robust_scale for c in r)
            else:
                size = np.linalg.norm(r)
                total += v * (size**2 if size <= w.robust_scale else 2 * w.robust_scale * size - w.robust_scale**2)
    h = np.diff(np.eye(len(shapes)), n=w.order, axis=0)
    total += w.temporal * (np.einsum("gf,fcp->gcp", h, shapes) ** 2).sum()
    if problem.laplacian is not None:
        total += w.spatial * ((shapes @ problem.laplacian.matrix.toarray().T) ** 2).sum()
    if w.low_rank > 0:
        count = shapes.shape[2]
        values = np.linalg.svd(shapes.reshape(len(shapes), -1), compute_uv=False) ** 2 / count
        total += (
            w.low_rank
            * count
            * sum(
                g / low_rank.RANK_FLOOR if g < low_rank.RANK_FLOOR else 1 + np.log(g / low_rank.RANK_FLOOR)
                for g in values
            )
        )
    return total


@pytest.mark.parametrize("loss", ["l1", "l2", "huber"])
@pytest.mark.parametrize("mesh", MESHES)
def test_energy_is_equation_7_summed_one_by_one(monkeypatch: pytest.MonkeyPatch, mesh: str, loss: str) -> None:
    monkeypatch.setattr(low_rank, "RANK_FLOOR", 0.4)
    problem = with_weights(small_problem(MESHES[mesh], loss=loss, temporal_order=2), low_rank=0.01)
    state = started(problem)
    np.testing.assert_allclose(state.objective, dense_energy(problem, state.shapes, state.translations), rtol=1e-12)


@pytest.mark.parametrize("loss", ["l1", "l2", "huber"])
@pytest.mark.parametrize("mesh", MESHES)
def test_normal_equations_give_the_gradient(monkeypatch: pytest.MonkeyPatch, mesh: str, loss: str) -> None:
    monkeypatch.setattr(low_rank, "RANK_FLOOR", 0.4)
    problem = replace(with_weights(small_problem(MESHES[mesh], loss=loss), low_rank=0.01), moving=False)
    state = started(problem)
    operator = operator_at(problem, state)
    target = problem.points - state.translations[:, :, None]
    gradient = 2 * (operator.apply(state.shapes) - operator.right_hand_side(target))
    along = np.random.default_rng(5).standard_normal(gradient.shape)
    size = 1e-5

    def energy(shapes: np.ndarray) -> float:
        return init(problem, shapes, state.translations).objective

    slope = (energy(state.shapes + size * along) - energy(state.shapes - size * along)) / (2 * size)
    np.testing.assert_allclose(np.vdot(gradient, along), slope, rtol=1e-6)


@pytest.mark.parametrize("loss", ["l1", "l2", "huber"])
@pytest.mark.parametrize("mesh", MESHES)
def test_energy_never_rises_and_ends_where_the_gradient_vanishes(
    monkeypatch: pytest.MonkeyPatch, mesh: str, loss: str
) -> None:
    monkeypatch.setattr(low_rank, "RANK_FLOOR", 0.05)
    problem = with_weights(small_problem(MESHES[mesh], loss=loss), low_rank=0.01)
    state = started(problem)
    first = gradient_norm(problem, state)
    for _ in range(60):
        after = step(problem, state)
        assert after.objective <= state.objective * (1 + 1e-12)
        state = after
    assert gradient_norm(problem, state) < 1e-3 * first


def gradient_norm(problem: Problem, state: State) -> float:
    operator = operator_at(problem, state)
    target = problem.points - state.translations[:, :, None]
    return float(np.linalg.norm(operator.apply(state.shapes) - operator.right_hand_side(target)))


@pytest.mark.parametrize("mesh", [*MESHES.values(), Mesh.from_grid(renumbered(HOLED))], ids=[*MESHES, "holed"])
def test_conjugate_gradients_reach_the_dense_solution(mesh: Mesh | None, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = (
        small_problem(mesh, hidden=0.1, method="spatio_temporal")
        if mesh is None or mesh.num_points == 63
        else holed(mesh)
    )
    state = started(problem)
    operator = operator_at(problem, state)
    size = state.shapes.size
    matrix = np.stack([operator.apply(e.reshape(state.shapes.shape)).ravel() for e in np.eye(size)])
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    b = operator.right_hand_side(problem.points - state.translations[:, :, None])
    exact = np.linalg.solve(matrix, b.ravel())
    monkeypatch.setattr("pliant.solver.shapes.irls.MAX_INNER", 2000)
    found = step(problem, replace(state, reduction=1e-12)).shapes
    centred = exact.reshape(found.shape) - exact.reshape(found.shape).mean(axis=2, keepdims=True)
    np.testing.assert_allclose(found, centred, atol=1e-7)


def holed(mesh: Mesh) -> Problem:
    whole = small_problem(None, hidden=0.1, method="spatio_temporal")
    keep = HOLED.ravel() >= 0
    return replace(
        with_weights(whole, spatial=0.02),
        points=np.ascontiguousarray(whole.points[..., keep]),
        confidence=np.ascontiguousarray(whole.confidence[:, keep]),
        laplacian=build_laplacian(mesh, "auto"),
    )


@pytest.mark.parametrize("mesh", MESHES)
def test_corrections_in_single_precision_lead_to_the_same_energy(mesh: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = small_problem(MESHES[mesh], hidden=0.1, prior="smooth", temporal_weight=30.0, spatial_weight=0.009)

    def descended() -> State:
        state = started(problem)
        for _ in range(25):
            state = no_higher(state, step(problem, state))
        return state

    single = descended()
    monkeypatch.setattr(block_tridiagonal, "SINGLE_SPAN", 0.0)
    double = descended()
    assert single.shapes.dtype == np.float64
    assert not np.array_equal(single.shapes, double.shapes)  # otherwise single precision was not used
    np.testing.assert_allclose(single.objective, double.objective, rtol=1e-6)


def test_single_precision_is_used_where_it_reaches_the_tolerance() -> None:
    problem = small_problem(MESHES["triangles"], prior="smooth", temporal_weight=30.0, spatial_weight=0.009)
    given = operator_at(problem, started(problem))
    assert inner_precision(given, 0.1) == np.float32
    assert inner_precision(given, 1e-6) == np.float64
    assert inner_precision(replace(given, weights=1e8 * given.weights), 0.1) == np.float64
    assert inner_precision(given.rounded(np.dtype(np.float32)), 1e-6) == np.float32
    prior = PathPrior.of(walk_bands(4, ordered=True)[0], (np.ones((4, 1)),) * 3)
    assert inner_precision(replace(given, quadratic=prior), 0.1) == np.float64
