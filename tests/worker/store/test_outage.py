"""Messages about a store that does not answer."""

from __future__ import annotations

import socket
from itertools import pairwise

import pytest
from pliant.worker.errors import JOB_STORE, StoreUnavailable
from pliant.worker.processes import preflight
from pliant.worker.processes.preflight import wait_for_store
from pliant.worker.settings import Settings
from pliant.worker.store.outage import LONGEST_PAUSE, Outage, address_of, described


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("redis://user:secret@host:99/3", "redis://host:99"),
        ("rediss://:secret@host", "rediss://host:6379"),
        ("redis://", "redis://localhost:6379"),
        ("redis://:secret@[::1]:7", "redis://[::1]:7"),
        ("unix://:secret@/run/valkey.sock?db=1", "unix:///run/valkey.sock"),
    ],
)
def test_addresses_show_no_password(url: str, address: str) -> None:
    assert address_of(url) == address


def test_only_messages_about_redis_get_its_address() -> None:
    blobs = StoreUnavailable("The blob store", reason="late")
    assert described(blobs, "redis://host") == str(blobs)
    records = StoreUnavailable(JOB_STORE, reason="late")
    assert described(records, "redis://:secret@host") == "The job store at redis://host:6379 is unavailable (late)."


def test_an_outage_is_reported_at_once_then_ever_less_often_and_its_end() -> None:
    now, told = 0.0, list[tuple[float, str]]()
    outage = Outage(redis_url="redis://h", tell=lambda text: told.append((now, text)), clock=lambda: now)
    outage.answered()
    assert told == []
    while now < 600:
        outage.failed(StoreUnavailable(JOB_STORE, reason="late"))
        now += 1
    assert told[0] == (0.0, "The job store at redis://h:6379 is unavailable (late). Waiting until it answers.")
    assert {text for _, text in told[1:]} == {"The job store at redis://h:6379 is unavailable (late). Still waiting."}
    times = [when for when, _ in told]
    assert times[:6] == [0, 2, 6, 14, 30, 62]
    assert all(later - before == LONGEST_PAUSE for before, later in pairwise(times[6:]))
    outage.answered()
    outage.answered()
    assert [text for _, text in told[-2:]].count("The store answers again.") == 1
    outage.failed(StoreUnavailable(JOB_STORE, reason="late"))
    assert told[-1][1].endswith("Waiting until it answers.")


def test_processes_wait_for_the_server_and_its_address_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "ASK_EVERY", 0.01)
    wait_for_store(Settings(), pytest.fail)  # the embedded server is started later
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        told: list[str] = []
        settings = Settings(redis_url=f"redis://:secret@127.0.0.1:{port}/2")
        with pytest.raises(StoreUnavailable, match="Connection refused"):
            wait_for_store(settings, told.append, within=0.1)
    expected = (
        f"The job store at redis://127.0.0.1:{port} is unavailable (Connection refused). Waiting until it answers."
    )
    assert told == [expected]
    answers = iter([StoreUnavailable(JOB_STORE, reason="late"), None])

    def ping(_: str) -> None:
        if fault := next(answers):
            raise fault

    monkeypatch.setattr("pliant.worker.store.connection.ping", ping)
    told.clear()
    wait_for_store(settings, told.append)
    assert told[-1] == "The store answers again."
