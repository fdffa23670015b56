"""Cameras turned towards the object: the images of turned pinhole cameras, whose corrected tracks are scaled-orthographic."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Tracks, gallery, solve
from pliant.solver.cameras import perspective
from pliant.solver.cameras.aimed import Aimed, towards
from pliant.solver.cameras.perspective import corrected
from pliant.solver.evaluation.metrics import e3d_frame_scaled, focal_error
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import MIRROR, exponential
from pliant.solver.refinement.focal_length import CorrectedEnergy
from pliant.solver.refinement.learned import Learned, motion_of
from pliant.solver.tracks.matrix import centred, columns

FRAMES, POINTS = 5, 30
INVERSE_FOCALS = pytest.mark.parametrize("inverse_focal", [0.25, -0.25])
PICTURE = (1280.0, 720.0)


def scene(inverse_focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Points `(F, P, 3)` before a camera with κ = `inverse_focal` at a depth of 1/κ, off the axis, and their images."""
    random = np.random.default_rng(3)
    points = 0.6 * random.normal(size=(FRAMES, POINTS, 3)) + [0, 0, 1 / abs(inverse_focal)]
    points[..., :2] += random.uniform(-1.5, 1.5, (FRAMES, 1, 2))
    views = points[..., :2] / points[..., 2:] / abs(inverse_focal)
    return (points if inverse_focal > 0 else points @ MIRROR), views  # negative κ: depth is minus the third coordinate


@INVERSE_FOCALS
def test_turned_images_are_those_of_turned_pinhole_cameras(inverse_focal: float) -> None:
    points, views = scene(inverse_focal)
    aimed = Aimed.of(views, inverse_focal)
    seen = points @ aimed.turns.transpose(0, 2, 1)
    images = seen[..., :2] / seen[..., 2:] / inverse_focal
    np.testing.assert_allclose(aimed.views * aimed.turns[:, 2, 2, None, None], images, atol=1e-12)
    middle = np.concatenate([inverse_focal * views.mean(axis=1), np.ones((FRAMES, 1))], axis=1)
    turned = np.einsum("fij,fj->fi", aimed.turns, middle)
    np.testing.assert_allclose(turned[:, :2], 0, atol=1e-12)
    np.testing.assert_allclose(
        aimed.turns @ aimed.turns.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-12
    )


def test_without_perspective_each_frame_is_centred() -> None:
    _, views = scene(0.25)
    aimed = Aimed.of(views, 0.0)
    np.testing.assert_allclose(aimed.views, centred(views), atol=1e-12)
    np.testing.assert_array_equal(aimed.turns, np.tile(np.eye(3), (FRAMES, 1, 1)))
    assert aimed.density == 0
    close = Aimed.of(views, 1e-7)
    np.testing.assert_allclose(close.views, aimed.views, atol=1e-5)


@INVERSE_FOCALS
def test_tracks_corrected_with_true_depths_are_scaled_orthographic(inverse_focal: float) -> None:
    """With the object's origin at a depth of 1/κ along the original axis, the scale is 1 in the turned cameras, too."""
    points, views = scene(inverse_focal)
    aimed = Aimed.of(views, inverse_focal)
    seen = points @ aimed.turns.transpose(0, 2, 1)
    origin = np.einsum(
        "fij,fj->fi", aimed.turns, np.concatenate([views.mean(axis=1), np.full((FRAMES, 1), 1 / inverse_focal)], axis=1)
    )
    depths = aimed.turns[:, 2, 2, None] * (seen[..., 2] - origin[:, None, 2])
    straight = corrected(aimed.views, depths, inverse_focal)
    np.testing.assert_allclose(straight, seen[..., :2], atol=1e-12)


def test_density_is_the_logarithm_of_the_jacobian() -> None:
    _, views = scene(0.25)
    aimed, step, logs = Aimed.of(views, 0.25), 1e-6, []
    cosine = aimed.turns[:, 2, 2, None, None]

    def image(moved: np.ndarray) -> np.ndarray:
        rays = np.concatenate([0.25 * moved, np.ones((FRAMES, POINTS, 1))], axis=2) @ aimed.turns.transpose(0, 2, 1)
        return np.asarray(rays[..., :2] / rays[..., 2:] / 0.25 / cosine)

    columns = [(image(views + step * axis) - image(views - step * axis)) / (2 * step) for axis in np.eye(2)]
    logs = np.log(np.abs(np.linalg.det(np.stack(columns, axis=-1))))
    assert aimed.density == pytest.approx(-logs.mean(), abs=1e-6)


def test_slopes_match_finite_differences() -> None:
    _, views = scene(0.25)
    aimed, slope, density_slope = Aimed.with_slopes(views, 0.2)
    before, after = Aimed.of(views, 0.199), Aimed.of(views, 0.201)
    np.testing.assert_array_equal(aimed.views, Aimed.of(views, 0.2).views)
    np.testing.assert_allclose(slope, (after.views - before.views) / 0.002, atol=1e-4)
    assert density_slope == pytest.approx((after.density - before.density) / 0.002, abs=1e-4)


def test_depths_of_turned_cameras_do_not_depend_on_the_form_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    _, views = scene(0.25)
    aimed, random = Aimed.of(views, 0.25), np.random.default_rng(1)
    covariance = ShapeCovariance(np.eye(3), np.eye(3), 0.1 * random.normal(size=(FRAMES, 2)), 1e-4, 1e-3, 10.0)
    images = columns(aimed.views)
    whole = aimed.depth_map(aimed.turns, np.ones(FRAMES), covariance)
    monkeypatch.setattr(perspective, "LEARNED_FRAMES", FRAMES - 1)
    factored = aimed.depth_map(aimed.turns, np.ones(FRAMES), covariance)
    assert isinstance(factored, perspective.DepthMap)
    np.testing.assert_allclose(factored @ images, whole @ images, atol=1e-8)


def test_rays_behind_a_turned_camera_are_an_error() -> None:
    _, views = scene(0.25)
    with pytest.raises(np.linalg.LinAlgError, match="behind"):
        Aimed.of(views, 30.0)


def test_the_smallest_turn_has_its_axis_in_the_image_plane() -> None:
    turns = towards(np.array([[0.0, 0.0], [1.0, 2.0]]), 0.3)
    np.testing.assert_array_equal(turns[0], np.eye(3))
    axis = turns[1] - turns[1].T
    assert axis[1, 0] == pytest.approx(0, abs=1e-12)
    assert turns[1, 2, 2] == pytest.approx(1 / np.sqrt(1 + 0.09 * 5))


def test_the_derivative_of_the_energy_with_known_rotations_is_exact() -> None:
    _, views = scene(0.25)
    random = np.random.default_rng(4)
    covariance = ShapeCovariance(np.eye(3), np.eye(3), 0.1 * random.normal(size=(FRAMES, 2)), 0.1, 1e-3, np.inf)
    found = Learned(exponential(0.3 * random.normal(size=(FRAMES, 3))), np.ones(FRAMES), covariance, np.inf)
    energy = CorrectedEnergy(views, 0.2, found, turning=False)
    given = motion_of(energy.scene, found).flat()
    for inverse_focal in (0.17, 0.2):
        more, step = inverse_focal - 0.2, 1e-5
        rows = columns(centred(corrected(views, energy.depths, inverse_focal)))
        gram = energy.grams[0] + more * energy.grams[1] + more**2 * energy.grams[2]
        np.testing.assert_allclose(gram, rows @ rows.T / POINTS, atol=1e-12)
        _, gradient = energy(np.append(given, inverse_focal))
        below, above = (energy(np.append(given, inverse_focal + each))[0] for each in (-step, step))
        assert gradient[-1] == pytest.approx((above - below) / (2 * step), rel=1e-4, abs=1e-7)


def moving_face(face: gallery.Sequence, path: np.ndarray, *, noise: float) -> tuple[np.ndarray, Tracks]:
    """Shapes in camera axes, half-size 300 px, and their noisy tracks from 900 px away while they move along x by `path` px."""
    seen = (face.shapes - face.shapes.mean(axis=1, keepdims=True)) @ face.rotations.transpose(0, 2, 1)
    seen = 300 * seen / np.abs(seen).max()
    images = (seen[..., :2] + path[:, None, None] * [1, 0]) / (1 + seen[..., 2:] / 900)
    errors = np.random.default_rng(0).normal(0, noise, images.shape)
    return seen, Tracks.from_arrays((np.array(PICTURE) - 1) / 2 + images + errors)


@pytest.mark.slow
def test_the_focal_length_of_given_cameras_with_a_moving_object() -> None:
    face = gallery.face(16, 60, degrees=40)
    _, tracks = moving_face(face, np.linspace(-200, 400, 16), noise=0.3)
    known = KnownCamera.from_arrays(face.rotations)
    solution = solve(tracks, cameras=known, settings=Settings(image_size=PICTURE, camera="perspective"))
    assert focal_error(solution.camera, 900) < 0.01


@pytest.mark.slow
def test_focal_length_and_shapes_of_an_object_that_moves_through_the_picture() -> None:
    face = gallery.face(15, 60, degrees=40)
    seen, tracks = moving_face(face, np.linspace(-75, 225, 15), noise=0.1)
    solution = solve(tracks, face.mesh, settings=Settings(image_size=PICTURE, surface="free"))
    assert focal_error(solution.camera, 900) < 0.1
    assert e3d_frame_scaled(solution.shapes, seen) < 0.03
