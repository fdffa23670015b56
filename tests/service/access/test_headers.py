"""Security headers of every response, and the accepted hosts."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from pliant.service.middleware.security_headers import SECURITY_HEADERS
from pliant.service.settings import ServiceSettings
from pliant.worker.errors import InvalidSetting
from serving import Running, Serve, finish, submit, until
from starlette.requests import Request
from starlette.responses import Response

CAREFUL = {
    "content-security-policy", "x-content-type-options", "x-frame-options", "referrer-policy", "cross-origin-opener-policy",
    "cross-origin-resource-policy", "permissions-policy", "cache-control",
}  # fmt: skip


@pytest.fixture(scope="module")
def user(guarded: Running) -> Iterator[httpx.Client]:
    with guarded.client() as client:
        yield client


def test_every_kind_of_response_has_the_security_headers(guarded: Running, user: httpx.Client) -> None:
    job = submit(user)
    finish(guarded, job.id, b"result")
    file = f"/v1/jobs/{job.id}/artifacts/shapes.npz"
    etag = user.head(file).headers["etag"]
    answers = {
        "page": user.get("/"),
        "manual": user.get("/docs"),
        "no such page file": user.get("/page/x.js"),
        "json": user.get(f"/v1/jobs/{job.id}"),
        "file": user.get(file),
        "part": user.get(file, headers={"Range": "bytes=0-1"}),
        "not modified": user.get(file, headers={"If-None-Match": etag}),
        "stream": user.get(f"/v1/jobs/{job.id}/events"),
        "log": user.get(f"/v1/jobs/{job.id}/log"),
        "description": user.get("/openapi.json"),
        "health": user.get("/healthz"),
        "deleted": user.delete(f"/v1/jobs/{job.id}"),
        "not found": user.get("/nowhere"),
        "wrong method": user.delete("/v1/options"),
        "wrong host": user.get("/v1/jobs", headers={"Host": "evil.example"}),
        "no token": httpx.get(f"{guarded.url}/v1/jobs"),
        "wrong scope": user.get("/metrics"),
        "not a form": user.post("/v1/jobs", content=b"x"),
        "other site": user.post("/v1/jobs", content=b"x", headers={"Origin": "https://evil.example"}),
    }
    assert {name.lower() for name in SECURITY_HEADERS} | {"cache-control"} == CAREFUL
    for name, answer in answers.items():
        assert set(answer.headers) >= CAREFUL, name
        policy = answer.headers["content-security-policy"]
        assert "unsafe" not in policy, name
        assert "frame-ancestors 'none'" in policy, name
        assert "server" not in answer.headers, name
        assert "access-control-allow-origin" not in answer.headers, name
    assert [answers[name].headers["cache-control"] for name in ("json", "log", "no token")] == ["no-store"] * 3
    assert "private" in answers["file"].headers["cache-control"]


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200), ("localhost:1", 200), ("[::1]:8000", 200), ("LOCALHOST", 200), ("evil.example", 421),
        ("127.0.0.1.evil.example", 421), ("localhost.evil.example", 421), ("evil.example:127.0.0.1", 421), ("", 421), ("[::2]", 421),
        ("127.0.0.1@evil.example", 421),
    ],
)  # fmt: skip
def test_on_loopback_only_loopback_hosts_are_accepted(running: Running, host: str, status: int) -> None:
    answer = httpx.get(f"{running.url}/v1/limits", headers={"Host": host})
    assert answer.status_code == status
    if status == 421:
        assert answer.json()["code"] == "unknown_host"


def test_a_service_on_another_loopback_address_is_reached_by_it(serve: Serve) -> None:
    running = serve(host="127.0.0.2")
    for host, status in (("127.0.0.2:8000", 200), ("localhost", 200), ("127.0.0.3", 421)):
        assert httpx.get(f"{running.url}/v1/limits", headers={"Host": host}).status_code == status


def test_only_the_listed_hosts_are_accepted(serve: Serve) -> None:
    running = serve(allowed_hosts=("Pliant.example:443",))  # as a Host header may spell it
    for host, status in (
        ("pliant.example", 200),
        ("pliant.example:443", 200),
        ("127.0.0.1", 421),
        ("x.pliant.example", 421),
    ):
        assert httpx.get(f"{running.url}/v1/limits", headers={"Host": host}).status_code == status


@pytest.mark.parametrize(
    "wrong",
    ["https://a.example", "a.example/", "a.example/path", "a.example:", "a.example:port", "::1", "*", "user@a.example"],
)
def test_a_listed_host_that_no_request_can_have_is_refused(monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    for allowed in ("a.example", "A.example:443,127.0.0.1", "[::1],[::1]:8000", "under_score"):
        monkeypatch.setenv("PLIANT_ALLOWED_HOSTS", allowed)
        assert ServiceSettings.from_environment().allowed_hosts == tuple(allowed.split(","))
    monkeypatch.setenv("PLIANT_ALLOWED_HOSTS", f"localhost, {wrong}")
    expected = "PLIANT_ALLOWED_HOSTS: expected names such as pliant.example.org, without scheme and path"
    with pytest.raises(InvalidSetting, match=expected) as caught:
        ServiceSettings.from_environment()
    assert wrong in caught.value.got


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics"])
def test_probes_and_monitoring_may_use_the_address_of_a_process(serve: Serve, path: str) -> None:
    running = serve(allowed_hosts=("pliant.example",))
    assert httpx.get(f"{running.url}{path}", headers={"Host": "10.42.0.17:8000"}).status_code != 421
    assert httpx.get(f"{running.url}{path}/", headers={"Host": "10.42.0.17:8000"}).status_code == 421
    declared = httpx.get(f"{running.url}/openapi.json", headers={"Host": "pliant.example"}).json()["paths"]
    assert "421" not in declared[path]["get"]["responses"]
    assert "421" in declared["/v1/limits"]["get"]["responses"]


def test_any_host_is_accepted_off_loopback_without_a_host_list(serve: Serve) -> None:
    running = serve(host="0.0.0.0")  # the setting; the test binds 127.0.0.1
    assert httpx.get(f"{running.url}/healthz", headers={"Host": "anything.example"}).status_code == 200


def test_internal_errors_hide_details_and_are_logged_and_counted(
    serve: Serve, caplog: pytest.LogCaptureFixture
) -> None:
    running = serve()

    async def broken(request: Request) -> Response:
        raise RuntimeError("secret detail")

    running.app.add_route("/v1/broken", broken)
    answer = httpx.get(f"{running.url}/v1/broken")
    assert (answer.status_code, answer.json()["code"]) == (500, "internal_error")
    assert set(answer.headers) >= CAREFUL
    assert "secret" not in answer.text
    until(lambda: "secret detail" in caplog.text)
    numbers = httpx.get(f"{running.url}/metrics").text
    assert 'pliant_http_requests_total{method="GET",route="other",status="500"} 1' in numbers
