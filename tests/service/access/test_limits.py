"""Limits per client: request rate, queued and running jobs, body size; and the responses beyond them."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import httpx
import pytest
import uvicorn
from pliant.client import Client, TooManyRequests
from pliant.client.retry import Retry
from pliant.service import __main__ as main
from pliant.service.middleware.rate_limit import MOST_CLIENTS, Rates, _client
from pliant.service.settings import USUAL_RATE, ServiceSettings
from pliant.worker.errors import InvalidSetting
from pliant.worker.tokens import Scope
from serving import Running, Serve, claim, form, settings_from, submit, tracks


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_a_burst_of_one_minute_is_allowed_then_the_steady_rate() -> None:
    clock = Clock()
    rates = Rates(clock=clock)
    assert [rates.take("a", 60) for _ in range(60)] == [0.0] * 60
    assert rates.take("a", 60) == pytest.approx(1.0)
    assert rates.take("a", 60) == pytest.approx(1.0), "a refused request is not counted"
    assert rates.take("b", 60) == 0.0
    clock.now += 0.99
    assert rates.take("a", 60) == pytest.approx(0.01)
    clock.now += 0.02
    assert rates.take("a", 60) == 0.0
    assert rates.take("a", 60) > 0.9
    clock.now += 3600
    assert [rates.take("a", 60) == 0.0 for _ in range(61)] == [True] * 60 + [False], "idleness is not saved up"


def test_the_long_term_rate_is_the_configured_rate() -> None:
    clock = Clock()
    rates = Rates(clock=clock)
    passed = 0
    for _ in range(10 * 60 * 10):  # ten minutes of ten requests a second
        clock.now += 0.1
        passed += rates.take("a", 30) == 0.0
    assert 10 * 30 <= passed <= 11 * 30 + 1


def test_remembered_clients_are_bounded_and_busy_ones_are_kept() -> None:
    clock = Clock()
    rates = Rates(clock=clock)
    while rates.take("greedy", 10) == 0.0:
        pass
    for number in range(3 * MOST_CLIENTS):
        rates.take(f"client {number}", 1000)
    assert len(rates._paid_off) <= MOST_CLIENTS
    assert rates.take("greedy", 10) > 0


def test_clients_are_counted_by_ipv4_address_or_ipv6_network() -> None:
    def who(host: str) -> str:
        return _client({"client": (host, 1)}, None)

    assert who("10.0.0.1") != who("10.0.0.2")
    assert who("2001:db8::1") == who("2001:db8::ffff:1") != who("2001:db8:0:1::1")
    assert who("::ffff:10.0.0.1") == who("10.0.0.1"), "as some proxies write it"
    assert who("testclient") == "testclient"
    assert _client({"client": None}, None) == ""


def test_too_many_requests_return_429_with_retry_after(serve: Serve) -> None:
    running = serve(requests_per_minute=5)
    with httpx.Client(base_url=running.url) as http:
        for _ in range(5):
            assert http.get("/v1/jobs").status_code == 200
        refused = http.post("/v1/jobs", files=form())
        assert (refused.status_code, refused.json()["code"]) == (429, "too_many_requests")
        assert refused.json()["retryable"]
        assert 1 <= int(refused.headers["retry-after"]) <= 12
        assert http.get("/healthz").status_code == 200
        assert running.waiting == 0


def test_each_token_has_its_own_rate(serve: Serve) -> None:
    running = serve(auth="required", requests_per_minute=3)
    with running.client() as one, running.client() as other, running.client(requests_per_minute=6) as third:
        assert [one.get("/v1/jobs").status_code for _ in range(4)] == [200] * 3 + [429]
        assert [other.get("/v1/jobs").status_code for _ in range(4)] == [200] * 3 + [429]
        assert [third.get("/v1/jobs").status_code for _ in range(7)] == [200] * 6 + [429]
    with running.client() as fourth:
        assert fourth.get("/v1/limits").json()["requests_per_minute"] == 3


def test_the_sdk_honours_retry_after_and_succeeds(serve: Serve) -> None:
    running = serve(requests_per_minute=60)
    with Client(running.url) as client:
        begun = time.monotonic()
        for _ in range(62):
            client.options()
        assert 0.5 < time.monotonic() - begun < 20
    hasty = Client(running.url, retries=Retry(patience=0.0, first_contact=0.0))

    def many() -> None:
        for _ in range(40):
            hasty.options()

    with hasty, pytest.raises(TooManyRequests):
        many()


def test_the_limit_of_queued_jobs_is_enforced(serve: Serve) -> None:
    running = serve(max_queued=2)
    with httpx.Client(base_url=running.url) as http:
        first, key = submit(http), {"Idempotency-Key": "k"}
        body = form(tracks(seed=5))
        second = http.post("/v1/jobs", files=body, headers=key)
        refused = http.post("/v1/jobs", files=form())
        assert (refused.status_code, refused.json()["code"], refused.headers["retry-after"]) == (
            429,
            "too_many_queued",
            "10",
        )
        assert "2 jobs are already queued" in refused.json()["detail"]
        assert http.put("/v1/jobs/third", files=form()).status_code == 429
        assert http.post("/v1/jobs", files=body, headers=key).json()["id"] == second.json()["id"], "no new job"
        assert running.waiting == 2
        claim(running, first.id)
        third = http.put("/v1/jobs/third", files=body)
        assert third.status_code == 202
        assert http.put("/v1/jobs/third", files=body).status_code == 200
        http.post(f"/v1/jobs/{second.json()['id']}/cancel")
        assert http.post(f"/v1/jobs/{second.json()['id']}/retry").status_code == 202
        assert http.post(f"/v1/jobs/{second.json()['id']}/retry").status_code == 429
        assert running.left_on_disk == []


def test_a_full_queue_refuses_before_the_body_is_read(serve: Serve) -> None:
    running = serve(max_queued=1)
    host, port = running.url.removeprefix("http://").split(":")
    with httpx.Client(base_url=running.url) as http:
        submit(http)

    head = (
        f"POST /v1/jobs HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Type: multipart/form-data; boundary=b\r\n"
        "Content-Length: 999999\r\n\r\n"
    )
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(head.encode())
        assert connection.recv(4096).startswith(b"HTTP/1.1 429 ")


def test_the_queue_limit_is_per_token(serve: Serve) -> None:
    running = serve(auth="required", max_queued=1)
    with running.client() as one, running.client() as other, running.client(max_queued=2) as third:
        for client, room in ((one, 1), (other, 1), (third, 2)):
            assert client.get("/v1/limits").json()["max_queued"] == room
            for _ in range(room):
                submit(client)
            assert client.post("/v1/jobs", files=form()).status_code == 429


def test_a_token_can_have_a_smaller_body_limit(serve: Serve) -> None:
    running = serve(auth="required")
    with running.client(max_body_bytes=1000) as small, running.client(max_body_bytes=2**60) as large:
        assert small.get("/v1/limits").json()["max_body_bytes"] == 1000
        assert small.post("/v1/jobs", files=form()).status_code == 413
        assert small.put("/v1/uploads/one", content=b"x" * 1001).status_code == 413
        stored = small.put("/v1/uploads/two", content=b"x" * 1000)
        assert (stored.status_code, stored.headers["upload-limit"]) == (201, "max-size=1000, max-age=86400")
        assert large.get("/v1/limits").json()["max_body_bytes"] == running.settings.max_body_bytes
        submit(large)


def test_the_default_rate_limit_applies_off_loopback_or_with_tokens() -> None:
    def rate(own: int | None = None, **env: str) -> int:
        return settings_from(**env).rate_of(own)

    assert rate() == 0
    assert rate(HOST="0.0.0.0") == rate(AUTH="required") == rate(HOST="::", AUTH="off") == USUAL_RATE
    assert rate(HOST="0.0.0.0", REQUESTS_PER_MINUTE="0") == 0
    assert rate(REQUESTS_PER_MINUTE="7") == 7
    assert rate(9, REQUESTS_PER_MINUTE="7") == 9
    for name in ("REQUESTS_PER_MINUTE", "MAX_QUEUED"):
        with pytest.raises(InvalidSetting, match=name):
            rate(**{name: "-1"})


def test_jobs_above_the_running_limit_are_held_back(serve: Serve) -> None:
    running = serve(auth="required")
    with running.client(max_running=1) as one, running.client() as other:
        assert (one.get("/v1/limits").json()["max_running"], other.get("/v1/limits").json()["max_running"]) == (1, 0)
        places = [submit(client).place_in_queue for client in (one, one, other, other)]
        assert places == [0, None, 1, 2], "null: held back"


def test_admin_jobs_have_their_own_queue_limit(serve: Serve) -> None:
    running: Running = serve(auth="required", max_queued=1)
    with running.client() as ada, running.client(Scope.ADMIN) as admin:
        submit(ada)
        submit(admin)
        assert admin.post("/v1/jobs", files=form()).status_code == 429


def test_proxy_headers_are_ignored_unless_a_proxy_is_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise any local user could spoof the counted address and evade the limit."""
    configured: list[uvicorn.Config] = []

    class Recorded(main.Server):
        def __init__(self, config: uvicorn.Config, **more: object) -> None:
            configured.append(config)
            super().__init__(config, **more)  # type: ignore[arg-type]

        def run(self, sockets: object = None) -> None:
            self.started = True

    monkeypatch.setattr(main, "Server", Recorded)
    monkeypatch.setattr(main.signal, "signal", lambda *_: None)
    monkeypatch.setattr(main, "configure_logging", lambda *_: None)
    assert main.main() == 0
    monkeypatch.setenv("PLIANT_TRUSTED_PROXIES", "127.0.0.1, 10.0.0.0/8")
    assert main.main() == 0
    assert [config.proxy_headers for config in configured] == [False, True]
    assert configured[1].forwarded_allow_ips == ["127.0.0.1", "10.0.0.0/8"]


def test_the_service_warns_about_unknown_variables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PLIANT_DATA", str(tmp_path))
    monkeypatch.setenv("PLIANT_TRUSTED_PROXIE", "127.0.0.1")
    monkeypatch.setattr(main, "configure_logging", lambda *_: None)
    monkeypatch.setattr(main, "check_access", refuse)
    assert main.main() == 2
    sentence = "PLIANT_TRUSTED_PROXIE is no setting of Pliant and has no effect. Did you mean PLIANT_TRUSTED_PROXIES?"
    assert sentence in [record.getMessage() for record in caplog.records]


def refuse(*_: object) -> None:
    raise InvalidSetting("PLIANT_AUTH", expected="a valid token", got="none")


@pytest.mark.parametrize("wrong", ["abc", "proxy.example", "10.0.0.1/8", "127.0.0.1:80", "10.0.0.0/8,*"])
def test_trusted_proxies_are_addresses_or_networks(monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    for trusted in ("*", "::1,127.0.0.1", "10.0.0.0/8,fd00::/8"):
        monkeypatch.setenv("PLIANT_TRUSTED_PROXIES", trusted)
        assert ServiceSettings.from_environment().trusted_proxies == tuple(trusted.split(","))
    monkeypatch.setenv("PLIANT_TRUSTED_PROXIES", wrong)
    expected = r"PLIANT_TRUSTED_PROXIES: expected addresses or networks such as 10\.0\.0\.0/8, .*, or \* alone, got"
    with pytest.raises(InvalidSetting, match=expected):
        ServiceSettings.from_environment()
