"""Tokens over real HTTP: authentication, scopes, and ownership of jobs."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import httpx
import numpy as np
import pytest
from pliant.client import AsyncClient, Client, NotAuthorized, NotFound
from pliant.schemas.job import Job
from pliant.service import __main__ as process
from pliant.service.app import create_app
from pliant.service.middleware.auth import is_public, needed
from pliant.service.settings import ServiceSettings
from pliant.worker.errors import InvalidSetting
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.tokens import Scope, Tokens
from serving import Running, Serve, finish, form, settings_from, submit, tracks, until


@pytest.fixture
def ada(guarded: Running) -> Iterator[httpx.Client]:
    with guarded.client() as client:
        yield client


@pytest.fixture
def bob(guarded: Running) -> Iterator[httpx.Client]:
    with guarded.client() as client:
        yield client


def addresses(running: Running) -> list[tuple[str, str]]:
    """Return every method and path of the API, read from FastAPI so that no route is missed."""
    app = create_app(running.jobs, running.settings, tokens=running.tokens)
    found = [
        (method, path.replace("{id}", "nobody").replace("{name}", "face").replace("{file}", "tracks.npz"))
        for path, operations in app.openapi()["paths"].items()
        for method in map(str.upper, operations)
    ]
    assert len(found) > 14
    return found


def test_every_path_but_the_public_ones_needs_a_token(guarded: Running) -> None:
    asked = {"nothing": {}, "basic": {"Authorization": "Basic YTpi"}, "empty": {"Authorization": "Bearer"}}
    with httpx.Client(base_url=guarded.url) as http:
        open_to_all = set()
        for method, path in [*addresses(guarded), ("GET", "/nowhere"), ("POST", "/"), ("DELETE", "/v1")]:
            if is_public(path):
                open_to_all.add("/errors" if path.startswith("/errors") else path)
                continue
            for headers in asked.values():
                answer = http.request(method, path, headers=headers)
                assert answer.status_code == 401, (method, path)
                assert answer.headers["www-authenticate"].startswith('Bearer realm="pliant"')
                assert answer.headers["content-type"] == "application/problem+json"
        assert open_to_all == {"/healthz", "/readyz", "/", "/errors"}
        for path in ("/healthz", "/openapi.json"):
            assert http.get(path).status_code == 200


def test_tokens_in_the_query_or_sent_twice_are_not_accepted(guarded: Running) -> None:
    _, text = guarded.tokens.create("ada")
    for name in ("token", "access_token", "authorization"):
        assert httpx.get(f"{guarded.url}/v1/jobs", params={name: text}).status_code == 401
    twice = [("Authorization", f"Bearer {text}"), ("Authorization", f"Bearer {text}")]
    assert httpx.get(f"{guarded.url}/v1/jobs", headers=twice).status_code == 401


@pytest.mark.parametrize("scheme", ["Bearer", "bearer", "BEARER"])
def test_a_valid_token_is_accepted(guarded: Running, scheme: str) -> None:
    _, text = guarded.tokens.create("ada")
    answer = httpx.get(f"{guarded.url}/v1/jobs", headers={"Authorization": f"{scheme} {text}"})
    assert (answer.status_code, answer.json()["jobs"]) == (200, [])


def test_missing_invalid_revoked_and_expired_tokens_are_rejected(guarded: Running) -> None:
    token, text = guarded.tokens.create("gone")
    _, short = guarded.tokens.create("short", expires=timedelta(seconds=0.05))
    time.sleep(0.1)

    def answer_to(value: str) -> tuple[int, str, bool]:
        answer = httpx.get(f"{guarded.url}/v1/jobs", headers={"Authorization": f"Bearer {value}"})
        return answer.status_code, answer.json()["code"], 'error="invalid_token"' in answer.headers["www-authenticate"]

    assert httpx.get(f"{guarded.url}/v1/jobs").json()["code"] == "unauthorized"
    assert answer_to("nonsense") == (401, "invalid_token", True)
    assert answer_to(text[:-2] + "zz") == (401, "invalid_token", True)
    assert answer_to(short) == (401, "expired_token", True)
    guarded.tokens.revoke(token.id)
    assert answer_to(text) == (401, "invalid_token", True)


def test_the_body_of_a_request_without_a_token_is_never_read(guarded: Running) -> None:
    """The response arrives before any byte of the body is sent, and nothing is written."""
    host, port = guarded.url.removeprefix("http://").split(":")
    head = (
        f"POST /v1/jobs HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Type: multipart/form-data; boundary=b\r\n"
        "Content-Length: 1000000000\r\n\r\n"
    )
    with socket.create_connection((host, int(port)), timeout=guarded.settings.stall_seconds / 4) as connection:
        connection.sendall(head.encode())
        assert connection.recv(4096).startswith(b"HTTP/1.1 401 ")
    assert guarded.left_on_disk == []


@pytest.mark.parametrize(
    ("scopes", "read", "write"),
    [((Scope.READ,), 200, 403), ((Scope.SUBMIT,), 403, 415), ((Scope.ADMIN,), 200, 415)],
)
def test_a_scope_limits_what_a_token_can_do(
    guarded: Running, scopes: tuple[Scope, ...], read: int, write: int, caplog: pytest.LogCaptureFixture
) -> None:
    with guarded.client(*scopes) as http:
        answers = {"read": http.get("/v1/jobs"), "write": http.post("/v1/jobs", content=b"x")}
        assert (answers["read"].status_code, answers["write"].status_code) == (read, write)
        for path in ("/v1/limits", "/v1/options", "/v1/examples", "/v1/examples/face/tracks.npz"):
            assert http.get(path).status_code == 200
    for answer in answers.values():
        if answer.status_code == 403:
            assert answer.json()["code"] == "insufficient_scope"
            assert 'error="insufficient_scope"' in answer.headers["www-authenticate"]
    token = guarded.tokens.all()[-1].id
    refused = [token] * [read, write].count(403)
    until(
        lambda: (
            [vars(each)["token"] for each in caplog.records if vars(each).get("code") == "insufficient_scope"]
            == refused
        )
    )


def test_required_scopes_follow_from_method_and_path() -> None:
    assert needed("GET", "/metrics") is Scope.ADMIN
    assert needed("POST", "/v1/options") is Scope.SUBMIT
    assert needed("GET", "/v1/optionsextra") is Scope.READ
    assert [needed(method, "/v1/jobs/x") for method in ("GET", "HEAD", "PUT", "DELETE", "PATCH", "BREW")] == (
        [Scope.READ] * 2 + [Scope.SUBMIT] * 4
    )
    assert [needed(method, "/v1/uploads/x") for method in ("GET", "HEAD", "PUT", "PATCH", "DELETE")] == [
        Scope.SUBMIT
    ] * 5


def test_a_submit_only_token_can_upload_large_files(guarded: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.client.multipart.RESUMABLE_BYTES", 1000)
    monkeypatch.setattr("pliant.client.multipart.SMALL", 1000)
    _, text = guarded.tokens.create("sender", scopes=(Scope.SUBMIT,))
    with Client(guarded.url, token=text) as client:
        job = client.submit(np.random.default_rng(0).normal(size=(6, 200, 2)) * 100)
    assert guarded.jobs.get(job.id).status == "queued"
    assert guarded.jobs.records.get(job.id).bytes > 1000


def test_jobs_of_another_token_return_404_on_every_route(
    guarded: Running, ada: httpx.Client, bob: httpx.Client
) -> None:
    job = submit(ada, name="ada's")
    finish(guarded, job.id, b"secret")
    queued = submit(ada, name="waits")
    document = create_app(guarded.jobs, guarded.settings, tokens=guarded.tokens).openapi()["paths"]
    routes = [
        (path, method)
        for path, operations in document.items()
        if path.startswith("/v1/jobs/{id}")
        for method in map(str.upper, operations)
        if method != "PUT"
    ]
    routes.append(("/v1/jobs/{id}/artifacts/{name}", "HEAD"))
    assert len(routes) >= 9
    for id in (job.id, queued.id):
        for path, method in routes:
            address = path.replace("{id}", id).replace("{name}", "shapes.npz")
            body = (
                {"outputs": ["usd"]} if path.endswith("/outputs") else None
            )  # a body is read before the job is looked up
            theirs, nobodys = (bob.request(method, at, json=body) for at in (address, address.replace(id, "nobody")))
            assert theirs.status_code == 404, (method, path)
            if method != "HEAD":
                assert theirs.json() | {"detail": ""} == nobodys.json() | {"detail": ""}
                assert theirs.json()["detail"].replace(id, "nobody") == nobodys.json()["detail"]
    assert [each["id"] for each in bob.get("/v1/jobs").json()["jobs"]] == []
    assert [each["id"] for each in ada.get("/v1/jobs").json()["jobs"]] == [queued.id, job.id]
    assert ada.get(f"/v1/jobs/{job.id}/artifacts/shapes.npz").content == b"secret"
    assert ada.get(f"/v1/jobs/{queued.id}").json()["status"] == "queued"


def test_an_id_used_by_another_token_conflicts_without_revealing_its_job(
    guarded: Running, ada: httpx.Client, bob: httpx.Client
) -> None:
    body = tracks(seed=3)
    assert ada.put("/v1/jobs/shared-name", files=form(body, name="ada's")).status_code == 202
    answer = bob.put("/v1/jobs/shared-name", files=form(body, name="ada's"))
    assert (answer.status_code, answer.json()["code"]) == (409, "id_taken")
    assert "ada" not in answer.text
    assert ada.put("/v1/jobs/shared-name", files=form(body, name="ada's")).status_code == 200
    assert bob.get("/v1/jobs/shared-name").status_code == 404

    def refused(client: httpx.Client, sent: bytes) -> str:
        again = client.put("/v1/jobs/shared-name", files=form(sent))
        assert again.status_code == 409
        return again.text

    assert refused(ada, tracks(seed=5)) == answer.text, "nor that it is another's"
    finish(guarded, "shared-name", b"result")
    assert refused(bob, tracks(seed=6)) == answer.text, "nor how it stands"


def test_idempotency_keys_are_scoped_to_a_token(ada: httpx.Client, bob: httpx.Client) -> None:
    parts = form(tracks(seed=4))
    key = {"Idempotency-Key": "one"}
    first, again, other = (each.post("/v1/jobs", files=parts, headers=key) for each in (ada, ada, bob))
    assert [answer.status_code for answer in (first, again, other)] == [202, 202, 202]
    assert first.json()["id"] == again.json()["id"] != other.json()["id"]


def test_admins_see_all_jobs_and_sharing_tokens_those_of_their_owner(guarded: Running, ada: httpx.Client) -> None:
    job = submit(ada, name="seen")
    owner = guarded.jobs.records.get(job.id).owner
    with guarded.client(Scope.ADMIN) as admin, guarded.client(sharing=owner) as fellow:
        for other in (admin, fellow):
            assert other.get(f"/v1/jobs/{job.id}").status_code == 200
            assert job.id in [each["id"] for each in other.get("/v1/jobs").json()["jobs"]]
        assert fellow.post(f"/v1/jobs/{job.id}/cancel").status_code == 200
        again = Job.model_validate_json(admin.post(f"/v1/jobs/{job.id}/retry").content)
        assert ada.get(f"/v1/jobs/{again.id}").status_code == 200, "what an admin runs again stays its owner's"


def test_the_sdk_works_with_a_token_and_explains_a_missing_one(guarded: Running) -> None:
    _, text = guarded.tokens.create("sdk")
    points = np.random.default_rng(0).normal(size=(6, 12, 2)) * 100
    with Client(guarded.url, token=text) as client:
        job = client.submit(points, mesh=(3, 4), name="by the SDK")
        finish(guarded, job.id, b"result")
        assert [each.id for each in client.list()] == [job.id]
        assert "by the SDK" in client.get(job.id).record.name

    async def twin() -> str:
        async with AsyncClient(guarded.url, token=text) as client:
            return (await client.get(job.id)).record.name

    assert asyncio.run(twin()) == "by the SDK"
    with Client(guarded.url) as stranger, pytest.raises(NotAuthorized, match="Authorization: Bearer"):
        stranger.get(job.id)
    _, other = guarded.tokens.create("other")
    with Client(guarded.url, token=other) as stranger, pytest.raises(NotFound):
        stranger.get(job.id)


def test_no_token_is_valid_if_the_store_is_down(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    running = serve(redis_url=f"unix://{tmp_path}/nobody.sock", auth="required")
    headers = {"Authorization": f"Bearer pliant_{'0' * 12}_{'a' * 43}"}
    answer = httpx.get(f"{running.url}/v1/limits", headers=headers, timeout=30)
    assert (answer.status_code, answer.json()["code"], answer.headers["retry-after"]) == (503, "store_unavailable", "2")
    ready = httpx.get(f"{running.url}/readyz", timeout=30)
    assert (ready.status_code, ready.json()["code"]) == (503, "not_ready")
    assert ready.json()["detail"] == "Not ready: redis, workers. The service's log has the reasons.", (
        "reasons are not for strangers"
    )
    assert "No such file or directory" in caplog.text


def test_a_preflight_needs_no_token_and_errors_are_readable_across_origins(serve: Serve) -> None:
    running = serve(auth="required", cors_origins=("https://good.example",))
    asking = {
        "Origin": "https://good.example",
        "Access-Control-Request-Method": "POST",
        "Access-Control-Request-Headers": "authorization,content-type",
    }
    assert httpx.options(f"{running.url}/v1/jobs", headers=asking).status_code == 200
    refused = httpx.get(f"{running.url}/v1/jobs", headers={"Origin": "https://good.example"})
    assert (refused.status_code, refused.headers["access-control-allow-origin"]) == (401, "https://good.example")
    strange = httpx.options(f"{running.url}/v1/jobs", headers=asking | {"Origin": "https://evil.example"})
    assert "access-control-allow-origin" not in strange.headers


def test_allowed_origins_are_written_as_browsers_send_them(valkey_url: str) -> None:
    read = settings_from(CORS_ORIGINS="https://Good.example/, http://localhost:3000")
    assert read.cors_origins == ("https://good.example", "http://localhost:3000")
    for wrong in ("good.example", "https://good.example/page", "*"):
        with pytest.raises(InvalidSetting, match="PLIANT_CORS_ORIGINS: expected origins such as "):
            settings_from(CORS_ORIGINS=wrong)


def test_tokens_are_required_by_default_except_on_loopback(valkey_url: str) -> None:
    def asks(**env: str) -> bool:
        return settings_from(**env).asks_for_tokens

    assert [asks(), asks(HOST="::1"), asks(HOST="localhost")] == [False, False, False]
    assert [asks(HOST="0.0.0.0"), asks(HOST="::"), asks(HOST="10.0.0.1"), asks(HOST="example.org")] == [True] * 4
    assert asks(AUTH="required")
    assert not asks(HOST="0.0.0.0", AUTH="off")
    with pytest.raises(InvalidSetting, match="'auto', 'required' or 'off'"):
        asks(AUTH="no")


def test_a_public_service_without_tokens_does_not_start(valkey_url: str, caplog: pytest.LogCaptureFixture) -> None:
    tokens = Tokens(connect(valkey_url, decode=True), prefix="check-door")
    strict, open_door = ServiceSettings(host="0.0.0.0"), ServiceSettings(host="0.0.0.0", auth="off")
    with pytest.raises(InvalidSetting, match=r"pliant token create.*PLIANT_AUTH=off"):
        process.check_access(strict, tokens)
    process.check_access(open_door, tokens)
    assert "can read and delete every job" in caplog.text
    process.check_access(ServiceSettings(), tokens)
    made, _ = tokens.create("somebody")
    process.check_access(strict, tokens)
    tokens.revoke(made.id)
    with pytest.raises(InvalidSetting, match=r"pliant token create.*PLIANT_AUTH=off"):
        process.check_access(strict, tokens)
    process.check_access(strict, Tokens(connect("unix:///nonexistent/x.sock", decode=True, retries=0), prefix="x"))


def test_a_service_whose_tokens_have_all_expired_starts_and_says_so(
    valkey_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A restart at night must not end what works without tokens, or make a new token wait for another restart."""
    before = Tokens(connect(valkey_url, decode=True), prefix="all-gone", clock=lambda: utc_now() - timedelta(days=3))
    before.create("early", expires=timedelta(days=1))
    last, _ = before.create("ada", expires=timedelta(days=2))
    tokens, strict = Tokens(connect(valkey_url, decode=True), prefix="all-gone"), ServiceSettings(host="0.0.0.0")
    process.check_access(strict, tokens)
    assert (
        f"every token has expired, the last one ({last.id}, for ada) on {last.expires_at:%Y-%m-%d %H:%M} UTC"
        in caplog.text
    )
    assert f"`pliant token create NAME --sharing {last.id}`" in caplog.text
    caplog.clear()
    tokens.create("next", sharing=last.id)
    process.check_access(strict, tokens)
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("name", "given", "sentence"),
    [
        ("REDIS_URL", "http://host", "PLIANT_REDIS_URL: expected a URL redis://"),
        ("BLOB_URL", "/srv/blobs", "PLIANT_BLOB_URL: expected file:///FOLDER"),
        ("BLOB_URL", "file:///proc/none", "PLIANT_BLOB_URL: expected a folder that exists or can be made"),
    ],
)
def test_a_service_whose_stores_cannot_be_opened_does_not_start(
    name: str,
    given: str,
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PLIANT_DATA", str(tmp_path))
    monkeypatch.setenv(f"PLIANT_{name}", given)
    monkeypatch.setattr(process, "configure_logging", lambda *_: None)
    assert process.main() == 2
    assert capsys.readouterr().err.startswith(sentence)


def test_a_token_is_ignored_if_authentication_is_off(running: Running, http: httpx.Client, tmp_path: Path) -> None:
    job = submit(http, name="anybody's")
    assert http.get(f"/v1/jobs/{job.id}", headers={"Authorization": "Bearer nonsense"}).status_code == 200
    assert Jobs.open(Settings(data=tmp_path / "x", redis_url="unix:///x")).owner is None
