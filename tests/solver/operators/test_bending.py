"""Products over points for several frames at once equal single products."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import Mesh
from pliant.solver.energy.hyperparameters import bending_weight
from pliant.solver.operators import bending
from pliant.solver.operators.bending import add_bending, bends_of, frames_together
from pliant.solver.operators.mesh_laplacian import build_laplacian
from waving_sheet import sheet, triangulated


@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize("tile", [5, 2048])
def test_rows_multiplied_together_equal_single_products(kind: type, tile: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bending, "TILE", tile)
    built = build_laplacian(triangulated(sheet()[1]), "uniform")
    assert built is not None
    laplacian, exact = built.rounded(np.dtype(kind)), built.matrix.toarray()
    rows = np.random.default_rng(4).standard_normal((7, len(exact))).astype(kind)
    close = 1e-12 if kind is np.float64 else 2e-4
    np.testing.assert_allclose(bends_of(laplacian, rows), exact @ rows.T, atol=close)
    out = np.ones_like(rows)
    add_bending(laplacian, 0.5, rows, out)
    assert out.dtype == kind
    np.testing.assert_allclose(out, 1 + 0.5 * rows @ exact.T @ exact, atol=10 * close)


def test_rounding_to_the_current_precision_changes_nothing() -> None:
    laplacian = build_laplacian(triangulated(sheet()[1]), "uniform")
    assert laplacian is not None
    assert laplacian.rounded(np.dtype(np.float64)) is laplacian
    assert laplacian.matrix.indices.dtype == np.int32


@pytest.mark.parametrize("kind", ["uniform", "cotangent"])
def test_a_grid_of_one_row_has_no_faces_and_thus_no_laplacian_of_faces(kind: str) -> None:
    assert build_laplacian(Mesh.from_grid(np.arange(5)[None]), kind, np.ones((5, 3))) is None


def test_faces_whose_corners_coincide_get_the_smallest_cotangent_weight() -> None:
    mesh = triangulated(sheet()[1])
    reference = np.random.default_rng(5).standard_normal((mesh.num_points, 3))
    reference[mesh.faces[0]] = 0
    built = build_laplacian(mesh, "cotangent", reference)
    assert built is not None
    assert np.isfinite(built.matrix.toarray()).all()


@pytest.mark.parametrize(("frames", "together"), [(1, 1), (3, 1), (10, 3), (32, 8), (800, 8)])
def test_few_frames_leave_work_for_every_thread(frames: int, together: int) -> None:
    assert frames_together(frames) == together


def test_the_weight_of_bending_follows_the_surface_and_the_modes() -> None:
    laplacian = build_laplacian(triangulated(np.arange(42).reshape(6, 7)), "uniform")
    assert laplacian is not None
    shapes = np.random.default_rng(3).standard_normal((20, 3, 42))
    whole = bending_weight(0.5, laplacian, shapes, 10)
    assert bending_weight(0.5, laplacian, shapes, 15) == whole, (
        "half as many modes as frames are all the bending there is"
    )
    assert bending_weight(0.5, laplacian, shapes, 5) == pytest.approx(whole / 2)
    assert bending_weight(0.5, laplacian, 3 * shapes, 10) == pytest.approx(whole / 9)
    assert bending_weight(1.0, laplacian, shapes, 10) == pytest.approx(2 * whole)
    assert bending_weight(0.5, laplacian, shapes, 10, bends=np.zeros(42, dtype=bool)) == whole
    one, other = (bending_weight(0.5, laplacian, shapes, 10, bends=np.arange(42) % 2 == parity) for parity in (0, 1))
    assert one != pytest.approx(other)
    assert 2 / (1 / one + 1 / other) == pytest.approx(whole), "inverse weights are means over the points"
