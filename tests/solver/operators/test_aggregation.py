"""Coarser levels by aggregation, and the additive multilevel preconditioner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver import KnownCamera, Mesh, Settings, gallery, solve
from pliant.solver.linear import preconditioner
from pliant.solver.linear.preconditioner import bends, build_preconditioner
from pliant.solver.operators.aggregation import COARSEST, build_levels
from pliant.solver.operators.mesh_laplacian import Laplacian, build_laplacian
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.shapes.irls import init, operator_at
from waving_sheet import sheet, small_problem, triangulated

ROWS, COLUMNS = 24, 30
WIDE = triangulated(sheet(1, ROWS, COLUMNS)[1])
PAPER = {"prior": "smooth", "temporal_weight": 1e-3, "spatial_weight": 1.0, "robust_scale": 1e-3}


def laplacian(mesh: Mesh = WIDE) -> Laplacian:
    built = build_laplacian(mesh, "uniform")
    assert built is not None
    return built


def operator(mesh: Mesh) -> Operator:
    problem = small_problem(mesh, frames=3, hidden=0.1, **PAPER)  # type: ignore[arg-type]
    random = np.random.default_rng(7)
    shapes = 0.1 * random.standard_normal((3, 3, problem.points.shape[2]))
    return operator_at(problem, init(problem, shapes, np.zeros((3, 2))))


def test_levels_shrink_quickly_and_represent_constants() -> None:
    levels, constant = laplacian().levels, np.ones(ROWS * COLUMNS)
    sizes = [ROWS * COLUMNS, *(len(level.bending) for level in levels)]
    assert len(levels) >= 2
    assert sizes[-1] <= COARSEST
    for level, before, after in zip(levels, sizes[:-1], sizes[1:], strict=True):
        assert level.up.shape == (before, after)
        assert after < before / 4
        np.testing.assert_array_equal(level.down.toarray(), level.up.toarray().T)
        np.testing.assert_allclose(level.mean.sum(axis=1), 1)
        coarse = np.linalg.lstsq(level.up.toarray(), constant, rcond=None)[0]
        np.testing.assert_allclose(level.up @ coarse, constant, atol=1e-9)  # otherwise a constant would bend
        constant = coarse


def test_columns_have_unit_length_and_match_the_stored_bending() -> None:
    built = laplacian()
    whole = np.eye(ROWS * COLUMNS)
    for level in built.levels:
        whole = whole @ level.up.toarray()
        np.testing.assert_allclose((whole**2).sum(axis=0), 1)
        np.testing.assert_allclose(level.bending, ((built.matrix.toarray() @ whole) ** 2).sum(axis=0), rtol=1e-9)


def test_points_without_neighbours_do_not_stall_coarsening() -> None:
    lonely = Mesh.from_faces(np.array([[0, 1, 2]]), 40)
    levels = build_levels(laplacian(lonely).matrix)
    assert all(len(level.bending) < level.up.shape[0] for level in levels)


def test_rounding_rounds_the_levels() -> None:
    levels = laplacian().rounded(np.dtype(np.float32)).levels
    assert {matrix.dtype for level in levels for matrix in (level.up, level.down, level.mean)} == {np.dtype(np.float32)}


def test_the_multilevel_preconditioner_is_symmetric_positive_definite() -> None:
    inverse, given = build_preconditioner(operator(triangulated(sheet()[1]))), operator(triangulated(sheet()[1]))
    assert bends(given)
    shape = (3, 3, given.weights.shape[2])
    size = int(np.prod(shape))
    matrix = np.stack([inverse(unit.reshape(shape)).ravel() for unit in np.eye(size)])
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-6, atol=1e-9 * matrix.max())
    assert np.linalg.eigvalsh(matrix).min() > 0


@pytest.mark.parametrize(("kind", "times"), [("grid", 1.2), ("triangles", 1.5)])
def test_levels_cut_iterations_with_paper_weights(kind: str, times: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without levels the iterations grow with the width of the surface."""
    made = gallery.corrupt(gallery.face(5, 3000, mesh=kind), outliers=0.1)  # type: ignore[arg-type]
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)
    settings = Settings(prior="smooth", preset="paper", max_reweightings=4)

    def iterations() -> int:
        return int(solve(made.tracks, made.mesh, cameras=cameras, settings=settings).trace.iterations.sum())

    with_levels = iterations()
    monkeypatch.setattr(preconditioner, "BENDS", np.inf)
    assert 4 < times * with_levels < iterations()


def test_negligible_bending_needs_no_levels() -> None:
    given = operator(triangulated(sheet()[1]))
    assert not bends(replace(given, spatial_weight=1e-9))
    assert not bends(replace(given, spatial_weight=0.0))
    assert not bends(replace(given, laplacian=None))
