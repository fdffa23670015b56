"""Retries: only when needed, never with duplicate effects, never endless."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import httpx
import numpy as np
import pytest
from pliant.client import (
    BadArgument,
    Client,
    InvalidRequest,
    NotAuthorized,
    NotFound,
    RemoteJob,
    Retry,
    ServiceFailed,
    TooManyRequests,
    UnexpectedAnswer,
    Unreachable,
    WaitTimeout,
)
from pliant.client.call import Call
from pliant.client.errors import seconds_of
from pliant.schemas.job import Job, Status
from pliant.service.testing import InMemoryService

POINTS = np.random.default_rng(0).normal(size=(4, 9, 2))


class Clock:
    """Time that advances only during pauses."""

    def __init__(self) -> None:
        self.now = 0.0
        self.pauses: list[float] = []

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.pauses.append(seconds)
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("pliant.client._sync.transport.sleep", clock.sleep)
    monkeypatch.setattr("pliant.client._sync.upload.sleep", clock.sleep)
    monkeypatch.setattr("pliant.client._sync.events.sleep", clock.sleep)
    return clock


class Flaky(InMemoryService):
    """A service that fails before, or after, it has handled a request."""

    def __init__(
        self, *faults: Callable[[httpx.Request], httpx.Response], after: bool = False, steps: float = 0
    ) -> None:
        super().__init__(steps=steps)
        self.faults = list(faults)
        self.after = after

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if len(self.faults) == 0:
            return super().handle_request(request)
        fault = self.faults.pop(0)
        if self.after:
            super().handle_request(request).close()
        else:
            request.read()
            self.requests.append(request)
        return fault(request)


def queued(client: Client) -> RemoteJob:
    """Submit a job behind one that runs until it is cancelled, so that this one stays queued."""
    client.submit(POINTS + 1)
    return client.submit(POINTS)


def no_connection(request: httpx.Request) -> httpx.Response:
    raise httpx.ConnectError("connection refused", request=request)


def cut_off(request: httpx.Request) -> httpx.Response:
    raise httpx.RemoteProtocolError("server disconnected without sending a response", request=request)


def answer(status: int, *, retryable: bool = False, **headers: str) -> Callable[[httpx.Request], httpx.Response]:
    problem = {"title": "t", "status": status, "code": "c", "detail": "Sentence.", "retryable": retryable}
    media = {"content-type": "application/problem+json", **headers}
    return lambda request: httpx.Response(status, json=problem, headers=media)


def client_of(service: httpx.BaseTransport, clock: Clock, **policy: float) -> Client:
    return Client("http://pliant.test", transport=service, retries=Retry(clock=clock, jitter=lambda: 1.0, **policy))


def test_a_lost_response_to_a_submission_creates_one_job(clock: Clock) -> None:
    service = Flaky(cut_off, cut_off, after=True)
    client = client_of(service, clock)
    job = client.submit(POINTS)
    assert [other.id for other in client.list()] == [job.id]
    keys = {request.headers["idempotency-key"] for request in service.requests if request.method == "POST"}
    assert len(keys) == 1
    bodies = {request.content.split(b"\r\n", 1)[1][:40] for request in service.requests[:3]}
    assert len(bodies) == 1


def test_an_idempotency_key_may_be_any_text(clock: Clock) -> None:
    client = client_of(InMemoryService(), clock)
    first, again, other = (client.submit(POINTS, idempotency_key=key) for key in ("Gänge 1", "Gänge 1", "歩行"))
    assert first.id == again.id != other.id


def test_a_call_that_may_have_been_carried_out_is_not_repeated(clock: Clock) -> None:
    service = Flaky(cut_off)
    client = client_of(service, clock)
    call = Call(method="POST", path="/v1/jobs/x/retry")  # without a key, as another client might send it
    with pytest.raises(Unreachable, match="not sent again, because it may have been carried out"):
        client._exchange(None).record(call, Job)
    assert len(service.requests) == 1
    assert clock.pauses == []


def test_a_retried_job_is_created_once_despite_a_lost_response(clock: Clock) -> None:
    service = Flaky(after=True, steps=math.inf)
    client = client_of(service, clock)
    job = queued(client).cancel()
    service.faults = [cut_off, cut_off]
    again = job.retry()
    assert again.record.retry_of == job.id
    assert [each.record.retry_of for each in client.list()] == [job.id, None, None]


def test_a_post_without_side_effects_is_repeated(clock: Clock) -> None:
    service = Flaky(cut_off, cut_off)
    assert client_of(service, clock).inspect(POINTS).num_points == 9
    assert [request.url.path for request in service.requests] == ["/v1/inspect"] * 3


@pytest.mark.parametrize("fault", [no_connection, answer(429, **{"retry-after": "2"})], ids=["refused", "429"])
def test_a_call_that_cannot_have_been_carried_out_is_repeated(clock: Clock, fault: Callable) -> None:
    service = Flaky(steps=math.inf)
    client = client_of(service, clock)
    job = queued(client)
    job.cancel()
    service.faults = [fault]
    job.retry()
    assert len(clock.pauses) == 1


def test_retry_after_is_honoured(clock: Clock) -> None:
    client = client_of(
        Flaky(answer(429, **{"retry-after": "7"}), answer(503, **{"retry-after": "3"})), clock, first_contact=60
    )
    client.options()
    assert clock.pauses == [7.25, 3.25]


def test_pauses_double_up_to_a_bound(clock: Clock) -> None:
    client = client_of(Flaky(*[no_connection] * 8), clock, first_contact=100)
    client.options()
    assert clock.pauses == [0.25, 0.5, 1, 2, 4, 8, 10, 10]


def test_a_wrong_address_fails_fast_but_a_restart_is_waited_for(clock: Clock) -> None:
    with pytest.raises(Unreachable, match=r"connection refused.*pliant up"):
        client_of(Flaky(*[no_connection] * 99), clock).options()
    assert 1 < clock.now < 6
    service = Flaky()
    client = client_of(service, clock)
    client.options()
    service.faults = [no_connection] * 10
    client.options()
    assert clock.now > 30
    service.faults = [no_connection] * 99
    with pytest.raises(Unreachable):
        client.options()


@pytest.mark.parametrize("status", [400, 401, 404, 409, 413, 422, 500, 501])
def test_a_non_retryable_error_is_not_retried(clock: Clock, status: int) -> None:
    service = Flaky(answer(status))
    with pytest.raises(Exception, match=r"Sentence\."):
        client_of(service, clock).options()
    assert len(service.requests) == 1


def test_a_retryable_error_is_retried(clock: Clock) -> None:
    service = Flaky(answer(500, retryable=True))
    client_of(service, clock).options()
    assert len(service.requests) == 2


@pytest.mark.parametrize(("status", "kind"), [(429, TooManyRequests), (503, ServiceFailed)])
def test_persistent_errors_are_raised_with_the_services_message(clock: Clock, status: int, kind: type) -> None:
    with pytest.raises(kind, match=r"Sentence\.") as caught:
        client_of(Flaky(*[answer(status)] * 99), clock).options()
    assert caught.value.status == status
    assert 60 < clock.now <= 90


def test_the_timeout_covers_all_retries(clock: Clock) -> None:
    with pytest.raises(WaitTimeout, match="The timeout of 3 s passed") as caught:
        client_of(Flaky(*[answer(503)] * 99), clock).options(timeout=3)
    assert clock.now <= 3
    assert "Sentence. " in str(caught.value)
    assert isinstance(caught.value, TimeoutError)


def test_a_wait_for_the_network_that_ends_with_the_timeout_is_no_error(clock: Clock) -> None:
    def silent(request: httpx.Request) -> httpx.Response:
        clock.now += request.extensions["timeout"]["read"] - 0.001
        raise httpx.ReadTimeout("timed out", request=request)

    with pytest.raises(WaitTimeout, match=r"The timeout of 3 s passed during the call\. Nothing was cancelled"):
        client_of(Flaky(silent), clock).options(timeout=3)
    with pytest.raises(WaitTimeout, match=r"the last error was: timed out"):
        client_of(Flaky(*[silent] * 99), clock).options(timeout=60.1)


def test_an_error_response_is_raised_even_after_the_deadline(clock: Clock) -> None:
    def late(request: httpx.Request) -> httpx.Response:
        clock.now += 5
        return answer(422)(request)

    with pytest.raises(InvalidRequest, match=r"Sentence\."):
        client_of(Flaky(late), clock).options(timeout=3)


@pytest.mark.parametrize("on_progress", [None, lambda _: None], ids=["polling", "events"])
def test_waiting_ends_with_the_timeout_and_the_job_continues(on_progress: Callable[[Job], None] | None) -> None:
    service = InMemoryService(steps=math.inf)
    with Client("http://pliant.test", transport=service, retries=Retry(poll_interval=0.01)) as client:
        job = client.submit(POINTS)
        with pytest.raises(WaitTimeout, match=r"0\.6 s passed during the wait for job"):
            job.wait(timeout=0.6, on_progress=on_progress)
        assert job.refresh().status == "running"


def test_a_deletion_with_a_lost_response_succeeds(clock: Clock) -> None:
    service = Flaky()
    client = client_of(service, clock)
    job = client.submit(POINTS)
    job.wait(timeout=9)
    service.faults, service.after = [cut_off], True
    job.delete()
    assert list(client.list()) == []


@pytest.mark.parametrize("fault", [no_connection, answer(429)], ids=["no connection", "429"])
def test_an_unknown_job_is_reported_if_no_attempt_can_have_deleted_it(
    clock: Clock, fault: Callable[[httpx.Request], httpx.Response]
) -> None:
    with pytest.raises(NotFound):
        client_of(Flaky(fault), clock).delete("no-such-job")


def test_a_submission_that_times_out_may_have_been_accepted(clock: Clock) -> None:
    def late(request: httpx.Request) -> httpx.Response:
        clock.now += request.extensions["timeout"]["read"]
        raise httpx.ReadTimeout("timed out", request=request)

    service = Flaky(late, after=True)
    client = client_of(service, clock)
    with pytest.raises(WaitTimeout, match=r"may have been accepted.*idempotency_key"):
        client.submit(POINTS, timeout=3, idempotency_key="once")
    with pytest.raises(WaitTimeout, match=r"last error was.*may have been accepted"):
        client_of(Flaky(*[answer(503)] * 99), clock).submit(POINTS, timeout=3)
    job = client.submit(POINTS, idempotency_key="once")
    assert [other.id for other in client.list()] == [job.id]
    job.wait(timeout=9)
    again = job.run_again(idempotency_key="more")
    assert job.run_again(idempotency_key="more").id == again.id != job.id


def test_a_retried_job_is_one_job_for_one_key(clock: Clock) -> None:
    with client_of(Flaky(steps=math.inf), clock) as client:
        job = queued(client)
        job.cancel()
        assert job.retry(idempotency_key="again").id == client.retry(job.id, idempotency_key="again").id != job.id


def test_an_event_stream_ends_with_the_timeout_between_two_heartbeats(clock: Clock) -> None:
    class Heartbeats(httpx.SyncByteStream):
        """A comment every 15 s, if the client reads that long."""

        def __init__(self, request: httpx.Request) -> None:
            self.request, self.longest = request, request.extensions["timeout"]["read"]

        def __iter__(self) -> Iterator[bytes]:
            while True:
                clock.now += min(15.0, self.longest)
                if self.longest < 15:
                    raise httpx.ReadTimeout("timed out", request=self.request)
                yield b": \n\n"

    class Quiet(InMemoryService):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.url.path.endswith("/events"):
                return httpx.Response(200, headers={"content-type": "text/event-stream"}, stream=Heartbeats(request))
            return super().handle_request(request)

    with client_of(Quiet(steps=math.inf), clock) as client:
        job = queued(client)
        begun = clock.now
        with pytest.raises(WaitTimeout):
            job.wait(timeout=31, on_progress=lambda _: None)
        assert clock.now - begun == pytest.approx(31, abs=0.6)


def test_a_service_that_grants_no_wait_is_polled(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.client._sync.operations.sleep", clock.sleep)
    service = Flaky()
    client = client_of(service, clock)
    job = client.submit(POINTS)
    job.wait(timeout=9)
    running = job.record.model_copy(update={"status": Status.RUNNING}).model_dump_json()
    granted = {"content-type": "application/json", "preference-applied": "wait=0"}
    service.faults = [lambda _: httpx.Response(200, text=running, headers=granted)] * 5
    clock.pauses.clear()
    assert client.wait(job.id, timeout=60).job.status is Status.SUCCEEDED
    assert len(clock.pauses) == 5
    assert min(clock.pauses) > 0.1


def test_a_revocation_with_a_lost_response_succeeds(clock: Clock) -> None:
    service = Flaky()
    client = client_of(service, clock)
    job = client.submit(POINTS)
    job.wait(timeout=9)
    share = job.share()
    service.faults, service.after = [cut_off], True
    client.revoke_share(job.id, share.id)
    assert client.shares(job.id) == []
    with pytest.raises(NotFound):
        client.revoke_share(job.id, share.id)


def test_an_error_page_of_a_proxy_during_a_restart_is_retried(clock: Clock) -> None:
    pages = [lambda request, status=status: httpx.Response(status, html="<h1>nginx</h1>") for status in (502, 503, 504)]
    assert client_of(Flaky(*pages), clock).limits().max_page == 200
    assert len(clock.pauses) == 3
    with pytest.raises(UnexpectedAnswer, match="with status 502"):
        client_of(Flaky(*pages[:1] * 99), clock).limits()
    service = Flaky(pages[0])
    with pytest.raises(UnexpectedAnswer):  # not idempotent: it may have been carried out
        client_of(service, clock)._exchange(None).record(Call(method="POST", path="/v1/jobs/x/retry"), Job)
    assert len(service.requests) == 1


def test_a_redirect_is_not_taken_for_success(clock: Clock) -> None:
    def to_tls(request: httpx.Request) -> httpx.Response:
        return httpx.Response(308, headers={"location": f"https://pliant.test{request.url.path}"})

    client = client_of(httpx.MockTransport(to_tls), clock)
    for call in (
        lambda: client.delete("a"),
        lambda: client.revoke_share("a", "b"),
        lambda: client.log("a"),
        lambda: client.options(),
        lambda: client.get("a"),
    ):
        with pytest.raises(UnexpectedAnswer, match=r"status 308.* redirect to https://pliant\.test/"):
            call()


def test_a_response_that_the_client_asked_to_delay_is_not_a_failure(clock: Clock) -> None:
    service = InMemoryService()
    client = client_of(service, clock, long_poll=60.0)
    client.submit(POINTS).wait(timeout=1000)
    (delayed,) = [request for request in service.requests if "prefer" in request.headers]
    assert delayed.headers["prefer"] == "wait=60"
    assert delayed.extensions["timeout"]["read"] > 100


@pytest.mark.parametrize("large", [False, True], ids=["form", "ahead"])
def test_the_timeout_of_a_submission_also_ends_a_slow_upload(
    clock: Clock, large: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if large:
        monkeypatch.setattr("pliant.client.multipart.RESUMABLE_BYTES", 100_000)
        monkeypatch.setattr("pliant.client.multipart.SMALL", 10_000)
    sent: list[int] = []

    def slowly(done: int, total: int) -> None:
        sent.append(done)
        clock.now += 1
        assert total > 4_000_000

    client = client_of(InMemoryService(), clock)
    with pytest.raises(WaitTimeout, match="passed during the submission"):
        client.submit(np.zeros((5, 60_000, 2)), on_upload=slowly, timeout=3)
    assert len(sent) == 3


@pytest.mark.parametrize("status", [200, 400])
def test_the_timeout_bounds_a_body_that_arrives_slowly(clock: Clock, status: int) -> None:
    class Slow(httpx.SyncByteStream):
        def __iter__(self) -> Iterator[bytes]:
            for _ in range(100):
                clock.now += 1
                yield b" "

    client = client_of(Flaky(lambda request: httpx.Response(status, stream=Slow())), clock)
    with pytest.raises(WaitTimeout, match="The timeout of 3 s passed"):
        client.limits(timeout=3)
    assert clock.now == 3


@pytest.mark.parametrize(("message", "words"), [("", "ReadError"), ("Server disconnected.", "Server disconnected")])
def test_the_last_error_is_named_whether_or_not_it_has_a_message(clock: Clock, message: str, words: str) -> None:
    def lost(request: httpx.Request) -> httpx.Response:
        raise httpx.ReadError(message)

    with pytest.raises(WaitTimeout, match=rf"the last error was: {words}\. Nothing"):
        client_of(Flaky(*[lost] * 30), clock).limits(timeout=3)
    with pytest.raises(Unreachable, match=rf"pliant\.test: {words}\. Check"):
        client_of(Flaky(*[lost] * 30), clock).limits()


def test_a_response_of_another_server_is_an_error(clock: Clock) -> None:
    page = lambda request: httpx.Response(404, html="<h1>nginx</h1>")  # noqa: E731
    with pytest.raises(UnexpectedAnswer, match=r"text/html.*nginx"):
        client_of(Flaky(page), clock).options()
    with pytest.raises(UnexpectedAnswer, match="Expected a Job with status 200"):
        client_of(Flaky(lambda request: httpx.Response(200, json={"hello": 1})), clock).get("a")
    with pytest.raises(UnexpectedAnswer, match="Expected a Document with status 200, got '<h1>Welcome"):
        client_of(Flaky(lambda request: httpx.Response(200, html="<h1>Welcome</h1>")), clock).ready()
    nonsense = {"content-type": "application/problem+json"}
    with pytest.raises(UnexpectedAnswer, match="cannot be read"):
        client_of(Flaky(lambda request: httpx.Response(500, content=b"{", headers=nonsense)), clock).get("a")


def test_addresses_and_ids_are_checked_before_anything_is_sent(clock: Clock) -> None:
    for address in ("127.0.0.1:8000", "ftp://here", "http://"):
        with pytest.raises(BadArgument, match="Expected the address of a service"):
            Client(address)
    client = client_of(service := InMemoryService(), clock)
    wrong: Any
    for wrong in ("../../secrets", "", 5):
        with pytest.raises(BadArgument, match="Expected the id of a job"):
            client.get(wrong)
        with pytest.raises(BadArgument, match="Expected the id of a job"):
            client.submit(inputs_of=wrong)
    assert service.requests == []


@pytest.mark.parametrize("key", ["", "a\nb", " a", "a ", "\ud800", "k" * 256, 5])
def test_an_idempotency_key_is_checked_before_anything_is_sent(clock: Clock, key: Any) -> None:
    client = client_of(service := InMemoryService(), clock)
    for call in (
        partial(client.submit, POINTS),
        partial(client.retry, "a-job"),
        partial(client.make_outputs, "a-job", "glb"),
    ):
        with pytest.raises(BadArgument, match="idempotency_key: expected 1 to 255 printable characters"):
            call(idempotency_key=key)
    assert service.requests == []


def test_statuses_are_checked_before_anything_is_sent(clock: Clock) -> None:
    client = client_of(service := InMemoryService(), clock)
    for wrong in ("done", ["queued", "done"]):
        with pytest.raises(BadArgument, match=r"statuses: 'done' is not a valid Status\. Choose from queued, running"):
            list(client.list(statuses=wrong))
    assert service.requests == []


def test_a_name_that_is_not_utf8_is_sent(clock: Clock) -> None:
    client = client_of(InMemoryService(), clock)
    assert client.submit(POINTS, name=os.fsdecode(b"pr\xfcfung")).record.name == "pr?fung"


def test_a_token_is_only_sent_in_the_header(clock: Clock) -> None:
    service = InMemoryService(auth="required")
    with pytest.raises(NotAuthorized, match="token"):
        client_of(service, clock).options()
    token = service.create_token()
    Client("http://pliant.test", transport=service, token=token).options()
    assert token not in str(service.requests[-1].url)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None),
        ("5", 5.0),
        ("soon", None),
        ("-3", None),
        ("²", None),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 0.0),
        ("Wed, 21 Oct 2015 07:28:00 -0000", 0.0),
    ],
)
def test_retry_after_is_seconds_or_a_date(header: str | None, seconds: float | None) -> None:
    assert seconds_of(header) == seconds


def test_an_input_error_has_all_its_fields(clock: Clock) -> None:
    with pytest.raises(InvalidRequest) as caught:
        client_of(InMemoryService(), clock).submit(np.zeros((5, 9)))
    problem = caught.value.problem
    assert problem.field == "tracks"
    assert "(frames, points, 2)" in str(problem.expected)
    assert "(5, 9)" in str(problem.got)


@pytest.mark.parametrize(
    "name", ["patience", "first_contact", "shortest_pause", "longest_pause", "long_poll", "poll_interval"]
)
def test_a_time_that_is_negative_or_no_number_is_refused(name: str) -> None:
    with pytest.raises(BadArgument, match=f"{name}: expected at least 0 seconds, got -1"):
        Retry(**{name: -1})
    wrong: Any
    for wrong in (math.nan, None, "5 s"):
        with pytest.raises(BadArgument, match=f"{name}: expected seconds as a number, got"):
            Retry(**{name: wrong})
    assert Retry(**{name: np.float32(0.5)}) == Retry(**{name: 0.5})
