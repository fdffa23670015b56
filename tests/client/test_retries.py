"""When a call is repeated: never without need, never twice in effect, never for ever."""

from __future__ import annotations

from collections.abc import Callable

import httpx
import numpy as np
import pytest
from pliant.client import (
    BadArgument,
    Client,
    InvalidRequest,
    Policy,
    ServiceFailed,
    TimeIsUp,
    TooManyRequests,
    UnexpectedAnswer,
    Unreachable,
)
from pliant.client import drive as driving
from pliant.client.errors import seconds_of
from pliant.client.flow import Call
from pliant.client.testing import FakeService
from pliant.client.transport import record
from pliant.schemas.job import Job

POINTS = np.random.default_rng(0).normal(size=(4, 9, 2))


class Clock:
    """Time that passes only when somebody pauses."""

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
    monkeypatch.setattr(driving.time, "sleep", clock.sleep)
    return clock


class Flaky(FakeService):
    """A service that misbehaves before, or after, it has done what it was asked."""

    def __init__(self, *faults: Callable[[httpx.Request], httpx.Response], after: bool = False) -> None:
        super().__init__(looks=0)
        self.faults = list(faults)
        self.after = after

    def _answer(self, request: httpx.Request) -> httpx.Response:
        if len(self.faults) == 0:
            return super()._answer(request)
        fault = self.faults.pop(0)
        if self.after:
            super()._answer(request)
        else:
            self.requests.append(request)
        return fault(request)


def no_connection(request: httpx.Request) -> httpx.Response:
    raise httpx.ConnectError("connection refused", request=request)


def cut_off(request: httpx.Request) -> httpx.Response:
    raise httpx.RemoteProtocolError("server disconnected without sending a response", request=request)


def answer(status: int, *, retryable: bool = False, **headers: str) -> Callable[[httpx.Request], httpx.Response]:
    problem = {"title": "t", "status": status, "code": "c", "detail": "Sentence.", "retryable": retryable}
    media = {"content-type": "application/problem+json", **headers}
    return lambda request: httpx.Response(status, json=problem, headers=media)


def client_of(service: httpx.BaseTransport, clock: Clock, **policy: float) -> Client:
    return Client("http://pliant.test", transport=service, policy=Policy(clock=clock, chance=lambda: 1.0, **policy))


def test_a_lost_answer_to_a_submission_makes_one_job(clock: Clock) -> None:
    service = Flaky(cut_off, cut_off, after=True)
    client = client_of(service, clock)
    job = client.submit(POINTS)
    assert [other.id for other in client.list()] == [job.id]
    keys = {request.headers["idempotency-key"] for request in service.requests if request.method == "POST"}
    assert len(keys) == 1
    bodies = {request.content.split(b"\r\n", 1)[1][:40] for request in service.requests[:3]}
    assert len(bodies) == 1


def test_a_call_that_may_have_been_carried_out_is_not_repeated(clock: Clock) -> None:
    service = Flaky(cut_off)
    client = client_of(service, clock)
    call = Call(method="POST", path="/v1/jobs/x/retry")  # without a key, as a client of another making might
    with pytest.raises(Unreachable, match="not sent again, because it may have been carried out"):
        driving.run(client._http, record(client._attempts(None), call, Job))
    assert len(service.requests) == 1
    assert clock.pauses == []


def test_a_job_run_again_is_one_new_job_though_the_answer_was_lost(clock: Clock) -> None:
    service = Flaky(after=True)
    client = client_of(service, clock)
    job = client.submit(POINTS).cancel()
    service.faults = [cut_off, cut_off]
    again = job.retry()
    assert again.record.retry_of == job.id
    assert sorted(each.id for each in client.list()) == sorted([job.id, again.id])


def test_a_question_is_asked_again_though_it_is_a_post(clock: Clock) -> None:
    service = Flaky(cut_off, cut_off)
    assert client_of(service, clock).inspect(POINTS).num_points == 9
    assert [request.url.path for request in service.requests] == ["/v1/inspect"] * 3


@pytest.mark.parametrize("fault", [no_connection, answer(429, **{"retry-after": "2"})], ids=["refused", "429"])
def test_a_call_that_cannot_have_been_carried_out_is_repeated(clock: Clock, fault: Callable) -> None:
    service = Flaky()
    client = client_of(service, clock)
    job = client.submit(POINTS)
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


def test_a_wrong_address_is_told_within_seconds_but_a_restart_is_outwaited(clock: Clock) -> None:
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
def test_a_definite_no_is_not_asked_again(clock: Clock, status: int) -> None:
    service = Flaky(answer(status))
    with pytest.raises(Exception, match=r"Sentence\."):
        client_of(service, clock).options()
    assert len(service.requests) == 1


def test_a_fault_that_calls_itself_retryable_is_retried(clock: Clock) -> None:
    service = Flaky(answer(500, retryable=True))
    client_of(service, clock).options()
    assert len(service.requests) == 2


@pytest.mark.parametrize(("status", "kind"), [(429, TooManyRequests), (503, ServiceFailed)])
def test_a_service_that_never_recovers_is_given_up_with_its_own_sentence(clock: Clock, status: int, kind: type) -> None:
    with pytest.raises(kind, match=r"Sentence\.") as caught:
        client_of(Flaky(*[answer(status)] * 99), clock).options()
    assert caught.value.status == status
    assert 60 < clock.now <= 90


def test_the_overall_timeout_holds_over_all_repetitions(clock: Clock) -> None:
    with pytest.raises(TimeIsUp, match="3 s were not enough") as caught:
        client_of(Flaky(*[answer(503)] * 99), clock).options(timeout=3)
    assert clock.now <= 3
    assert isinstance(caught.value, TimeoutError)


def test_waiting_ends_with_the_timeout_and_leaves_the_job_alone(clock: Clock) -> None:
    service = FakeService(looks=float("inf"))
    client = client_of(service, clock)
    job = client.submit(POINTS)
    with pytest.raises(TimeIsUp, match=r"Nothing was cancelled"):
        job.wait(timeout=5, on_progress=lambda _: None)
    assert 4 < clock.now <= 5
    assert job.refresh().status == "running"


def test_a_deletion_whose_answer_was_lost_is_a_deletion(clock: Clock) -> None:
    service = Flaky()
    client = client_of(service, clock)
    job = client.submit(POINTS)
    job.wait(timeout=9)
    service.faults, service.after = [cut_off], True
    job.delete()
    assert list(client.list()) == []


def test_an_answer_from_something_else_is_named(clock: Clock) -> None:
    page = lambda request: httpx.Response(404, html="<h1>nginx</h1>")  # noqa: E731
    with pytest.raises(UnexpectedAnswer, match=r"text/html.*nginx"):
        client_of(Flaky(page), clock).options()
    with pytest.raises(UnexpectedAnswer, match="Expected a Job with status 200"):
        client_of(Flaky(lambda request: httpx.Response(200, json={"hello": 1})), clock).get("a")
    nonsense = {"content-type": "application/problem+json"}
    with pytest.raises(UnexpectedAnswer, match="cannot be read"):
        client_of(Flaky(lambda request: httpx.Response(500, content=b"{", headers=nonsense)), clock).get("a")


def test_addresses_and_ids_are_checked_before_anything_is_sent(clock: Clock) -> None:
    for address in ("127.0.0.1:8000", "ftp://here", "http://"):
        with pytest.raises(BadArgument, match="Expected the address of a service"):
            Client(address)
    service = FakeService()
    with pytest.raises(BadArgument, match="Expected the id of a job"):
        client_of(service, clock).get("../../secrets")
    assert service.requests == []


def test_a_token_travels_in_the_header_alone(clock: Clock) -> None:
    service = FakeService(token="s3cret")
    with pytest.raises(Exception, match="token is needed"):
        client_of(service, clock).options()
    Client("http://pliant.test", transport=service, token="s3cret").options()
    assert "s3cret" not in str(service.requests[-1].url)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None),
        ("5", 5.0),
        ("soon", None),
        ("-3", None),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 0.0),
        ("Wed, 21 Oct 2015 07:28:00 -0000", 0.0),
    ],
)
def test_retry_after_is_seconds_or_a_date(header: str | None, seconds: float | None) -> None:
    assert seconds_of(header) == seconds


def test_the_fault_of_an_input_is_whole(clock: Clock) -> None:
    with pytest.raises(InvalidRequest) as caught:
        client_of(FakeService(), clock).submit(np.zeros((5, 9)))
    problem = caught.value.problem
    assert (problem.field, problem.expected, problem.got) == ("tracks", "(frames, points, 2)", "(5, 9)")
