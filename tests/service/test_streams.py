"""Long-lived responses: idle event streams, shutdown, waiting; and the log."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import aclosing
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import cast

import httpx
import pytest
from pliant.schemas.job import Status
from pliant.service import event_stream
from pliant.service.event_stream import WOKEN_AT_ONCE, Followers, _Watcher, is_final
from pliant.worker.errors import StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Event, utc_now
from pliant.worker.settings import Settings
from serving import Running, Serve, claim, finish, form, submit, tracks, until


@pytest.fixture(scope="module")
def restless(serve: Serve) -> Running:
    return serve(heartbeat_seconds=0.2)


def test_an_idle_stream_sends_comment_lines(restless: Running) -> None:
    with httpx.Client(base_url=restless.url, timeout=10) as http:
        job = submit(http, name="quiet")
        begun = time.monotonic()
        with http.stream("GET", f"/v1/jobs/{job.id}/events") as answer:
            assert answer.headers["content-type"].startswith("text/event-stream")
            assert answer.headers["cache-control"] == "no-store"
            lines = answer.iter_lines()
            signs = [next(line for line in lines if line.startswith(":")) for _ in range(4)]
        assert signs == [": ping"] * 4
        assert 0.6 < time.monotonic() - begun < 20


def test_followers_are_woken_in_batches_so_other_requests_can_run() -> None:
    async def turns() -> list[int]:
        watcher, woken = _Watcher(), [0]

        async def follow() -> None:
            assert await watcher.changed(20)
            woken[0] += 1

        followers = [asyncio.create_task(follow()) for _ in range(4 * WOKEN_AT_ONCE + 1)]
        await asyncio.sleep(0)
        followers.pop().cancel()
        watcher.publish([Event("1-0", "progress", "{}"), Event("2-0", "progress", "{}")])
        assert [event.id for event in watcher.newer("1-0")] == ["2-0"]
        seen = []
        while not all(task.done() for task in followers):
            await asyncio.sleep(0)  # as another request does
            seen.append(woken[0])
        assert not await watcher.changed(0.01)
        assert watcher._waiting == {}
        return seen

    seen = asyncio.run(turns())
    assert seen[-1] == 4 * WOKEN_AT_ONCE
    assert max(after - before for before, after in pairwise([0, *seen])) <= WOKEN_AT_ONCE


def test_a_job_that_ends_between_reads_still_yields_its_final_event(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="ends")
    seen = running.jobs.events(job.id)[-1].id

    class Ending:
        """Finishes the job right after its events were read."""

        records, get = running.jobs.records, staticmethod(running.jobs.get)

        @staticmethod
        def events(id: str, *, after: str) -> list[Event]:
            found = running.jobs.events(id, after=after)
            if not running.jobs.get(id).status.final:
                finish(running, id, b"result")
            return found

    async def followed() -> list[Event | None]:
        return [event async for event in Followers().follow(cast(Jobs, Ending()), job.id, after=seen)]

    last = asyncio.run(followed())[-1]
    assert last is not None
    assert is_final(last)


def test_a_follower_that_comes_while_the_reader_fails_still_gets_events(
    running: Running, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = submit(http, name="follows")
    seen = running.jobs.events(job.id)[-1].id

    class Failing(event_stream._Reader):
        """Has already told all followers that it fails when the next one comes, and then ends."""

        def run(self) -> None:
            monkeypatch.undo()
            self.ended.wait(0.2)

    monkeypatch.setattr(event_stream, "_Reader", Failing)

    async def followed() -> Event | None:
        stream = Followers().follow(running.jobs, job.id, after=seen, heartbeat=0.5)
        async with aclosing(stream), asyncio.timeout(15):
            assert await anext(stream) is None
            await asyncio.to_thread(finish, running, job.id, b"result")
            return [event async for event in stream][-1]

    last = asyncio.run(followed())
    assert last is not None
    assert is_final(last)


def test_a_client_that_reads_nothing_keeps_no_failure_alive(
    running: Running, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = submit(http, name="stalled")

    async def followed() -> Status:
        followers = Followers()
        async with aclosing(followers.follow(running.jobs, job.id)) as stalled:
            await anext(stalled)
            with monkeypatch.context() as away:
                away.setattr(running.jobs.records, "changes", lambda: (_ for _ in ()).throw(StoreUnavailable("away")))
                followers._stop_reader()
                followers._start_reader(running.jobs.records)
                async with asyncio.timeout(15):
                    while followers._watchers[job.id].failure is None:
                        await asyncio.sleep(0.01)
            await asyncio.to_thread(finish, running, job.id, b"result")
            return (await followers.wait(running.jobs, job.id, 15)).status

    assert asyncio.run(followed()) is Status.SUCCEEDED


def test_a_new_job_under_the_id_of_one_that_ended_is_followed(running: Running, http: httpx.Client) -> None:
    def put() -> None:
        http.put("/v1/jobs/again-1", files=form(name="again")).raise_for_status()

    async def followed() -> Status:
        followers = Followers()
        await asyncio.to_thread(put)
        async with aclosing(followers.follow(running.jobs, "again-1")) as stalled:
            await anext(stalled)
            await asyncio.to_thread(finish, running, "again-1", b"result")
            async with asyncio.timeout(15):
                while not followers._watchers["again-1"].ended:
                    await asyncio.sleep(0.01)
            reader = followers._reader  # it must not read between the deletion and the new job
            assert reader is not None
            followers._stop_reader()
            await asyncio.to_thread(reader.join)
            await asyncio.to_thread(running.jobs.delete, "again-1")
            await asyncio.to_thread(put)
            waiting = asyncio.create_task(followers.wait(running.jobs, "again-1", 15))
            await asyncio.sleep(0.5)
            assert not waiting.done()
            await asyncio.to_thread(finish, running, "again-1", b"result")
            return (await waiting).status

    assert asyncio.run(followed()) is Status.SUCCEEDED


def test_followers_are_removed_when_their_client_disconnects(restless: Running) -> None:
    service = restless.app.state.service
    with httpx.Client(base_url=restless.url, timeout=10) as http:
        job = submit(http, name="left")
        with http.stream("GET", f"/v1/jobs/{job.id}/events") as answer:
            lines = answer.iter_lines()  # keep a reference: a discarded iterator closes the connection
            next(lines)
            until(lambda: service.followers.watched == 1)
        until(lambda: service.followers.watched == 0)


@pytest.mark.parametrize("how", ["revoked", "expired"])
def test_revoked_or_expired_tokens_end_their_streams(serve: Serve, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    running = serve(auth="required", heartbeat_seconds=0.2)
    token, text = running.tokens.create("listener", expires=timedelta(hours=1) if how == "expired" else None)
    with httpx.Client(base_url=running.url, timeout=10, headers={"Authorization": f"Bearer {text}"}) as http:
        job = submit(http)
        with http.stream("GET", f"/v1/jobs/{job.id}/events") as answer:
            lines = answer.iter_lines()
            assert next(line for line in lines if line.startswith(":"))
            if how == "revoked":
                running.tokens.revoke(token.id)
            else:
                later = utc_now() + timedelta(hours=2)
                monkeypatch.setattr("pliant.service.middleware.auth.utc_now", lambda: later)
            begun = time.monotonic()
            rest = list(lines)
        assert time.monotonic() - begun < 20
        assert all(line in ("", ": ping") for line in rest)
        assert http.get(f"/v1/jobs/{job.id}/events").status_code == 401


@pytest.mark.parametrize("verb", ["POST", "PUT"])
def test_a_submission_can_wait_for_the_job_to_finish(running: Running, http: httpx.Client, verb: str) -> None:
    path = "/v1/jobs" if verb == "POST" else "/v1/jobs/awaited-at-once"
    body = form(tracks(seed=7), name=f"awaited {verb}")
    begun = time.monotonic()
    early = http.request(verb, path, files=body, headers={"Prefer": "wait=1", "Idempotency-Key": f"awaited {verb}"})
    assert 0.9 < time.monotonic() - begun < 8
    assert (early.status_code, early.json()["status"]) == (202, "queued")
    assert early.headers["preference-applied"] == "wait=1"
    timer = threading.Timer(0.5, finish, (running, early.json()["id"], b"x"))
    timer.start()
    late = http.request(verb, path, files=body, headers={"Prefer": "wait=15", "Idempotency-Key": f"awaited {verb}"})
    timer.join()
    assert late.json()["id"] == early.json()["id"]
    assert late.json()["status"] == "succeeded"


@pytest.mark.parametrize("verb", ["POST", "PUT"])
def test_a_submission_is_accepted_even_if_its_wait_fails(
    running: Running, http: httpx.Client, verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object, **__: object) -> list[object]:
        raise StoreUnavailable("The job store", reason="ConnectionError")

    path = "/v1/jobs" if verb == "POST" else "/v1/jobs/accepted-all-the-same"
    monkeypatch.setattr(running.jobs.records, "events", away)
    answer = http.request(verb, path, files=form(name="accepted"), headers={"Prefer": "wait=5"})
    assert (answer.status_code, answer.json()["status"]) == (202, "queued")
    assert answer.headers["location"] == f"/v1/jobs/{answer.json()['id']}"
    assert http.get(answer.headers["location"], headers={"Prefer": "wait=5"}).json()["code"] == "store_unavailable"


@pytest.mark.parametrize("wish", ["wait", "wait=", "wait=x", "wait=-9", "return=minimal", "wait=9.5", "wait=٩"])
def test_an_invalid_prefer_header_is_ignored(http: httpx.Client, wish: str) -> None:
    job = submit(http)
    begun = time.monotonic()
    answer = http.get(f"/v1/jobs/{job.id}", headers={b"Prefer": wish.encode()})
    assert answer.status_code == 200
    assert "preference-applied" not in answer.headers
    assert time.monotonic() - begun < 8


def test_a_wait_is_capped_by_the_service(serve: Serve) -> None:
    running = serve(max_wait_seconds=1)
    with httpx.Client(base_url=running.url, timeout=10) as http:
        job = submit(http)
        begun = time.monotonic()
        answer = http.get(f"/v1/jobs/{job.id}", headers={"Prefer": "wait=100000000"})
        assert answer.headers["preference-applied"] == "wait=1"
        assert time.monotonic() - begun < 20


def test_resuming_after_the_final_event_returns_204_which_ends_an_event_source(
    running: Running, http: httpx.Client
) -> None:
    job = submit(http, name="resumed at the end")
    finish(running, job.id, b"x")
    address = f"/v1/jobs/{job.id}/events"
    last = [line for line in http.get(address).text.splitlines() if line.startswith("id: ")][-1].removeprefix("id: ")
    again = http.get(address, headers={"Last-Event-ID": last}, timeout=5)
    assert (again.status_code, again.content) == (204, b"")


def test_a_stream_after_an_id_of_the_future_ends_with_the_job(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="early")
    headers = {"Last-Event-ID": "18446744073709551615-0"}
    with http.stream("GET", f"/v1/jobs/{job.id}/events", headers=headers, timeout=15) as answer:
        until(lambda: running.app.state.service.followers.watched == 1)
        finish(running, job.id, b"result")
        assert "id:" not in "".join(answer.iter_text())


@pytest.mark.parametrize(
    "id", ["99999999999999999999-0", "0-18446744073709551616", "18446744073709551615-18446744073709551615", "x", "1-"]
)
def test_an_invalid_event_id_is_rejected(http: httpx.Client, id: str) -> None:
    job = submit(http, name="impossible")
    answer = http.get(f"/v1/jobs/{job.id}/events", headers={"Last-Event-ID": id}, timeout=5)
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_event_id")


def test_the_log_is_returned_as_plain_text(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="logged")
    empty = http.get(f"/v1/jobs/{job.id}/log")
    assert (empty.status_code, empty.text) == (200, "")
    claim(running, job.id)
    written = ["2026-05-04T09:30:00Z Attempt 1 began on worker w.", "Größe: 3 × 4 <b>not markup</b>"]
    running.jobs.records.append_log(job.id, written)
    answer = http.get(f"/v1/jobs/{job.id}/log")
    assert answer.text.splitlines() == written
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"
    assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.fixture
def process(
    valkey_url: str, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[tuple[subprocess.Popen[bytes], str, Path]]:
    """The service in its own process, started as `pliant up` does or with the arguments of the test."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = Settings(data=tmp_path, redis_url=valkey_url, queue=f"stop-{os.getpid()}")
    env = {
        **os.environ,
        **settings.to_environment(),
        "PLIANT_HOST": "127.0.0.1",
        "PLIANT_PORT": str(port),
        "PLIANT_LOG_LEVEL": "warning",
    }
    begin = getattr(request, "param", ("-m", "pliant.service"))
    log = tmp_path / "service.log"
    with log.open("wb") as errors:
        started = subprocess.Popen([sys.executable, *begin], env=env, stdout=errors, stderr=errors)
    url = f"http://127.0.0.1:{port}"

    def answers() -> bool:
        try:
            return httpx.get(f"{url}/healthz").status_code == 200
        except httpx.TransportError:
            return False

    until(answers, seconds=60)
    yield started, url, log
    if started.poll() is None:
        started.kill()
    started.wait(10)


@pytest.mark.slow
def test_sigterm_ends_streams_and_waits_promptly_and_cleanly(
    process: tuple[subprocess.Popen[bytes], str, Path],
) -> None:
    service, url, log = process
    ended: dict[str, float] = {}
    with httpx.Client(base_url=url, timeout=60) as http:
        job = submit(http)

        def listen() -> None:
            text = http.get(f"/v1/jobs/{job.id}/events").text
            assert text.endswith("\n\n"), "no event is cut in half"
            ended["stream"] = time.monotonic()

        def wait() -> None:
            assert http.get(f"/v1/jobs/{job.id}", headers={"Prefer": "wait=50"}).json()["status"] == "queued"
            ended["wait"] = time.monotonic()

        threads = [threading.Thread(target=each) for each in (listen, wait)]
        for thread in threads:
            thread.start()
        until(
            lambda: "pliant_http_requests_in_progress 3" in http.get("/metrics").text
        )  # the stream, the wait and this request
        stopped = time.monotonic()
        service.send_signal(signal.SIGTERM)
        assert service.wait(20) == 0
        gone = time.monotonic()
        for thread in threads:
            thread.join(20)
    assert {name: at - stopped < 3 for name, at in ended.items()} == {"stream": True, "wait": True}
    assert gone - stopped < 5
    assert log.read_text() == "", "neither a traceback nor chatter"


STOPPED_BETWEEN_LOOK_AND_WAIT = """
import os, signal
from pliant.service import event_stream
from pliant.service.__main__ import main

look = event_stream._Watcher.newer

def newer(watcher, last):
    os.kill(os.getpid(), signal.SIGTERM)
    event_stream._Watcher.newer = look
    return look(watcher, last)

event_stream._Watcher.newer = newer
raise SystemExit(main())
"""


@pytest.mark.slow
@pytest.mark.parametrize("process", [("-c", STOPPED_BETWEEN_LOOK_AND_WAIT)], indirect=True, ids=["between"])
def test_a_stream_between_check_and_wait_still_ends_on_shutdown(
    process: tuple[subprocess.Popen[bytes], str, Path],
) -> None:
    service, url, log = process
    with httpx.Client(base_url=url, timeout=60) as http:
        job = submit(http)
        # A stream that is not ended is cut off after the grace period, and reading it raises.
        assert http.get(f"/v1/jobs/{job.id}/events").text.endswith("\n\n")
    assert service.wait(20) == 0
    assert log.read_text() == "", "nothing was cancelled"
