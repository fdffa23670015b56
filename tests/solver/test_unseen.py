"""Points that no frame shows lie on the thinnest plate through their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Mesh, Settings, Tracks, gallery, metrics, solve
from pliant.solver.cameras import given_cameras
from pliant.solver.closed_form import uniform_solution
from pliant.solver.iteration import init
from pliant.solver.normalise import normalise
from pliant.solver.problem import build_problem
from pliant.solver.state import Problem, State
from pliant.solver.unseen import close_surface

MADE = gallery.face(16, 400, degrees=60, mesh="triangles")
CAMERAS = KnownCamera.from_arrays(MADE.rotations, MADE.scales)


def seen_but(points: list[int]) -> Tracks:
    visible = np.ones(MADE.tracks.points.shape[:2])
    visible[:, points] = 0
    return Tracks.from_arrays(MADE.tracks.points, visible)


def patch(centre: int, rings: int) -> list[int]:
    found = {centre}
    for _ in range(rings):
        found |= set(MADE.mesh.edges[np.isin(MADE.mesh.edges, list(found)).any(axis=1)].ravel().tolist())
    return sorted(found)


@pytest.mark.parametrize("cameras", [CAMERAS, None], ids=["known", "estimated"])
def test_a_hole_in_the_face_is_closed(cameras: KnownCamera | None) -> None:
    hole = patch(190, 2)
    assert len(hole) > 12
    found = solve(seen_but(hole), MADE.mesh, cameras=cameras)
    error = metrics.e3d_frame(found.shapes, MADE.shapes)
    assert error < 1.5 * metrics.e3d_frame(solve(MADE.tracks, MADE.mesh, cameras=cameras).shapes, MADE.shapes) + 0.02
    assert (found.weights[:, hole] == 0).all()
    sides = np.delete(np.arange(400), hole)
    centred = found.shapes[:, sides] - found.shapes[:, sides].mean(axis=1, keepdims=True)
    whole = solve(seen_but([]), MADE.mesh, cameras=cameras).shapes[:, sides]
    assert metrics.e3d_frame(centred, whole - whole.mean(axis=1, keepdims=True)) < 0.1


def test_what_hangs_on_nothing_stays_in_the_middle() -> None:
    alone = 77
    faces = MADE.mesh.faces[~(MADE.mesh.faces == alone).any(axis=1)]
    found = solve(seen_but([alone]), Mesh.from_faces(faces, 400), cameras=CAMERAS)
    size = np.linalg.norm(found.shapes, axis=2).mean()
    assert np.linalg.norm(found.shapes[:, alone], axis=1).max() < 0.2 * size


def problem_of(tracks: Tracks, mesh: Mesh | None) -> tuple[Problem, State]:
    normalised, settings = normalise(tracks), Settings(prior="smooth")
    estimate = given_cameras(normalised, CAMERAS, settings)
    problem, _ = build_problem(normalised, estimate, mesh, settings)
    return problem, init(problem, uniform_solution(problem, estimate.translations), estimate.translations)


@pytest.mark.parametrize(
    ("tracks", "mesh"),
    [(MADE.tracks, MADE.mesh), (seen_but([7]), None)],
    ids=["everything seen", "no surface"],
)
def test_nothing_moves_where_there_is_nothing_to_close(tracks: Tracks, mesh: Mesh | None) -> None:
    problem, state = problem_of(tracks, mesh)
    assert close_surface(problem, state) is state


def test_what_is_drawn_is_the_thinnest_plate_and_the_rest_stays() -> None:
    hole = patch(190, 1)
    problem, state = problem_of(seen_but(hole), MADE.mesh)
    closed = close_surface(problem, state)
    seen = np.delete(np.arange(400), hole)
    moved = closed.shapes - closed.shapes.mean(axis=2, keepdims=True)
    before = state.shapes - state.shapes[:, :, seen].mean(axis=2, keepdims=True)
    after = moved - moved[:, :, seen].mean(axis=2, keepdims=True)
    np.testing.assert_allclose(after[:, :, seen], before[:, :, seen], atol=1e-12)
    assert problem.laplacian is not None
    matrix = problem.laplacian.matrix
    pull = np.asarray((matrix.T @ (matrix @ moved.reshape(-1, 400).T)).T).reshape(moved.shape)
    assert np.abs(pull[:, :, hole]).max() < 1e-4 * np.abs(pull[:, :, seen]).max(), "stationary in the unseen points"


def test_the_published_prior_is_left_as_its_energy_has_it() -> None:
    """Of least energy, unseen points included: closing the surface afterwards would not be."""
    hole, settings = patch(190, 1), Settings(prior="smooth", spatial_weight=0.1, tolerance=1e-10)
    found = solve(seen_but(hole), MADE.mesh, cameras=CAMERAS, settings=settings)
    assert found.trace.objective[-1] <= found.trace.objective.min()
    problem, _ = problem_of(seen_but(hole), MADE.mesh)
    closed = close_surface(
        problem, init(problem, found.shapes.transpose(0, 2, 1) / found.choices.unit, np.zeros((16, 2)))
    )
    assert (
        np.abs(closed.shapes[:, :, hole].transpose(0, 2, 1) * found.choices.unit - found.shapes[:, hole]).max() > 1e-3
    )
