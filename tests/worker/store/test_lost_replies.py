"""A change whose reply was lost is repeated by the Redis client; it then has its effect once, and is reported as made."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import redis
from pliant.schemas.job import Job
from pliant.schemas.shares import ShareRequest
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.sharing import create_share, list_shares, revoke_share
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.connection import connect
from pliant.worker.uploads import shared
from pliant.worker.uploads.service import Capacity
from pliant.worker.uploads.shared import SharedUploads
from pliant.worker.uploads.states import UploadStates
from redis.connection import AbstractConnection

NOW = datetime(2030, 1, 2, tzinfo=UTC)


@pytest.fixture
def lose_next(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Return a function after which the connection breaks once, when a script has made a change."""
    pending: list[bool] = []
    whole = AbstractConnection.read_response

    def read(connection: AbstractConnection, *arguments: Any, **more: Any) -> Any:
        reply = whole(connection, *arguments, **more)
        if pending and reply == 1:
            pending.clear()
            connection.disconnect()
            raise redis.ConnectionError("the connection broke before the reply")
        return reply

    monkeypatch.setattr(AbstractConnection, "read_response", read)
    return lambda: pending.append(True)


@pytest.mark.parametrize("jobs", ["redis"], indirect=True)
def test_a_change_of_a_record_is_made_once(
    jobs: Jobs, submit: Callable[..., Job], lose_next: Callable[[], None]
) -> None:
    id = submit().id
    attempt_id = jobs.records.get(id).attempt_id
    jobs.records.update(id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=NOW))
    result = Finished(metrics={}, outcome="converged", sentence="Converged.", warnings=(), artifacts=())
    lose_next()
    done = jobs.records.update(
        id, lambda held: lifecycle.succeed(held, result, attempt_id=attempt_id, prefix="p/", now=NOW, retention=0)
    )
    assert done == jobs.records.get(id)
    assert jobs.records.tallies()["ended:succeeded"] == 1
    lose_next()
    share = create_share(jobs, id, ShareRequest())
    assert [each.id for each in list_shares(jobs, id)] == [share.id]
    lose_next()
    revoke_share(jobs, id, share.id)
    assert list_shares(jobs, id) == []


def test_a_piece_of_an_upload_is_kept(
    settings: Settings, tmp_path: Path, lose_next: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared, "PIECE", 100)
    states = UploadStates(connect(settings.redis, decode=True), queue=settings.queue)
    uploads = SharedUploads(directory=tmp_path, expiry=3600, blobs=Blobs.open("memory:///"), states=states)
    with uploads.write("film", offset=0, length=300, capacity=Capacity(max_bytes=1000)) as writer:
        for letter in (b"a", b"b", b"c"):
            lose_next()
            writer.write(letter * 100)
        writer.finish(sha256=None)
    assert list(uploads.findings(datetime.now(UTC))) == []
    uploads.take("film", tmp_path / "taken")
    assert (tmp_path / "taken").read_bytes() == b"a" * 100 + b"b" * 100 + b"c" * 100
