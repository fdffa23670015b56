"""Scales: found where the camera zooms, exactly 1 where it does not, however the object deforms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, gallery, solve
from pliant.solver.cameras.scale import rigid_scales
from pliant.solver.evaluation import metrics
from pliant.solver.tracks.normalization import normalize

ONE: dict[str, Any] = {"basis_size": 2}
"""One factorization: cameras are estimated in less time."""


def missed(found: np.ndarray, truth: np.ndarray) -> float:
    """Standard deviation of the logarithm of the ratio."""
    return float(np.std(np.log(found / truth)))


@pytest.mark.long
@pytest.mark.slow
def test_scales_of_a_zooming_camera_are_recovered() -> None:
    film = gallery.face(12, 60, scale_change=0.1)
    found = solve(film.tracks, settings=Settings(**ONE))
    plain = solve(film.tracks, settings=Settings(camera="orthographic", **ONE))
    truth = np.asarray(film.scales)
    assert (plain.camera.scales == 1).all()
    assert missed(found.camera.scales, truth) < 0.4 * missed(np.ones(12), truth)
    assert np.log(found.camera.scales).mean() == pytest.approx(0, abs=1e-12)
    assert metrics.e3d_frame(found.shapes, film.shapes) < 0.7 * metrics.e3d_frame(plain.shapes, film.shapes)
    assert found.choices.reasons["scales"].startswith("Scales from")


@pytest.mark.parametrize("name", ["face", pytest.param("flag", marks=pytest.mark.long)])
@pytest.mark.slow
def test_a_camera_that_does_not_zoom_has_scales_of_one(name: str) -> None:
    film = gallery.face(12, 60) if name == "face" else gallery.flag(16, 150)
    found = solve(film.tracks, settings=Settings(**ONE) if name == "face" else Settings())
    assert (found.camera.scales == 1).all()
    assert found.choices.reasons["scales"].startswith("Every scale is 1")


@pytest.mark.slow
def test_implausibly_large_scale_changes_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    film = gallery.face(6, 30, scale_change=0.1)
    # Neither the rigid scales nor those found with the shapes may vary more.
    for module in ("cameras.scale", "refinement.free_scales"):
        monkeypatch.setattr(f"pliant.solver.{module}.WIDEST", 0.02)
    found = solve(film.tracks, settings=Settings(max_reweightings=1, basis_size=1))
    assert (found.camera.scales == 1).all()
    assert "vary more than those of any camera" in found.choices.reasons["scales"]


@pytest.mark.slow
def test_scales_of_given_rotations_are_more_accurate_than_those_of_a_rigid_shape() -> None:
    film = gallery.face(24, 150, scale_change=0.1)
    rows = normalize(film.tracks).points.transpose(0, 2, 1).reshape(48, -1)
    rigid = rigid_scales(rows @ rows.T, film.rotations)
    found, poor = (
        solve(film.tracks, cameras=KnownCamera.from_arrays(film.rotations, scales)) for scales in (None, rigid)
    )
    assert missed(found.camera.scales, film.scales) < 0.4 * missed(rigid, film.scales)
    assert metrics.e3d_frame(found.shapes, film.shapes) < 0.5 * metrics.e3d_frame(poor.shapes, film.shapes)


def test_rigid_scales_are_exact_for_a_rigid_shape() -> None:
    random = np.random.default_rng(0)
    shape = random.normal(size=(3, 50))
    scales = np.exp(random.normal(0, 0.1, 9))
    scales /= np.exp(np.log(scales).mean())
    rotations = np.linalg.qr(random.normal(size=(9, 3, 3)))[0]
    rows = (scales[:, None, None] * rotations[:, :2] @ shape).reshape(18, 50)
    np.testing.assert_allclose(rigid_scales(rows @ rows.T, rotations), scales, rtol=1e-4)
