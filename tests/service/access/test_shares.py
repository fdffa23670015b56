"""Share links attacked over HTTP: other jobs, other operations, expiry, deletion, tampering, too many."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import httpx
import pytest
from pliant.worker.tokens import Scope
from serving import Running, Serve, finish, submit


@pytest.fixture(params=["off", "required"])
def guarded(request: pytest.FixtureRequest, serve: Serve) -> Running:
    """A service without tokens, and one that requires them: share links grant the same on both."""
    return serve(auth=request.param)


def shared(running: Running, http: httpx.Client, **body: int) -> tuple[str, str, httpx.Client]:
    id = submit(http).id
    finish(running, id, b"arrays")
    answer = http.post(f"/v1/jobs/{id}/shares", json=body)
    assert answer.status_code == 201, answer.text
    token = answer.json()["token"]
    return id, token, httpx.Client(base_url=running.url, headers={"Authorization": f"Bearer {token}"}, timeout=20)


def test_a_share_link_grants_read_access_to_its_job_only(guarded: Running) -> None:
    with guarded.client(name="owner") as http:
        id, _, guest = shared(guarded, http)
        other = submit(http).id
        with guest:
            assert guest.get(f"/v1/jobs/{id}").json()["status"] == "succeeded"
            assert [each["name"] for each in guest.get(f"/v1/jobs/{id}/artifacts").json()] == ["shapes.npz"]
            part = guest.get(f"/v1/jobs/{id}/artifacts/shapes.npz", headers={"Range": "bytes=0-2"})
            assert (part.status_code, part.content) == (206, b"arr")
            assert "job" in guest.get(f"/v1/jobs/{id}/events").text
            assert http.post(f"/v1/jobs/{id}/shares").status_code == 201
            (own,) = guest.get(f"/v1/jobs/{id}/shares").json()  # its own link, not the other one
            first, _ = http.get(f"/v1/jobs/{id}/shares").json()
            assert own == first
            assert own["token"] is None
            forbidden = [
                ("GET", f"/v1/jobs/{other}"), ("GET", "/v1/jobs"), ("GET", f"/v1/jobs/{id}/log"), ("GET", f"/v1/jobs/{other}/shares"),
                ("POST", f"/v1/jobs/{id}/shares"), ("DELETE", f"/v1/jobs/{id}/shares/{own['id']}"),
                ("DELETE", f"/v1/jobs/{id}"), ("POST", f"/v1/jobs/{id}/outputs"),
                ("POST", f"/v1/jobs/{id}/retry"), ("POST", "/v1/jobs"), ("PUT", f"/v1/jobs/{id}"), ("GET", "/metrics"),
                ("GET", f"/v1/jobs/{id}/artifacts/..%2F..%2F{other}"), ("GET", f"/v1/jobs/{id}%2F..%2F{other}"), ("GET", "/v1/limits"),
            ]  # fmt: skip
            for method, path in forbidden:
                answer = guest.request(method, path)
                assert (answer.status_code, answer.json()["code"]) == (403, "beyond_share"), (method, path)


def test_share_links_end_on_expiry_revocation_or_job_deletion(running: Running, http: httpx.Client) -> None:
    id, _, guest = shared(running, http, expires_in=60)
    with guest:
        past = datetime.now(UTC) - timedelta(seconds=1)
        running.jobs.records.update(
            id,
            lambda held: held.model_copy(update={"shares": (held.shares[0].model_copy(update={"expires_at": past}),)}),
        )
        late = guest.get(f"/v1/jobs/{id}")
        assert (late.status_code, late.json()["code"]) == (401, "expired_share")
        assert late.json()["detail"] == "This share link has expired. Ask its sender for a new one."
        assert datetime.fromisoformat(late.json()["got"]) == past
        assert "www-authenticate" in late.headers
        assert http.get(f"/v1/jobs/{id}/shares").json() == []
    id, _, guest = shared(running, http)
    (share,) = http.get(f"/v1/jobs/{id}/shares").json()
    assert share["token"] is None
    assert http.delete(f"/v1/jobs/{id}/shares/{share['id']}").status_code == 204
    assert http.delete(f"/v1/jobs/{id}/shares/{share['id']}").json()["code"] == "unknown_share"
    with guest:
        assert guest.get(f"/v1/jobs/{id}").json()["code"] == "invalid_share"
    id, _, guest = shared(running, http)
    assert http.delete(f"/v1/jobs/{id}").status_code == 204
    with guest:
        gone = guest.get(f"/v1/jobs/{id}/artifacts/shapes.npz")
        assert (gone.status_code, gone.json()["code"]) == (401, "invalid_share")


def test_tampered_share_tokens_are_rejected(running: Running, http: httpx.Client) -> None:
    id, token, guest = shared(running, http)
    guest.close()
    other = submit(http).id
    finish(running, other, b"other")
    secret = token.rpartition(".")[2]
    tampered = (
        token[:-1] + ("A" if token[-1] != "A" else "B"), f"share.{id}.", f"share.{other}.{secret}", "share.", "share..",
        f"share.{id}", token + "x" * 300, f"share.{'a' * 40}.{secret}",
    )  # fmt: skip
    for bad in tampered:
        answer = http.get(f"/v1/jobs/{id}", headers={"Authorization": f"Bearer {bad}"})
        assert (answer.status_code, answer.json()["code"]) == (401, "invalid_share"), bad
    stored = running.jobs.records.get(id).model_dump_json()
    assert secret not in stored, "only its digest is stored"


def test_only_owners_can_share_finished_jobs_up_to_a_limit(serve: Serve) -> None:
    running = serve(auth="required")
    with running.client(name="owner") as http, running.client(name="stranger") as stranger:
        id, _, guest = shared(running, http)
        guest.close()
        assert stranger.post(f"/v1/jobs/{id}/shares").json()["code"] == "unknown_job"
        with running.client(Scope.READ, name="reader") as reader:
            assert reader.post(f"/v1/jobs/{id}/shares").json()["code"] == "insufficient_scope"
        for _ in range(19):
            assert http.post(f"/v1/jobs/{id}/shares").status_code == 201
        full = http.post(f"/v1/jobs/{id}/shares")
        assert (full.status_code, full.json()["code"]) == (409, "too_many_shares")
        queued = submit(http).id
        assert http.post(f"/v1/jobs/{queued}/shares").json()["code"] == "not_allowed_now"


BODIES = {
    "too short": (b'{"expires_in": 1}', "application/json", 422, "invalid_request"),
    "unknown": (b'{"days": 1}', "application/json", 422, "invalid_request"),
    "no JSON": (b"{", "application/json", 422, "invalid_request"),
    "a form": (b"a=1", "application/x-www-form-urlencoded", 415, "unsupported_media_type"),
    "too large": (b" " * (2**20 + 1), "application/json", 413, "body_too_large"),
}


@pytest.mark.parametrize("case", BODIES)
def test_invalid_bodies_for_shares_and_outputs_are_rejected(running: Running, http: httpx.Client, case: str) -> None:
    body, kind, status, code = BODIES[case]
    for path in ("shares", "outputs"):
        answer = http.post(f"/v1/jobs/none/{path}", content=body, headers={"Content-Type": kind})
        assert (answer.status_code, answer.json()["code"]) == (status, code), path
