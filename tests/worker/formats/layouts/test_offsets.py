"""The order of the rows of a matrix does not depend on where in the picture the object is."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.solver.gallery import sphere
from pliant.worker.formats.tracks.interpretation import understand


@pytest.mark.parametrize("rows", ["interleaved", "stacked"])
def test_rows_are_recognised_where_x_and_y_are_far_apart(rows: str) -> None:
    points = sphere(20, 300).tracks.points + np.array((2000, 0))
    array = points.transpose((0, 2, 1) if rows == "interleaved" else (2, 0, 1)).reshape(-1, points.shape[1])
    got = understand({"W": array}, Options())
    np.testing.assert_array_equal(got.points, points)
    assert got.layout == f"W (2F, P), rows {rows}"
