"""While Redis does not answer, few commands wait for it, and others are refused at once."""

from __future__ import annotations

import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import redis
from pliant.worker.store import connection
from pliant.worker.store.calls import COMMANDS, PROBES, SILENT_AFTER, SilentServer


class Clock:
    """A clock that moves by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def waiting(server: SilentServer, number: int, pool: ThreadPoolExecutor, end: threading.Event) -> None:
    """Let this many commands wait until an event, and then fail."""
    begun = threading.Semaphore(0)

    def wait() -> None:
        with server.call():
            begun.release()
            end.wait()
            raise redis.TimeoutError

    for _ in range(number):
        pool.submit(wait)
    for _ in range(number):
        assert begun.acquire(timeout=20)


def test_a_silent_server_gets_a_few_probes_then_one_per_second() -> None:
    clock, end = Clock(), threading.Event()
    server = SilentServer(clock=clock)
    with ThreadPoolExecutor(PROBES + 1) as pool:
        waiting(server, PROBES, pool, end)
        with server.call():
            pass  # commands that are slow do not make the server silent
        clock.now += SILENT_AFTER + 0.1
        waiting(server, 1, pool, end)  # a probe: none was sent for a second
        with pytest.raises(redis.TimeoutError, match="does not answer"), server.call():
            pass
        clock.now += 1
        with server.call():
            pass  # the next probe, and it is answered
        with server.call():
            pass
        clock.now += SILENT_AFTER + 0.1
        end.set()
    clock.now += 1

    def fail() -> None:
        with server.call():
            clock.now += SILENT_AFTER + 0.1
            raise redis.TimeoutError

    with pytest.raises(redis.TimeoutError):
        fail()
    with server.call():
        pass  # no command is waiting, so the server is tried again


def test_commands_above_the_limit_are_refused_after_a_short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.worker.store.calls.TURN", 0.05)
    server, end = SilentServer(clock=Clock()), threading.Event()
    monkeypatch.setattr(server._capacity, "wait", lambda left: setattr(server.clock, "now", server.clock.now + left))
    with ThreadPoolExecutor(COMMANDS) as pool:
        waiting(server, COMMANDS, pool, end)
        with pytest.raises(redis.TimeoutError, match="too many"), server.call():
            pass
        end.set()
    with server.call():
        pass


def test_a_command_error_counts_as_an_answer() -> None:
    server = SilentServer()
    with pytest.raises(redis.ResponseError), server.call():
        raise redis.ResponseError("WRONGTYPE")
    assert not server._is_silent()


def test_silence_is_shared_by_all_clients_and_pipelines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "ANSWER_WITHIN", 0.2)
    monkeypatch.setattr("pliant.worker.store.calls.SILENT_AFTER", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        url = f"redis://127.0.0.1:{deaf.getsockname()[1]}"
        text, raw = connection.connect(url, decode=True), connection.connect(url, decode=False)
        with pytest.raises(redis.TimeoutError):
            text.get("k")
        server = connection._SILENCE[url]
        assert server._is_silent()
        monkeypatch.setattr("pliant.worker.store.calls.PROBES", 0)
        with pytest.raises(redis.TimeoutError, match="does not answer"):
            raw.get("k")
        pipe = raw.pipeline()
        pipe.get("k")
        with pytest.raises(redis.TimeoutError, match="does not answer"):
            pipe.execute()
        text.close()
        raw.close()


def test_a_last_moment_answer_lets_other_commands_through() -> None:
    clock, end = Clock(), threading.Event()
    server = SilentServer(clock=clock)
    with ThreadPoolExecutor(PROBES) as pool:
        waiting(server, PROBES, pool, end)
        clock.now += SILENT_AFTER + 0.1
        server._probed = clock.now
        look = server._capacity.wait

        def answered(seconds: float) -> bool:
            server._answered = clock.now  # as the thread that reads the answer does
            return look(0)

        server._capacity.wait = answered  # type: ignore[assignment]
        with server.call():
            pass
        end.set()
