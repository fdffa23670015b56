"""`pliant up` and `pliant work` with settings that cannot work: they end before a process is started."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import Run
from pliant.cli import app
from pliant.cli.doctor import check_memory, check_variables
from pliant.cli.exits import Exit
from pliant.cli.up import service_child
from pliant.worker.processes import memory
from pliant.worker.processes.supervisor import Supervisor
from pliant.worker.settings import Settings
from typer.testing import CliRunner, Result


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, no_variables: None) -> Run:
    """Run a command with some variables of Pliant and no others, in an empty folder and without starting processes."""
    monkeypatch.setenv("COLUMNS", "400")

    def never(*_: object, **__: object) -> None:
        raise AssertionError("processes would be started")

    monkeypatch.setattr(Supervisor, "run", never)

    def run(*arguments: str, **variables: str) -> Result:
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        return CliRunner().invoke(app, arguments)

    return run


@pytest.mark.parametrize("command", ["up", "work"])
def test_more_workers_than_fit_into_the_memory_are_refused(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr(memory, "_physical", lambda: 1 << 30)
    monkeypatch.setattr(memory, "group_files", lambda name: [])
    (finding,) = check_memory()
    assert (finding.verdict, finding.found) == ("good", "1.1 GB for 1 worker(s)")
    for result in (run(command, "--workers", "10000"), run(command, PLIANT_WORKERS="10000")):
        assert result.exit_code == Exit.REFUSED
        assert "PLIANT_WORKERS: expected at most 14, " in result.output
        assert "got 10000. Lower it" in result.output
    (finding,) = check_memory()
    assert finding.verdict == "bad"
    assert "got 10000" in finding.found


@pytest.mark.parametrize("command", ["up", "work"])
def test_a_folder_of_another_user_is_refused_before_processes_start(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path / "work")
    result = run(command, "--data", str(tmp_path), *(["--port", "0"] if command == "up" else []))
    assert result.exit_code == Exit.REFUSED
    sentence = f"PLIANT_DATA: expected a folder that this user can create and write, got '{tmp_path / 'work'}' (Permission denied)"
    assert sentence in result.output


@pytest.mark.parametrize("store", ["data", "blobs"])
def test_a_full_disk_is_named_before_processes_start(
    run: Run, monkeypatch: pytest.MonkeyPatch, small_disk: Path, tmp_path: Path, store: str
) -> None:
    small = small_disk / store
    data, variables = (small, {}) if store == "data" else (tmp_path / "data", {"PLIANT_BLOB_URL": small.as_uri()})
    monkeypatch.setattr(Supervisor, "run", lambda *_, **__: None)
    assert run("up", "--port", "0", "--data", str(data), **variables).exit_code == Exit.DONE
    with pytest.raises(OSError, match="No space left on device"):
        (small_disk / "filler").write_bytes(b"x" * (4 << 20))
    result = run("up", "--port", "0", "--data", str(data), **variables)
    assert result.exit_code == Exit.UNREACHABLE
    assert f"The disk of {small} is full: free some space, then start again." in result.output
    (small_disk / "filler").unlink()
    assert run("up", "--port", "0", "--data", str(data), **variables).exit_code == Exit.DONE


@pytest.mark.parametrize("command", ["up", "work"])
@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("REDIS_URL", "http://:secret@host", "a URL redis://, rediss:// or unix://, got another text"),
        ("REDIS_URL", "redis://host:99999", "a URL redis://, rediss:// or unix://, got another text"),
        ("BLOB_URL", "/srv/blobs", "file:///FOLDER or s3://BUCKET/PREFIX, got '/srv/blobs'"),
        ("BLOB_URL", "file:///dev/null/blobs", "a folder that exists or can be made, got 'file:///dev/null/blobs'"),
    ],
)
def test_an_invalid_url_of_a_store_is_reported_once_as_an_invalid_setting(
    run: Run, command: str, name: str, value: str, expected: str
) -> None:
    result = run(command, "--json", **{f"PLIANT_{name}": value})
    assert result.exit_code == Exit.REFUSED
    assert result.output.count(f"PLIANT_{name}: expected {expected}") == 1
    assert "invalid_setting" in result.output
    assert "secret" not in result.output


@pytest.mark.parametrize("command", ["up", "work"])
def test_an_interruption_while_waiting_for_the_store_starts_nothing(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupted)
    result = run(command, PLIANT_REDIS_URL="redis://:secret@127.0.0.1:9", PLIANT_PORT="0")
    assert result.exit_code == Exit.DONE
    assert result.output.count("The job store at redis://127.0.0.1:9 is unavailable (Connection refused).") == 1
    assert "secret" not in result.output


@pytest.mark.parametrize("command", ["up", "work"])
def test_an_unknown_variable_is_named_once(run: Run, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setattr(Supervisor, "run", lambda *_, **__: None)
    sentence = "PLIANT_WORKRES is no setting of Pliant and has no effect. Did you mean PLIANT_WORKERS?"
    result = run(command, "--port", "0", PLIANT_WORKRES="2") if command == "up" else run(command, PLIANT_WORKRES="2")
    assert result.exit_code == Exit.DONE, result.output
    assert result.output.count(sentence) == 1
    child = service_child(Settings(), "127.0.0.1", 1, "http://127.0.0.1:1", auth="off")
    assert child.env["PLIANT_WORKRES"] == "", "the service would name it again"
    (finding,) = check_variables()
    assert (finding.verdict, finding.found) == ("note", sentence)
