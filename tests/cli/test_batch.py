"""`pliant submit` of several files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pliant.cli import app
from pliant.cli.exits import Exit
from pliant.cli.session import Session
from pliant.service.testing import InMemoryService
from typer.testing import CliRunner, Result

Run = Callable[..., Result]


@pytest.fixture
def service() -> InMemoryService:
    return InMemoryService(steps=1)


@pytest.fixture
def run(service: InMemoryService, monkeypatch: pytest.MonkeyPatch) -> Run:
    for name in ("PLIANT_URL", "PLIANT_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments], obj=Session(transport=service))


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


def test_a_folder_a_pattern_and_a_list_are_a_job_for_each_file(run: Run, takes: Path) -> None:
    for given in ([takes], [takes / "*.npz"], sorted(takes.glob("*.npz"))):
        ran = run("submit", *given, "--mesh", "none", "--json")
        assert ran.exit_code == 0, ran.output
        rows = json.loads(ran.stdout)
        assert [Path(row["file"]).name for row in rows] == [f"take-{number}.npz" for number in range(3)]
        assert [row["job"]["name"] for row in rows] == [f"take-{number}" for number in range(3)]
    assert len(jobs_of(run)) == 3, "the second and third command found the jobs of the first"


def test_another_option_or_key_makes_other_jobs(run: Run, takes: Path) -> None:
    for more in ([], ["-O", "loss=huber"], ["--key", "again"]):
        assert run("submit", takes, "--mesh", "none", *more).exit_code == 0
    assert len(jobs_of(run)) == 9


def test_results_lie_in_a_folder_for_each_and_a_second_run_goes_on(run: Run, takes: Path, tmp_path: Path) -> None:
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


def test_files_of_other_content_are_kept_unless_forced(run: Run, takes: Path, tmp_path: Path) -> None:
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


def test_a_file_that_is_refused_has_its_row_and_stops_nothing(run: Run, takes: Path) -> None:
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


def test_what_belongs_to_one_job_is_refused(run: Run, takes: Path, tmp_path: Path) -> None:
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
