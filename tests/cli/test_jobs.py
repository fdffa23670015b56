"""The commands that use a service, against the in-memory service: output and exit codes."""

from __future__ import annotations

import errno
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Run
from PIL import Image
from pliant.cli import app
from pliant.cli.exits import Exit, code_of
from pliant.cli.session import Session
from pliant.client import Client, Problem
from pliant.service.testing import InMemoryService
from typer.testing import CliRunner

FAULT = Problem(
    title="Lost", status=500, code="worker_lost", detail="The worker vanished. Retry the job.", retryable=True
)


@pytest.fixture
def endless(run: Run, service: InMemoryService, tracks: Path) -> None:
    """Occupy the worker until the end of the test, so that further jobs stay queued."""
    service.worker.steps = math.inf
    submitted(run, tracks, "--id", "endless")


def submitted(run: Run, tracks: Path, *more: object) -> dict[str, Any]:
    ran = run("submit", tracks, "--json", *more)
    assert ran.exit_code == 0, ran.output
    return json.loads(ran.stdout)


def test_inspect_can_use_a_service(run: Run, service: InMemoryService, tracks: Path) -> None:
    ran = run("inspect", tracks, "--mesh", "3x4", "-O", "loss=huber", "--url", "http://pliant.test", "--json")
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["num_points"] == 12
    assert [request.url.path for request in service.requests] == ["/v1/inspect"]
    assert "5 frames × 12 points" in run("inspect", tracks, "--url", "http://pliant.test").stdout
    np.savez(tracks, tracks=np.ones((2, 9, 2)))
    assert run("inspect", tracks, "--url", "http://pliant.test").exit_code == Exit.REFUSED


def test_inspect_through_a_service_refuses_a_mask_among_the_pictures(run: Run, tmp_path: Path) -> None:
    for name in ("1.png", "mask.png"):
        Image.new("L", (8, 6), 255).save(tmp_path / name)
    ran = run("inspect", tmp_path, "--region", tmp_path / "mask.png", "--url", "http://pliant.test")
    assert ran.exit_code == Exit.REFUSED
    assert "region: expected a mask outside the film's folder of pictures" in ran.stderr


def test_submit_wait_and_fetch_in_one_command(run: Run, tracks: Path, tmp_path: Path) -> None:
    ran = run(
        "submit", tracks, "--mesh", "3x4", "-O", "loss=huber", "-O", "fps=30", "-n", "take", "-o", tmp_path / "out"
    )
    assert ran.exit_code == 0, ran.output
    assert "succeeded" in ran.stdout
    assert "5 frames × 12 points" in ran.stdout
    assert np.load(tmp_path / "out" / "shapes.npz")["shapes"].shape == (5, 12, 3)
    assert (tmp_path / "out" / "shapes.glb").is_file()


def test_options_reach_the_service(run: Run, tracks: Path) -> None:
    job = submitted(run, tracks, "-O", "loss=huber", "-O", "fps=30", "-O", "basis_size=null", "--id", "mine")
    assert (job["options"]["loss"], job["options"]["fps"], job["options"]["basis_size"]) == ("huber", 30.0, None)
    assert job["id"] == "mine"


def test_submit_without_waiting_prints_how_to_follow(run: Run, tracks: Path) -> None:
    ran = run("submit", tracks)
    assert ran.exit_code == 0
    assert "pliant watch" in ran.stderr
    assert "queued" in ran.stdout


def test_every_json_output_is_one_document(run: Run, tracks: Path, tmp_path: Path) -> None:
    job = submitted(run, tracks)["id"]
    assert json.loads(run("status", job, "--json").stdout)["id"] == job
    assert json.loads(run("watch", job, "--json").stdout)["status"] == "succeeded"
    assert json.loads(run("log", job, "--json").stdout) == run("log", job).stdout.splitlines() != []
    assert [each["id"] for each in json.loads(run("list", "--json").stdout)] == [job]
    paths = json.loads(run("result", job, "-o", tmp_path / "r", "--json").stdout)
    assert all(Path(path).is_file() for path in paths.values())
    assert "properties" in json.loads(run("options", "--json").stdout)
    assert json.loads(run("delete", job, "--json").stdout) == {"deleted": [job]}


def test_list_shows_the_newest_first_and_filters(run: Run, tracks: Path, service: InMemoryService) -> None:
    submitted(run, tracks, "--id", "job-0")
    run("watch", "job-0")
    service.worker.steps = math.inf
    submitted(run, tracks, "--id", "busy")
    for n in (1, 2):
        submitted(run, tracks, "--id", f"job-{n}")
    rows = [line.split()[:2] for line in run("list").stdout.splitlines()[1:]]
    assert [rows[0], rows[1], rows[3]] == [["job-2", "queued"], ["job-1", "queued"], ["job-0", "succeeded"]]
    assert [line.split()[0] for line in run("list", "-s", "succeeded").stdout.splitlines()[1:]] == ["job-0"]
    assert len(run("list", "--limit", 2).stdout.splitlines()) == 3


def test_result_can_fetch_a_single_file(run: Run, tracks: Path, tmp_path: Path) -> None:
    job = submitted(run, tracks)["id"]
    run("watch", job)
    ran = run("result", job, "-o", tmp_path / "some", "--only", "report.json")
    assert ran.stdout.strip() == str(tmp_path / "some" / "report.json")
    assert [path.name for path in (tmp_path / "some").iterdir()] == ["report.json"]


def test_a_grid_size_may_be_written_with_a_multiplication_sign(run: Run, tracks: Path) -> None:
    assert submitted(run, tracks, "--mesh", "3×4")["interpretation"]["mesh_grid"] == [3, 4]


def test_an_empty_name_is_the_default(run: Run, tracks: Path) -> None:
    assert submitted(run, tracks, "--name", "")["name"] == tracks.stem


def test_usage_errors_are_json_with_json(run: Run) -> None:
    ran = run("submit", "--json")
    assert ran.exit_code == Exit.USAGE
    assert json.loads(ran.stderr)["exit_code"] == Exit.USAGE
    assert "Missing argument" in json.loads(ran.stderr)["detail"]


def test_names_with_brackets_are_shown_as_they_are(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "named.npz"
    tracks = np.random.default_rng(1).normal(size=(5, 12, 2))
    np.savez(file, tracks=tracks, point_names=["[/b]nose", "[red]eye", *map(str, range(10))])
    ran = run("submit", file, "--wait")
    assert ran.exit_code == 0, ran.output
    assert "[/b]nose" in ran.stdout


def test_a_named_job_is_downloaded_again_into_the_same_folder(run: Run, tracks: Path, tmp_path: Path) -> None:
    for _ in range(2):
        ran = run("submit", tracks, "--id", "again", "-o", tmp_path / "out")
        assert ran.exit_code == 0, ran.output
        (tmp_path / "out" / "report.json").unlink()
    (tmp_path / "out" / "shapes.npz").write_text("mine")
    assert run("submit", tracks, "--id", "again", "-o", tmp_path / "out").exit_code == Exit.REFUSED
    assert (tmp_path / "out" / "shapes.npz").read_text() == "mine"


def test_a_job_named_twice_is_deleted_once(run: Run, tracks: Path) -> None:
    job = submitted(run, tracks)["id"]
    run("watch", job)
    ran = run("delete", job, job[:-1], "--json")
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout) == {"deleted": [job]}


@pytest.mark.parametrize("token", ["ü€", "a b", "a\x1bb"])
def test_a_token_that_no_header_can_carry_is_refused_without_showing_it(
    token: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLIANT_TOKEN", token)
    ran = run("list")
    assert ran.exit_code == Exit.REFUSED
    assert "PLIANT_TOKEN: expected ASCII" in ran.stderr
    assert token not in ran.stderr


@pytest.mark.parametrize("number", [errno.EFBIG, errno.EIO, errno.EROFS])
def test_errors_of_the_file_system_have_no_traceback(number: int) -> None:
    assert code_of(OSError(number, os.strerror(number))) is Exit.REFUSED


@pytest.mark.usefixtures("endless")
def test_cancel_and_retry(run: Run, tracks: Path) -> None:
    job = submitted(run, tracks)["id"]
    assert "cancelled" in run("cancel", job).stdout
    assert "queued" in run("retry", job).stdout


def test_options_lists_every_option_of_this_installation_or_a_service(run: Run, service: InMemoryService) -> None:
    text = run("options").stdout
    for words in ("temporal_weight", "l1 | l2 | huber", "number ≥ 0 ≤ 1e+06 or null", "boolean"):
        assert words in text
    assert service.requests == []
    assert run("options", "--url", "http://pliant.test").stdout == text
    assert len(service.requests) == 1


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["status", "nobody"], Exit.NOT_FOUND, "There is no job 'nobody'"),
        (["status", "../x"], Exit.REFUSED, "Expected the id of a job"),
        (["list", "-s", "done"], Exit.REFUSED, "expected one of queued, running"),
        (["submit", "no-such-file.npz"], Exit.REFUSED, "got no file at no-such-file.npz"),
        (["submit", "TRACKS", "-O", "loss"], Exit.REFUSED, "expected NAME=VALUE, got 'loss'"),
        (["submit", "TRACKS", "-O", "los=l1"], Exit.REFUSED, "got the unknown name 'los'. Did you mean loss?"),
        (["submit", "TRACKS", "-O", "loss=l3"], Exit.REFUSED, "loss: expected 'l1', 'l2' or 'huber', got 'l3'"),
        (["submit", "TRACKS", "-m", "no.obj"], Exit.REFUSED, "mesh: expected a mesh file, ROWSxCOLUMNS or none"),
        (["result", "JOB"], Exit.NOT_NOW, "there is no result yet"),
        (["delete", "JOB"], Exit.NOT_NOW, "Cancel it first"),
        (["retry", "JOB"], Exit.NOT_NOW, "Wait until it ends"),
        (["submit", ""], Exit.REFUSED, "got an empty argument"),
        (["submit", "TRACKS", "--mesh", ""], Exit.REFUSED, "got an empty argument"),
        (["submit", "TRACKS", "--jso"], Exit.USAGE, "No such option"),
        (["result", "JOB", "--fps", "50"], Exit.REFUSED, "--fps: expected --make beside it"),
        (["submit"], Exit.USAGE, "Missing argument"),
        (["frobnicate"], Exit.USAGE, "No such command"),
        (["list", "--url", "nowhere"], Exit.REFUSED, "Expected the address of a service"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
@pytest.mark.usefixtures("endless")
def test_every_error_has_its_exit_code_and_message(
    run: Run, tracks: Path, arguments: list[str], code: Exit, words: str
) -> None:
    job = submitted(run, tracks)["id"]
    ran = run(*({"TRACKS": str(tracks), "JOB": job}.get(word, word) for word in arguments))
    assert ran.exit_code == code
    assert words in " ".join(ran.stderr.split())
    assert ran.stdout == ""


def test_a_failed_job_ends_with_exit_code_1_and_its_message(tracks: Path) -> None:
    session = Session(transport=InMemoryService(problem=FAULT))
    ran = CliRunner().invoke(app, ["submit", str(tracks), "--wait"], obj=session)
    assert ran.exit_code == Exit.FAILED
    assert "The worker vanished. Retry the job." in ran.stderr
    ran = CliRunner().invoke(app, ["submit", str(tracks), "--wait", "--json"], obj=session)
    assert json.loads(ran.stderr)["code"] == "worker_lost"
    assert json.loads(ran.stderr)["exit_code"] == 1


class Impatient(Session):
    """Gives up on a service that never answered after a fraction of the usual five seconds."""

    def client(self, url: str, *, first_contact: float | None = None) -> Client:
        return super().client(url, first_contact=0.3)


def test_timeouts_and_unreachable_services_have_exit_codes(tracks: Path) -> None:
    endless = Session(transport=InMemoryService(steps=math.inf))
    ran = CliRunner().invoke(app, ["submit", str(tracks), "--wait", "--timeout", "0.3"], obj=endless)
    assert ran.exit_code == Exit.TIMEOUT
    ran = CliRunner().invoke(app, ["list", "--url", "http://127.0.0.1:9", "--json"], obj=Impatient())
    assert ran.exit_code == Exit.UNREACHABLE
    assert "pliant up" in json.loads(ran.stderr)["detail"]


def test_the_token_comes_from_the_environment(tracks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = InMemoryService(auth="required")
    session = Session(transport=service)
    ran = CliRunner().invoke(app, ["list"], obj=session)
    assert ran.exit_code == Exit.NOT_NOW
    monkeypatch.setenv("PLIANT_TOKEN", f"{service.create_token()}\r\n")  # of a file with the line ends of Windows
    assert CliRunner().invoke(app, ["list"], obj=session).exit_code == 0


def test_ctrl_c_ends_with_exit_code_130(tracks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pliant.client._sync.client.Client.submit", interrupt)
    ran = CliRunner().invoke(app, ["submit", str(tracks)], obj=Session(transport=InMemoryService()))
    assert ran.exit_code == Exit.INTERRUPTED
    assert "Interrupted" in ran.stderr


def test_a_defect_keeps_its_traceback(tracks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("pliant.client._sync.client.Client.list", break_down)
    ran = CliRunner().invoke(app, ["list"], obj=Session(transport=InMemoryService()))
    assert isinstance(ran.exception, ZeroDivisionError)


def test_version(run: Run) -> None:
    assert run("--version").stdout.startswith("pliant 0.")
