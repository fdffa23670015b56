"""The gallery: exact tracks, exact sizes, determinism, and the geometry of each surface."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import InvalidInput, Mesh
from pliant.solver.gallery import corrupt, face, flag, sphere, talk
from pliant.solver.gallery.sequence import facing, vertex_normals

MADE = [
    face(12, 400), face(12, 400, mesh="triangles"), flag(12, 300), flag(12, 301, mesh="triangles"), sphere(12, 200),
    talk(12, 200),
]  # fmt: skip
NAMES = ["face", "face-triangles", "flag", "flag-triangles", "sphere", "talk"]


def residual(sequence):
    """Tracks minus projected true shapes, NaN if hidden; only one translation per frame remains."""
    projected = sequence.scales[:, None, None] * (sequence.shapes @ sequence.rotations[:, :2].transpose(0, 2, 1))
    return np.where(sequence.tracks.visible[..., None] > 0, sequence.tracks.points - projected, np.nan)


@pytest.mark.parametrize("made", MADE, ids=NAMES)
def test_truth_explains_the_tracks_exactly(made):
    left = residual(made)
    assert np.nanmax(np.abs(left - np.nanmean(left, axis=1, keepdims=True))) < 1e-9
    assert made.rotations @ made.rotations.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (12, 1, 1)))
    assert np.linalg.det(made.rotations) == pytest.approx(np.ones(12))
    assert made.mesh.num_points == made.tracks.num_points == made.shapes.shape[1]


@pytest.mark.parametrize("make", [face, flag])
@pytest.mark.parametrize("mesh", ["grid", "triangles"])
@pytest.mark.parametrize("count", [4, 5, 17, 100, 997])
def test_faces_and_flags_have_exactly_the_requested_points(make, mesh, count):
    made = make(3, count, mesh=mesh)
    assert made.shapes.shape == (3, count, 3)
    assert (made.mesh.grid is not None) == (mesh == "grid")
    if count >= 100:
        assert set(range(count)) == set(made.mesh.faces.ravel().tolist())


@pytest.mark.parametrize("count", [4, 5, 50, 999])
def test_the_sphere_is_closed_for_any_number_of_points(count):
    mesh = sphere(3, count).mesh
    assert len(mesh.faces) == 2 * count - 4  # Euler: V − E + T = 2 with 3T = 2E
    assert len(mesh.edges) == 3 * count - 6


@pytest.mark.parametrize("made", [*MADE[:4]], ids=NAMES[:4])
def test_open_surfaces_face_the_viewer_and_the_sphere_faces_outward(made):
    normals = vertex_normals(made.shapes[0], made.mesh)
    assert (normals[:, 2] < 0).mean() > 0.9
    ball = MADE[4]
    outward = vertex_normals(ball.shapes[0], ball.mesh)
    assert (np.einsum("pi,pi->p", outward, ball.shapes[0]) > 0).all()


def test_a_flag_does_not_stretch_along_its_threads_but_bends():
    made = flag(8, 60 * 90)
    grid = made.mesh.grid
    steps = np.linalg.norm(np.diff(made.shapes[:, grid], axis=2)[..., (0, 2)], axis=-1)
    # A chord of a curve is shorter than its arc, by little at this resolution.
    whole = 2 * 1.5 * 200 / (grid.shape[1] - 1)
    assert steps.max() <= whole * (1 + 2e-6)
    assert steps.min() > 0.98 * whole
    assert np.ptp(made.shapes[..., 2]) > 60


def test_a_face_moves_at_the_mouth_and_not_at_the_nose_bridge():
    made = face(40, 2000)
    motion = made.shapes.std(axis=0).sum(axis=1)
    x, y = made.shapes[:, :, 0].mean(axis=0), made.shapes[:, :, 1].mean(axis=0)
    mouth = np.hypot(x, y - 90) < 40
    nose_bridge = np.hypot(x, y + 40) < 15
    assert motion[mouth].mean() > 8 > 1 > motion[nose_bridge].mean()
    centred = made.shapes - made.shapes.mean(axis=(0, 1))
    deviation = np.linalg.norm(made.shapes - made.shapes.mean(axis=0)) / np.linalg.norm(centred)
    assert 0.03 < deviation < 0.12
    # Not a linear model of five expressions: the sixth basis shape still matters, the twentieth hardly.
    values = np.linalg.svd((made.shapes - made.shapes.mean(axis=0)).reshape(40, -1), compute_uv=False)
    assert values[5] > 0.02 * values[0]
    assert values[19] < 0.01 * values[0]


def test_the_sphere_radius_varies_and_its_far_side_is_hidden():
    ball = sphere(40, 500)
    radius = np.linalg.norm(ball.shapes, axis=2)
    assert np.ptp(radius.mean(axis=1)) > 0.15 * radius.mean()
    assert 0.4 < ball.tracks.visible.mean() < 0.55
    assert ball.tracks.visible.any(axis=0).mean() > 0.98  # the camera goes right round; a dent may hide at a pole
    assert sphere(3, 50, self_occlusion=False).tracks.all_visible


def test_facing_is_exact_on_a_box():
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    front, back = [0, 2, 6, 4], [1, 5, 7, 3]  # counter-clockwise seen from outside
    seen = facing(corners[None], Mesh.from_faces([front, back], 8), np.eye(3)[None])
    assert seen[0, front].all()
    assert not seen[0, back].any()


def test_the_camera_turns_by_the_given_degrees_and_scales_have_mean_log_zero():
    made = face(30, 50, degrees=40, tilt=0, scale_change=0.2)
    forward = made.rotations[:, 2]
    assert np.degrees(np.arccos(forward[0] @ forward[-1])) == pytest.approx(80)
    assert np.log(made.scales).mean() == pytest.approx(0, abs=1e-12)
    assert np.ptp(np.log(made.scales)) == pytest.approx(0.4, rel=0.02)
    assert (face(5, 50).scales == 1).all()


@pytest.mark.parametrize("make", [face, flag, sphere])
def test_the_same_seed_gives_the_same_bits_and_another_does_not(make):
    first, again, other = make(4, 60, seed=3), make(4, 60, seed=3), make(4, 60, seed=4)
    assert first.tracks.points.tobytes() == again.tracks.points.tobytes()
    assert not np.array_equal(first.shapes, other.shapes)
    with pytest.raises(ValueError, match="read-only"):
        first.shapes[0] = 0


def test_noise_std_is_relative_to_the_largest_coordinate():
    clean = face(20, 500)
    noisy = corrupt(clean, noise=0.03, seed=1)
    points = clean.tracks.points
    largest = np.abs(points - points.mean(axis=1, keepdims=True)).max()
    assert (noisy.tracks.points - points).std() == pytest.approx(0.03 * largest, rel=0.02)
    assert noisy.shapes is clean.shapes
    assert not noisy.outliers.any()


def test_outliers_and_hidden_points_have_the_exact_share():
    clean = face(20, 500)
    spoilt = corrupt(clean, outliers=0.1, hidden=0.3, seed=1)
    moved = np.linalg.norm(spoilt.tracks.points - clean.tracks.points, axis=2) > 1e-9
    seen = spoilt.tracks.visible > 0
    assert (~seen).sum() == 3000
    assert ((moved & seen) == spoilt.outliers).all()
    assert spoilt.outliers.sum() == pytest.approx(0.7 * 1000, rel=0.1)
    assert corrupt(clean, outliers=0.1).outliers.sum() == 1000
    box = clean.tracks.points - clean.tracks.points.mean(axis=1, keepdims=True)
    wrong = (spoilt.tracks.points - clean.tracks.points.mean(axis=1, keepdims=True))[spoilt.outliers]
    assert (wrong >= box.min(axis=(0, 1))).all()
    assert (wrong <= box.max(axis=(0, 1))).all()
    assert np.ptp(wrong, axis=0) == pytest.approx(np.ptp(box, axis=(0, 1)), rel=0.05)


def test_corruption_keeps_what_was_hidden_and_is_deterministic():
    ball = sphere(6, 100)
    first, again = (corrupt(ball, noise=0.01, outliers=0.05, hidden=0.2, seed=9) for _ in range(2))
    assert first.tracks.points.tobytes() == again.tracks.points.tobytes()
    assert not first.tracks.visible[ball.tracks.visible == 0].any()
    assert corrupt(ball).tracks.points == pytest.approx(ball.tracks.points)
    assert not np.array_equal(corrupt(ball, noise=0.01, seed=1).tracks.points, first.tracks.points)


@pytest.mark.parametrize(
    "call",
    [
        lambda: face(2, 100),
        lambda: face(5, 3),
        lambda: sphere(5, 3),
        lambda: flag(5, 100, mesh="cubes"),
        lambda: face(5, 100, scale_change=2),
        lambda: corrupt(MADE[0], noise=-1),
        lambda: corrupt(MADE[0], outliers=1.5),
        lambda: corrupt(MADE[0], hidden=float("nan")),
    ],
)
def test_impossible_arguments_are_refused(call):
    with pytest.raises(InvalidInput):
        call()
