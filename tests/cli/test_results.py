"""Commands on finished results: further files, share links, other options, and the viewer on local files."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from commands import Run
from fastapi.testclient import TestClient
from pliant.cli import app
from pliant.cli.exits import Exit
from pliant.cli.session import Session
from pliant.service.local_result import create_viewer, read_result
from pliant.service.testing import InMemoryService
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.errors import InvalidRequest
from results import make_result
from typer.testing import CliRunner


@pytest.fixture
def service() -> InMemoryService:
    return InMemoryService()


@pytest.fixture
def job(run: Run, tmp_path: Path) -> str:
    np.savez(tmp_path / "tracks.npz", tracks=np.random.default_rng(0).normal(size=(5, 12, 2)))
    ran = run("submit", tmp_path / "tracks.npz", "--wait", "--json", "-n", "take", "-O", "stride=2")
    assert ran.exit_code == 0, ran.output
    return str(json.loads(ran.stdout)["id"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result as `pliant solve` writes it, beside a file that must not be served."""
    held = tmp_path_factory.mktemp("face")
    inputs, solution, options = make_result(outputs="glb")
    report = build_report(inputs, solution, options, metrics={"e3d_frame": 0.5, "rotation_degrees": float("inf")})
    write_artifacts(inputs, solution, options, report, held)
    (held / "private.txt").write_text("private")
    return held


TAKEN = "Address already in use"


def test_result_make_creates_and_downloads_further_outputs(run: Run, job: str, tmp_path: Path) -> None:
    ran = run("result", job, "--make", "mdd,mat", "--make", "csv", "--fps", "50", "-o", tmp_path / "more")
    assert ran.exit_code == 0, ran.output
    assert {path.name for path in (tmp_path / "more").iterdir()} == {
        "shapes.mdd",
        "shapes.mat",
        "metrics_frames.csv",
        "metrics_points.csv",
    }
    wrong = run("result", job, "--make", "fbx", "-o", tmp_path / "no")
    assert (wrong.exit_code, " ".join(wrong.stderr.split())) == (
        Exit.REFUSED,
        "error outputs.0: expected 'glb', 'ply', 'obj', 'usd', 'abc', 'mdd', 'mat' or 'csv', got 'fbx'. "
        "More about this error: pliant explain invalid_argument",
    )


def test_rerun_uses_the_same_inputs_with_other_options(run: Run, job: str) -> None:
    ran = run("rerun", job, "-O", "loss=l2", "--json")
    assert ran.exit_code == 0, ran.output
    again = json.loads(ran.stdout)
    assert (again["name"], again["options"]["loss"], again["options"]["stride"]) == ("take", "l2", 2)
    assert "pliant watch" in run("rerun", "@last").stderr
    assert run("rerun", job, "-O", "stride=3").exit_code == Exit.REFUSED


def test_share_links_are_created_listed_and_revoked(run: Run, job: str, service: InMemoryService) -> None:
    made = run("share", job, "--days", "2")
    assert made.exit_code == 0, made.output
    address = made.stdout.strip()
    assert address.startswith("http://127.0.0.1:8000/#share=share.")
    token = address.partition("#share=")[2]
    with httpx.Client(
        transport=service, base_url="http://pliant.test", headers={"Authorization": f"Bearer {token}"}
    ) as guest:
        assert guest.get(f"/v1/jobs/{job}").status_code == 200
        (listed,) = json.loads(run("share", job, "--list", "--json").stdout)
        assert listed["id"] in run("share", job, "--list").stdout
        assert token not in run("share", job, "--list", "--json").stdout
        assert run("share", job, "--revoke", listed["id"]).exit_code == 0
        assert guest.get(f"/v1/jobs/{job}").status_code == 401
    assert run("share", job, "--revoke", listed["id"]).exit_code == Exit.NOT_FOUND
    assert json.loads(run("share", job, "--json").stdout)["url"].startswith("http://127.0.0.1:8000/#share=")
    wrong = run("share", job, "--days", "0")
    assert (wrong.exit_code, " ".join(wrong.stderr.split())) == (
        Exit.REFUSED,
        "error days: expected a minute (0.0007) to 366 days, got 0.0. More about this error: pliant explain invalid_argument",
    )


def test_solve_and_submit_write_equal_meshes_named_as_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("PLIANT_TOKEN", raising=False)
    given = tmp_path / "my take.npz"
    np.savez(given, tracks=np.random.default_rng(0).normal(size=(4, 12, 2)))
    same = ("-O", "prior=smooth", "-O", "refine_rotations=false", "-O", "surface=free", "-O", "max_reweightings=1")
    same += ("-O", "outputs=glb,ply,obj", "--mesh", "3x4")
    session = Session(transport=InMemoryService(reconstruct=None))
    for command in ("solve", "submit"):
        ran = CliRunner().invoke(app, [command, str(given), *same, "-o", str(tmp_path / command)], obj=session)
        assert ran.exit_code == 0, ran.output
    for name in ("shapes.glb", "shapes_ply.zip", "shapes_obj.zip"):
        assert (tmp_path / "solve" / name).read_bytes() == (tmp_path / "submit" / name).read_bytes()
    assert list(trimesh.load(tmp_path / "solve" / "shapes.glb", process=False).geometry) == ["my take"]
    record = TestClient(create_viewer(tmp_path / "solve", "t"), base_url="http://127.0.0.1:1").get("/t/v1/jobs/local")
    assert record.json()["name"] == "my take"


def test_the_viewer_serves_only_its_result_and_only_under_its_token(folder: Path) -> None:
    client = TestClient(create_viewer(folder, "secret"), base_url="http://127.0.0.1:1")
    record = client.get("/secret/v1/jobs/local").json()
    assert (record["status"], record["name"], record["metrics"]) == ("succeeded", folder.name, {"e3d_frame": 0.5})
    assert {each["name"] for each in record["artifacts"]} == {"shapes.npz", "shapes.glb", "preview.bin", "report.json"}
    part = client.get("/secret/v1/jobs/local/artifacts/preview.bin", headers={"Range": "bytes=0-7"})
    head = client.head("/secret/v1/jobs/local/artifacts/preview.bin")
    assert (head.status_code, head.headers["content-length"]) == (200, str((folder / "preview.bin").stat().st_size))
    assert (part.status_code, part.content) == (206, b"PLIANTPV")
    missing = (
        "/v1/jobs/local", "/guess/v1/jobs/local", "/secret/v1/jobs/other", "/secret/v1/jobs/local/artifacts/private.txt",
        "/secret/v1/jobs/local/artifacts/..%2Fprivate.txt", "/secret/v1/jobs/other/artifacts/report.json", "/secret/v1/jobs",
    )  # fmt: skip
    assert {path: client.get(path).status_code for path in missing} == dict.fromkeys(missing, 404)
    assert client.get("/secret/v1/jobs/local", headers={"Host": "evil.example"}).status_code == 400
    assert client.post("/secret/v1/jobs/local").status_code == 405


def test_view_rejects_folders_without_a_result_and_busy_ports(run: Run, folder: Path, tmp_path: Path) -> None:
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        no_result = (
            f"error {tmp_path}: expected the folder of a result, as `pliant solve -o` or `pliant result -o` writes it, got a folder "
            "without report.json and preview.bin. Name the folder that holds report.json and preview.bin."
        )
        usage, none = "invalid_argument", tmp_path / "none"
        for arguments, code, words in (
            ((none,), usage, f"error result: {none} does not exist. Name the folder that `pliant solve -o` wrote."),
            ((tmp_path,), "not_a_result", no_result),
            ((folder, "--port", port), usage, f"error --port: cannot listen on {port}: {TAKEN}. Choose another, or 0."),
        ):  # fmt: skip
            ran = run("view", "--no-browser", *arguments)
            assert ran.exit_code == Exit.REFUSED, ran.output
            assert " ".join(ran.stderr.split()) == f"{words} More about this error: pliant explain {code}"
    for text in ("{", "[]", '{"options": 1}'):
        (tmp_path / "report.json").write_text(text)
        (tmp_path / "preview.bin").write_bytes(b"")
        with pytest.raises(InvalidRequest, match="that Pliant did not write"):
            read_result(tmp_path)


def test_the_viewer_listens_before_the_browser_opens(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    def visit(url: str) -> None:
        opened.append(url)
        socket.create_connection(("127.0.0.1", httpx.URL(url).port or 0), timeout=5).close()

    monkeypatch.setattr("webbrowser.open", visit)
    monkeypatch.setattr("uvicorn.Server.run", lambda *_, **__: None)
    ran = run("view", folder)
    assert ran.exit_code == Exit.DONE, ran.output
    assert opened == [ran.stdout.strip()]


@pytest.mark.slow
def test_view_runs_until_ctrl_c(folder: Path) -> None:
    command = [sys.executable, "-m", "pliant.cli", "view", str(folder / "shapes.npz"), "--no-browser", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as viewing:
        assert viewing.stdout is not None
        text = ""
        while not text.endswith("}\n"):
            text += viewing.stdout.readline()
        url: Any = json.loads(text)["url"]
        address = url.partition("#")[0]
        assert httpx.get(f"{address}v1/jobs/local").json()["id"] == "local"
        viewing.send_signal(signal.SIGINT)
        assert viewing.wait(20) == Exit.DONE
