"""`pliant submit` of several files."""

from __future__ import annotations

import importlib
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Run, words
from pliant.cli import app
from pliant.cli.exits import Exit
from pliant.cli.session import Session
from pliant.client import BadArgument, Client, RemoteJob
from pliant.schemas.job import LONGEST_NAME
from pliant.service.testing import InMemoryService
from typer.testing import CliRunner


@pytest.fixture
def takes(tmp_path: Path) -> Path:
    folder = tmp_path / "takes"
    folder.mkdir()
    for number in range(3):
        np.savez(folder / f"take-{number}.npz", tracks=np.random.default_rng(number).normal(size=(5, 12, 2)))
    (folder / "notes.md").write_text("not a track file")
    return folder


def jobs_of(run: Run) -> list[dict[str, str]]:
    return json.loads(run("list", "--json").stdout)


def test_a_folder_a_pattern_or_a_list_submits_one_job_per_file(run: Run, takes: Path) -> None:
    for given in ([takes], [takes / "*.npz"], sorted(takes.glob("*.npz"))):
        ran = run("submit", *given, "--mesh", "none", "--json")
        assert ran.exit_code == 0, ran.output
        rows = json.loads(ran.stdout)
        assert [Path(row["file"]).name for row in rows] == [f"take-{number}.npz" for number in range(3)]
        assert [row["job"]["name"] for row in rows] == [f"take-{number}" for number in range(3)]
    assert len(jobs_of(run)) == 3, "the second and third command found the jobs of the first"


def test_a_job_that_was_cancelled_is_submitted_again(takes: Path) -> None:
    files = [str(takes / f"take-{number}.npz") for number in (0, 1)]
    slow = InMemoryService(steps=1000)

    def submit() -> list[str]:
        ran = CliRunner().invoke(app, ["submit", *files, "--mesh", "none", "--json"], obj=Session(transport=slow))
        return [row["job"]["id"] for row in json.loads(ran.stdout)]

    first = submit()
    assert submit() == first
    for command, code in (("cancel", Exit.DONE), ("watch", Exit.FAILED)):
        ran = CliRunner().invoke(app, [command, first[0]], obj=Session(transport=slow))
        assert ran.exit_code == code, ran.output
    second = submit()
    assert second[0] != first[0]
    assert second[1] == first[1]
    assert submit() == second


def test_reasons_of_refusals_are_complete_on_a_narrow_terminal(
    run: Run, takes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    np.savez(takes / "short.npz", tracks=np.zeros((2, 12, 2)))
    ran = run("submit", takes, "--mesh", "none", "-o", takes / "out")
    assert ran.exit_code == Exit.FAILED
    assert {each.name for each in (takes / "out").iterdir()} == {f"take-{number}" for number in range(3)}
    (line,) = [line for line in ran.stdout.splitlines() if line.startswith(str(takes / "short.npz"))]
    assert "expected at least 3 frames" in line
    assert "More about this error: http" in line


def test_a_folder_with_tracks_and_pictures_is_refused(run: Run, takes: Path) -> None:
    (takes / "frame-1.png").write_bytes(b"")
    ran = run("submit", takes)
    assert ran.exit_code == Exit.REFUSED
    assert "got a folder with both (take-0.npz, frame-1.png). Name the track files" in " ".join(ran.output.split())


def test_a_job_name_over_the_length_limit_is_shortened(run: Run, takes: Path) -> None:
    files = [(takes / "take-0.npz").rename(takes / f"{'x' * 230}.npz"), takes / "take-1.npz"]
    for _ in range(2):
        ran = run("submit", *files, "--mesh", "none")
        assert ran.exit_code == 0, ran.output
    assert sorted(job["name"] for job in jobs_of(run)) == ["take-1", "x" * LONGEST_NAME]


def test_another_option_or_key_creates_new_jobs(run: Run, takes: Path) -> None:
    for more in ([], ["-O", "loss=huber"], ["--key", "again"]):
        assert run("submit", takes, "--mesh", "none", *more).exit_code == 0
    assert len(jobs_of(run)) == 9


def test_changed_inputs_priority_or_webhook_secret_create_new_jobs(
    run: Run, takes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, truth, rotations = (tmp_path / name for name in ("mesh.npz", "truth.npz", "rotations.npz"))
    np.savez(mesh, faces=[[0, 1, 2]])
    np.savez(truth, shapes=np.random.default_rng(7).normal(size=(5, 12, 3)))
    np.savez(rotations, rotations=np.tile(np.eye(3), (5, 1, 1)))
    files = ("-m", mesh, "-g", truth, "-r", rotations, "--webhook", "https://example.org/")

    def number_of_jobs(*more: str) -> int:
        ran = run("submit", takes / "take-0.npz", takes / "take-1.npz", *files, *more)
        assert ran.exit_code == 0, ran.output
        return len(jobs_of(run))

    monkeypatch.setenv("PLIANT_WEBHOOK_SECRET", f"whsec_{'A' * 43}=")
    assert [number_of_jobs(), number_of_jobs()] == [2, 2]
    assert [number_of_jobs("--priority", "high"), number_of_jobs("--priority", "high")] == [4, 4]
    np.savez(mesh, faces=[[0, 1, 2], [1, 2, 3]])
    assert [number_of_jobs(), number_of_jobs()] == [6, 6]
    np.savez(truth, shapes=np.random.default_rng(8).normal(size=(5, 12, 3)))
    assert [number_of_jobs(), number_of_jobs()] == [8, 8]
    np.savez(rotations, rotations=np.tile(-np.eye(3)[[1, 0, 2]], (5, 1, 1)))
    assert [number_of_jobs(), number_of_jobs()] == [10, 10]
    monkeypatch.setenv("PLIANT_WEBHOOK_SECRET", f"whsec_{'B' * 42}A=")
    assert [number_of_jobs(), number_of_jobs()] == [12, 12]
    files = ("-m", mesh.rename(tmp_path / "same.npz"), *files[2:])
    assert number_of_jobs() == 12, "the content counts, not the path"


def test_results_get_a_folder_per_file_and_a_second_run_resumes(run: Run, takes: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = run("submit", takes, "--mesh", "none", "-o", out)
    assert first.exit_code == 0, first.output
    assert first.stdout.count("succeeded") == 3
    np.savez(takes / "take-3.npz", tracks=np.random.default_rng(9).normal(size=(5, 12, 2)))
    (out / "take-1" / "shapes.npz").unlink()
    again = run("submit", takes, "--mesh", "none", "-o", out)
    assert again.exit_code == 0, again.output
    assert sorted(path.name for path in out.iterdir()) == [f"take-{number}" for number in range(4)]
    assert all((out / f"take-{number}" / "shapes.npz").is_file() for number in range(4))
    assert len(jobs_of(run)) == 4


def test_existing_files_are_kept_unless_forced(run: Run, takes: Path, tmp_path: Path) -> None:
    kept = tmp_path / "out" / "take-0" / "shapes.npz"
    kept.parent.mkdir(parents=True)
    kept.write_text("mine")
    command = ("submit", takes, "--mesh", "none", "-o", tmp_path / "out")
    ran = run(*command, "--json")
    assert ran.exit_code == Exit.FAILED
    rows = json.loads(ran.stdout)
    assert [row["error"] for row in rows] == [
        f"--output: {kept.parent} already holds shapes.npz. Choose another folder, or replace the files with --force.",
        None,
        None,
    ]
    assert [row["job"]["status"] for row in rows] == ["succeeded"] * 3
    assert [path.name for path in kept.parent.iterdir()] == ["shapes.npz"], "nothing else is written beside it"
    assert kept.read_text() == "mine"
    ran = run(*command, "--force")
    assert ran.exit_code == 0, ran.output
    assert np.load(kept)["shapes"].shape == (5, 12, 3)


def test_a_rejected_file_is_reported_and_the_others_continue(run: Run, takes: Path) -> None:
    np.savez(takes / "take-1.npz", tracks=np.ones((2, 9, 2)))
    ran = run("submit", takes, "--mesh", "none", "--wait")
    assert ran.exit_code == Exit.FAILED
    assert (ran.stdout.count("succeeded"), ran.stdout.count("│ refused")) == (2, 1)
    rows = json.loads(run("submit", takes, "--mesh", "none", "--wait", "--json").stdout)
    assert [(row["error"], row["explained_at"]) for row in rows if row["error"] is not None] == [
        (
            "tracks: expected at least 3 frames, got 2. Track a longer clip.",
            "http://127.0.0.1:8000/errors/too_few_frames",
        )
    ]
    assert len(jobs_of(run)) == 2


def test_a_job_deleted_while_it_is_followed_is_reported_and_the_others_continue(
    run: Run, takes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait, deleted = RemoteJob.wait, []

    def delete_the_first(job: RemoteJob, **more: Any) -> Any:
        done = wait(job, **more)
        if not deleted:
            deleted.append(job.id)
            job.delete()
        return done

    monkeypatch.setattr(RemoteJob, "wait", delete_the_first)
    ran = run("submit", takes, "--mesh", "none", "--wait", "--json")
    assert ran.exit_code == Exit.FAILED, ran.output
    assert [row["error"] is None for row in json.loads(ran.stdout)] == [False, True, True]


def test_a_file_that_the_client_rejects_is_reported_and_the_others_continue(
    run: Run, takes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit = Client.submit

    def reject_the_second(client: Client, *given: Any, **more: Any) -> RemoteJob:
        if more["name"] == "take-1":
            raise BadArgument("tracks: expected another file.")
        return submit(client, *given, **more)

    monkeypatch.setattr(Client, "submit", reject_the_second)
    ran = run("submit", takes, "--mesh", "none", "--json")
    assert ran.exit_code == Exit.FAILED, ran.output
    assert [row["error"] for row in json.loads(ran.stdout)] == [None, "tracks: expected another file.", None]


def test_a_file_with_a_used_key_is_reported_and_the_others_continue(
    run: Run, takes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module("pliant.cli.commands.batch")
    monkeypatch.setattr(module, "_key_of", lambda text: str(" take-2 " in text))
    ran = run("submit", takes, "--mesh", "none", "--json")
    assert ran.exit_code == Exit.FAILED, ran.output
    first, second, third = json.loads(ran.stdout)
    assert (first["error"], third["error"]) == (None, None)
    assert (second["job"], second["error"].partition(",")[0]) == (
        None,
        "This Idempotency-Key was used for a different request",
    )
    assert len(jobs_of(run)) == 2


def test_a_missing_token_ends_the_batch_at_the_first_file(takes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PLIANT_TOKEN", raising=False)
    service = InMemoryService(auth="required")
    ran = CliRunner().invoke(app, ["submit", str(takes), "--mesh", "none"], obj=Session(transport=service))
    assert ran.exit_code == Exit.NOT_NOW
    assert [request.url.path for request in service.requests] == ["/v1/jobs"]


def test_single_job_options_empty_inputs_and_name_clashes_are_rejected(run: Run, takes: Path, tmp_path: Path) -> None:
    for more in (["--id", "mine"], ["--name", "a name"], ["--region", takes / "take-0.npz"]):
        ran = run("submit", takes / "take-0.npz", takes / "take-1.npz", *more)
        assert ran.exit_code == Exit.REFUSED, more
        assert more[0] in ran.stderr
    (tmp_path / "empty").mkdir()
    for nothing in (tmp_path / "empty", takes / "*.mat", takes / "missing.npz"):
        assert run("submit", nothing).exit_code == Exit.REFUSED
    (tmp_path / "more").mkdir()
    np.savez(tmp_path / "more" / "take-0.npz", tracks=np.zeros((5, 12, 2)))
    ran = run("submit", takes, tmp_path / "more", "-o", tmp_path / "out")
    assert ran.exit_code == Exit.REFUSED
    assert "take-0" in ran.stderr


def test_a_priority_reaches_the_job(run: Run, takes: Path) -> None:
    ran = run("submit", takes / "take-0.npz", "--mesh", "none", "--priority", "high", "--json")
    assert json.loads(ran.stdout)["priority"] == "high"
    assert run("submit", takes / "take-0.npz", "--priority", "urgent").exit_code == Exit.USAGE


def test_ids_are_printed_at_submission_and_progress_while_waiting(
    run: Run, service: InMemoryService, takes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.worker.steps = 30
    monkeypatch.setattr(importlib.import_module("pliant.cli.commands.batch"), "LINE_EVERY", 0.1)
    ran = run("submit", takes, "--mesh", "none", "--wait", "--json")
    assert ran.exit_code == 0, ran.output
    lines = ran.stderr.splitlines()
    ids = [f"{row['file']}: job {row['job']['id']}" for row in json.loads(ran.stdout)]
    assert [line for line in lines if ": job " in line] == ids
    assert lines.index(ids[-1]) < lines.index(f"{takes / 'take-0.npz'}: succeeded")
    form = re.compile(rf"\d+ s: [a-z]+ \d+%, {re.escape(str(takes))}/take-\d\.npz(, .*)?")
    while_waiting = [line for line in lines if " s: " in line]
    assert len(while_waiting) >= 3
    assert all(form.fullmatch(line) or line.endswith(" s: waiting") for line in while_waiting), while_waiting


@pytest.mark.parametrize(("count", "rest"), [(3, " and 2 others continue"), (2, " and 1 other continue")])
def test_ctrl_c_while_waiting_prints_how_to_resume(
    run: Run, service: InMemoryService, takes: Path, monkeypatch: pytest.MonkeyPatch, count: int, rest: str
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    service.worker.steps = math.inf
    monkeypatch.setattr("pliant.client._sync.job.RemoteJob.wait", interrupt)
    files = sorted(takes.glob("*.npz"))[:count]
    ran = run("submit", *files, "--mesh", "none", "--wait")
    ids = [line.rpartition(" ")[2] for line in ran.stderr.splitlines() if ": job " in line]
    first = ids[0]
    assert (ran.exit_code, len(ids)) == (Exit.INTERRUPTED, count)
    assert words(ran).partition("error ")[2] == (
        f"Interrupted. Job {first}{rest}: repeat the command to follow all of them, "
        f"`pliant watch {first}` follows this one, `pliant cancel {first}` stops it."
    )
    for each in ids:
        run("cancel", each)
    assert len(jobs_of(run)) == count


def test_ctrl_c_while_submitting_names_the_created_jobs(run: Run, takes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pliant.client import Client

    submit = Client.submit

    def interrupted(self: Client, *given: Any, name: str, **more: Any) -> Any:
        if name == "take-1":
            raise KeyboardInterrupt
        return submit(self, *given, name=name, **more)

    monkeypatch.setattr(Client, "submit", interrupted)
    ran = run("submit", takes, "--mesh", "none")
    (only,) = [job["id"] for job in jobs_of(run)]
    assert ran.exit_code == Exit.INTERRUPTED
    assert words(ran) == (
        f"{takes / 'take-0.npz'}: job {only} error Interrupted. Job {only} continues: `pliant watch {only}` follows it, "
        f"`pliant cancel {only}` stops it."
    )
