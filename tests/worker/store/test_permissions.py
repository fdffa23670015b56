"""A server whose access rules (ACL) forbid something: each process names the permission, and no job is lost."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import redis
from pliant.schemas.job import Status
from pliant.worker.errors import StoreForbidden
from pliant.worker.jobs.service import Jobs
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings
from pliant.worker.store import permissions
from pliant.worker.store.connection import check_server, connect
from worker_house import House, settled

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")

PAGE = Path(__file__).parents[3] / "docs/how-to/two-hosts.md"

ALL = ("~*", "&*", "+@all")

EVERY = (
    *permissions.ON_BOTH,
    *permissions.ON_OWN,
    *permissions.ON_RQ,
    *permissions.ON_CHANNEL,
    *permissions.WITHOUT_KEY,
)

Grant = Callable[..., None]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[redis.Redis]:
    """A server of its own, whose commands can be counted."""
    valkey = Valkey.claim(tmp_path)
    process = valkey.start()
    with closing(connect(Settings(data=tmp_path).redis, decode=True)) as client:
        yield client
    process.terminate()
    process.wait(10)
    valkey.release()


@pytest.fixture
def settings(server: redis.Redis, tmp_path: Path) -> Settings:
    """Settings of an installation whose user on the server is `limited`."""
    path = Settings(data=tmp_path).redis.removeprefix("unix://").partition("?")[0]
    return Settings(
        data=tmp_path / "data", redis_url=f"unix://limited:word@{path}", threads=1, lost_after=2.0, stop_grace=1.0
    )


@pytest.fixture
def grant(server: redis.Redis) -> Grant:
    def grant(*rules: str) -> None:
        server.execute_command("ACL", "SETUSER", "limited", "reset", "on", ">word", *rules)

    return grant


@pytest.mark.parametrize(
    ("process", "rules", "named"),
    [
        ("pliant.service", (*ALL, "-zadd", "-script|load"), "the commands ZADD, SCRIPT LOAD"),
        ("pliant.worker work", ("~other:*", "~rq:*", "&*", "+@all"), "the keys pliant:*"),
        ("pliant.worker reconcile", ("~*", "+@all", "-ping"), "the channel pliant:changes and the command PING"),
    ],
)
def test_a_process_does_not_start_and_names_what_is_forbidden(
    settings: Settings, grant: Grant, process: str, rules: tuple[str, ...], named: str
) -> None:
    if "SCRIPT" in named:  # the check itself is a script
        grant(*ALL)
        with closing(connect(settings.redis, decode=True)) as client:
            permissions.check_permissions(client, settings.queue)
    grant(*rules)
    env = {**os.environ, **settings.to_environment(), "PLIANT_PORT": "0"}
    result = subprocess.run(
        [sys.executable, "-m", *process.split()], env=env, check=False, capture_output=True, text=True, timeout=60
    )
    assert result.returncode in (1, 2)
    (line,) = result.stderr.splitlines()
    assert line.startswith("The job store at unix://")
    assert f"is unavailable (its access rules forbid {named}). Grant it to the user in PLIANT_REDIS_URL" in line
    assert "word" not in line


def test_without_scripts_the_command_is_named(settings: Settings, grant: Grant) -> None:
    grant(*ALL, "-evalsha")
    with pytest.raises(StoreForbidden, match=r"forbid the command EVALSHA.*the operator must grant the permission"):
        Jobs.open(settings).page()


def test_the_doctor_checks_permissions(settings: Settings, grant: Grant) -> None:
    grant(*ALL)
    assert check_server(settings.redis, queue=settings.queue) == "noeviction"
    grant(*ALL, "-config")
    assert check_server(settings.redis, queue=settings.queue) == "", "it is not needed"
    grant(*ALL, "-xadd", "-hincrby")
    with pytest.raises(StoreForbidden, match="forbid the commands HINCRBY, XADD"):
        check_server(settings.redis, queue=settings.queue)


def test_each_checked_command_has_a_valid_number_of_arguments(valkey_data: Path) -> None:
    """The server may crash on a check of others."""
    with closing(connect(Settings(data=valkey_data).redis, decode=True)) as client:
        for command in EVERY:
            name, given = permissions.name_of(command), len(command.split())
            (about,) = client.execute_command("COMMAND", "INFO", name.replace(" ", "|")).values()
            assert given == about["arity"] if about["arity"] > 0 else given >= -about["arity"], command


@pytest.mark.slow
def test_the_documented_rules_suffice_and_every_command_is_checked_at_the_start(
    server: redis.Redis, settings: Settings, grant: Grant, inputs_files: tuple[Path, Path]
) -> None:
    found = re.search(r"ACL SETUSER pliant on >password (.*)", PAGE.read_text())
    assert found is not None
    grant(*found[1].split())
    with House(settings, inputs=inputs_files) as house:
        id = house.submit(idempotency_key="a key")
        with closing(house.jobs.records.changes()) as changes:
            assert house.final(id).status is Status.SUCCEEDED
            changes.next(0.1)
        lost = house.submit(long=True)
        house.solving(lost)
        os.kill(house.worker_pids()[0], signal.SIGKILL)
        house.until(lambda: house.jobs.get(lost).attempt == 2, "the lost job is repeated")
        house.jobs.cancel(lost)
        house.final(lost)
        house.jobs.log(id)
        house.jobs.delete(id)
        settled(house)
    assert server.execute_command("ACL", "LOG") == []
    sent = {name.removeprefix("cmdstat_").upper().replace("|", " ") for name in server.info("commandstats")}
    checked = {permissions.name_of(command) for command in EVERY}
    administrative = {name for name in sent if name.startswith(("ACL", "CLIENT", "CONFIG", "HELLO", "INFO", "AUTH"))}
    assert sent - checked - administrative == set()


@pytest.mark.slow
def test_a_permission_lost_during_work_loses_no_job(
    settings: Settings, grant: Grant, inputs_files: tuple[Path, Path], capfd: pytest.CaptureFixture[str]
) -> None:
    grant(*ALL)
    with House(settings, inputs=inputs_files) as house:
        assert house.final(house.submit()).status is Status.SUCCEEDED
        settled(house)
        grant(*ALL, "-lrem")  # RQ needs it to begin a job
        waiting = house.submit()
        house.until(lambda: "not started: " in capfd.readouterr().err, "refused")
        grant(*ALL)
        job = house.final(waiting)
        assert (job.status, job.attempt) == (Status.SUCCEEDED, 1)
        (worker,) = house.worker_pids()
        capfd.readouterr()
        grant(*ALL, "-blmove")
        house.until(lambda: house.worker_pids() != [worker], "the idle worker ends")
        words = capfd.readouterr().err
        assert "its access rules forbid the command BLMOVE" in words
        assert "Traceback" not in words
        grant(*ALL)
        assert house.final(house.submit(), seconds=60).status is Status.SUCCEEDED
        settled(house)
