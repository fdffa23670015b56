from __future__ import annotations

import hashlib
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pliant.schemas.job import Job, Problem, Status
from pliant.service.settings import MB
from pliant.worker.formats import Limits, load_inputs
from pliant.worker.jobs.service import Jobs
from serving import Running, Serve, claim, form, heard, npz, submit, tracks, until


def test_a_submitted_job_is_stored_queued_and_returned(running: Running, http: httpx.Client, tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(6, 12, 2)) * 100
    answer = http.post(
        "/v1/jobs", files=form(npz(tracks=points), mesh="3x4", options={"method": "temporal"}, name=" a\nb ")
    )
    assert answer.status_code == 202
    job = Job.model_validate_json(answer.content)
    assert answer.headers["location"] == f"/v1/jobs/{job.id}"
    assert (job.status, job.name, job.options.method) == (Status.QUEUED, "a b", "temporal")
    assert (job.interpretation.num_frames, job.interpretation.num_points) == (6, 12)
    assert job.interpretation.mesh_source == "grid"
    assert Job.model_validate_json(http.get(answer.headers["location"]).content) == job
    running.jobs.blobs.fetch(running.jobs.records.get(job.id).inputs, tmp_path / "inputs.npz")
    np.testing.assert_array_equal(load_inputs(tmp_path / "inputs.npz").tracks.points, points)
    assert running.left_on_disk == []


def test_text_parts_can_have_a_file_name(http: httpx.Client) -> None:
    parts = form() | {"options": ("options.json", b'{"method": "temporal"}', "application/json")}
    answer = http.post("/v1/jobs", files=parts)
    assert answer.status_code == 202
    assert answer.json()["options"]["method"] == "temporal"


BAD: dict[str, tuple[dict[str, Any], int, str, str]] = {
    "no tracks": ({"tracks": None, "name": "x"}, 422, "missing_part", "tracks"),
    "tracks as text": ({"tracks": "hello"}, 422, "not_a_file", "tracks"),
    "unknown part": ({"pickles": b"x"}, 422, "unknown_part", "pickles"),
    "text posing as npz": ({"tracks": b"hello, I am tracks"}, 422, "unknown_format", "tracks"),
    "empty file": ({"tracks": b""}, 422, "empty_file", "tracks"),
    "object array": ({"tracks": npz(tracks=np.array([{}, 1], object))}, 422, "object_array", "tracks.tracks"),
    "wrong shape": ({"tracks": npz(tracks=np.zeros((4, 5, 6, 7)))}, 422, "wrong_shape", "tracks"),
    "two frames": ({"tracks": tracks(2)}, 422, "too_few_frames", "tracks"),
    "vertices": ({"mesh": "5x5"}, 422, "vertex_count_mismatch", "mesh"),
    "options no JSON": ({"options": "{"}, 422, "invalid_option", "options"),
    "options no object": ({"options": "[1]"}, 422, "invalid_option", "options"),
    "options too deep": ({"options": "[" * 100_000}, 422, "invalid_option", "options"),
    "unknown option": ({"options": {"metod": "robust"}}, 422, "unknown_option", "options.metod"),
    "option out of range": ({"options": {"fps": -1}}, 422, "invalid_option", "options.fps"),
    "option not finite": ({"options": '{"fps": NaN}'}, 422, "invalid_option", "options.fps"),
    "priority": ({"priority": "urgent"}, 422, "invalid_priority", "priority"),
    "long name": ({"name": "n" * 201}, 422, "name_too_long", "name"),
    "long text": ({"name": "n" * (2**20 + 1)}, 413, "text_too_large", "name"),
    "long options": ({"options": ("options.json", b" " * (2**20 + 1))}, 413, "text_too_large", "options"),
    "not UTF-8": ({"name": ("", b"\xff\xfe")}, 422, "not_utf8", "name"),
}


@pytest.mark.parametrize("case", BAD)
def test_an_error_states_expected_and_got_and_nothing_is_kept(running: Running, http: httpx.Client, case: str) -> None:
    parts, status, code, field = BAD[case]
    given = form() | {
        name: value if isinstance(value, tuple) else form(**{name: value})[name]
        for name, value in parts.items()
        if value is not None
    }
    if parts.get("tracks", b"") is None:
        del given["tracks"]
    before = running.waiting
    answer = http.post("/v1/jobs", files=given)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = Problem.model_validate_json(answer.content)
    assert (problem.status, problem.code, problem.field) == (status, code, field)
    assert problem.expected
    assert problem.got
    assert problem.hint
    assert problem.detail.endswith((".", ")"))
    assert "frames" not in problem.hint or code != "text_too_large"
    assert running.waiting == before
    assert running.left_on_disk == []


def test_unavailable_outputs_are_rejected_before_the_job_is_queued(
    running: Running, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    wish = form(options={"outputs": ["usd"]})
    monkeypatch.setattr("pliant.worker.artifacts.scenes.usd.available", lambda: False)
    before = running.waiting
    problem = Problem.model_validate_json(http.post("/v1/jobs", files=wish).content)
    assert (problem.status, problem.code, problem.field) == (422, "output_unavailable", "options.outputs")
    assert running.waiting == before
    monkeypatch.setattr("pliant.worker.artifacts.scenes.usd.available", lambda: True)
    assert http.post("/v1/jobs", files=wish).status_code == 202


@pytest.mark.parametrize(
    ("content_type", "body", "status", "code"),
    [
        (None, b"x", 415, "unsupported_media_type"),
        ("text/plain", b"x", 415, "unsupported_media_type"),
        ("multipart/form-data", b"x", 400, "malformed_form"),
        ("multipart/form-data; boundary=" + "b" * 300, b"x", 400, "malformed_form"),
        ("multipart/form-data; boundary=b", b"no boundary", 400, "malformed_form"),
        ("multipart/form-data; boundary=b", b"", 400, "malformed_form"),
        (
            "multipart/form-data; boundary=b",
            b'--b\r\nContent-Disposition: form-data; name="name"\r\n\r\nx',
            400,
            "malformed_form",
        ),
        ("multipart/form-data; boundary=b", b"--b\r\nX: y\r\n\r\nx\r\n--b--\r\n", 400, "malformed_form"),
        (
            "multipart/form-data; boundary=b",
            b'--b\r\nContent-Disposition: form-data; name="name"\r\n\r\nx\r\n' * 2 + b"--b--\r\n",
            422,
            "repeated_part",
        ),
    ],
)
def test_a_body_that_is_not_a_form_is_rejected(
    running: Running, http: httpx.Client, content_type: str | None, body: bytes, status: int, code: str
) -> None:
    answer = http.post("/v1/jobs", content=body, headers={"content-type": content_type} if content_type else {})
    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert running.left_on_disk == []


@pytest.fixture(scope="module")
def small(serve: Serve) -> Running:
    return serve(max_body_mb=0.2, limits=Limits(max_frames=10))


def test_a_body_over_the_limit_is_rejected_chunked_or_not(small: Running) -> None:
    body = form(b"x" * 30_000_000)
    for chunked in (False, True):
        request = httpx.Request("POST", f"{small.url}/v1/jobs", files=body)
        content: Any = request.read()
        headers = {"content-type": request.headers["content-type"]}
        answer = httpx.post(request.url, content=iter([content]) if chunked else content, headers=headers)
        assert answer.status_code == 413
        assert answer.json()["code"] == "body_too_large"
        assert answer.json()["expected"] == f"at most {int(0.2 * MB)} bytes"
        assert answer.headers["connection"] == "close"
    assert small.left_on_disk == []
    assert small.waiting == 0


def test_the_input_limits_of_the_service_apply(small: Running) -> None:
    answer = httpx.post(f"{small.url}/v1/jobs", files=form(tracks(11)))
    assert (answer.status_code, answer.json()["code"]) == (422, "too_large")


def _begun(url: str, *, declared: int, sent: bytes) -> socket.socket:
    host, port = url.removeprefix("http://").split(":")
    connection = socket.create_connection((host, int(port)), timeout=10)
    head = (
        f"POST /v1/jobs HTTP/1.1\r\nHost: {host}\r\nContent-Type: multipart/form-data; boundary=b\r\n"
        f"Content-Length: {declared}\r\n\r\n"
        '--b\r\nContent-Disposition: form-data; name="tracks"; filename="t.npz"\r\n\r\n'
    )
    connection.sendall(head.encode() + sent)
    return connection


def test_a_stalled_body_is_rejected(serve: Serve) -> None:
    hasty = serve(stall_seconds=0.5)
    with _begun(hasty.url, declared=100_000, sent=b"x" * 1000) as connection:
        answer = heard(connection, b'"body_stalled"')
    assert answer.startswith(b"HTTP/1.1 408")
    assert hasty.left_on_disk == []


def test_nothing_is_stored_if_the_client_disconnects(running: Running, caplog: pytest.LogCaptureFixture) -> None:
    connection = _begun(running.url, declared=10_000_000, sent=b"x" * 3_000_000)
    until(lambda: any(path.is_file() and path.stat().st_size > 0 for path in running.left_on_disk))
    connection.close()
    until(lambda: running.left_on_disk == [])
    until(lambda: "code=bad_request" in caplog.text)  # and not `internal_error`
    assert running.server.started


def test_two_idempotency_keys_are_refused(running: Running, http: httpx.Client) -> None:
    before = running.waiting
    twice = [("Idempotency-Key", "one"), ("Idempotency-Key", "two")]
    for address, parts in (("/v1/jobs", {"files": form()}), ("/v1/jobs/nobody/retry", {})):
        answer = http.post(address, headers=twice, **parts)
        assert (answer.status_code, answer.json()["code"]) == (400, "conflicting_headers")
    assert running.waiting == before


def test_an_idempotency_key_makes_a_submission_repeatable(running: Running, http: httpx.Client) -> None:
    key = {"Idempotency-Key": "6f1b"}
    first = http.post("/v1/jobs", files=form(name="same"), headers=key)
    # The same parts in another order and with another boundary are the same content.
    again = http.post("/v1/jobs", files=dict(reversed(form(name="same").items())), headers=key)
    assert (first.status_code, again.status_code) == (202, 202)
    assert first.json()["id"] == again.json()["id"]
    other = http.post("/v1/jobs", files=form(name="other"), headers=key)
    assert (other.status_code, other.json()["code"]) == (409, "idempotency_conflict")
    assert http.post("/v1/jobs", files=form(name="same")).json()["id"] != first.json()["id"]


def test_an_idempotency_key_has_255_characters_in_any_script(running: Running, http: httpx.Client) -> None:
    keys = [("ж" * 255).encode(), b"\xe9" * 255, ("ж" * 256).encode(), b""]
    answers = [http.post("/v1/jobs", files=form(), headers=[(b"Idempotency-Key", key)]) for key in keys]
    assert [each.status_code for each in answers] == [202, 202, 422, 422]
    assert {each.json()["code"] for each in answers[2:]} == {"invalid_idempotency_key"}
    assert running.left_on_disk == []


def test_twenty_concurrent_repetitions_create_one_job(running: Running) -> None:
    found: list[str] = []

    def send() -> None:
        key = {"Idempotency-Key": "at once"}
        answer = httpx.post(f"{running.url}/v1/jobs", files=form(name="once"), headers=key, timeout=60)
        found.append(answer.json()["id"])

    threads = [threading.Thread(target=send) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 20
    assert len(set(found)) == 1


def test_put_observes_an_idempotency_key(http: httpx.Client) -> None:
    key = {"Idempotency-Key": "take-7"}
    first = http.put("/v1/jobs/take-7a", files=form(name="take"), headers=key)
    again = http.put("/v1/jobs/take-7a", files=form(name="take"), headers=key)
    assert (first.status_code, again.status_code) == (202, 200)
    assert http.post("/v1/jobs", files=form(name="take"), headers=key).json()["id"] == "take-7a"
    other = http.put("/v1/jobs/take-7b", files=form(name="take"), headers=key)
    assert (other.status_code, other.json()["code"]) == (409, "idempotency_conflict")
    assert "take-7a" in other.json()["detail"]
    assert http.get("/v1/jobs/take-7b").status_code == 404


def test_put_uses_the_id_chosen_by_the_client(http: httpx.Client) -> None:
    first = http.put("/v1/jobs/my-own-id", files=form(name="mine"))
    assert (first.status_code, first.json()["id"]) == (202, "my-own-id")
    again = http.put("/v1/jobs/my-own-id", files=form(name="mine"))
    assert (again.status_code, again.json()["id"]) == (200, "my-own-id")
    other = http.put("/v1/jobs/my-own-id", files=form(name="not mine"))
    assert (other.status_code, other.json()["code"]) == (409, "id_taken")
    odd = http.put("/v1/jobs/x", files=form())
    assert (odd.status_code, odd.json()["code"]) == (422, "invalid_id")
    assert http.put("/v1/jobs/a%2Fb", files=form()).status_code == 404


def test_of_two_equal_puts_at_once_only_one_creates_the_job(
    http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Jobs, "known", lambda *_: None)  # neither finds the job of the other
    answers = [http.put("/v1/jobs/both-at-once", files=form()) for _ in range(2)]
    assert [each.status_code for each in answers] == [202, 200]
    assert answers[0].json() == answers[1].json()
    assert http.put("/v1/jobs/both-at-once", files=form(name="other")).json()["code"] == "id_taken"


def test_pages_list_every_job_once_newest_first(serve: Serve) -> None:
    running = serve()
    with httpx.Client(base_url=running.url) as http:
        ids = [submit(http).id for _ in range(5)]
        http.post(f"/v1/jobs/{ids[1]}/cancel")
        seen: list[str] = []
        cursor: str | None = None
        while True:
            page = http.get("/v1/jobs", params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
            seen += [job["id"] for job in page["jobs"]]
            cursor = page["next"]
            if cursor is None:
                break
        assert seen == ids[::-1]
        cancelled = http.get("/v1/jobs", params={"status": "cancelled"}).json()["jobs"]
        assert [job["id"] for job in cancelled] == [ids[1]]
        both = http.get("/v1/jobs", params=[("status", "cancelled"), ("status", "queued")]).json()["jobs"]
        assert len(both) == 5
        for bad, code in (
            ({"cursor": "x"}, "invalid_cursor"),
            ({"limit": 0}, "invalid_limit"),
            ({"limit": "many"}, "invalid_request"),
            ({"status": "x"}, "invalid_request"),
        ):
            answer = http.get("/v1/jobs", params=bad)
            assert (answer.status_code, answer.json()["code"]) == (422, code)


def test_cancel_retry_and_delete_depend_on_the_status(running: Running, http: httpx.Client) -> None:
    job = submit(http)
    assert http.delete(f"/v1/jobs/{job.id}").status_code == 409
    assert http.post(f"/v1/jobs/{job.id}/retry").json()["code"] == "not_allowed_now"
    assert http.post(f"/v1/jobs/{job.id}/cancel").json()["status"] == "cancelled"
    again = http.post(f"/v1/jobs/{job.id}/retry")
    assert (again.status_code, again.json()["retry_of"]) == (202, job.id)
    assert again.headers["location"] == f"/v1/jobs/{again.json()['id']}"
    key = {"Idempotency-Key": "again"}
    twice = [http.post(f"/v1/jobs/{job.id}/retry", headers=key) for _ in range(2)]
    assert [each.status_code for each in twice] == [202, 202]
    assert twice[0].json()["id"] == twice[1].json()["id"] != again.json()["id"]
    assert http.post("/v1/jobs", files=form(), headers=key).json()["code"] == "idempotency_conflict"
    claim(running, again.json()["id"])
    assert http.post(f"/v1/jobs/{again.json()['id']}/cancel").json()["status"] == "cancelling"
    gone = http.delete(f"/v1/jobs/{job.id}")
    assert (gone.status_code, gone.content) == (204, b"")
    assert http.get(f"/v1/jobs/{job.id}").json()["code"] == "unknown_job"
    assert http.delete(f"/v1/jobs/{job.id}").status_code == 404
    assert http.get(f"/v1/jobs/{job.id}/log").status_code == 404


def _chunks(body: bytes, sizes: list[int]) -> Iterator[bytes]:
    at = 0
    for size in sizes:
        yield body[at : at + size]
        at += size
    yield body[at:]


def test_chunk_boundaries_of_a_body_do_not_matter(http: httpx.Client) -> None:
    request = httpx.Request("POST", "http://x/v1/jobs", files=form(name="cut"))
    body = request.read()
    answers = [
        http.post(
            "/v1/jobs",
            content=_chunks(body, [int(n) for n in np.random.default_rng(seed).integers(1, 90, 40)]),
            headers={"content-type": request.headers["content-type"], "Idempotency-Key": "cut"},
        )
        for seed in range(4)
    ]
    assert {answer.status_code for answer in answers} == {202}
    assert len({answer.json()["id"] for answer in answers}) == 1


def test_the_fingerprint_covers_names_and_contents() -> None:
    from pliant.service.multipart import File, Form

    def made(**texts: str) -> str:
        return Form({"tracks": File(Path("x"), 1, hashlib.sha256(b"x").hexdigest())}, texts).fingerprint

    assert made(name="a", mesh="b") == made(mesh="b", name="a") != made(name="b", mesh="a")
    assert json.loads(f'"{made()}"') != made(name="")
