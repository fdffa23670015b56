"""From tracks to a mesh, in process and through the service, with identical results; and the other commands."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, Any

import httpx
import numpy as np
import pytest
from commands import CLEAN
from pliant.cli.demo import GOOD, judge, running
from pliant.solver.gallery import corrupt, face
from pliant.worker.jobs.service import Jobs
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings

pytestmark = pytest.mark.slow


def pliant(*arguments: object, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pliant.cli", *map(str, arguments)]
    return subprocess.run(
        command,
        cwd=folder,
        env={**CLEAN, **environment},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as held:
        return {name: held[name] for name in held.files}


def test_demo_writes_a_result_judges_it_and_stops_on_sigint(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pliant.cli", "demo", "--small", "--keep", "--json"]
    process = subprocess.Popen(command, cwd=tmp_path, env=CLEAN, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    printed = document(process.stdout)
    assert printed["job"]["status"] == "succeeded"
    assert httpx.get(f"{printed['url']}/v1/jobs").json()["jobs"][0]["id"] == printed["job"]["id"]
    assert "text/html" in httpx.get(printed["url"]).headers["content-type"]
    process.send_signal(signal.SIGINT)
    assert process.stdout.read() == ""
    process.stdout.close()
    assert process.wait(60) == (0 if printed["good"] else 1)
    with pytest.raises(httpx.ConnectError):
        httpx.get(printed["url"])

    assert printed["good"] == judge(printed["metrics"])
    assert set(GOOD) <= set(printed["metrics"])
    assert all(value > 0 for value in printed["metrics"].values())
    files = {name: tmp_path / path for name, path in printed["files"].items()}
    assert files["shapes.glb"].read_bytes()[:4] == b"glTF"
    shapes = arrays(files["shapes.npz"])["shapes"]
    np.testing.assert_allclose(shapes.mean(axis=1), 0, atol=1e-6 * np.abs(shapes).max())
    report = json.loads(files["report.json"].read_text())
    assert report["options"] == printed["job"]["options"]
    assert list(tmp_path.iterdir()) == [tmp_path / "demo-output"]


def document(stream: IO[str]) -> dict[str, Any]:
    """Read the first JSON document of a stream that stays open."""
    text = ""
    for line in stream:
        text += line
        if line.rstrip() == "}":
            break
    value: dict[str, Any] = json.loads(text)
    return value


def test_work_serves_a_queue_until_it_is_stopped(tmp_path: Path) -> None:
    valkey = Valkey.claim(tmp_path)
    server = valkey.start()
    command = [sys.executable, "-m", "pliant.cli", "work", "--data", str(tmp_path), "--workers", "1", "--json"]
    process = subprocess.Popen(command, env=CLEAN, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert document(process.stdout) == {"workers": 1, "queue": "pliant"}
        jobs = Jobs.open(Settings(data=tmp_path))
        deadline = time.monotonic() + 60
        while jobs.ready()["workers"] != "ok" and time.monotonic() < deadline:
            time.sleep(0.1)
        assert jobs.ready()["workers"] == "ok"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        process.stdout.close()
        assert jobs.ready()["workers"] != "ok"
    finally:
        server.terminate()
        server.wait(10)
        valkey.release()


def test_solve_and_the_service_give_bit_identical_results(service_url: str, tmp_path: Path) -> None:
    sequence = corrupt(face(8, 80), noise=0.005, outliers=0.03, hidden=0.05, seed=5)
    points = np.where(sequence.tracks.visible[..., None] > 0, sequence.tracks.points, np.nan)
    np.savez(tmp_path / "tracks.npz", tracks=points)
    np.savez(tmp_path / "mesh.npz", faces=sequence.mesh.faces)
    np.savez(tmp_path / "truth.npz", shapes=sequence.shapes, rotations=sequence.rotations)
    inputs = (
        "tracks.npz",
        "--mesh",
        "mesh.npz",
        "--ground-truth",
        "truth.npz",
        "-O",
        "seed=3",
        "-O",
        "max_reweightings=6",
        "-O",
        "surface=free",
        "-O",
        "outputs=glb,ply,obj,usd,mat,csv",
        "-O",
        "colours=error",
    )
    here = pliant("solve", *inputs, "-o", "here", "--threads", 1, "--json", folder=tmp_path)
    assert here.returncode == 0, here.stderr
    there = pliant("submit", *inputs, "-o", "there", "--json", folder=tmp_path, PLIANT_URL=service_url)
    assert there.returncode == 0, there.stderr
    one, other = arrays(tmp_path / "here" / "shapes.npz"), arrays(tmp_path / "there" / "shapes.npz")
    assert set(one) == set(other)
    assert {
        name for name in one if not np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
    } == set()
    assert json.loads(here.stdout)["metrics"] == json.loads(there.stdout)["metrics"]
    assert one["shapes"].shape == sequence.shapes.shape
    names = {path.name for path in (tmp_path / "here").iterdir()}
    assert names == {path.name for path in (tmp_path / "there").iterdir()}
    assert {
        "shapes.glb",
        "shapes_ply.zip",
        "shapes_obj.zip",
        "shapes.usdc",
        "shapes.mat",
        "metrics_frames.csv",
    } <= names
    for name in names - {"report.json"}:
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes(), name


def test_solve_reports_invalid_input_as_json_with_its_exit_code(tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=np.ones((2, 9, 2)))
    ran = pliant("solve", "tracks.npz", "-o", "out", "--json", folder=tmp_path)
    assert ran.returncode == 3
    printed = json.loads(ran.stderr)
    assert (printed["code"], printed["field"], printed["got"], printed["exit_code"]) == (
        "too_few_frames",
        "tracks",
        "2",
        3,
    )
    assert not (tmp_path / "out").exists()


def test_ambiguous_inputs_list_choices_that_can_be_selected(tmp_path: Path) -> None:
    np.savez(tmp_path / "noise.npz", W=np.random.default_rng(0).normal(size=(16, 9)))
    ran = pliant("inspect", "noise.npz", folder=tmp_path)
    assert ran.returncode == 3
    assert "rows=interleaved" in ran.stderr
    assert "rows=stacked" in ran.stderr
    assert pliant("inspect", "noise.npz", "-O", "rows=stacked", folder=tmp_path).returncode == 0


def test_inspect_shows_how_a_file_is_interpreted(tmp_path: Path) -> None:
    sequence = face(12, 60)
    tracked = sequence.tracks.points[None].transpose(0, 2, 1, 3)
    np.savez(tmp_path / "tapir.npz", tracks=tracked, visibles=np.ones(tracked.shape[:3], bool))
    ran = pliant("inspect", "tapir.npz", "--json", "-O", "layout=points_frames", folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
    printed = json.loads(ran.stdout)
    assert (printed["num_frames"], printed["num_points"]) == sequence.tracks.points.shape[:2]
    ran = pliant("inspect", "tapir.npz", "-O", "layout=points_frames", folder=tmp_path)
    assert f"12 frames × {sequence.tracks.num_points} points" in ran.stdout


@pytest.mark.long
def test_up_rejects_ports_and_folders_in_use_and_leaves_no_process(tmp_path: Path) -> None:
    with running(tmp_path / "one") as url:
        port = url.rpartition(":")[2]
        busy = pliant("up", "--port", port, "--data", "other", folder=tmp_path)
        assert busy.returncode == 3
        assert "--port 0 takes a free one" in busy.stderr
        twice = pliant("up", "--port", "0", "--data", tmp_path / "one" / "data", folder=tmp_path)
        assert twice.returncode == 6
        assert "already used" in twice.stderr
    left = [entry for entry in Path("/proc").glob("[0-9]*/cmdline") if str(tmp_path).encode() in _read(entry)]
    assert left == []


def _read(entry: Path) -> bytes:
    try:
        return entry.read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def test_doctor_accepts_a_healthy_installation_and_reports_faults(tmp_path: Path) -> None:
    ran = pliant("doctor", "--port", 1, "--url", "http://127.0.0.1:9", "--json", folder=tmp_path)
    found = {finding["what"]: finding for finding in json.loads(ran.stdout)}
    assert (found["Python"]["verdict"], found["packages"]["verdict"], found["queue"]["verdict"]) == (
        "good",
        "good",
        "good",
    )
    assert found["service"]["verdict"] == "note"
    assert "pliant up" in found["service"]["advice"]
    assert ran.returncode == 0
    (tmp_path / "file").write_text("not a folder")
    dead = {"PLIANT_REDIS_URL": "redis://127.0.0.1:9"}
    ran = pliant("doctor", "--data", "file/data", "--url", "http://127.0.0.1:9", folder=tmp_path, **dead)
    assert ran.returncode == 8
    words = " ".join(ran.stdout.split())
    assert "redis://127.0.0.1:9 cannot be used (Connection refused)" in words
    assert "address and password in PLIANT_REDIS_URL; unset it to use the embedded one" in words


def test_fsck_compares_the_stores_with_the_records(tmp_path: Path) -> None:
    data = tmp_path / "data"

    def fsck() -> tuple[int, list[tuple[str, str]]]:
        ran = pliant("fsck", "--data", data, "--json", folder=tmp_path)
        return ran.returncode, [(finding["verdict"], finding["found"]) for finding in json.loads(ran.stdout)]

    refused = pliant("fsck", "--data", data, folder=tmp_path)
    assert refused.returncode == 3
    assert "expected the directory of an installation" in refused.stderr
    assert not data.exists()
    valkey = Valkey.claim(data)
    code, ((verdict, found),) = fsck()
    assert (code, verdict, "is unavailable" in found) == (8, "bad", True)
    server = valkey.start()
    try:
        assert fsck() == (0, [("good", "the stores are consistent with the job records")])
        (data / "incoming" / "dead").mkdir(parents=True)
        (data / "incoming" / "dead.lock").touch()
        assert fsck() == (8, [("bad", "Folder incoming/dead belongs to a process that has ended.")])
        (data / "uploads" / "somebody" / "half").mkdir(parents=True)
        code, findings = fsck()
        assert code == 8
        assert findings == [
            ("bad", "Upload half holds nothing; expected exactly one file."),
            ("bad", "Folder incoming/dead belongs to a process that has ended."),
        ]
    finally:
        server.terminate()
        server.wait(10)
        valkey.release()


@pytest.mark.parametrize(
    ("shell", "asked"),
    [
        ("bash", {"COMP_WORDS": "pliant sta", "COMP_CWORD": "1"}),
        ("zsh", {"_TYPER_COMPLETE_ARGS": "pliant sta"}),
        ("fish", {"_TYPER_COMPLETE_ARGS": "pliant sta", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}),
    ],
)
def test_shell_completion_offers_matching_commands(shell: str, asked: dict[str, str], tmp_path: Path) -> None:
    ran = pliant(folder=tmp_path, _PLIANT_COMPLETE=f"complete_{shell}", **asked)
    assert "status" in ran.stdout
    assert "submit" not in ran.stdout
