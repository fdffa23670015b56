"""Tracks seen by a distant pinhole camera, simulated tracker errors, and the table of camera-model choices."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pliant.solver import Tracks


def standing(frames: int = 60, points: int = 80) -> Tracks:
    places = np.random.default_rng(5).uniform(100, 500, (points, 2))
    return Tracks.from_arrays(np.tile(places, (frames, 1, 1)))


def test_a_distant_pinhole_camera_converges_to_orthography(bench) -> None:
    distances = bench("accuracy.distances")
    case = distances.cases(None, points=60, visibility="all", only=["sphere"])
    case = next(iter(case))
    near, shapes, _ = distances.seen_from(case, 3.0)
    far, _, _ = distances.seen_from(case, 1e9)
    flat, _, rotations = distances.seen_from(case, float("inf"))
    moved, same, _ = distances.seen_from(case, float("inf"), travel=2.0)
    path = (moved.points - flat.points)[:, 0, 0] / distances.HALF_SIZE
    assert (path[0], path[-1]) == pytest.approx((-0.5, 1.5))
    np.testing.assert_array_equal(same, shapes)
    np.testing.assert_allclose(far.points, flat.points, atol=1e-5)
    assert np.abs(near.points - flat.points).max() > 10
    seen = shapes @ rotations.transpose(0, 2, 1)
    assert np.abs(seen).max() == pytest.approx(distances.HALF_SIZE)
    np.testing.assert_allclose(flat.points, seen[..., :2] + [639.5, 359.5])


def test_drift_grows_like_a_random_walk_and_noise_does_not(bench) -> None:
    spoiling = bench("accuracy.spoiling")
    tracks = standing(points=2000)
    drift = spoiling.spoiled(tracks, spoiling.SPOILINGS["drift"]).points - tracks.points
    np.testing.assert_allclose(drift.std(axis=(1, 2)), 0.1 * np.sqrt(np.arange(60)), rtol=0.1, atol=1e-9)
    noise = spoiling.spoiled(tracks, spoiling.SPOILINGS["noise"]).points - tracks.points
    np.testing.assert_allclose(noise.std(axis=(1, 2)), 1.0, rtol=0.1)
    assert (spoiling.spoiled(tracks, spoiling.SPOILINGS["clean"]).points == tracks.points).all()


def test_simulated_tracks_are_partial_and_some_jump(bench) -> None:
    spoiling = bench("accuracy.spoiling")
    tracks = standing(points=2000)
    found = spoiling.spoiled(tracks, spoiling.SPOILINGS["births"])
    seen = found.visible > 0
    turns = np.abs(np.diff(seen.astype(int), axis=0, prepend=0, append=0)).sum(axis=0)
    assert set(turns) <= {0, 2}, "a track is seen in one run of frames"
    assert 0.2 < seen.mean() < 0.4
    off = (np.abs(np.where(seen[..., None], found.points - tracks.points, 0)).sum(axis=2) > 0).any(axis=0)
    assert 0.01 < off.mean() <= 0.05
    everything = spoiling.spoiled(tracks, spoiling.SPOILINGS["all"])
    assert (everything.visible > 0).mean() == pytest.approx(0.7)
    assert (np.linalg.norm(everything.points - tracks.points, axis=2)[everything.visible > 0] > 20).mean() > 0.08


@pytest.mark.long
@pytest.mark.slow
def test_distances_are_measured_once_and_drawn(bench, tmp_path, monkeypatch) -> None:
    distances, plots = bench("accuracy.distances"), bench("figures.plots")
    out = tmp_path / "distances.jsonl"
    given = ["--only", "sphere", "--points", "60", "--distances", "inf", "--methods", "orthographic", "--out", str(out)]
    distances.main(given)
    first = out.read_text()
    distances.main(given)
    assert out.read_text() == first
    kept = {row["metric"]: row for row in map(json.loads, first.splitlines())}
    assert kept["e3d_frame_scaled"]["sequence"].startswith("sphere P=")
    assert kept["mirrored"]["value"] == 0.0
    records = [
        {**row, "sequence": row["sequence"].replace("sphere", "samba")} for row in map(json.loads, first.splitlines())
    ]
    drawn = plots.distance(records)
    assert sum(len(axes.lines) for axes in drawn.axes) == 1


@pytest.mark.long
@pytest.mark.slow
def test_the_choice_of_a_camera_is_tabulated(bench, tmp_path, capsys) -> None:
    choice = bench("accuracy.camera_choice")
    out = tmp_path / "choice.jsonl"
    choice.main(["--only", "sphere", "--points", "60", "--out", str(out)])
    row = json.loads(out.read_text())
    assert row["camera"] == "scaled_orthographic"
    assert row["same_bits"]
    assert "same bits" in capsys.readouterr().out
    choice.main(["--table", "--out", str(out)])
    assert capsys.readouterr().out.count("\n") == 3
