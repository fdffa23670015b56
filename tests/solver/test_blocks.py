"""Shapes that are solved in blocks of points."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Outcome, Settings, Solution, Step, Tracks, gallery, solve
from pliant.solver.evaluation import metrics
from pliant.solver.reconstruction import blocks
from pliant.solver.shapes.sparsely_observed import mesh_of

FRAMES, POINTS = 12, 900


@pytest.fixture(scope="module")
def film() -> gallery.Sequence:
    return gallery.face(FRAMES, POINTS)


def given(sequence: gallery.Sequence) -> KnownCamera:
    return KnownCamera.from_arrays(sequence.rotations, sequence.scales)


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "BLOCK_OBSERVATIONS", FRAMES * POINTS // 3)


@pytest.fixture(scope="module", params=["gaussian", "smooth"])
def settings(request: pytest.FixtureRequest) -> Settings:
    return Settings(prior=request.param, tolerance=1e-4)


@pytest.fixture(scope="module")
def whole(film: gallery.Sequence, settings: Settings) -> Solution:
    return solve(film.tracks, film.mesh, cameras=given(film), settings=settings)


@pytest.mark.usefixtures("limited")
def test_blocks_give_the_shapes_of_a_solve_at_once(film: gallery.Sequence, settings: Settings, whole: Solution) -> None:
    steps: list[Step] = []
    solution = solve(film.tracks, film.mesh, cameras=given(film), settings=settings, on_step=steps.append)
    size = np.sqrt(np.square(whole.shapes).sum(axis=2).mean())
    apart = np.linalg.norm(solution.shapes - whole.shapes, axis=2)
    assert np.sqrt(np.square(apart).mean()) < 3e-3 * size
    error, expected = (metrics.e3d_frame(each.shapes, film.shapes) for each in (solution, whole))
    assert error < 1.05 * expected + 1e-4
    assert solution.shapes.mean(axis=1) == pytest.approx(np.zeros((FRAMES, 3)), abs=1e-9)
    image = solution.camera.project(solution.shapes)
    assert np.linalg.norm(image - film.tracks.points, axis=2) == pytest.approx(solution.residuals, abs=1e-6)
    assert solution.outcome is Outcome.CONVERGED
    assert (solution.shapes_std is None) == (whole.shapes_std is None)
    assert solution.trust is not None
    assert whole.trust is not None
    assert solution.trust.verdict == whole.trust.verdict
    assert solution.trust.degrees_per_frame == pytest.approx(whole.trust.degrees_per_frame)
    if settings.gaussian:
        assert solution.trust.held_out_error == pytest.approx(whole.trust.held_out_error, rel=0.5)
    else:
        assert solution.trust.held_out_error is None
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1


@pytest.mark.usefixtures("limited")
def test_a_stop_between_blocks_leaves_a_result(film: gallery.Sequence) -> None:
    asked = 0

    def later() -> bool:
        nonlocal asked
        asked += 1
        return asked > 60

    settings = Settings(prior="smooth")
    solution = solve(film.tracks, film.mesh, cameras=given(film), settings=settings, should_stop=later)
    assert solution.outcome is Outcome.STOPPED
    assert np.isfinite(solution.shapes).all()


def test_blocks_are_equal_parts_of_all_points(film: gallery.Sequence) -> None:
    parts = blocks.blocks(film.tracks, 4)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(POINTS))
    assert {len(part) for part in parts} == {POINTS // 4}


def test_a_margin_has_as_many_rings_as_asked(monkeypatch: pytest.MonkeyPatch, film: gallery.Sequence) -> None:
    own = np.array([450])
    monkeypatch.setattr(blocks, "MARGIN", 1)
    near = blocks.with_margin(own, film.mesh.edges, POINTS)
    beside = film.mesh.edges[(film.mesh.edges == 450).any(axis=1)]
    assert set(near.tolist()) == set(beside.ravel().tolist())
    assert blocks.with_margin(own, np.zeros((0, 2), dtype=np.int32), POINTS).tolist() == [450]
    assert mesh_of(film.mesh, near).num_points == len(near)


def test_only_priors_of_single_points_are_solved_in_blocks() -> None:
    tracks = Tracks.from_arrays(np.zeros((3, 4, 2)))
    assert not blocks.needs_blocks(tracks, Settings())
    big = gallery.face(3, 50).tracks
    assert not blocks.needs_blocks(big, Settings(prior="smooth+low_rank"))
