"""Minimal and mostly hidden inputs: every result is finite, and plausible where data exist."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver import InvalidInput, KnownCamera, Mesh, Settings, Solution, Tracks, gallery, solve
from pliant.solver.evaluation import metrics

pytestmark = pytest.mark.slow

METHODS = ("pseudo_inverse", "temporal", "spatio_temporal", "robust")
MADE = gallery.face(12, 60, degrees=45, mesh="triangles")
INSIDE = [20, 37]
"""Vertices inside the mesh."""
CAMERAS = KnownCamera.from_arrays(MADE.rotations, MADE.scales)
ONE: dict[str, Any] = {"basis_size": 2}
"""One factorization: cameras are estimated in less time."""
LONG = pytest.mark.long
"""For combinations whose parts other cases cover."""

KNOWN = pytest.mark.parametrize("cameras", [CAMERAS, pytest.param(None, marks=LONG)], ids=["known", "estimated"])


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def assert_finite(solution: Solution) -> None:
    for array in (solution.shapes, solution.residuals, solution.weights, *vars_of(solution)):
        assert np.isfinite(array).all()
    assert (solution.weights >= 0).all()
    assert (solution.weights <= 1).all()
    if solution.camera.focal is None:  # under perspective the tracks are corrected again with the depths found
        assert (np.diff(solution.trace.objective) <= 0).all()


def vars_of(solution: Solution) -> tuple[np.ndarray, ...]:
    camera = solution.camera
    return camera.rotations, camera.scales, camera.translations, solution.trace.objective, solution.trace.residual


def hidden(frames: object = slice(None), points: object = slice(None)) -> np.ndarray:
    visible = np.ones(MADE.tracks.points.shape[:2])
    visible[frames, points] = 0  # type: ignore[index]
    return visible


@pytest.mark.parametrize(
    ("meshed", "cameras", "method"),
    [
        pytest.param(
            meshed,
            cameras,
            method,
            id=f"{'mesh' if meshed else 'no mesh'}-{'known' if cameras else 'estimated'}-{method}",
            marks=[LONG] if cameras is None else [],
        )
        for cameras in (CAMERAS, None)
        for meshed in (True, False)
        for method in METHODS
    ],
)
def test_three_frames_of_four_points_are_solved(cameras: KnownCamera | None, method: str, meshed: bool) -> None:
    tracks = Tracks.from_arrays(MADE.tracks.points[:3, [0, 10, 25, 55]])
    given = None if cameras is None else KnownCamera.from_arrays(MADE.rotations[:3], MADE.scales[:3])
    mesh = Mesh.from_faces([[0, 1, 2], [0, 2, 3]], 4) if meshed else None
    found = solve(tracks, mesh, cameras=given, settings=Settings(method=method, **ONE))  # type: ignore[arg-type]
    assert_finite(found)
    assert np.median(found.residuals) < 0.2 * found.choices.unit


@pytest.mark.parametrize(("frames", "points"), [(2, 5), (3, 3)])
def test_fewer_than_three_frames_or_four_points_are_rejected(frames: int, points: int) -> None:
    with pytest.raises(InvalidInput, match="at least"):
        Tracks.from_arrays(np.random.default_rng(0).standard_normal((frames, points, 2)))


@KNOWN
def test_non_finite_positions_act_like_a_visibility_mask(cameras: KnownCamera | None) -> None:
    gaps = np.random.default_rng(3).random(MADE.tracks.points.shape[:2]) < 0.2
    by_mask = Tracks.from_arrays(MADE.tracks.points, ~gaps)
    for nothing in (np.nan, np.inf, -np.inf):
        points = MADE.tracks.points.copy()
        points[gaps, 1] = nothing
        by_value = Tracks.from_arrays(points)
        np.testing.assert_array_equal(by_value.points, by_mask.points)
        np.testing.assert_array_equal(by_value.visible, by_mask.visible)
    found = solve(by_value, MADE.mesh, cameras=cameras, settings=Settings(**ONE))
    assert_finite(found)
    assert (found.weights[gaps] == 0).all()
    assert (found.weights[~gaps] > 0).any()
    assert (found.residuals[gaps] == 0).all()


@pytest.mark.parametrize(
    ("frames", "cameras", "method"),
    [
        pytest.param(
            frames,
            cameras,
            method,
            id=f"{frames}-{'known' if cameras else 'estimated'}-{method}",
            marks=[LONG] if cameras is None else [],
        )
        for cameras in (CAMERAS, None)
        for frames in ([11], [0, 1, 6, 7])
        for method in METHODS
    ],
)
def test_hidden_frames_are_filled_in_except_by_the_pseudo_inverse(
    frames: list[int], cameras: KnownCamera | None, method: str
) -> None:
    tracks = Tracks.from_arrays(MADE.tracks.points, hidden(frames))
    found = solve(tracks, MADE.mesh, cameras=cameras, settings=Settings(method=method))  # type: ignore[arg-type]
    assert_finite(found)
    error = metrics.e3d_frame(found.shapes[frames], MADE.shapes[frames])
    if method == "pseudo_inverse":
        assert not found.shapes[frames].any()  # independent frames: without observations, zero
    else:
        assert 0.005 < error < 0.2


@pytest.mark.parametrize(
    ("meshed", "cameras"),
    [(True, CAMERAS), (False, CAMERAS), *(pytest.param(meshed, None, marks=LONG) for meshed in (True, False))],
    ids=["mesh-known", "no mesh-known", "mesh-estimated", "no mesh-estimated"],
)
def test_never_seen_points_follow_their_mesh_neighbours(cameras: KnownCamera | None, meshed: bool) -> None:
    """A hidden point inside the mesh follows its neighbours; without a mesh it stays at the centre."""
    inside = INSIDE
    tracks = Tracks.from_arrays(MADE.tracks.points, hidden(points=inside))
    found = solve(tracks, MADE.mesh if meshed else None, cameras=cameras, settings=Settings(**ONE))
    assert_finite(found)
    assert (found.weights[:, inside] == 0).all()
    rest = np.delete(np.arange(60), inside)
    assert metrics.e3d_frame(found.shapes[:, rest], MADE.shapes[:, rest]) < 0.1
    if meshed and cameras is not None:
        whole = solve(MADE.tracks, MADE.mesh, cameras=cameras)
        size = np.linalg.norm(MADE.shapes, axis=2).mean()
        assert np.linalg.norm(found.shapes[:, inside] - whole.shapes[:, inside], axis=2).max() < 0.25 * size


@pytest.mark.parametrize(
    ("kind", "cameras"),
    [
        ("uniform", CAMERAS),
        ("cotangent", CAMERAS),
        ("auto", CAMERAS),
        *(pytest.param(kind, None, marks=LONG) for kind in ("uniform", "cotangent", "auto")),
    ],
    ids=lambda each: each if isinstance(each, str) else "known" if each is CAMERAS else "estimated",
)
def test_isolated_vertices_and_separate_patches_are_reconstructed(cameras: KnownCamera | None, kind: str) -> None:
    """One vertex has no face and two patches are disconnected: only the temporal prior, not smoothing, reaches them."""
    alone = INSIDE[0]
    faces = MADE.mesh.faces[~(MADE.mesh.faces == alone).any(axis=1)]
    x = MADE.shapes[0][:, 0]
    faces = faces[((x[faces] > 0).all(axis=1)) | ((x[faces] <= 0).all(axis=1))]
    mesh = Mesh.from_faces(faces, 60)
    found = solve(MADE.tracks, mesh, cameras=cameras, settings=Settings(laplacian=kind, **ONE))  # type: ignore[arg-type]
    assert_finite(found)
    assert 0.005 < metrics.e3d_frame(found.shapes, MADE.shapes) < 0.08
    if cameras is not None:
        truth = MADE.shapes[:, alone] - MADE.shapes.mean(axis=1)
        assert relative(found.shapes[:, alone], truth) < 0.15


def test_a_mesh_without_faces_equals_no_mesh() -> None:
    without = solve(MADE.tracks, cameras=CAMERAS)
    empty = solve(MADE.tracks, Mesh.from_faces(np.zeros((0, 3), dtype=int), 60), cameras=CAMERAS)
    np.testing.assert_array_equal(empty.shapes, without.shapes)


@KNOWN
def test_a_grid_with_holes_and_islands_is_reconstructed(cameras: KnownCamera | None) -> None:
    made = gallery.face(12, 120, degrees=45)
    assert made.mesh.grid is not None
    cells = made.mesh.grid.copy()
    cells[:, cells.shape[1] // 2] = -1  # cut in two
    cells[2:4, 2:4] = -1
    kept = np.sort(cells[cells >= 0])
    renumbered = np.full(cells.shape, -1)
    renumbered[cells >= 0] = np.searchsorted(kept, cells[cells >= 0])
    found = solve(
        Tracks.from_arrays(made.tracks.points[:, kept]),
        Mesh.from_grid(renumbered),
        cameras=cameras,
        settings=Settings(**ONE),
    )
    assert_finite(found)
    assert 0.005 < metrics.e3d_frame(found.shapes, made.shapes[:, kept]) < 0.08


@KNOWN
def test_a_rigid_object_comes_out_rigid(cameras: KnownCamera | None) -> None:
    still = np.repeat(MADE.shapes[:1], 12, axis=0)
    points = MADE.scales[:, None, None] * (still @ MADE.rotations[:, :2].transpose(0, 2, 1))
    found = solve(Tracks.from_arrays(points), MADE.mesh, cameras=cameras, settings=Settings(**ONE))
    assert metrics.e3d_frame(found.shapes, still) < 0.02
    spread = np.linalg.norm(found.shapes - found.shapes.mean(axis=0)) / np.linalg.norm(found.shapes)
    assert spread < 0.02


@pytest.mark.parametrize("given", [pytest.param({}, marks=LONG), {"image_size": (640.0, 480.0), "focal": 700.0}])
def test_collinear_points_give_finite_shapes_but_no_good_verdict(given: dict[str, object]) -> None:
    """A line determines neither depth nor a surface, so the verdict must not be good."""
    along = np.linspace(-1, 1, 9)[None, :, None]
    angle = np.linspace(0.2, 1.0, 4)[:, None, None]
    line = np.concatenate([along * np.cos(angle), along * np.sin(angle)], axis=2)
    found = solve(Tracks.from_arrays(320 + 150 * line), settings=Settings(max_reweightings=5, **ONE, **given))  # type: ignore[arg-type]
    assert np.isfinite(found.shapes).all()
    assert found.trust is not None
    assert found.trust.verdict != "good"
    assert found.choices.warnings or found.trust.reasons
