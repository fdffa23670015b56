"""The complete solve: methods, input errors, stopping."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pliant.solver import (
    InvalidInput,
    InvalidSettings,
    KnownCamera,
    Mesh,
    NotFinite,
    Outcome,
    Settings,
    Step,
    Tracks,
    estimate_cameras,
    find_outliers,
    gallery,
    learn_prior,
    solve,
    solve_shapes,
)
from waving_sheet import cameras_of, project, sheet, triangulated, turning

METHODS = ("pseudo_inverse", "temporal", "spatio_temporal", "robust")


def scene(frames: int = 12, degrees: float = 45) -> tuple[np.ndarray, np.ndarray, Tracks, Mesh]:
    shapes, grid = sheet(frames)
    rotations = turning(frames, degrees)
    return shapes, rotations, Tracks.from_arrays(5 * project(shapes, rotations) + [3.0, 4.0]), Mesh.from_grid(grid)


def error(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.mean(np.linalg.norm(found - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))))


def test_given_scales_contradict_an_orthographic_camera() -> None:
    _, rotations, tracks, mesh = scene()
    cameras = KnownCamera.from_arrays(rotations, np.linspace(0.5, 2, len(rotations)))
    with pytest.raises(InvalidSettings, match="Orthographic cameras have scale 1"):
        solve(tracks, mesh, cameras=cameras, settings=Settings(camera="orthographic"))


def test_an_exact_fit_has_converged() -> None:
    _, rotations, tracks, _ = scene()
    settings = Settings(method="temporal", temporal_weight=0.0)
    found = solve(tracks, None, cameras=cameras_of(rotations), settings=settings)
    assert found.outcome is Outcome.CONVERGED
    assert not found.trace.objective.flags.writeable


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_finite_centred_shapes_that_explain_the_tracks(method: str) -> None:
    _, rotations, tracks, mesh = scene()
    found = solve(tracks, mesh, cameras=cameras_of(rotations), settings=Settings(method=method))
    assert np.isfinite(found.shapes).all()
    np.testing.assert_allclose(found.shapes.mean(axis=1), 0, atol=1e-9)
    camera = found.camera
    image = np.einsum("f,fij,fpj->fpi", camera.scales, camera.rotations[:, :2], found.shapes)
    image += camera.translations[:, None]
    np.testing.assert_allclose(np.linalg.norm(tracks.points - image, axis=2), found.residuals, atol=1e-9)
    assert np.median(found.residuals) < 0.1


def test_temporal_smoothness_recovers_depth_unlike_the_pseudo_inverse() -> None:
    shapes, rotations, tracks, mesh = scene()
    flat, deep = (
        error(solve(tracks, mesh, cameras=cameras_of(rotations), settings=Settings(method=method)).shapes, 5 * shapes)
        for method in ("pseudo_inverse", "temporal")
    )
    assert 0.2 < flat < 0.6
    assert 0.001 < deep < 0.1


@pytest.mark.slow
def test_the_same_call_converges_to_the_same_bits() -> None:
    """With the default settings, estimated cameras and a mesh, whether progress is reported or not."""
    face = gallery.face(4, 12, mesh="triangles")
    steps: list[Step] = []
    one = solve(face.tracks, face.mesh, on_step=steps.append)
    two = solve(face.tracks, face.mesh)
    assert one.outcome is Outcome.CONVERGED
    assert np.isfinite(one.shapes).all()
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1
    assert (np.diff(one.trace.objective) <= 0).all()
    for name in ("shapes", "residuals", "weights"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    assert np.array_equal(one.camera.rotations, two.camera.rotations)
    assert one.choices == two.choices


def test_stopping_returns_the_last_shapes_with_outcome_stopped() -> None:
    _, rotations, tracks, mesh = scene()
    asked = iter([False] * 3)
    found = solve(tracks, mesh, cameras=cameras_of(rotations), should_stop=lambda: next(asked, True))
    assert found.outcome is Outcome.STOPPED
    assert np.isfinite(found.shapes).all()


def test_a_mesh_with_another_vertex_count_is_rejected() -> None:
    _, _, tracks, _ = scene()
    with pytest.raises(InvalidInput, match="63 vertices") as caught:
        solve(tracks, Mesh.from_faces([[0, 1, 2]], 64))
    assert caught.value.code == "mesh_mismatch"


def test_cameras_with_another_frame_count_are_rejected() -> None:
    _, rotations, tracks, _ = scene()
    with pytest.raises(InvalidInput, match="12 rotations") as caught:
        solve(tracks, cameras=KnownCamera.from_arrays(rotations[:5]))
    assert caught.value.code == "camera_mismatch"


def test_the_grid_stencil_needs_a_grid() -> None:
    _, rotations, tracks, _ = scene()
    with pytest.raises(InvalidSettings, match="pixel grid"):
        solve(
            tracks, triangulated(sheet()[1]), cameras=cameras_of(rotations), settings=Settings(laplacian="grid8"),
            should_stop=lambda: pytest.fail("before any work"),
        )  # fmt: skip


def test_observations_are_kept_where_all_are_outliers(monkeypatch: pytest.MonkeyPatch) -> None:
    _, rotations, tracks, _ = scene()
    points, visible = tracks.points.copy(), np.ones(tracks.visible.shape)
    visible[:, 1] = np.arange(len(visible)) % 2
    points[::3, ::4] += 3
    monkeypatch.setattr("pliant.solver.reconstruction.start.OUTLIER_SHARE", -1.0)
    monkeypatch.setattr("pliant.solver.reconstruction.start.gross_outliers", lambda *_, **__: visible > 0)
    found = solve(Tracks.from_arrays(points, visible), cameras=cameras_of(rotations))
    assert np.isfinite(found.trace.residual).all()
    assert found.weights.any()


def test_equations_that_are_singular_to_rounding_are_an_error_of_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    _, rotations, tracks, mesh = scene()
    known = cameras_of(rotations)
    cameras = estimate_cameras(tracks, known)
    prior = learn_prior(tracks, cameras)
    calls: tuple[tuple[str, Callable[[], object]], ...] = (
        ("reconstruct.cameras_of", lambda: solve(tracks, mesh, cameras=known)),
        ("reconstruction.cameras.cameras_of", lambda: estimate_cameras(tracks, known)),
        ("reconstruction.prior.prior_of", lambda: learn_prior(tracks, cameras)),
        ("reconstruction.start.begin", lambda: find_outliers(tracks, cameras, prior)),
        ("reconstruction.solve_shapes.shapes_of", lambda: solve_shapes(tracks, cameras, prior)),
    )
    for name, call in calls:
        with monkeypatch.context() as patched:
            patched.setattr(f"pliant.solver.{name}", singular)
            with pytest.raises(NotFinite, match=r"singular \(not positive definite\)"):
                call()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_overflow_is_an_error_not_a_result() -> None:
    _, rotations, tracks, mesh = scene()
    points = 1e-20 * tracks.points
    points[0, 0] = 1e12
    settings = Settings(precision="float32", prior="smooth")
    with pytest.raises(NotFinite, match="float64"):
        solve(Tracks.from_arrays(points), mesh, cameras=cameras_of(rotations), settings=settings)


@pytest.mark.parametrize(
    ("field", "more", "make"),
    [
        ("tracks", {"tracks": np.zeros((5, 9, 2))}, "Tracks.from_arrays"),
        ("mesh", {"mesh": [[0, 1, 2]]}, "Mesh.from_faces"),
        ("cameras", {"cameras": np.eye(3)}, "KnownCamera.from_arrays"),
        ("settings", {"settings": {"loss": "l1"}}, "Settings("),
    ],
)
def test_plain_arrays_are_refused_with_the_record_to_make(field: str, more: dict[str, Any], make: str) -> None:
    given: dict[str, Any] = {"tracks": gallery.face(5, 30).tracks, **more}
    with pytest.raises(InvalidInput, match=make.replace("(", r"\(")) as caught:
        solve(**given)
    assert (caught.value.code, caught.value.field) == ("wrong_type", field)


TRACKS = gallery.face(5, 30).tracks
FACING = np.tile(np.eye(3), (5, 1, 1))


@pytest.mark.parametrize(
    ("points", "visible", "field", "code"),
    [
        (TRACKS.points.astype(int), TRACKS.visible, "tracks", "wrong_type"),
        (TRACKS.points.astype(np.float32), TRACKS.visible, "tracks", "wrong_type"),
        (TRACKS.points.tolist(), TRACKS.visible, "tracks", "wrong_type"),
        (TRACKS.points, TRACKS.visible > 0, "visibility", "wrong_type"),
        (TRACKS.points[0], TRACKS.visible, "tracks", "wrong_shape"),
        (TRACKS.points[..., :1], TRACKS.visible, "tracks", "wrong_shape"),
        (TRACKS.points[:2], TRACKS.visible[:2], "tracks", "wrong_shape"),
        (TRACKS.points[:, :3], TRACKS.visible[:, :3], "tracks", "wrong_shape"),
        (TRACKS.points, TRACKS.visible[:, 1:], "visibility", "wrong_shape"),
        (np.where(TRACKS.points == TRACKS.points[1, 2], np.nan, TRACKS.points), TRACKS.visible, "tracks", "out_of_range"),
        (TRACKS.points + 2e12, TRACKS.visible, "tracks", "out_of_range"),
        (TRACKS.points, 2 * TRACKS.visible, "visibility", "out_of_range"),
        (TRACKS.points, -TRACKS.visible, "visibility", "out_of_range"),
        (TRACKS.points, np.nan * TRACKS.visible, "visibility", "out_of_range"),
    ],
)  # fmt: skip
def test_tracks_made_without_validation_are_refused(points: Any, visible: Any, field: str, code: str) -> None:
    with pytest.raises(InvalidInput, match=r"Tracks\.from_arrays") as caught:
        solve(Tracks(points, visible), settings=Settings(method="temporal", prior="smooth"))
    assert (caught.value.code, caught.value.field) == (code, field)


@pytest.mark.parametrize(
    ("members", "field", "code"),
    [
        ({"rotations": np.ones((5, 3, 3))}, "rotations", "not_a_rotation"),
        ({"rotations": FACING[:, :2]}, "rotations", "wrong_shape"),
        ({"rotations": FACING.astype(int)}, "rotations", "wrong_type"),
        ({"rotations": FACING.tolist()}, "rotations", "wrong_type"),
        ({"rotations": FACING, "scales": np.ones(4)}, "scales", "wrong_shape"),
        ({"rotations": FACING, "scales": -np.ones(5)}, "scales", "out_of_range"),
        ({"rotations": FACING, "scales": [1.0] * 5}, "scales", "wrong_type"),
        ({"rotations": FACING, "focal": -9.0}, "cameras.focal", "out_of_range"),
        ({"rotations": FACING, "principal_point": (np.nan, 0.0)}, "cameras.principal_point", "not_finite"),
    ],
)
@pytest.mark.parametrize("stage", [solve, estimate_cameras])
def test_cameras_made_without_validation_are_refused(
    stage: Any, members: dict[str, Any], field: str, code: str
) -> None:
    known = KnownCamera(**members)
    with pytest.raises(InvalidInput) as caught:
        stage(TRACKS, **{"cameras" if stage is solve else "known": known})
    assert (caught.value.code, caught.value.field) == (code, field)
