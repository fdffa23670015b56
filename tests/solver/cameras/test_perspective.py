"""Perspective: projection, the corrected tracks' identity, κ's gradient, focal length and sign of depth by evidence, bad input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pliant.solver import (
    Camera,
    Choices,
    InvalidInput,
    InvalidSettings,
    KnownCamera,
    Outcome,
    Settings,
    Solution,
    Tracks,
    gallery,
    solve,
)
from pliant.solver.cameras.lens import given_lens
from pliant.solver.cameras.perspective import (
    Candidate,
    Perspective,
    corrected,
    corrected_moments,
    density,
    depth_map,
    depths_of,
    mirrored,
    posterior_depths,
)
from pliant.solver.evaluation.metrics import e3d_frame_scaled, focal_error, reprojection
from pliant.solver.model.marginal_likelihood import UNLIKELY
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import exponential
from pliant.solver.reconstruction.camera_report import described, improbable, with_camera_choice
from pliant.solver.refinement.focal_length import CorrectedEnergy, unclear_perspective
from pliant.solver.refinement.learned import Learned, motion_of
from pliant.solver.shapes import perspective_shapes
from pliant.solver.shapes.assessment import _unclear_camera
from pliant.solver.tracks import completion
from pliant.solver.tracks.normalization import normalize

PICTURE = (1280.0, 720.0)
CENTRE = (np.array(PICTURE) - 1) / 2
FOCAL = 900.0
ONE: dict[str, Any] = {"basis_size": 2}
"""One factorization: cameras are estimated in less time."""
FACE = gallery.face(8, 60, degrees=70)


def in_camera(shapes: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Shapes in camera axes, centred, half-size 300 px."""
    seen = (shapes - shapes.mean(axis=1, keepdims=True)) @ rotations.transpose(0, 2, 1)
    return np.asarray(300 * seen / np.abs(seen).max())


SEEN = in_camera(FACE.shapes, FACE.rotations)


def pinhole(seen: np.ndarray, focal: float, centre: np.ndarray = CENTRE) -> Tracks:
    """Tracks of points (F, P, 3) in camera axes, their origin at depth φ."""
    return Tracks.from_arrays(centre + seen[..., :2] / (1 + seen[..., 2:] / focal))


@pytest.fixture(scope="module")
def close() -> Solution:
    """A face at three half-sizes' distance, φ unknown."""
    return solve(pinhole(SEEN, FOCAL), settings=Settings(image_size=PICTURE, **ONE))


def a_camera(*, y_up: bool = False) -> Camera:
    random = np.random.default_rng(2)
    return Camera(
        exponential(0.3 * random.normal(size=(5, 3))), random.uniform(0.8, 1.2, 5), random.normal(size=(5, 2)) * 50,
        400.0, 1.0, np.array([20.0, -10.0]), y_up,
    )  # fmt: skip


@pytest.mark.parametrize("chunk", [7, 25])
def test_corrected_tracks_do_not_depend_on_the_size_of_chunks(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    random, normalized = np.random.default_rng(7), normalize(pinhole(SEEN, FOCAL))
    covariance = ShapeCovariance(np.eye(3), np.eye(3), 0.1 * random.normal(size=(len(SEEN), 2)), 1e-4, 1e-4, 0.0)
    offsets = (normalized.centroid - CENTRE) / normalized.unit
    sample = normalized.points[:, ::3] + offsets[:, None]
    view = Perspective(
        offsets, CENTRE, inverse_focal=normalized.unit / FOCAL, learning_sample=sample, full_sample=sample,
        depth=depth_map(FACE.rotations, np.ones(len(SEEN)), covariance),
    )  # fmt: skip
    assert normalized.points.shape[1] < completion.POINTS_PER_CHUNK
    gram, middle, _ = corrected_moments(view, normalized)
    depths = posterior_depths(view, normalized)
    monkeypatch.setattr(completion, "POINTS_PER_CHUNK", chunk)
    assert posterior_depths(view, normalized) == pytest.approx(depths, abs=1e-12)
    other, moved, _ = corrected_moments(view, normalized)
    assert other == pytest.approx(gram, abs=1e-12)
    assert moved == pytest.approx(middle, abs=1e-12)
    assert depths[:, ::3] == pytest.approx(depths_of(view.depth, view.learning_sample, view.inverse_focal), abs=1e-3)


@pytest.mark.parametrize("y_up", [False, True])
@pytest.mark.parametrize("focal", [None, 400.0])
def test_shapes_about_another_origin_project_to_the_same_pixels(y_up: bool, focal: float | None) -> None:
    camera = replace(a_camera(y_up=y_up), focal=focal)
    random = np.random.default_rng(3)
    shapes, origins = random.normal(size=(5, 20, 3)) * 40, random.normal(size=(5, 3)) * 30
    moved = camera.centred_on(origins).project(shapes - origins[:, None])
    assert moved == pytest.approx(camera.project(shapes), abs=1e-9)


@pytest.mark.parametrize("y_up", [False, True])
def test_projection_matches_a_pinhole_at_the_camera_position(y_up: bool) -> None:
    camera, shapes = a_camera(y_up=y_up), np.random.default_rng(3).normal(size=(5, 20, 3)) * 40
    assert camera.positions is not None
    points = shapes @ camera.rotations.transpose(0, 2, 1) + camera.positions[:, None]
    depth = -points[..., 2] if y_up else points[..., 2]
    image = camera.principal_point + 400.0 * points[..., :2] / depth[..., None]
    assert camera.project(shapes) == pytest.approx(image, abs=1e-9)
    assert camera.at(slice(2, 3)).project(shapes[2:3]) == pytest.approx(image[2:3], abs=1e-9)


def test_an_orthographic_camera_projects_as_one_infinitely_far_away() -> None:
    shapes = np.random.default_rng(3).normal(size=(5, 20, 3)) * 40
    far, never = replace(a_camera(), focal=1e12), replace(a_camera(), focal=None)
    assert never.project(shapes) == pytest.approx(far.project(shapes), abs=1e-6)
    assert never.positions is None


def test_corrected_tracks_equal_the_orthographic_tracks() -> None:
    views = pinhole(SEEN, FOCAL).points - CENTRE
    assert corrected(views, SEEN[..., 2], 1 / FOCAL) == pytest.approx(SEEN[..., :2], abs=1e-9)


def test_density_is_the_logarithm_of_the_jacobian() -> None:
    depths, inverse_focal = np.random.default_rng(1).normal(size=(4, 6)) * 0.5, 0.3
    jacobian = np.array([np.linalg.det((1 + inverse_focal * each) * np.eye(2)) for each in depths.ravel()])
    assert density(depths, inverse_focal) == pytest.approx(-np.log(jacobian).mean())


def a_covariance(frames: int = 6) -> tuple[np.ndarray, ShapeCovariance]:
    random = np.random.default_rng(4)
    rotations = exponential(np.linspace(-0.6, 0.6, frames)[:, None] * np.array([[0.3, 1.0, 0.1]]))
    root = random.normal(size=(3, 3))
    axis_covariance = root @ root.T + np.eye(3)
    modes = 0.1 * random.normal(size=(frames, 2))
    return rotations, ShapeCovariance(
        np.diag([1.0, 0.8, 0.5]), 3 * axis_covariance / np.trace(axis_covariance), modes, 1e-4, 1e-6, np.inf
    )


def test_depths_match_the_true_shape_at_low_noise() -> None:
    rotations, covariance = a_covariance(20)
    covariance = replace(covariance, modes=0 * covariance.modes, walk_variance=1e-9)
    shape = np.random.default_rng(5).normal(size=(40, 3)) * [1.0, 0.8, 0.6]
    seen = in_camera(np.broadcast_to(shape, (20, 40, 3)), rotations) / 200
    views = seen[..., :2] / (1 + 0.2 * seen[..., 2:]) + 0.1
    depth = depth_map(rotations, np.ones(20), covariance)
    found = depths_of(depth, (views - 0.1), 0.2)
    assert np.abs(found - seen[..., 2]).max() < 1e-3
    turned, other = mirrored(rotations, covariance)
    assert depth_map(turned, np.ones(20), other) == pytest.approx(-depth)


def test_hardly_observed_tracks_give_no_warning_about_their_covariance() -> None:
    rotations, covariance = a_covariance(20)
    covariance = replace(covariance, modes=0 * covariance.modes, walk_variance=1e-15, noise_variance=1e-15)
    assert np.isfinite(depth_map(rotations, np.ones(20), covariance)).all()


def test_the_corrected_energy_gradient_matches_finite_differences() -> None:
    rotations, covariance = a_covariance()
    random = np.random.default_rng(6)
    views = random.normal(size=(6, 30, 2)) + random.normal(size=(6, 1, 2))
    found = Learned(rotations, np.ones(6), replace(covariance, noise_variance=0.5), np.inf)
    energy = CorrectedEnergy(views, 0.13, found)
    flat = np.append(motion_of(energy.scene, found).flat(), 0.15)
    _, gradient = energy(flat)
    for place in (0, 7, 25, len(flat) - 1):
        step = np.zeros_like(flat)
        step[place] = 1e-5
        slope = (energy(flat + step)[0] - energy(flat - step)[0]) / 2e-5
        assert gradient[place] == pytest.approx(slope, rel=1e-4, abs=1e-7)


@pytest.mark.slow
def test_focal_length_sign_of_depth_and_shapes_are_found(close: Solution) -> None:
    assert close.choices.camera == "perspective"
    assert close.choices.depth_sign == "settled"
    assert focal_error(close.camera, FOCAL) < 0.1
    assert close.camera.focal_std is not None
    assert 0 < close.camera.focal_std < 0.3 * FOCAL
    assert e3d_frame_scaled(close.shapes, SEEN) < 0.03
    turned = np.einsum("fpi,fpj->fij", SEEN, close.shapes)
    assert (np.linalg.det(turned) > 0).all(), "the shapes are mirrored"
    candidates = close.choices.focal_candidates
    assert min(candidates, key=lambda each: each.nll).mirrored is False
    assert any(each.focal is None for each in candidates)
    assert any(each.mirrored for each in candidates)


def test_the_cameras_project_to_the_pixels_given(close: Solution) -> None:
    tracks = pinhole(SEEN, FOCAL)
    left = np.linalg.norm(tracks.points - close.camera.project(close.shapes), axis=2)
    assert close.residuals == pytest.approx(left)
    assert reprojection(tracks, close).rms < 1.0
    assert close.camera.principal_point == pytest.approx(CENTRE)


@pytest.mark.slow
def test_mirrored_input_gives_mirrored_shapes() -> None:
    """Under perspective the mirrored shape has different images, so depth gets the opposite sign."""
    other = SEEN * [1, 1, -1]
    found = solve(pinhole(other, FOCAL), settings=Settings(image_size=PICTURE, focal=FOCAL, **ONE))
    assert (np.linalg.det(np.einsum("fpi,fpj->fij", other, found.shapes)) > 0).all()
    assert e3d_frame_scaled(found.shapes, other) < 0.04
    assert found.camera.focal == pytest.approx(FOCAL)
    assert found.camera.focal_std == 0.0
    assert not any("improbable" in warning for warning in found.choices.warnings)


@pytest.mark.slow
@pytest.mark.long
def test_tracks_with_y_up_are_the_same_scene_in_other_axes(close: Solution) -> None:
    tracks = pinhole(SEEN, FOCAL)
    up = Tracks.from_arrays(np.array([0.0, PICTURE[1] - 1]) + tracks.points * [1, -1])
    found = solve(up, settings=Settings(image_size=PICTURE, y_up=True, **ONE))
    assert found.camera.focal == pytest.approx(close.camera.focal, rel=0.05)
    seen = SEEN * [1, -1, -1]
    assert (np.linalg.det(np.einsum("fpi,fpj->fij", seen, found.shapes)) > 0).all()
    assert reprojection(up, found).rms < 1.0


@pytest.mark.slow
@pytest.mark.long
def test_camera_distances_of_a_rigid_object_are_as_exact_as_its_shape() -> None:
    seen = in_camera(np.repeat(FACE.shapes[:1], 8, axis=0), FACE.rotations)
    away = np.exp(0.25 * np.sin(np.arange(8)))  # in units of the focal length
    tracks = Tracks.from_arrays(CENTRE + seen[..., :2] / (away[:, None, None] + seen[..., 2:] / FOCAL))
    found = solve(tracks, settings=Settings(image_size=PICTURE, **ONE))
    assert "Scales from" in found.choices.reasons["scales"]  # a rigid shape had determined them
    product = found.camera.scales * away
    assert product / np.exp(np.log(product).mean()) == pytest.approx(np.ones(8), abs=1e-3)
    assert e3d_frame_scaled(found.shapes, seen) < 1e-3


@pytest.mark.slow
def test_a_principal_point_off_centre_is_used() -> None:
    corner = np.array([200.0, 650.0])
    views = pinhole(SEEN + np.array([150.0, -200.0, 0.0]), FOCAL, corner)
    settings = Settings(camera="perspective", focal=FOCAL, principal_point=(200.0, 650.0))
    found = solve(views, cameras=KnownCamera.from_arrays(FACE.rotations, np.ones(8)), settings=settings)
    assert e3d_frame_scaled(found.shapes, SEEN) < 0.03
    assert reprojection(views, found).rms < 1.0
    assert found.camera.principal_point == pytest.approx(corner)


def test_corrections_for_perspective_keep_to_the_maximum_number_of_reweightings() -> None:
    settings = Settings(camera="perspective", focal=FOCAL, image_size=PICTURE, prior="smooth", max_reweightings=2)
    cameras = KnownCamera.from_arrays(FACE.rotations, np.ones(8))
    found = solve(pinhole(SEEN, FOCAL), cameras=cameras, settings=settings)
    assert found.outcome is Outcome.MAX_REWEIGHTINGS
    assert np.count_nonzero(found.trace.iterations) == 2


@pytest.mark.slow
def test_a_wrong_focal_length_is_used_and_reported_as_improbable() -> None:
    found = solve(
        pinhole(SEEN, FOCAL), settings=Settings(image_size=PICTURE, focal=3 * FOCAL, max_reweightings=1, **ONE)
    )
    assert found.camera.focal == pytest.approx(3 * FOCAL)
    assert any("improbable" in warning for warning in found.choices.warnings)
    assert found.trust is not None
    assert "explains the tracks better than the given focal length." in " ".join(found.trust.reasons)


def test_a_field_of_view_is_a_focal_length() -> None:
    angle = float(np.degrees(2 * np.arctan(PICTURE[0] / 2 / FOCAL)))
    assert Settings(field_of_view=angle, image_size=PICTURE).focal_length == pytest.approx(FOCAL)


@pytest.mark.slow
def test_orthographic_tracks_give_the_orthographic_result_to_the_bit() -> None:
    few = gallery.face(6, 30, degrees=70).tracks
    plain = solve(few, settings=Settings(camera="scaled_orthographic", max_reweightings=3, **ONE))
    chosen = solve(few, settings=Settings(max_reweightings=3, **ONE))
    assert chosen.choices.camera == "scaled_orthographic"
    assert chosen.choices.depth_sign == "ambiguous"
    assert np.array_equal(chosen.shapes, plain.shapes)
    assert np.array_equal(chosen.residuals, plain.residuals)
    assert np.array_equal(chosen.camera.rotations, plain.camera.rotations)
    assert "Orthography" in chosen.choices.reasons["camera_model"]
    assert chosen.camera.focal is None


@pytest.fixture(scope="module")
def given_cameras() -> Solution:
    cameras = KnownCamera.from_arrays(FACE.rotations, np.ones(8), focal=FOCAL, principal_point=(639.5, 359.5))
    return solve(pinhole(SEEN, FOCAL), cameras=cameras)


def test_given_cameras_may_be_perspective(given_cameras: Solution) -> None:
    found = given_cameras
    assert found.camera.focal == pytest.approx(FOCAL)
    assert found.choices.depth_sign == "settled"
    assert e3d_frame_scaled(found.shapes, SEEN) < 0.03


@pytest.mark.long
@pytest.mark.slow
def test_unknown_scales_barely_increase_the_error_under_perspective(given_cameras: Solution) -> None:
    cameras = KnownCamera.from_arrays(FACE.rotations, focal=FOCAL, principal_point=(639.5, 359.5))
    found = solve(pinhole(SEEN, FOCAL), cameras=cameras)
    assert e3d_frame_scaled(found.shapes, SEEN) < 1.1 * e3d_frame_scaled(given_cameras.shapes, SEEN)


@pytest.mark.long
@pytest.mark.slow
def test_the_smooth_prior_supports_a_perspective_camera() -> None:
    found = solve(
        pinhole(SEEN, FOCAL), settings=Settings(prior="smooth", camera="perspective", image_size=PICTURE, **ONE)
    )
    flat = solve(pinhole(SEEN, FOCAL), settings=Settings(prior="smooth", **ONE))
    assert found.choices.camera == "perspective"
    assert flat.choices.camera == "scaled_orthographic"
    assert reprojection(pinhole(SEEN, FOCAL), found).rms < 3.0


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"focal": 0.0}, "focal"),
        ({"focal": -500.0}, "focal"),
        ({"focal": float("nan")}, "focal"),
        ({"focal": 900.0, "field_of_view": 60.0, "image_size": PICTURE}, "field_of_view"),
        ({"field_of_view": 60.0}, "field_of_view"),
        ({"field_of_view": 180.0, "image_size": PICTURE}, "field_of_view"),
        ({"focal": 900.0, "camera": "orthographic"}, "focal"),
        ({"image_size": (0.0, 720.0)}, "image_size"),
        ({"principal_point": (float("inf"), 0.0)}, "principal_point"),
        ({"principal_point": (-1e5, 0.0), "image_size": PICTURE}, "principal_point"),
    ],
)
def test_contradictory_camera_settings_are_rejected(wrong: dict[str, object], name: str) -> None:
    with pytest.raises(InvalidSettings) as refused:
        Settings(**wrong)  # type: ignore[arg-type]
    assert refused.value.field == f"options.{name}"


def test_an_image_size_that_excludes_the_tracks_is_rejected() -> None:
    with pytest.raises(InvalidInput, match="most positions within") as refused:
        solve(pinhole(SEEN, FOCAL), settings=Settings(image_size=(64.0, 48.0)))
    assert refused.value.code == "outside_picture"


def test_a_distant_principal_point_is_rejected() -> None:
    tracks = pinhole(SEEN, FOCAL)
    with pytest.raises(InvalidInput) as refused:
        given_lens(normalize(tracks), Settings(principal_point=(1e7, 0.0)))
    assert (refused.value.code, refused.value.field) == ("principal_point_far", "options.principal_point")


def test_a_distant_principal_point_of_given_cameras_is_named_as_theirs() -> None:
    known = KnownCamera.from_arrays(FACE.rotations, principal_point=(1e7, 0.0))
    with pytest.raises(InvalidInput) as refused:
        given_lens(normalize(pinhole(SEEN, FOCAL)), Settings(principal_point=tuple(CENTRE)), known)
    assert (refused.value.code, refused.value.field) == ("principal_point_far", "cameras.principal_point")


@pytest.mark.parametrize("size", [None, (1920.0, 1080.0)])
def test_perspective_is_not_considered_for_an_object_that_is_small_beside_its_distance_from_the_centre(
    size: Any,
) -> None:
    across = np.linspace(0, 1800, len(SEEN))[:, None, None] * [1, 0]
    small = normalize(Tracks.from_arrays(20 + SEEN[..., :2] / 100 + across))
    assert given_lens(small, Settings(image_size=size)) is None
    field = "tracks" if size is None else "options.image_size"
    for settings in (Settings(image_size=size, camera="perspective"), Settings(image_size=size, focal=2000.0)):
        with pytest.raises(InvalidInput, match="Choose camera scaled_orthographic") as refused:
            given_lens(small, settings)
        assert (refused.value.code, refused.value.field) == ("principal_point_far", field)


def test_fractions_of_the_picture_with_its_size_in_pixels_are_rejected() -> None:
    tracks = pinhole(SEEN, FOCAL)
    fractions = Tracks.from_arrays(tracks.points / np.array(PICTURE), tracks.visible)
    with pytest.raises(InvalidInput, match="tracks that are fractions") as refused:
        given_lens(normalize(fractions), Settings(image_size=PICTURE))
    assert (refused.value.code, refused.value.field) == ("principal_point_far", "options.image_size")


def test_a_focal_length_in_millimetres_is_refused() -> None:
    tracks = pinhole(SEEN, FOCAL)
    normalized = normalize(tracks)
    wide = {"field_of_view": 179.0, "image_size": PICTURE}
    known = KnownCamera.from_arrays(FACE.rotations, focal=4.2)
    for settings, cameras, field in (
        (Settings(focal=4.2), None, "options.focal"),
        (Settings(**wide), None, "options.field_of_view"),
        (Settings(), known, "cameras.focal"),
    ):
        with pytest.raises(InvalidSettings, match="not in millimetres") as refused:
            given_lens(normalized, settings, cameras)
        assert refused.value.field == field
    with pytest.raises(InvalidSettings, match="not in millimetres"):
        Settings(focal=24, image_size=PICTURE)
    assert given_lens(normalized, Settings(focal=normalized.unit / 3.7)) is not None
    assert Settings(focal=PICTURE[0] / 7.4, image_size=PICTURE).focal is not None


def test_different_focal_lengths_in_cameras_and_settings_are_rejected() -> None:
    cameras = KnownCamera.from_arrays(FACE.rotations, focal=FOCAL)
    with pytest.raises(InvalidInput) as refused:
        solve(FACE.tracks, cameras=cameras, settings=Settings(focal=500.0))
    assert refused.value.field == "cameras.focal"


@pytest.mark.parametrize("wrong", [{"focal": 0.0}, {"focal": float("nan")}, {"principal_point": (0.0, float("nan"))}])
def test_given_cameras_with_an_invalid_lens_are_rejected(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidInput):
        KnownCamera.from_arrays(FACE.rotations, **wrong)  # type: ignore[arg-type]


def test_shapes_centred_on_more_points_keep_their_image() -> None:
    """If depths were relative to the mean of some points, scales and translations change so that pixels stay."""
    tracks = pinhole(SEEN, FOCAL)
    normalized = normalize(tracks)
    view = given_lens(normalized, Settings(focal=FOCAL, image_size=PICTURE))
    assert view is not None
    kept = np.arange(20)
    middle = SEEN[:, kept].mean(axis=1)
    about = SEEN - middle[:, None]  # centred on the kept points
    truth = Camera(np.tile(np.eye(3), (8, 1, 1)), np.ones(8), CENTRE + middle[:, :2], FOCAL, 0.0, CENTRE)
    image = Tracks.from_arrays(truth.project(about))
    whole = about.mean(axis=1)
    camera = Camera(truth.rotations, truth.scales, truth.translations + whole[:, :2])
    flat = np.zeros(SEEN.shape[:2])
    given = Solution(about - whole[:, None], camera, flat, flat, None, None, None, {})  # type: ignore[arg-type]
    found = perspective_shapes.seen_in_perspective(
        given, image, replace(view, inverse_focal=normalized.unit / FOCAL), normalized.unit, kept
    )
    assert found.residuals.max() < 1e-6


@pytest.mark.parametrize("given", [{"prior": "smooth"}, {"method": "temporal"}])
def test_other_priors_accept_fully_given_perspective_cameras(given: dict[str, object]) -> None:
    cameras = KnownCamera.from_arrays(FACE.rotations, np.ones(8), focal=FOCAL, principal_point=(639.5, 359.5))
    found = solve(pinhole(SEEN, FOCAL), cameras=cameras, settings=Settings(order="film", **given))  # type: ignore[arg-type]
    assert found.camera.focal == pytest.approx(FOCAL)
    assert reprojection(pinhole(SEEN, FOCAL), found).rms < 3.0


def test_the_reported_gain_is_that_of_the_given_focal_length() -> None:
    candidates = tuple(Candidate(each, nll) for each, nll in ((0.0, 1.0), (0.1, 0.9), (0.2, 0.5), (-0.1, 0.95)))
    view = Perspective(
        np.zeros((8, 2)), CENTRE, given=0.1, signs=(1, -1), required=False, inverse_focal=0.1, candidates=candidates
    )
    assert "gains 0.100 in" in described(view, 100.0)
    assert "gains 0.400 in" in str(improbable(view, 100.0))
    assert improbable(replace(view, candidates=candidates[:1]), 100.0) is None  # stopped before its own was compared


@pytest.mark.parametrize(
    ("nll", "unclear"),
    [
        ({0.06: -0.01, -0.1: 0.0}, 0.06),
        ({0.06: -0.004}, None),  # clearly orthographic
        ({0.06: -0.031}, None),  # clearly perspective
        ({0.01: -0.01, 0.06: 0.02}, None),  # an inverse focal length that makes no difference
    ],
)
def test_gains_near_the_limit_leave_the_camera_model_unclear(nll: dict[float, float], unclear: float | None) -> None:
    candidates = tuple(Candidate(each, nll[each]) for each in nll)
    view = Perspective(np.zeros((8, 2)), CENTRE, candidates=(Candidate(0.0, 0.0), *candidates))
    assert unclear_perspective(view) == unclear
    assert (_unclear_camera(view, 100.0) is None) == (unclear is None)
    if unclear is not None:
        assert "a focal length of about 1667. " in str(_unclear_camera(view, 100.0))
        found = str(_unclear_camera(replace(view, inverse_focal=0.03), 100.0))  # after the joint refinement
        assert "compare with camera=scaled_orthographic" in found
        assert "1667" not in found, "the focal length reported is another one"
    assert unclear_perspective(replace(view, required=True)) is None
    assert unclear_perspective(replace(view, given=0.1)) is None
    assert unclear_perspective(replace(view, candidates=candidates)) is None  # stopped before orthography was compared


def test_an_unknown_picture_centre_is_a_warning_where_perspective_is_found() -> None:
    view = Perspective(
        np.zeros((8, 2)), CENTRE, given=None, signs=(1, -1), required=False, inverse_focal=0.1,
        candidates=(Candidate(0.1, 0.5), Candidate(0.0, 1.0)),
    )  # fmt: skip
    orbit = FACE.rotations, np.ones(8)
    choices = Choices(1, 0.1, 0.1, 0.1, 1, 0.0, "uniform", 100.0, 0.1)

    def warnings(settings: Settings, known: KnownCamera | None = None, *, found: Perspective = view) -> tuple[str, ...]:
        return with_camera_choice(choices, found, settings, unit=100.0, known=known).warnings

    unknown = ((Settings(), None), (Settings(), KnownCamera.from_arrays(*orbit, focal=FOCAL)))
    for settings, known in unknown:
        assert ["the picture's size is unknown" in each for each in warnings(settings, known)] == [True]
    lens = KnownCamera.from_arrays(*orbit, focal=FOCAL, principal_point=(639.5, 359.5))
    for settings, known in (
        (Settings(image_size=PICTURE), None),
        (Settings(principal_point=(600.0, 300.0)), None),
        (Settings(), lens),
    ):
        assert warnings(settings, known) == ()
    assert warnings(Settings(), found=replace(view, inverse_focal=0.0)) == ()


def test_a_given_focal_length_with_which_the_depths_diverge_has_no_figure_in_the_report() -> None:
    candidates = tuple(Candidate(each, nll) for each, nll in ((-0.1, UNLIKELY), (0.0, 1.0), (0.1, UNLIKELY)))
    view = Perspective(
        np.zeros((8, 2)), CENTRE, given=0.1, signs=(1, -1), required=False, inverse_focal=0.1, candidates=candidates
    )
    for sentence in (described(view, 100.0), str(improbable(view, 100.0))):
        assert "the depths of the points diverge" in sentence
        assert "gains" not in sentence


def test_the_standard_deviation_of_the_focal_length_is_said_to_count_noise_alone() -> None:
    candidates = (Candidate(0.0, -1.0), Candidate(0.1, -2.0))
    view = Perspective(np.zeros((3, 2)), np.zeros(2), inverse_focal=0.1, inverse_focal_std=0.01, candidates=candidates)
    assert described(view, 100.0).endswith("is 1000 ± 100 from noise alone.")
