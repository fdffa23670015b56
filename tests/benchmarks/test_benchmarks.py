"""The benchmarks at tiny sizes: they run, resume, decimate meshes correctly and detect regressions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pliant.solver import KnownCamera, Mesh, Settings, solve
from pliant.solver.gallery import corrupt, face, sphere
from pliant.solver.tracks.normalization import normalize

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.accuracy", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=240, check=False)


@pytest.fixture
def run_here(bench, monkeypatch, capsys):
    """Return a function that runs the accuracy benchmark in this process and returns what it prints."""
    monkeypatch.chdir(ROOT)

    def ran(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["accuracy", *map(str, arguments)])
        capsys.readouterr()
        assert bench("accuracy.__main__").main() == 0
        return capsys.readouterr().out

    return ran


def write_case(folder: Path) -> None:
    made = face(5, 120)
    folder.mkdir(parents=True)
    np.savez(folder / "tracks.npz", tracks=made.tracks.points, visibility=made.tracks.visible > 0)
    np.savez(folder / "mesh.npz", faces=made.mesh.faces)
    np.savez(folder / "truth.npz", shapes=made.shapes, rotations=made.rotations[:, :2])
    (folder / "about.json").write_text(json.dumps({"units": "pixels"}))


@pytest.mark.long
def test_accuracy_runs_resume_without_remeasuring(tmp_path, run_here):
    write_case(tmp_path / "data" / "tiny")
    results = tmp_path / "cells.jsonl"
    arguments = ("--data", tmp_path / "data", "--points", 40, "--methods", "pseudo_inverse,temporal", "--corruptions",
                 "clean,outliers 6", "--trials", 2, "--results", results)  # fmt: skip
    first = run(*arguments)
    assert first.returncode == 0, first.stderr
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    assert len(rows) == 2 * 2 * (1 + 2)  # cameras × methods × (clean once, outliers twice)
    assert {row["points"] for row in rows} == {40}
    assert all(row["commit"] for row in rows)
    assert "| tiny, 5 × 40 | outliers 6 % | 2 |" in first.stdout
    assert f"{len(rows)} cells, measured at {rows[0]['commit']}" in first.stdout
    summary = tmp_path / "summary.jsonl"
    assert run_here(*arguments, "--tables", "--summary", summary) == ""
    records = [json.loads(line) for line in summary.read_text().splitlines()]
    assert {record["metric"] for record in records} == set(rows[0]["metrics"])
    spoiled = [r for r in records if r["corruption"] != "clean" and r["metric"] == "e3d_frame"]
    errors = [r["metrics"]["e3d_frame"] for r in rows if (r["corruption"], r["cameras"], r["method"]) == (
        spoiled[0]["corruption"], spoiled[0]["cameras"], spoiled[0]["method"])]  # fmt: skip
    assert spoiled[0]["trials"] == 2
    assert spoiled[0]["mean"] == pytest.approx(np.mean(errors))
    assert spoiled[0]["std"] == pytest.approx(np.std(errors, ddof=1))
    kept = results.read_text()
    results.write_text(kept[:-40])  # the last line was cut off by an interruption
    run_here(*arguments)
    lines = results.read_text().splitlines()
    assert lines[:-2] == kept.splitlines()[:-1]  # nothing else was remeasured
    remade, original = json.loads(lines[-1]), json.loads(kept.splitlines()[-1])
    assert remade["metrics"] == pytest.approx(original["metrics"])


def test_results_of_another_commit_are_remeasured_only_on_request(tmp_path, run_here):
    write_case(tmp_path / "data" / "tiny")
    results = tmp_path / "cells.jsonl"
    arguments = ("--data", tmp_path / "data", "--methods", "pseudo_inverse", "--cameras", "true", "--results", results)
    run_here(*arguments)
    old = json.loads(results.read_text())
    results.write_text(json.dumps({**old, "commit": "0ld"}) + "\n")
    assert "measured at 0ld" in run_here(*arguments)
    assert len(results.read_text().splitlines()) == 1
    again = run_here(*arguments, "--remeasure")
    assert f"1 cells, measured at {old['commit']}" in again
    assert len(results.read_text().splitlines()) == 2


def test_the_plan_names_existing_sequences_methods_and_corruptions(bench):
    plan, cells = bench("accuracy.plan"), bench("accuracy.cells")
    for part in plan.PARTS:
        assert set(part.methods) <= set(cells.METHODS)
        for word in part.corruptions:
            assert word in ("all", "clean") or any(word in name for name in cells.CORRUPTIONS)


def test_thinning_keeps_a_closed_surface_closed(bench):
    ball = sphere(3, 2000)
    points = ball.shapes[0]
    kept = bench("subsample").thin_points(points, 150)
    assert len(set(kept.tolist())) == 150
    thin = bench("subsample").thin_mesh(ball.mesh, points, kept)
    assert thin.num_points == 150
    assert 150 - len(thin.edges) + len(thin.faces) == 2  # Euler's number of a sphere
    corners = points[kept][thin.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ti,ti->t", outward, corners.mean(axis=1) - points.mean(axis=0)) > 0).mean() > 0.98
    assert np.ptp(np.linalg.norm(np.diff(points[kept][thin.edges], axis=1), axis=-1)) < 250


def test_thinning_keeps_components_apart(bench):
    two = np.concatenate([np.arange(6).reshape(2, 3), 6 + np.arange(6).reshape(2, 3)])
    faces = np.concatenate([Mesh.from_grid(np.arange(6).reshape(2, 3)).faces + shift for shift in (0, 6)])
    points = np.zeros((12, 3))
    points[:, 0] = np.tile(np.arange(3), 4)
    points[:, 1] = np.repeat([0, 1, 5, 6], 3)
    kept = np.array([0, 2, 3, 5, 6, 8, 9, 11])
    thin = bench("subsample").thin_mesh(Mesh.from_faces(faces, 12), points, kept)
    assert two.shape == (4, 3)
    side = points[kept][thin.edges][..., 1] > 3
    assert (side[:, 0] == side[:, 1]).all()


def test_all_visible_puts_hidden_points_where_the_camera_would_see_them(bench):
    ball = sphere(8, 100)
    whole = sphere(8, 100, self_occlusion=False)
    sequences = bench("sequences")
    case = sequences.as_given(sequences.from_gallery(ball, "sphere"), "all")
    assert case.tracks.all_visible
    assert case.tracks.points == pytest.approx(whole.tracks.points)
    assert sequences.as_given(sequences.from_gallery(ball, "sphere"), "file").tracks is ball.tracks


def test_a_regression_is_detected_and_noise_is_not(bench):
    gate = bench("accuracy.gate")
    baseline = {"a": 0.1, "b": 0.0, "c": 0.2}
    assert gate.regressions({"a": 0.1055, "b": 0.0009, "c": 0.05}, baseline) == set()
    assert gate.regressions({"a": 0.107, "b": 0.0011, "new": 9.0}, baseline) == {"a", "b"}


@pytest.fixture(scope="module")
def small_problem():
    made = corrupt(face(8, 120), noise=0.01, outliers=0.1)
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)
    settings = Settings(preset="paper", prior="smooth", tolerance=1e-6, max_reweightings=200)
    return made, cameras, settings, solve(made.tracks, made.mesh, cameras=cameras, settings=settings)


@pytest.mark.parametrize("name", ["gradient_descent", "conjugate_gradients", "direct"])
def test_every_baseline_reaches_the_solver_s_energy(bench, small_problem, name):
    made, cameras, settings, solution = small_problem
    baselines, side = bench("speed.baselines"), bench("speed.side_by_side")
    problem, start = side.prepare(made.tracks, made.mesh, cameras, settings)
    centred = normalize(made.tracks)
    translations = (solution.camera.translations - centred.centroid) / centred.unit
    best = solution.trace.objective[-1]
    finished = getattr(baselines, name)(problem, start, translations, target=1.01 * best, cap=30.0)
    assert finished.reached
    assert best * 0.999 < finished.objective[-1] <= 1.01 * best


def test_the_rasteriser_shows_the_nearer_surface_and_its_colour(bench):
    raster = bench("figures.shading")
    square = np.array([(-1, -1, 0), (-1, 1, 0), (1, 1, 0), (1, -1, 0)], dtype=float)
    points = np.concatenate([square, square * 0.5 - (0, 0, 1)])
    faces = np.array([(0, 1, 2, 3), (4, 5, 6, 7)])
    colours = np.array([(1.0, 0, 0)] * 4 + [(0, 1.0, 0)] * 4)
    image = raster.draw_mesh(points, faces, size=(60, 60), scale=20, colours=colours)
    assert image[30, 30, 1] > 0.5 > 0.1 > image[30, 30, 0]
    assert image[15, 15, 0] > 0.5 > 0.1 > image[15, 15, 1]
    assert (image[2, 2] == 1).all()
    covered = (image != 1).any(axis=2)
    assert covered.sum() == pytest.approx(40 * 40, rel=0.02)


def test_every_result_file_is_measured() -> None:
    command = [sys.executable, "-m", "benchmarks.files", "--frames", "6", "--points", "80"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    sizes = {row.split("|")[1].strip(): float(row.split("|")[3]) for row in ran.stdout.splitlines()[3:]}
    assert {"shapes.npz", "shapes.glb", "shapes.usdc", "shapes_obj.zip", "shapes.mat", "metrics_points.csv"} <= set(
        sizes
    )
    assert 24 < sizes["shapes.npz"] < 60
    assert 12 < sizes["shapes.glb"] < 60


@pytest.mark.parametrize("y_up", [False, True])
def test_pictures_show_what_the_camera_saw(bench, y_up: bool) -> None:
    pictures, sequences = bench("figures.pictures"), bench("sequences")
    case = replace(sequences.from_gallery(face(6, 120, degrees=30), "face"), y_up=y_up)
    solution = solve(case.tracks, case.mesh, cameras=case.cameras, settings=Settings(max_reweightings=2))
    exact = replace(solution, shapes=case.shapes)
    film = pictures.scene_of(case, exact, fixed=False, side=0)
    seen = case.tracks.points - case.tracks.points.mean(axis=1, keepdims=True)
    flip = [1, -1] if y_up else [1, 1]
    scales = np.asarray(case.cameras.scales)[:, None, None]
    np.testing.assert_allclose(scales * film.ours[..., :2] * flip, seen, atol=1e-9 * np.ptp(seen))
    np.testing.assert_allclose(film.ours, film.truth, atol=1e-9 * np.ptp(seen))
    assert film.share.max() < 1e-9
    fixed = pictures.scene_of(case, solution, fixed=True, side=0)
    assert fixed.share.max() > 1e-4
    turned = film.truth[0] @ np.linalg.pinv(fixed.truth[0])  # (P, P) of rank 3: another view of the same points
    np.testing.assert_allclose(turned @ fixed.truth[0], film.truth[0], atol=1e-9 * np.ptp(seen))
    alone = pictures.scene_of(replace(case, shapes=None), solution, fixed=True, side=20)
    assert (alone.truth, alone.relative, alone.quantity) == (None, None, "reprojection residual")


@pytest.mark.long
@pytest.mark.parametrize("given", ["mesh and truth", "tracks alone"])
def test_pictures_are_drawn_with_or_without_mesh_and_truth(tmp_path: Path, given: str) -> None:
    from PIL import Image

    write_case(tmp_path / "some")
    if given == "tracks alone":
        for name in ("mesh", "truth"):
            (tmp_path / "some" / f"{name}.npz").unlink()
    command = [
        sys.executable,
        "-m",
        "benchmarks.figures.pictures",
        "--data",
        tmp_path,
        "--at",
        "0,4",
        "--out",
        tmp_path / "out",
    ]
    command += ["--settings", "max_reweightings=2,prior=smooth,camera=orthographic,surface=free"]
    ran = subprocess.run(map(str, command), cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ("e3d_frame" in ran.stdout) == (given == "mesh and truth")
    image = np.asarray(Image.open(tmp_path / "out" / "some.png").convert("L"))
    assert (image < 250).mean() > 0.01


@pytest.mark.parametrize(
    ("value", "text"), [(0.03412, ".0341"), (1.254, "1.25"), (-0.5, "-.500"), (0.0, "0"), (float("nan"), "–")]
)
def test_numbers_are_formatted_as_in_the_literature(bench, value, text):
    assert bench("accuracy.tables").number(value) == text


def test_the_committed_figures_are_drawn_from_the_committed_results(bench, tmp_path, monkeypatch):
    plots = bench("figures.plots")
    drawn = {name for name, (source, _) in plots.FIGURES.items() if plots.read(source)}
    assert drawn
    assert drawn <= {path.stem for path in (ROOT / "docs" / "images").glob("*.png")}
    monkeypatch.setattr(sys, "argv", ["plots", "--into", str(tmp_path)])
    plots.main()
    assert {path.stem for path in tmp_path.glob("*.png")} == drawn
