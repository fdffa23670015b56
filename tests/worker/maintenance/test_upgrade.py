"""Data of an older version is brought up to date before the records are first used; data of a newer one is refused.

`tests/data/records_of_fafc6bb.json` holds the Redis keys of an installation made by commit fafc6bb, the last one that stored
records without their version: three jobs, one of them with a result, and a token. RQ's own entries are left out.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from fastapi.testclient import TestClient
from pliant.schemas.job import Status
from pliant.service import __main__ as service
from pliant.service.app import create_app
from pliant.service.settings import ServiceSettings
from pliant.worker import __main__ as worker
from pliant.worker.errors import NewerData, StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.maintenance.backup import restore_backup, write_backup
from pliant.worker.maintenance.fsck import findings
from pliant.worker.maintenance.reconciler import FORGOTTEN_AFTER, Reconciler
from pliant.worker.settings import Settings
from pliant.worker.store import redis, schema
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.connection import connect
from pliant.worker.store.schema import CURRENT, STEPS, migrated, prepare
from pliant.worker.tokens import Tokens

OLD = Path(__file__).parents[2] / "data" / "records_of_fafc6bb.json"
CONTENTS = {"inputs.npz": b"inputs of an old job", "shapes.npz": b"shapes of an old job"}


@pytest.fixture
def old(settings: Settings) -> Settings:
    """An installation as the old version left it."""
    client: Any = connect(settings.redis, decode=True)
    for kind, name, value in json.loads(OLD.read_text()):
        key = name.replace("pliant:", f"{settings.queue}:", 1)
        if kind == "stream":
            for id, fields in value:
                client.xadd(key, fields, id=id)
        else:
            write = {"string": lambda: client.set(key, value), "hash": lambda: client.hset(key, mapping=value),  # noqa: B023
                     "list": lambda: client.rpush(key, *value), "zset": lambda: client.zadd(key, dict(value))}  # noqa: B023  # fmt: skip
            write[kind]()
    client.close()
    blobs = Blobs.open(settings.blobs)
    for body in bodies(settings).values():
        for place in (body["inputs"], *(f"{body['prefix']}{each['name']}" for each in body["job"]["artifacts"])):
            file = settings.data / "a blob"
            file.write_bytes(CONTENTS[place.rpartition("/")[2]])
            blobs.put(place, file)
            file.unlink()
    return settings


def migrate(old: Settings) -> int:
    client = connect(old.redis, decode=True)
    count = prepare(client, old.queue)
    client.close()
    return count


def bodies(settings: Settings) -> dict[str, dict[str, Any]]:
    client: Any = connect(settings.redis, decode=True)
    keys = client.keys(f"{settings.queue}:job:*")
    found = {key.rpartition(":")[2]: json.loads(client.hget(key, "body")) for key in keys}
    client.close()
    return found


def test_an_old_installation_keeps_working_after_migration(old: Settings) -> None:
    assert all("schema" not in body for body in bodies(old).values())
    assert migrate(old) == 3
    assert {body["schema"] for body in bodies(old).values()} == {CURRENT}
    assert migrate(old) == 0, "once"
    jobs = Jobs.open(old)
    done = jobs.get("old-done")
    assert (done.status, done.options.loss, done.metrics) == (Status.SUCCEEDED, "huber", {"residual_median": 0.25})
    assert b"".join(jobs.artifact("old-done", "shapes.npz")[1].read()) == CONTENTS["shapes.npz"]
    assert "Attempt 1 began" in jobs.log("old-done")
    assert [token.name for token in Tokens.open(old).all()] == ["somebody"]
    reconciler = Reconciler(jobs=jobs, clock=iter([0.0, 1.0, *(float(10 * n) for n in range(1, 20))]).__next__)
    for _ in range(int(FORGOTTEN_AFTER) + 4):  # RQ's own entries are not part of the old data
        reconciler.tick()
    assert len(jobs.queue.waiting()) == 1
    assert findings(jobs, pause=0) == []


def test_a_backup_of_old_records_is_migrated_on_restore(
    old: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as before:
        before.setattr(redis, "prepare", lambda *_: 0)
        write_backup(old, tmp_path / "backup")
    assert all("schema" not in body for body in bodies(old).values())
    new = Settings(data=tmp_path / "new", redis_url=old.redis_url, queue=f"{old.queue}-new")
    restore_backup(new, tmp_path / "backup")
    assert {body["schema"] for body in bodies(new).values()} == {CURRENT}
    assert Jobs.open(new).get("old-done") == Jobs.open(old).get("old-done")


def test_simultaneous_starts_migrate_only_once(old: Settings) -> None:
    counts: list[int] = []
    threads = [threading.Thread(target=lambda: counts.append(migrate(old))) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert sorted(counts) == [0, 0, 0, 3]


def test_a_migration_that_outlasts_its_lock_is_counted(old: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "_LOCK_SECONDS", 0.05)
    rewrite = schema._rewrite

    def slowly(client: Any, at: str) -> int:
        time.sleep(0.2)
        return rewrite(client, at)

    monkeypatch.setattr(schema, "_rewrite", slowly)
    assert migrate(old) == 3
    assert migrate(old) == 0


def test_records_that_another_process_still_migrates_are_unavailable(
    old: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schema, "_LOCK_SECONDS", 0.05)
    client: Any = connect(old.redis, decode=True)
    with client.lock(f"{old.queue}:migrating"), pytest.raises(StoreUnavailable, match="still migrates"):
        migrate(old)
    client.close()
    assert migrate(old) == 3


@pytest.fixture
def away(old: Settings, tmp_path: Path) -> tuple[Settings, Callable[[], None]]:
    """The old installation with a store that does not answer before the function is called."""
    socket = Path(tempfile.mkdtemp(dir=tmp_path)) / "store"
    real = urlsplit(old.redis).path
    return replace(old, redis_url=f"unix://{socket}"), lambda: socket.symlink_to(real)


def test_records_are_migrated_when_a_store_that_was_away_answers(away: tuple[Settings, Callable[[], None]]) -> None:
    settings, come_back = away
    jobs = Jobs.open(settings)
    with pytest.raises(StoreUnavailable):
        jobs.page()
    come_back()
    assert len(jobs.page().jobs) == 3
    assert {body["schema"] for body in bodies(settings).values()} == {CURRENT}


def test_a_service_whose_store_was_away_serves_no_data_of_a_newer_version(
    away: tuple[Settings, Callable[[], None]], old: Settings
) -> None:
    settings, come_back = away
    write_newer_version(old)
    app = create_app(Jobs.open(settings), ServiceSettings(), tokens=Tokens.open(settings))
    with TestClient(app, base_url="http://127.0.0.1") as http:
        assert http.get("/v1/jobs").json()["code"] == "store_unavailable"
        come_back()
        assert http.get("/v1/jobs").json()["code"] == "newer_data"


@pytest.mark.parametrize("task", ["work", "reconcile"])
def test_a_worker_does_not_start_without_its_store(
    task: str, away: tuple[Settings, Callable[[], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in away[0].to_environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(worker, "configure_logging", lambda *_: None)
    assert worker.main([task]) == 1


def write_newer_version(settings: Settings) -> None:
    client: Any = connect(settings.redis, decode=True)
    client.set(f"{settings.queue}:schema", CURRENT + 1)
    client.close()


def test_data_of_a_newer_version_is_refused_by_every_process(
    old: Settings, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_newer_version(old)
    for name, value in old.to_environment().items():
        monkeypatch.setenv(name, value)
    for process in (service, worker):
        monkeypatch.setattr(process, "configure_logging", lambda *_: None)
    for main in (service.main, worker.main):
        assert main([]) in (1, 2)
        assert "written by a newer Pliant" in capsys.readouterr().err
    with pytest.raises(NewerData):
        migrated({"schema": CURRENT + 1})


def test_there_is_a_migration_step_from_every_older_version() -> None:
    assert sorted(STEPS) == list(range(1, CURRENT))
    assert migrated({"version": 5}) == {"version": 5, "schema": CURRENT}
