"""The uncertainty of a frame's size, where scales are estimated."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Tracks, gallery, solve
from pliant.solver.evaluation.metrics import coverage
from pliant.solver.shapes.assessment import SIZE_CORRELATION, with_size_std


def test_uncertainty_of_size_is_proportional_to_deformation_and_distance_from_the_centre() -> None:
    random = np.random.default_rng(0)
    rigid = random.standard_normal((20, 3))
    rigid -= rigid.mean(axis=0)
    growing = rigid * (1 + 0.1 * np.array([1, -1, 1, -1]))[:, None, None]
    std = np.zeros((4, 20))
    with_size_std(std, growing, centred=True)
    np.testing.assert_allclose(std, 0.1 * SIZE_CORRELATION * np.linalg.norm(growing, axis=2))
    moved, farther = np.full((4, 20), 0.5), growing + random.standard_normal((4, 1, 3))
    with_size_std(moved, farther, centred=True)
    np.testing.assert_allclose(moved, np.hypot(0.5, std))
    still = np.full((4, 20), 0.5)
    with_size_std(still, np.repeat(rigid[None], 4, axis=0), centred=False)
    np.testing.assert_allclose(still, 0.5)


@pytest.mark.parametrize("given", [False, True], ids=["estimated", "given"])
def test_standard_deviations_cover_the_size_where_scales_absorb_growth(*, given: bool) -> None:
    face = gallery.face(30, 120, degrees=60)
    jaw = np.clip(-face.shapes[:, :, 1:2] / np.abs(face.shapes).max(), 0, None)  # moves along with its own position
    opening = 0.2 * np.sin(np.linspace(0, 9, 30))[:, None, None]
    shapes = face.shapes + opening * jaw * face.shapes * [0.0, 1.0, 0.0]
    scales = np.exp(0.03 * np.random.default_rng(2).standard_normal(30))
    points = scales[:, None, None] * np.einsum("fij,fpj->fpi", face.rotations[:, :2], shapes)
    cameras = KnownCamera.from_arrays(face.rotations, scales if given else None)
    found = solve(Tracks.from_arrays(points), cameras=cameras, settings=Settings(refine_rotations=False))
    assert found.shapes_std is not None
    assert coverage(found.shapes_std, found.shapes, shapes) > 0.9
    if given:
        size = np.linalg.norm(shapes - shapes.mean(axis=1, keepdims=True), axis=2).mean()
        assert np.median(found.shapes_std) < 0.01 * size
