"""Other authors' methods: exchange of tracks and shapes, reasons of failure, and the table. A script stands in for Octave."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from pliant.solver import Tracks
from pliant.solver.gallery import sphere

FLAT = """
from scipy.io import loadmat, savemat
W = loadmat("tracks.mat")["W"]
S = __import__("numpy").zeros((len(W) // 2 * 3, W.shape[1]))
S[0::3], S[1::3], S[2::3] = W[0::2], W[1::2], {depth}
savemat("shapes.mat", {{"S": S, "seconds": 1.25}})
"""
"""A stand-in for Octave that returns shapes of constant depth."""


@pytest.fixture
def octave(monkeypatch, tmp_path):
    """Replace `octave-cli` by a Python program."""

    def put(program: str) -> None:
        at = tmp_path / "bin" / "octave-cli"
        at.parent.mkdir(exist_ok=True)
        at.write_text(f"#!{sys.executable}\n{program}")
        at.chmod(0o755)
        monkeypatch.setenv("PATH", str(at.parent), prepend=":")

    return put


@pytest.fixture
def data(tmp_path) -> Path:
    """Two sequences without cameras, one of them with a hidden point."""
    sequence = sphere(8, 30)
    for name, seen in (("seen", 1.0), ("hidden", 0.0)):
        folder = tmp_path / "data" / name
        folder.mkdir(parents=True)
        visibility = np.ones(sequence.tracks.points.shape[:2])
        visibility[0, 0] = seen
        np.savez(folder / "tracks.npz", tracks=sequence.tracks.points, visibility=visibility)
        np.savez(folder / "truth.npz", shapes=sequence.shapes)
    return tmp_path / "data"


@pytest.fixture
def code(tmp_path) -> Path:
    """A folder with empty files named like the authors' code."""
    for name in ("a/nrsfm_trajectory.m", "b/NRSFM_BMM.m", "c/install_sdpt3.m", "c/Solver/Mexfun/x.m", "c/.git/y.m"):
        at = tmp_path / "code" / name
        at.parent.mkdir(parents=True, exist_ok=True)
        at.touch()
    return tmp_path / "code"


def test_octave_receives_tracks_and_returns_shapes(bench, octave) -> None:
    octave(FLAT.format(depth=7))
    tracks = np.random.default_rng(0).normal(size=(5, 4, 2))
    shapes, seconds = bench("accuracy.octave").run("S = f (W);", tracks, paths=[], seconds=60)
    assert shapes.shape == (5, 4, 3)
    np.testing.assert_allclose(shapes[..., :2], tracks)
    assert (shapes[..., 2] == 7).all()
    assert seconds == 1.25


def test_the_octave_script_adds_the_paths_before_the_call(bench, octave, tmp_path) -> None:
    octave(f'import shutil; shutil.copytree(".", "{tmp_path}/seen")')
    with pytest.raises(bench("accuracy.octave").Failed):
        bench("accuracy.octave").run("S = f (W, 3);", np.ones((2, 3, 2)), paths=[Path("/first")], seconds=60)
    script = (tmp_path / "seen" / "call.m").read_text().splitlines()
    assert script.index('addpath ("/first");') < script.index("S = f (W, 3);")
    assert (tmp_path / "seen" / "ours" / "fminunc.m").exists()


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import sys; sys.exit('error: out of memory\\nerror: called from')", "^out of memory$"),
        ("import sys; sys.exit(3)", "^octave-cli ended with 3$"),
        ("while True: pass", "^more than 1 s$"),
        (FLAT.format(depth="float('nan')"), "not finite"),
    ],
)
def test_a_failed_octave_run_reports_its_reason(bench, octave, program: str, reason: str) -> None:
    octave(program)
    seconds = 1 if "more than" in reason else 60
    with pytest.raises(bench("accuracy.octave").Failed, match=reason):
        bench("accuracy.octave").run("", np.ones((2, 3, 2)), paths=[], seconds=seconds)


def test_basis_sizes_respect_the_factorization_and_prefer_published_ones(bench) -> None:
    peers, sequences = bench("accuracy.peers"), bench("sequences")
    tracks = Tracks.from_arrays(np.random.default_rng(1).normal(size=(8, 90, 2)))
    case = sequences.Case("some", tracks, None, None, None)
    assert peers.bases("pta", case) == (2, 3, 5)
    assert peers.bases("pnd2", case) == (None,)
    shark = sequences.Case("shark_objframe", tracks, None, None, None)
    assert peers.bases("bmm", case) == (3, 5)
    assert peers.bases("bmm", shark) == (4,)


def test_the_folders_of_the_authors_code_are_found(bench, code) -> None:
    peers = bench("accuracy.peers")
    found = [str(path.relative_to(code)) for path in peers.paths(peers.PEERS["bmm"], code)]
    assert found == ["b", "c/Solver/Mexfun", "c/Solver", "c"]
    with pytest.raises(SystemExit, match=r"No NRSfM_PND2\.m"):
        peers.paths(peers.PEERS["pnd2"], code)


@pytest.mark.slow
def test_each_run_is_measured_once_even_if_it_failed(bench, octave, data, code, tmp_path, capsys) -> None:
    peers, out = bench("accuracy.peers"), tmp_path / "peers.jsonl"
    given = ["--data", str(data), "--code", str(code), "--out", str(out), "--methods"]
    octave(FLAT.format(depth=0))
    peers.main([*given, "pta"])
    octave(f"import sys; sys.exit('error: {code}/b/x.m: too large')")
    peers.main([*given, "pta,bmm"])
    found = [json.loads(line) for line in out.read_text().splitlines()]
    assert {row["sequence"] for row in found} == {"seen"}
    assert [(row["method"], row["K"], row["metric"]) for row in found] == [
        *(("pta", K, metric) for K in (2, 3, 5) for metric in ("e3d_frame", "e3d_frame_similarity")),
        *(("bmm", K, "failed") for K in (3, 5)),
    ]  # fmt: skip
    assert all(0.3 < row["value"] < 1 for row in found if row["method"] == "pta")
    assert {row["reason"] for row in found if row["method"] == "bmm"} == {"b/x.m: too large"}
    shown = capsys.readouterr().out
    assert "hidden: left out" in shown
    before = out.read_text()
    peers.main([*given, "pta,bmm"])
    assert out.read_text() == before


def test_true_shapes_in_another_unit_have_zero_error(bench, octave, data, tmp_path) -> None:
    peers = bench("accuracy.peers")
    case = next(iter(peers.complete(data, points=None, only=["seen"])))
    spread = case.tracks.points.std(axis=1).mean()
    np.save(tmp_path / "truth.npy", case.shapes.transpose(0, 2, 1).reshape(-1, case.tracks.num_points) / spread)
    octave(
        "import numpy; from scipy.io import savemat\n"
        f"savemat('shapes.mat', {{'S': numpy.load('{tmp_path}/truth.npy'), 'seconds': 1.0}})"
    )
    (tmp_path / "NRSfM_PND2.m").touch()
    row = next(iter(peers.measured("pnd2", case, K=None, code=tmp_path, seconds=60)))
    assert (row["metric"], row["points"]) == ("e3d_frame", 30)
    assert row["value"] < 1e-12


def test_the_table_shows_the_best_basis_size_or_the_reason_of_failure(bench, tmp_path) -> None:
    peers, out = bench("accuracy.peers"), tmp_path / "peers.jsonl"
    same = {"sequence": "some", "frames": 8, "points": 30}
    lines = [
        {**same, "method": "pta", "K": 2, "metric": "e3d_frame", "value": 0.5, "seconds": 3.0},
        {**same, "method": "pta", "K": 3, "metric": "e3d_frame", "value": 0.25, "seconds": 4.0},
        {**same, "method": "pta", "K": 3, "metric": "e3d_frame_similarity", "value": 0.1, "seconds": 4.0},
        {**same, "method": "pta", "K": 5, "metric": "failed", "value": None, "reason": "more than 300 s"},
        {**same, "method": "bmm", "K": 3, "metric": "failed", "value": None, "reason": "more than 300 s"},
        {**same, "method": "default", "K": None, "metric": "e3d_frame", "value": 0.125, "seconds": 2.0},
    ]
    out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert peers.table(out).splitlines()[2:] == [
        "| some, 8 × 30 | .250 (K = 3, 4 s) | more than 300 s | – | .125 (2 s) |"
    ]


def test_peers_are_plotted_only_for_the_same_number_of_points(bench, monkeypatch) -> None:
    plots = bench("figures.plots")
    same = {"sequence": "mp_face37", "points": 37, "metric": "e3d_frame"}
    peers = [
        {**same, "method": "pta", "value": 0.5},
        {**same, "method": "pta", "value": 0.25},
        {**same, "method": "pta", "metric": "failed", "value": None},
        {**same, "method": "bmm", "sequence": "horse_gallop", "points": 300, "value": 0.5},
        {**same, "method": "default", "value": 0.01},
    ]
    monkeypatch.setattr(plots, "read", lambda name: peers if name == "peers" else [])
    clean = {"cameras": "estimated", "corruption": "clean", "visibility": "file", "method": "default", "mean": 0.1}
    others = [{"sequence": "horse_gallop", "points": 1000}, {"sequence": "dinosaur_real", "points": 49}]
    figure = plots.error_by_sequence([{**same, **clean, **other} for other in ({}, *others)])
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["galloping horse", "face landmarks"]
    drawn = {each.get_label(): np.asarray(each.get_offsets()).tolist() for each in figure.axes[0].collections}
    assert drawn["trajectory basis (Akhter et al.)"] == [[0.25, 1.0]]
    assert not any("block matrix" in label for label in drawn)
