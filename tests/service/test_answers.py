"""Downloads, readiness, events, waits, origin checks, and an unavailable store."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import os
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path
from urllib.parse import urljoin

import anyio
import httpx
import pytest
from pliant.schemas.job import Status
from pliant.service.app import create_app
from pliant.service.problems import of_error
from pliant.service.settings import MB
from pliant.service.spool import Incoming
from pliant.worker import errors
from pliant.worker.errors import InvalidSetting, StoreUnavailable
from pliant.worker.formats import InvalidInput
from pliant.worker.formats.records import Limits
from pliant.worker.records import EVENTS_KEPT_AT_LAST, utc_now
from pliant.worker.store.blobs import Blobs
from serving import Running, Serve, finish, settings_from, submit, until

CONTENTS = os.urandom(3_000_000)


@pytest.fixture(scope="module")
def address(running: Running) -> str:
    with httpx.Client(base_url=running.url) as http:
        job = submit(http, name="done")
    finish(running, job.id, CONTENTS)
    return f"/v1/jobs/{job.id}/artifacts/shapes.npz"


def test_a_file_is_sent_completely_with_its_digest(http: httpx.Client, address: str) -> None:
    answer = http.get(address)
    digest = hashlib.sha256(CONTENTS)
    assert answer.content == CONTENTS
    assert answer.headers["content-length"] == str(len(CONTENTS))
    assert answer.headers["etag"] == f'"{digest.hexdigest()}"'
    assert answer.headers["repr-digest"] == f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
    assert answer.headers["content-disposition"] == 'attachment; filename="shapes.npz"'
    head = http.head(address)
    assert (head.status_code, head.content, head.headers["etag"]) == (200, b"", answer.headers["etag"])
    listed = http.get(address.rpartition("/")[0]).json()
    assert [(each["name"], each["sha256"]) for each in listed] == [("shapes.npz", digest.hexdigest())]


def test_downloads_support_ranges_and_preconditions(http: httpx.Client, address: str) -> None:
    tag = http.head(address).headers["etag"]
    rest = http.get(address, headers={"Range": "bytes=1234567-", "If-Range": tag})
    assert (rest.status_code, rest.content) == (206, CONTENTS[1234567:])
    assert rest.headers["content-range"] == f"bytes 1234567-{len(CONTENTS) - 1}/{len(CONTENTS)}"
    assert http.get(address, headers={"Range": "bytes=5-", "If-Range": '"other"'}).content == CONTENTS
    assert http.get(address, headers={"If-None-Match": tag}).status_code == 304
    assert http.get(address, headers={"If-Match": '"other"'}).json()["code"] == "precondition_failed"
    beyond = http.get(address, headers={"Range": f"bytes={len(CONTENTS)}-"})
    assert (beyond.status_code, beyond.json()["code"]) == (416, "range_not_satisfiable")
    assert beyond.headers["content-range"] == f"bytes */{len(CONTENTS)}"
    assert http.get(address + "x").json()["code"] == "unknown_artifact"


def test_a_file_deleted_before_or_during_a_download_returns_410(
    running: Running, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = submit(http, name="gone")
    finish(running, job.id, b"x" * 10)
    address = f"/v1/jobs/{job.id}/artifacts/shapes.npz"
    stored = running.jobs.blobs.get(f"{running.jobs.records.get(job.id).prefix}shapes.npz")
    running.jobs.blobs.delete(f"jobs/{job.id}/")
    answer = http.get(address)
    assert (answer.status_code, answer.json()["code"]) == (410, "artifact_gone")
    # Deleted after its size was read, before its first byte.
    monkeypatch.setattr("pliant.worker.store.blobs.Blobs.get", lambda *_: stored)
    answer = http.get(address)
    assert (answer.status_code, answer.json()["code"]) == (410, "artifact_gone")
    running.jobs.records.delete(running.jobs.records.get(job.id), at=utc_now())
    answer = http.get(address)
    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_job")


def test_readiness_can_exclude_the_workers(http: httpx.Client) -> None:
    whole = http.get("/readyz")
    assert (whole.status_code, whole.json()["code"]) == (503, "not_ready")
    assert "No worker" in whole.json()["detail"]
    own = http.get("/readyz", params={"exclude": "workers"})
    assert (own.status_code, own.json()) == (200, {"redis": "ok", "blobs": "ok"})
    assert http.get("/readyz", params={"exclude": "nothing"}).status_code == 422


def test_events_end_with_the_job_and_resume_after_the_last_one(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="followed")
    timer = threading.Timer(0.5, finish, (running, job.id, b"x"))
    timer.start()
    text = http.get(f"/v1/jobs/{job.id}/events").text
    timer.join()
    assert '"status":"succeeded"' in text.replace(" ", "")
    ids = [line.removeprefix("id: ") for line in text.splitlines() if line.startswith("id: ")]
    assert len(ids) == len(set(ids)) >= 2
    later = http.get(f"/v1/jobs/{job.id}/events", headers={"Last-Event-ID": ids[-2]}).text
    assert [line for line in later.splitlines() if line.startswith("id: ")] == [f"id: {ids[-1]}"]
    odd = http.get(f"/v1/jobs/{job.id}/events", headers={"Last-Event-ID": "x"})
    assert (odd.status_code, odd.json()["code"]) == (422, "invalid_event_id")
    assert http.get("/v1/jobs/nobody/events").status_code == 404


def test_share_links_of_a_finished_job_are_no_events(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="often shared")
    finish(running, job.id, b"x")
    address = f"/v1/jobs/{job.id}"
    before = http.get(f"{address}/events").text
    for _ in range(EVENTS_KEPT_AT_LAST):
        share = http.post(f"{address}/shares", json={}).json()
        assert http.delete(f"{address}/shares/{share['id']}").status_code == 204
    assert http.get(f"{address}/events", timeout=20).text == before
    last = before.rpartition("id: ")[2].split()[0]
    assert "data:" not in http.get(f"{address}/events", headers={"Last-Event-ID": last}, timeout=20).text


def test_waiting_ends_with_the_job_or_its_time_limit(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="awaited")
    begun = time.monotonic()
    early = http.get(f"/v1/jobs/{job.id}", headers={"Prefer": "wait=1"})
    assert 0.9 < time.monotonic() - begun < 14
    assert (early.json()["status"], early.headers["preference-applied"]) == (Status.QUEUED, "wait=1")
    timer = threading.Timer(0.5, finish, (running, job.id, b"x"))
    timer.start()
    begun = time.monotonic()
    assert http.get(f"/v1/jobs/{job.id}", headers={"Prefer": "respond-async, wait=15"}).json()["status"] == "succeeded"
    several = [("Prefer", "return=representation"), ("Prefer", "wait=15")]
    assert http.get(f"/v1/jobs/{job.id}", headers=several).headers["preference-applied"] == "wait=15"
    assert time.monotonic() - begun < 14
    timer.join()


def test_errors_and_health_checks_have_the_security_headers(http: httpx.Client) -> None:
    for answer in (http.get("/healthz"), http.get("/nowhere"), http.get("/v1/jobs/nobody")):
        assert answer.headers["content-security-policy"].startswith("default-src 'none'")
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [("GET", "/nowhere", 404, "no_such_address"), ("DELETE", "/v1/options", 405, "method_not_allowed")],
)
def test_framework_errors_are_problem_documents(
    http: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    answer = http.request(method, path)
    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert answer.headers["content-type"] == "application/problem+json"


def test_allow_names_every_method_of_an_address(http: httpx.Client) -> None:
    def allowed(method: str, path: str) -> str:
        answer = http.request(method, path)
        assert answer.status_code == 405
        return answer.headers["allow"]

    assert allowed("PATCH", "/v1/jobs/abc") == "DELETE, GET, HEAD, PUT"
    assert allowed("OPTIONS", "/v1/jobs") == "GET, HEAD, POST"
    assert allowed("POST", "/v1/jobs/abc/artifacts/shapes.npz") == "GET, HEAD"


@pytest.mark.parametrize(
    ("address", "field", "hint"),
    [
        ("/v1/jobs?stauts=failed", "stauts", "Did you mean `status`?"),
        ("/v1/jobs?limit=1&page=2", "page", "Omit it"),
        ("/v1/limits?verbose=1", "verbose", "Omit it"),
    ],
)
def test_an_unknown_query_parameter_is_refused(http: httpx.Client, address: str, field: str, hint: str) -> None:
    answer = http.get(address)
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (422, "unknown_parameter", field)
    assert problem["hint"].startswith(hint)


@pytest.mark.parametrize("address", ["/healthz?probe=1", "/readyz?exclude=workers&probe=1", "/metrics?format=text"])
def test_addresses_for_machines_accept_any_query_parameter(http: httpx.Client, address: str) -> None:
    assert http.get(address).status_code == 200


def test_a_trailing_slash_is_no_redirect(http: httpx.Client) -> None:
    answer = http.post("/v1/jobs/", headers={"X-Forwarded-Proto": "https"})
    assert (answer.status_code, answer.json()["code"]) == (404, "no_such_address")


def test_the_openapi_document_names_its_service_under_any_path(http: httpx.Client) -> None:
    (server,) = http.get("/openapi.json").json()["servers"]
    for home in ("http://127.0.0.1:8000/", "https://example.org/pliant/"):
        assert urljoin(f"{home}openapi.json", server["url"]) == home


def test_a_body_that_is_not_json_is_described(http: httpx.Client) -> None:
    job = submit(http)
    headers = {"Content-Type": "application/json"}
    answer = http.post(f"/v1/jobs/{job.id}/shares", content=b'{"days":', headers=headers)
    assert (answer.status_code, answer.json()["expected"]) == (
        422,
        "JSON (EOF while parsing a value at line 1 column 8)",
    )
    assert answer.json()["got"] == """'{"days":'"""


def test_a_body_that_is_not_utf8_is_refused(http: httpx.Client) -> None:
    job = submit(http)
    answer = http.post(
        f"/v1/jobs/{job.id}/shares", content=b'{"days": "\xff"}', headers={"Content-Type": "application/json"}
    )
    assert answer.status_code == 422
    assert "invalid unicode" in answer.json()["expected"]


@pytest.mark.parametrize(("gibibytes", "parse"), [(3, 3), (8, 4)])
def test_parsing_one_file_gets_no_more_memory_than_reading(running: Running, gibibytes: int, parse: int) -> None:
    settings = replace(running.jobs.settings, read_memory=gibibytes << 30)
    app = create_app(
        replace(running.jobs, settings=settings), running.app.state.service.settings, tokens=running.tokens
    )

    async def limits() -> Limits:
        async with app.router.lifespan_context(app):
            found: Limits = app.state.service.limits
            return found

    found = asyncio.run(limits())
    assert (found.read_memory, found.parse_memory) == (gibibytes << 30, parse << 30)


VARYING = {"date", "x-request-id", "transfer-encoding"}
"""Headers that differ between two equal requests, or describe how a body is sent."""


def test_head_answers_every_get_route_with_its_status_and_headers_and_no_body(
    running: Running, http: httpx.Client
) -> None:
    job = submit(http)
    finish(running, job.id, b"result")
    values = {"id": job.id, "name": "shapes.npz", "code": "unknown_job"}
    document = running.app.openapi()["paths"]
    paths = [path for path, operations in document.items() if "get" in operations and "uploads" not in path]
    assert not any("head" in operations for path, operations in document.items() if "uploads" not in path)
    assert len(paths) >= 14
    for path in paths:
        address = "/v1/examples/face/tracks.npz" if "{file}" in path else path.format(**values)
        address += "?exclude=workers" if path == "/readyz" else ""
        got, head = http.get(address), http.head(address)
        assert (head.status_code, head.content) == (200, b""), path
        assert {name: text for name, text in head.headers.items() if name not in VARYING | {"content-length"}} == {
            name: text for name, text in got.headers.items() if name not in VARYING | {"content-length"}
        }, path
        if path != "/metrics":  # it counts the requests
            assert head.headers.get("content-length") == got.headers.get("content-length"), path
    for address in (
        "/v1/jobs/nobody",
        "/v1/jobs/nobody/events",
        f"/v1/jobs/{job.id}/artifacts/none.txt",
        "/errors/none",
    ):
        assert http.head(address).status_code == http.get(address).status_code == 404
    file = http.head(f"/v1/jobs/{job.id}/artifacts/shapes.npz").headers
    assert (file["content-length"], file["etag"]) == ("6", f'"{hashlib.sha256(b"result").hexdigest()}"')


def test_head_of_the_events_of_a_running_job_does_not_wait_for_its_end(http: httpx.Client) -> None:
    answer = http.head(f"/v1/jobs/{submit(http).id}/events", timeout=10)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),
        ({"Origin": "https://evil.example"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_other_origins_and_hosts_cannot_write(running: Running, headers: dict[str, str], status: int) -> None:
    before = running.waiting
    answer = httpx.post(f"{running.url}/v1/jobs", content=b"", headers=headers)
    assert answer.status_code == status
    assert running.waiting == before


def test_a_refused_origin_is_compared_with_the_host(running: Running) -> None:
    """A proxy that drops the port from the Host header makes the service's own page foreign."""
    host = running.url.removeprefix("http://")
    headers = {"Origin": running.url.replace("http://", "https://"), "Host": host.partition(":")[0]}
    refused = httpx.post(f"{running.url}/v1/jobs", content=b"", headers=headers).json()
    assert (refused["code"], refused["got"]) == ("cross_site_request", f"https://{host}")
    assert refused["expected"] == "127.0.0.1"
    passed = httpx.post(f"{running.url}/v1/jobs", content=b"", headers={**headers, "Host": host}).json()
    assert passed["code"] != "cross_site_request"


def test_an_allowed_origin_passes_the_origin_check(serve: Serve) -> None:
    running = serve(cors_origins=("https://good.example",))
    headers = {"Origin": "https://good.example"}
    answer = httpx.post(f"{running.url}/v1/jobs", content=b"x", headers=headers)
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (415, "https://good.example")
    for method, wanted in (("HEAD", "authorization"), ("GET", "if-range, if-none-match, if-match, range")):
        asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": wanted}
        assert httpx.options(f"{running.url}/v1/uploads/x", headers=headers | asked).status_code == 200


def test_requests_return_503_if_the_store_is_unreachable(serve: Serve, tmp_path: Path) -> None:
    running = serve(redis_url=f"unix://{tmp_path}/nobody.sock")
    assert httpx.get(f"{running.url}/healthz").status_code == 200
    assert httpx.get(f"{running.url}/readyz").json()["code"] == "not_ready"
    answer = httpx.get(f"{running.url}/v1/jobs", timeout=30)
    assert (answer.status_code, answer.json()["code"]) == (503, "store_unavailable")
    assert answer.json()["retryable"]
    assert answer.headers["retry-after"] == "2"


def test_a_job_can_be_deleted_while_the_blob_store_is_down(
    running: Running, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    id = submit(http).id
    finish(running, id, b"result")

    def away(*_: object) -> None:
        raise StoreUnavailable("The blob store", reason="no answer")

    with monkeypatch.context() as patch:
        patch.setattr(Blobs, "delete", away)
        assert http.delete(f"/v1/jobs/{id}").status_code == 204
        assert http.get(f"/v1/jobs/{id}").status_code == 404, "the record is gone, and nothing else is stated"
    assert set(running.jobs.records.deleted()) >= {id}, "the reconciler removes the files later"


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (errors.UnknownJob("a"), 404),
        (errors.InvalidRequest("invalid_id", field="id", expected="letters", got="?", hint="Change it."), 422),
        (errors.StoreUnavailable("The job store", reason="no answer"), 503),
        (errors.WorkerError("The worker failed."), 500),
        (InvalidInput("invalid_argument", field="frames", expected="3", got="2", hint="Add one."), 422),
    ],
)
def test_an_errors_code_determines_the_status(error: errors.WorkerError | InvalidInput, status: int) -> None:
    answer = of_error(error)
    assert answer.status_code == status
    assert ("retry-after" in answer.headers) == (status == 503)


def test_requests_time_out_and_health_checks_pass_if_the_store_hangs(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pliant.worker.store.connection.ANSWER_WITHIN", 2.0)
    with socket.create_server(("127.0.0.1", 0), backlog=200) as deaf:  # the kernel accepts; nothing replies
        running = serve(redis_url=f"redis://127.0.0.1:{deaf.getsockname()[1]}")
        answers: list[int] = []
        http = httpx.Client(base_url=running.url, timeout=30)

        def ask() -> None:
            answers.append(http.get("/v1/jobs/some-job").status_code)

        threads = [threading.Thread(target=ask) for _ in range(60)]  # more than the thread pool holds
        began = time.monotonic()
        for thread in threads:
            thread.start()
        until(
            lambda: (
                (running.app.state.service.metrics.registry.get_sample_value("pliant_http_requests_in_progress") or 0)
                > 40
            )
        )
        assert http.get("/healthz").status_code == 200
        assert len(answers) < 20, "it did not wait for a thread: 40 there are, and more than 40 were before it"
        for thread in threads:
            thread.join()
        http.close()
        assert answers == [503] * 60
        assert time.monotonic() - began < 20


def test_scratch_folders_of_dead_processes_are_removed_live_ones_kept(tmp_path: Path) -> None:
    living = Incoming(tmp_path)
    living.open()
    (tmp_path / "dead").mkdir()
    (tmp_path / "dead" / "part").write_bytes(b"x")
    (tmp_path / "dead.lock").touch()

    async def receive() -> None:
        async with living.scratch() as room:
            (room / "part").write_bytes(b"x")
            assert Incoming(tmp_path).abandoned() == ["dead"]
            second = Incoming(tmp_path)
            second.open()
            assert not (tmp_path / "dead").exists()
            assert (room / "part").read_bytes() == b"x"
            second.close()
        assert not room.exists()

    anyio.run(receive)
    living.close()
    assert list(tmp_path.iterdir()) == []


def test_settings_come_from_the_environment() -> None:
    settings = settings_from(MAX_BODY_MB="5", ALLOWED_HOSTS="a, b")
    assert (settings.max_body_bytes, settings.allowed_hosts, settings.loopback) == (5 * MB, ("a", "b"), True)
    assert not settings_from(HOST="0.0.0.0").loopback
    for name, value in (
        ("PORT", "70000"),
        ("PARSERS", "0"),
        ("PORT", "x"),
        ("MAX_BODY_MB", "0"),
        ("LOG_FORMAT", "xml"),
    ):
        with pytest.raises(InvalidSetting, match=f"PLIANT_{name}"):
            settings_from(**{name: value})
