"""The block-tridiagonal preconditioner: exact over frames for each point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import Mesh, threads_limited
from pliant.solver.linear import block_tridiagonal
from pliant.solver.linear.conjugate_gradient import conjugate_gradient
from pliant.solver.linear.preconditioner import Diagonalised, _by_point, build_preconditioner
from pliant.solver.operators.normal_equations import Operator, RankTerm
from pliant.solver.shapes.irls import init, operator_at
from waving_sheet import sheet, small_problem, triangulated

GRID = sheet()[1]


def operator(mesh: Mesh | None = None, *, frames: int = 6, **settings: object) -> Operator:
    """At random shapes, so that there are many inliers and outliers."""
    problem = small_problem(mesh, frames=frames, prior="smooth", **settings)  # type: ignore[arg-type]
    random = np.random.default_rng(7)
    shapes = random.standard_normal((frames, 3, problem.points.shape[2]))
    return operator_at(problem, init(problem, shapes, np.zeros((frames, 2))))


def dense(apply: object, shape: tuple[int, ...]) -> np.ndarray:
    return np.stack([apply(unit.reshape(shape)).ravel() for unit in np.eye(int(np.prod(shape)))])  # type: ignore[operator]


def test_the_preconditioner_is_the_exact_inverse_without_a_mesh() -> None:
    given = operator(hidden=0.1, temporal_weight=0.7)
    shape = (6, 3, given.weights.shape[2])
    product = dense(lambda x: block_tridiagonal.build(given)(given.apply(x)), shape)
    np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-7)


def test_the_preconditioner_inverts_the_block_of_each_point_with_a_mesh() -> None:
    given = operator(triangulated(GRID), temporal_weight=2.0)
    shape = (6, 3, given.weights.shape[2])
    whole = dense(given.apply, shape).reshape(shape * 2)
    alone = np.zeros_like(whole)
    for point in range(shape[2]):
        alone[:, :, point, :, :, point] = whole[:, :, point, :, :, point]
    size = int(np.prod(shape))
    found = dense(block_tridiagonal.build(given), shape)
    np.testing.assert_allclose(found @ alone.reshape(size, size), np.eye(size), atol=1e-6)


def test_preconditioner_is_symmetric_positive_definite_with_unseen_points() -> None:
    given = operator(hidden=0.3, temporal_weight=0.7)
    given.weights[:, :, 5] = 0
    matrix = dense(block_tridiagonal.build(given), (6, 3, given.weights.shape[2]))
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-6, atol=1e-9)
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_blocks_of_points_and_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    given = operator(temporal_weight=0.7)
    r = np.random.default_rng(1).standard_normal((6, 3, given.weights.shape[2]))
    whole = block_tridiagonal.build(given)(r)
    monkeypatch.setattr(block_tridiagonal, "POINTS_PER_BLOCK", 10)
    with threads_limited(2):
        np.testing.assert_array_equal(block_tridiagonal.build(given)(r), whole)


def test_individual_weights_need_fewer_iterations_than_mean_weights() -> None:
    """The purpose of the preconditioner: mean weights need more, although each costs a product over frames."""
    given = operator(triangulated(GRID), frames=20, temporal_weight=30.0, spatial_weight=0.009, robust_scale=0.004)
    b = np.random.default_rng(2).standard_normal((20, 3, given.weights.shape[2]))
    mean = Diagonalised.of(given, b.dtype)

    def iterations(precondition: object) -> int:
        return conjugate_gradient(
            given.apply, b.copy(), precondition=precondition, reduction=1e-4, max_iterations=500  # type: ignore[arg-type]
        ).iterations  # fmt: skip

    exact, uniform = (
        iterations(block_tridiagonal.build(given)),
        iterations(lambda r, out=None: _by_point(r, mean, np.zeros(1))),
    )
    assert 1 < exact < 0.7 * uniform


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"temporal_weight": 30.0, "spatial_weight": 0.009}, True),
        ({"temporal_weight": 1e-3, "spatial_weight": 1.0}, True),  # the paper's: with levels beside it
        ({"temporal_weight": 30.0, "spatial_weight": 0.0}, True),
        ({"temporal_weight": 0.0, "spatial_weight": 0.0}, False),
        ({"temporal_weight": 30.0, "spatial_weight": 0.009, "temporal_order": 2}, False),
    ],
)
@pytest.mark.parametrize("mesh", [Mesh.from_grid(GRID), triangulated(GRID)], ids=["grid", "triangles"])
def test_it_applies_where_only_neighbouring_frames_are_coupled(
    mesh: Mesh, settings: dict[str, object], expected: bool
) -> None:
    assert block_tridiagonal.fits(operator(mesh, **settings)) is expected


def test_it_does_not_apply_with_a_rank_term() -> None:
    given = operator(temporal_weight=30.0)
    term = RankTerm(1.0, np.eye(6)[:, :2], np.array([0.5, 0.4]))
    assert block_tridiagonal.fits(given)
    assert not block_tridiagonal.fits(replace(given, rank=term))
    r = np.ones((6, 3, given.weights.shape[2]))
    np.testing.assert_array_equal(build_preconditioner(given)(r), block_tridiagonal.build(given)(r))
