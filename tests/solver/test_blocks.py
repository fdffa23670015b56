"""Shapes solved in blocks of points."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pliant.solver import (
    InvalidInput,
    KnownCamera,
    Outcome,
    Settings,
    Solution,
    Step,
    Tracks,
    estimate_cameras,
    gallery,
    learn_prior,
    solve,
    solve_shapes,
)  # fmt: skip
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
def test_solving_in_blocks_matches_solving_at_once(film: gallery.Sequence, settings: Settings, whole: Solution) -> None:
    steps: list[Step] = []
    solution = solve(film.tracks, film.mesh, cameras=given(film), settings=settings, on_step=steps.append)
    size = np.sqrt(np.square(whole.shapes).sum(axis=2).mean())
    apart = np.linalg.norm(solution.shapes - whole.shapes, axis=2)
    assert np.sqrt(np.square(apart).mean()) < 3e-3 * size
    error, expected = (metrics.e3d_frame(each.shapes, film.shapes) for each in (solution, whole))
    assert error < 1.01 * expected + 1e-4
    if settings.prior == "gaussian":  # the smooth prior takes it from the noise of each block
        assert solution.choices.spatial_weight == pytest.approx(whole.choices.spatial_weight, rel=0.01)
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
    assert solution.choices.spatial_weight == pytest.approx(whole.choices.spatial_weight, rel=0.6)
    assert {step.stage for step in steps[3:]} <= {"cameras", "initialise", "reweight", "finish"}
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1


@pytest.mark.slow
def test_cameras_of_blocks_with_sparsely_observed_points_see_the_tracks_in_perspective(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = gallery.face(6, 60)
    away = np.einsum("fpi,fi->fp", seen.shapes, seen.rotations[:, 2])
    image = np.einsum("fpi,fci->fpc", seen.shapes, seen.rotations[:, :2])
    size = np.sqrt(np.square(seen.shapes).sum(axis=2).mean())
    focal = 4 * size
    visible = np.ones(away.shape)
    visible[1:, :12] = 0
    tracks = Tracks.from_arrays(image / (1 + away / focal)[..., None], visible)
    cameras = KnownCamera.from_arrays(seen.rotations, focal=focal, principal_point=(0.0, 0.0))
    monkeypatch.setattr(blocks, "BLOCK_OBSERVATIONS", 6 * 20)
    solution = solve(tracks, seen.mesh, cameras=cameras, settings=Settings(order="film"))
    assert solution.camera.focal == pytest.approx(focal)
    left = np.linalg.norm(solution.camera.project(solution.shapes) - tracks.points, axis=2)
    assert left[visible > 0] == pytest.approx(solution.residuals[visible > 0], abs=1e-9)
    assert np.median(left[visible > 0]) < 3e-3 * size
    assert solution.shapes.mean(axis=1) == pytest.approx(np.zeros((6, 3)), abs=1e-9)


@pytest.mark.usefixtures("limited")
def test_points_that_no_frame_shows_are_dealt_to_all_blocks(film: gallery.Sequence) -> None:
    visible = np.ones((FRAMES, POINTS))
    visible[:, : POINTS // 2] = 0
    tracks = Tracks.from_arrays(film.tracks.points, visible)
    parts = blocks.blocks(tracks, 3)
    assert sorted(np.concatenate(parts)) == list(range(POINTS))
    assert [len(part) for part in parts] == [POINTS // 3] * 3
    assert all((part >= POINTS // 2).sum() == POINTS // 6 for part in parts)
    solution = solve(tracks, None, cameras=given(film), settings=Settings(prior="smooth", max_reweightings=2))
    assert np.isfinite(solution.shapes).all()


@pytest.mark.usefixtures("limited")
def test_a_stop_between_blocks_returns_finite_shapes(film: gallery.Sequence) -> None:
    asked = 0

    def later() -> bool:
        nonlocal asked
        asked += 1
        return asked > 60

    settings = Settings(prior="smooth")
    solution = solve(film.tracks, film.mesh, cameras=given(film), settings=settings, should_stop=later)
    assert solution.outcome is Outcome.STOPPED
    assert np.isfinite(solution.shapes).all()


@pytest.mark.usefixtures("limited")
@pytest.mark.slow
def test_verdict_and_outlier_share_in_blocks_match_solving_at_once(film: gallery.Sequence) -> None:
    tracks, _ = gallery.corrupt_tracks(film.tracks, noise=0.003, outliers=0.08, hidden=0.3, seed=0)
    cameras, settings = given(film), Settings(max_reweightings=1)
    parts = solve(tracks, film.mesh, cameras=cameras, settings=settings)
    blocks.BLOCK_OBSERVATIONS = FRAMES * POINTS
    whole = solve(tracks, film.mesh, cameras=cameras, settings=settings)
    assert parts.trust is not None
    assert whole.trust is not None
    assert parts.trust.hidden == pytest.approx(whole.trust.hidden, abs=2e-3)
    assert parts.trust.hidden > 0.33  # includes rejected observations
    assert [reason[:20] for reason in parts.trust.reasons] == [reason[:20] for reason in whole.trust.reasons]
    rejected = [float(each.choices.reasons["outliers"].split("%")[0]) for each in (parts, whole)]
    assert rejected[0] == pytest.approx(rejected[1], abs=0.3)


@pytest.mark.usefixtures("limited")
def test_choices_of_blocks_are_reported_as_medians_with_all_warnings(film: gallery.Sequence) -> None:
    solution = solve(film.tracks, film.mesh, cameras=given(film), settings=Settings(prior="smooth", max_reweightings=2))
    whole = blocks._Whole(film.tracks, estimate_cameras(film.tracks, given(film)), None, Settings(), None)
    kept = np.arange(POINTS)
    for weight, warning in ((1.0, "one"), (3.0, "two"), (9.0, "one")):
        reasons = dict(solution.choices.reasons, few=warning) | ({"late": "late"} if weight == 9 else {})
        choices = replace(solution.choices, temporal_weight=weight, warnings=(warning,), reasons=reasons)
        whole.add(replace(solution, choices=choices), kept, kept)
    found = whole.solution(seconds={}).choices
    assert found.temporal_weight == 3
    assert found.warnings == ("one", "two")
    assert found.reasons["weights"].startswith("Medians of 3 blocks of points. The first: ")
    assert (found.reasons["few"], found.reasons["late"]) == tuple(
        f"In one of 3 blocks of points: {each}" for each in ("one", "late")
    )
    assert found.reasons["camera"] == solution.choices.reasons["camera"]


def test_blocks_are_equal_parts_of_all_points(film: gallery.Sequence) -> None:
    parts = blocks.blocks(film.tracks, 4)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(POINTS))
    assert {len(part) for part in parts} == {POINTS // 4}
    middle = film.tracks.points.mean(axis=0)
    wide, high = (np.ptp(middle, axis=0) / 2).tolist()
    for part in parts:  # a quarter of an oval, not a strip
        assert np.ptp(middle[part, 0]) < 1.2 * wide
        assert np.ptp(middle[part, 1]) < 1.2 * high
    assert sorted(len(part) for part in blocks.blocks(film.tracks, 7)) == pytest.approx(np.full(7, POINTS / 7), abs=1)


def test_a_margin_of_one_adds_one_ring_of_neighbours(monkeypatch: pytest.MonkeyPatch, film: gallery.Sequence) -> None:
    own = np.array([450])
    monkeypatch.setattr(blocks, "MARGIN", 1)
    near = blocks.with_margin(own, film.mesh.edges, POINTS)
    beside = film.mesh.edges[(film.mesh.edges == 450).any(axis=1)]
    assert set(near.tolist()) == set(beside.ravel().tolist())
    assert blocks.with_margin(own, np.zeros((0, 2), dtype=np.int32), POINTS).tolist() == [450]
    assert mesh_of(film.mesh, near).num_points == len(near)


def test_small_sequences_need_no_blocks() -> None:
    tracks = Tracks.from_arrays(np.zeros((3, 4, 2)))
    assert not blocks.needs_blocks(tracks, Settings())
    big = gallery.face(3, 50).tracks
    assert not blocks.needs_blocks(big, Settings(prior="smooth+low_rank"))


FEW = Settings(max_reweightings=4)


@pytest.fixture(scope="module")
def in_memory(film: gallery.Sequence) -> Solution:
    """Solved in blocks, without a scratch file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "BLOCK_OBSERVATIONS", FRAMES * POINTS // 3)
        return solve(film.tracks, film.mesh, cameras=given(film), settings=FEW)


@pytest.mark.usefixtures("limited")
@pytest.mark.slow
def test_results_in_scratch_files_equal_those_in_memory(
    film: gallery.Sequence, in_memory: Solution, tmp_path: Path
) -> None:
    np.save(tmp_path / "tracks.npy", film.tracks.points)
    folder = tmp_path / "scratch"
    folder.mkdir()
    mapped = Tracks.from_arrays(np.load(tmp_path / "tracks.npy", mmap_mode="r"), scratch=folder)
    outside = solve(mapped, film.mesh, cameras=given(film), settings=FEW, scratch=folder)
    for name in ("shapes", "residuals", "weights", "shapes_std", "inlier_probability"):
        array = getattr(outside, name)
        assert np.array_equal(array, getattr(in_memory, name))
        assert isinstance(array.base, np.memmap)
        assert not array.flags.writeable
    assert list(folder.iterdir()) == []


@pytest.mark.usefixtures("limited")
@pytest.mark.slow
def test_composed_stages_equal_solve_in_blocks_too(film: gallery.Sequence, in_memory: Solution, tmp_path: Path) -> None:
    cameras = estimate_cameras(film.tracks, given(film), settings=FEW)
    prior = learn_prior(film.tracks, cameras)
    steps: list[Step] = []
    parts = solve_shapes(film.tracks, cameras, prior, film.mesh, scratch=tmp_path, on_step=steps.append)
    for name in ("shapes", "residuals", "weights", "shapes_std", "inlier_probability"):
        assert np.array_equal(getattr(parts, name), getattr(in_memory, name))
    assert isinstance(parts.shapes.base, np.memmap)
    assert steps[-1].fraction == 1
    again = solve_shapes(film.tracks, cameras, prior, film.mesh, start=parts)
    assert again.trace.objective[0] < 1.01 * parts.trace.objective[-1]
    with pytest.raises(InvalidInput) as caught:
        solve_shapes(film.tracks, cameras, prior, film.mesh, start=parts.shapes[:, :5])
    assert (caught.value.code, caught.value.field, caught.value.got) == ("wrong_shape", "start", f"({FRAMES}, 5, 3)")


MEASURED = """
import sys
from pathlib import Path
from pliant.solver import KnownCamera, Settings, gallery, solve
from pliant.solver.reconstruction import blocks

def memory(name):
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines[name].split()[0]) * 1024

blocks.BLOCK_OBSERVATIONS = int(sys.argv[1])
def solved(film):
    cameras, settings = KnownCamera.from_arrays(film.rotations, film.scales), Settings(max_reweightings=1)
    solve(film.tracks, film.mesh, cameras=cameras, settings=settings)

film = gallery.face(20, 10_000)
solved(gallery.face(4, 50))  # loads what any solve needs
Path("/proc/self/clear_refs").write_text("5")  # the peak so far
before = memory("VmRSS")
solved(film)
print((memory("VmHWM") - before) / film.tracks.visible.size)
"""


def bytes_per_observation(block: int) -> float:
    ran = subprocess.run(
        [sys.executable, "-c", MEASURED, str(block)], capture_output=True, text=True, timeout=250, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return float(ran.stdout)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux resets the peak of a process")
def test_memory_per_observation_is_bounded_at_once_and_in_blocks() -> None:
    """Besides the tracks (24 bytes): 330 bytes at once; in many small blocks, 56 held for all points plus one block."""
    at_once, in_blocks = bytes_per_observation(10_000_000), bytes_per_observation(20_000)

    assert at_once < 360
    assert in_blocks < 180


@pytest.mark.usefixtures("limited")
def test_a_block_of_points_may_lie_outside_the_picture(film: gallery.Sequence) -> None:
    x = film.tracks.points[..., 0]
    moved = Tracks.from_arrays(film.tracks.points - film.tracks.points.min(axis=(0, 1)))
    size = (float(np.quantile(x - x.min(), 0.6)), float(np.ptp(film.tracks.points[..., 1])) + 1)
    groups = blocks.blocks(moved, 3)
    inside = [(moved.points[:, own, 0] < size[0]).mean() for own in groups]
    assert min(inside) < 0.5 < float((moved.points[..., 0] < size[0]).mean())
    solved = solve(
        moved, film.mesh, cameras=given(film), settings=Settings(prior="smooth", image_size=size, max_reweightings=1)
    )
    assert np.isfinite(solved.shapes).all()
