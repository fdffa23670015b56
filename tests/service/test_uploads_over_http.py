"""Large inputs over real HTTP: sent whole, in parts or over broken connections; used by jobs; rejected."""

from __future__ import annotations

import base64
import hashlib
import io
import re
import socket
import threading
import time
from typing import Any

import httpx
import numpy as np
import pytest
from pliant.schemas.job import Job, Problem, Upload
from pliant.worker.formats import Limits
from serving import Running, Serve, form, heard, npz, tracks, until

DATA = np.random.default_rng(0).bytes(3_000_000)


def repr_digest(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


def begun(url: str, path: str, *, declared: int, sent: bytes, headers: str = "") -> socket.socket:
    """Start a PUT and leave it open."""
    host, port = url.removeprefix("http://").split(":")
    connection = socket.create_connection((host, int(port)), timeout=10)
    head = f"PUT {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {declared}\r\n{headers}\r\n"
    connection.sendall(head.encode() + sent)
    return connection


def offset(http: httpx.Client, path: str) -> int:
    answer = http.head(path)
    return int(answer.headers["upload-offset"]) if answer.status_code == 204 else -1


def test_one_put_is_a_complete_upload(http: httpx.Client) -> None:
    answer = http.put("/v1/uploads/plain", content=DATA)
    assert answer.status_code == 201
    upload = Upload.model_validate_json(answer.content)
    assert (upload.complete, upload.offset, upload.length) == (True, len(DATA), len(DATA))
    assert upload.sha256 == hashlib.sha256(DATA).hexdigest()
    assert answer.headers["location"] == "/v1/uploads/plain"
    assert answer.headers["repr-digest"] == repr_digest(DATA)
    head = http.head("/v1/uploads/plain")
    assert (head.status_code, head.headers["upload-offset"]) == (204, str(len(DATA)))
    assert (head.headers["upload-complete"], head.headers["cache-control"]) == ("?1", "no-store")
    assert head.headers["upload-limit"] == f"max-size={Limits().max_bytes}, max-age=86400"
    assert Upload.model_validate_json(http.get("/v1/uploads/plain").content) == upload
    assert http.delete("/v1/uploads/plain").status_code == 204
    assert http.get("/v1/uploads/plain").json()["code"] == "unknown_upload"


@pytest.mark.parametrize("verb", ["PATCH", "PUT"])
def test_an_upload_can_span_several_requests(http: httpx.Client, verb: str) -> None:
    path = f"/v1/uploads/parts-{verb}"
    first = http.put(path, content=DATA[:1_000_000], headers={"Upload-Complete": "?0", "Upload-Length": str(len(DATA))})
    assert (first.status_code, first.json()["complete"], first.headers["upload-complete"]) == (201, False, "?0")
    assert http.head(path).headers["upload-length"] == str(len(DATA))
    more = {"Upload-Offset": "1000000", "Upload-Complete": "?0"}
    assert http.request(verb, path, content=DATA[1_000_000:2_000_000], headers=more).status_code == 200
    last = {"Upload-Offset": "2000000", "Repr-Digest": repr_digest(DATA)}
    whole = http.request(verb, path, content=DATA[2_000_000:], headers=last).json()
    assert (whole["complete"], whole["sha256"]) == (True, hashlib.sha256(DATA).hexdigest())


def test_patch_at_0_discards_and_creates_nothing(http: httpx.Client) -> None:
    again = {"Upload-Offset": "0", "Upload-Complete": "?0"}
    assert http.patch("/v1/uploads/unknown", content=b"x", headers=again).status_code == 404
    http.put("/v1/uploads/held", content=b"0123456789", headers={"Upload-Complete": "?0", "Upload-Length": "20"})
    answer = http.patch("/v1/uploads/held", content=b"x", headers=again)
    assert (answer.status_code, answer.json()["code"]) == (409, "upload_offset_mismatch")
    assert answer.headers["upload-offset"] == "10"
    assert http.get("/v1/uploads/held").json()["offset"] == 10
    http.put("/v1/uploads/empty", content=b"", headers={"Upload-Complete": "?0", "Upload-Length": "3"})
    more = http.patch("/v1/uploads/empty", content=b"xy", headers=again).json()
    assert (more["offset"], more["length"]) == (2, 3)


def test_put_with_content_range_is_refused_and_keeps_what_is_there(http: httpx.Client) -> None:
    """`curl -C` resumes like this; its body is only the rest."""
    http.put("/v1/uploads/half", content=b"01234", headers={"Upload-Complete": "?0"})
    answer = http.put("/v1/uploads/half", content=b"56789", headers={"Content-Range": "bytes 5-9/10"})
    assert (answer.status_code, answer.json()["field"]) == (400, "Content-Range")
    assert "Upload-Offset" in answer.json()["detail"]
    assert http.get("/v1/uploads/half").json()["offset"] == 5


def test_a_broken_connection_keeps_the_received_bytes(running: Running, http: httpx.Client) -> None:
    path = "/v1/uploads/broken"
    connection = begun(running.url, path, declared=len(DATA), sent=DATA[:2_000_000])
    until(lambda: offset(http, path) >= 1_000_000)
    connection.close()
    until(lambda: offset(http, path) == 2_000_000)
    assert http.get(path).json()["length"] == len(DATA), "known from the first request's Content-Length"
    named = http.post("/v1/jobs", files={"tracks_upload": (None, "broken")}).json()
    assert (named["code"], named["field"]) == ("upload_incomplete", "tracks_upload")
    wrong = http.patch(path, content=DATA[1_500_000:], headers={"Upload-Offset": "1500000"})
    assert (wrong.status_code, wrong.headers["upload-offset"]) == (409, "2000000")
    problem = Problem.model_validate_json(wrong.content)
    assert (problem.code, problem.expected, problem.got) == ("upload_offset_mismatch", "2000000", "1500000")
    assert problem.type.endswith("#mismatching-upload-offset")
    rest = http.patch(path, content=DATA[2_000_000:], headers={"Upload-Offset": "2000000"})
    assert rest.json()["sha256"] == hashlib.sha256(DATA).hexdigest()


def test_a_reconnecting_client_replaces_its_dead_connection(running: Running, http: httpx.Client) -> None:
    path = "/v1/uploads/half-open"
    with begun(running.url, path, declared=len(DATA), sent=DATA[:2_000_000]) as dead:
        until(lambda: offset(http, path) >= 1_500_000)  # whole batches; the service still waits for more
        time.sleep(0.2)
        began = time.monotonic()
        at = offset(http, path)
        answer = http.patch(path, content=DATA[at:], headers={"Upload-Offset": str(at)})
        assert time.monotonic() - began < 15
        assert answer.json()["sha256"] == hashlib.sha256(DATA).hexdigest()
        heard(dead, b'"upload_taken_over"')


def test_repeating_a_put_after_a_lost_response_is_safe(running: Running, http: httpx.Client) -> None:
    digest = {"Repr-Digest": repr_digest(DATA)}
    assert http.put("/v1/uploads/again", content=DATA, headers=digest).status_code == 201
    assert http.put("/v1/uploads/again", content=DATA, headers=digest).status_code == 200
    other = http.put("/v1/uploads/again", content=DATA)
    assert (other.status_code, other.json()["code"]) == (409, "upload_complete")
    assert http.get("/v1/uploads/again").json()["complete"]


def test_ten_concurrent_uploads_of_one_id_give_one_complete_file(running: Running, http: httpx.Client) -> None:
    digest = {"Repr-Digest": repr_digest(DATA)}

    def send() -> None:
        httpx.put(f"{running.url}/v1/uploads/at-once", content=DATA, headers=digest, timeout=30)

    threads = [threading.Thread(target=send) for _ in range(10)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert http.get("/v1/uploads/at-once").json()["sha256"] == hashlib.sha256(DATA).hexdigest()


@pytest.fixture(scope="module")
def small(serve: Serve) -> Running:
    return serve(limits=Limits(max_bytes=100_000))


REFUSED: dict[str, tuple[dict[str, Any], bytes, int, str]] = {
    "too large": ({}, b"x" * 200_000, 413, "upload_too_large"),
    "length too large": ({"Upload-Complete": "?0", "Upload-Length": "200000"}, b"x", 413, "upload_too_large"),
    "other bytes": ({"Repr-Digest": repr_digest(b"y")}, b"x", 422, "digest_mismatch"),
    "odd digest": ({"Repr-Digest": "sha-256=:AAA:"}, b"x", 422, "invalid_digest"),
    "foreign digest": ({"Repr-Digest": "sha-256=:é:".encode("latin-1")}, b"x", 422, "invalid_digest"),
    "hexadecimal digest": ({"Repr-Digest": hashlib.sha256(b"x").hexdigest()}, b"x", 422, "invalid_digest"),
    "digest that is no byte sequence": ({"Repr-Digest": "sha-256=AAAA"}, b"x", 422, "invalid_digest"),
    "digest in capitals": ({"Repr-Digest": repr_digest(b"x").upper()}, b"x", 422, "invalid_digest"),
    "short digest": ({"Repr-Digest": "sha-256=:AAAA:"}, b"x", 422, "invalid_digest"),
    "negative": ({"Upload-Offset": "-1"}, b"x", 422, "invalid_request"),
    "not a number": ({"Upload-Length": "many"}, b"x", 422, "invalid_request"),
    "not a boolean": ({"Upload-Complete": "yes"}, b"x", 422, "invalid_request"),
    "not begun": ({"Upload-Offset": "7"}, b"x", 404, "unknown_upload"),
    "longer than announced": ({"Upload-Length": "3"}, b"xxxx", 422, "inconsistent_upload_length"),
    "shorter than announced": ({"Upload-Length": "3"}, b"xx", 422, "inconsistent_upload_length"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_rejected_uploads_state_the_reason(small: Running, case: str) -> None:
    headers, body, status, code = REFUSED[case]
    path = f"{small.url}/v1/uploads/{case.replace(' ', '-')}"
    answer = httpx.put(path, content=body, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    there = httpx.get(path)
    assert there.status_code == 404 or there.json()["complete"] is False


def test_digests_of_other_algorithms_are_ignored(small: Running) -> None:
    for number, digest in enumerate(("md5=:AAAA:", f"md5=:AAAA:, {repr_digest(b'x')}")):
        answer = httpx.put(f"{small.url}/v1/uploads/other-{number}", content=b"x", headers={"Repr-Digest": digest})
        assert answer.status_code == 201, answer.text


def test_a_body_of_unknown_length_is_limited_too(small: Running) -> None:
    answer = httpx.put(f"{small.url}/v1/uploads/endless", content=iter([b"x" * 50_000] * 10))
    assert (answer.status_code, answer.json()["code"]) == (413, "upload_too_large")
    assert httpx.put(f"{small.url}/v1/uploads/x", content=b"").json()["code"] == "invalid_id"


def test_a_stalled_upload_ends_and_its_bytes_are_kept(serve: Serve) -> None:
    hasty = serve(stall_seconds=0.5)
    with begun(hasty.url, "/v1/uploads/stalled", declared=90_000, sent=b"x" * 1000) as connection:
        heard(connection, b'"body_stalled"')
    there = httpx.get(f"{hasty.url}/v1/uploads/stalled").json()
    assert (there["complete"], there["length"], there["offset"]) == (False, 90_000, 1000)


def test_a_job_can_use_uploads_instead_of_form_parts(running: Running, http: httpx.Client) -> None:
    sent = tracks(6, 12)
    truth = npz(shapes=np.random.default_rng(1).normal(size=(6, 12, 3)))
    http.put("/v1/uploads/tracks-1", content=sent)
    http.put("/v1/uploads/truth-1", content=truth)
    parts: dict[str, Any] = form(sent, mesh="3x4") | {"ground_truth_upload": (None, "truth-1")}
    del parts["tracks"]
    parts["tracks_upload"] = (None, "tracks-1")
    key = {"Idempotency-Key": "by either road"}
    answer = http.post("/v1/jobs", files=parts, headers=key)
    assert answer.status_code == 202, answer.text
    job = Job.model_validate_json(answer.content)
    assert (job.interpretation.num_points, job.interpretation.has_ground_truth) == (12, True)
    # The same content sent as parts or as uploads is the same request, and the job no longer needs the uploads.
    for id in ("tracks-1", "truth-1"):
        assert http.delete(f"/v1/uploads/{id}").status_code == 204
    carried = http.post("/v1/jobs", files=form(sent, mesh="3x4", ground_truth=truth), headers=key)
    assert carried.json()["id"] == job.id
    assert running.jobs.blobs.get(running.jobs.records.get(job.id).inputs).size > 0
    assert running.left_on_disk == []


def test_a_missing_upload_or_a_duplicate_part_is_rejected(running: Running, http: httpx.Client) -> None:
    before = running.waiting
    unknown = http.post("/v1/jobs", files={"tracks_upload": (None, "nowhere")})
    assert (unknown.status_code, unknown.json()["code"]) == (422, "unknown_upload")
    assert unknown.json()["field"] == "tracks_upload"
    both = http.post("/v1/jobs", files=form(tracks_upload="nowhere"))
    assert (both.status_code, both.json()["code"]) == (422, "repeated_part")
    two = http.post("/v1/jobs", files=form(mesh="3x4", mesh_upload="nowhere"))
    assert (two.status_code, two.json()["code"]) == (422, "repeated_part")
    assert running.waiting == before


def test_uploads_count_toward_the_quota(serve: Serve) -> None:
    full = serve(quota=150_000)
    with httpx.Client(base_url=full.url) as http:
        assert http.put("/v1/uploads/first", content=b"x" * 100_000).status_code == 201
        answer = http.put("/v1/uploads/second", content=b"x" * 100_000)
        assert (answer.status_code, answer.json()["code"], answer.json()["retryable"]) == (507, "quota_exceeded", True)
        assert re.fullmatch(
            r"Disk quota reached: 1\d\d,\d{3} of 150,000 bytes are used, and 100,000 more are needed\. "
            r"Delete jobs, wait until they expire, or raise PLIANT_DISK_QUOTA\.",
            answer.json()["detail"],
        ), answer.json()["detail"]
        never = http.put("/v1/uploads/third", content=b"x" * 200_000).json()
        assert (never["code"], never["retryable"]) == ("quota_exceeded", False), (
            "the client does not wait for what never fits"
        )
        http.delete("/v1/uploads/first")
        assert http.put("/v1/uploads/second", content=b"x" * 100_000).status_code == 201
        assert http.put("/v1/uploads/second", content=b"x" * 100_000).status_code == 409


def test_too_many_uploads_are_refused(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.worker.uploads.service.MAX_UPLOADS", 2)
    url = serve().url
    answers = [httpx.put(f"{url}/v1/uploads/number-{number}", content=io.BytesIO(b"x")) for number in range(3)]
    assert [answer.status_code for answer in answers] == [201, 201, 429]
    assert answers[-1].json()["code"] == "too_many_uploads"


def test_uploads_of_another_token_are_invisible(serve: Serve) -> None:
    running = serve(auth="required")
    assert httpx.put(f"{running.url}/v1/uploads/mine", content=b"x").status_code == 401
    with running.client() as ada, running.client() as bob:
        sent = tracks(6, 12)
        assert ada.put("/v1/uploads/mine", content=sent).status_code == 201
        for verb in ("GET", "HEAD", "DELETE"):
            assert bob.request(verb, "/v1/uploads/mine").status_code == 404
        named = bob.post("/v1/jobs", files={"tracks_upload": (None, "mine")})
        assert (named.status_code, named.json()["code"]) == (422, "unknown_upload")
        assert bob.put("/v1/uploads/mine", content=b"his own").json()["offset"] == 7
        assert ada.get("/v1/uploads/mine").json()["offset"] == len(sent)
        assert ada.post("/v1/jobs", files={"tracks_upload": (None, "mine")}).status_code == 202
