"""The exact error messages of the service, as users of the page, the SDK or HTTP see them."""

# ruff: noqa: E501
from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from pliant.service.testing import InMemoryService
from pliant.worker import errors
from serving import tracks

Request = tuple[str, str, dict[str, Any]]


TRACKS = ("tracks.npz", tracks(5))
FILM = ("film.mp4", b"\0\0\0\x18ftypmp42")


def form(**parts: Any) -> dict[str, Any]:
    """Return a form: strings as text parts, pairs as files."""
    return {"files": {name: (None, part) if isinstance(part, str) else part for name, part in parts.items()}}


@pytest.fixture(scope="module")
def http() -> Iterator[httpx.Client]:
    """A service with the jobs `done` and `running`, the complete upload `whole` and the upload `part`."""
    service = InMemoryService(steps=1)
    with httpx.Client(transport=service, base_url="http://pliant.test") as client:
        prepare(service, client)
        yield client
    service.stop()


def prepare(service: InMemoryService, client: httpx.Client) -> None:
    named = {"tracks": TRACKS, "mesh": (None, "none")}
    assert client.put("/v1/jobs/done", files=named, headers={"Prefer": "wait=20"}).json()["status"] == "succeeded"
    service.worker.steps = math.inf
    assert client.put("/v1/jobs/running", files=named).is_success
    assert client.put("/v1/uploads/whole", content=TRACKS[1]).is_success
    assert client.put(
        "/v1/uploads/part", content=b"ab", headers={"Upload-Complete": "?0", "Upload-Length": "9"}
    ).is_success


PART = (
    "{}: expected one of film, film_upload, ground_truth, ground_truth_upload, inputs_of, mesh, mesh_upload, name, options, priority, region, "
    "region_upload, rotations, rotations_upload, tracks, tracks_upload, webhook, webhook_secret, got {!r}. "
)

REQUESTS: dict[str, tuple[Request, str]] = {
    "no tracks": (("POST", "/v1/jobs", form(mesh="none")),
        "tracks: expected a file, got none. Add the part, as in curl's -F tracks=@tracks.npz, or a film: -F film=@film.mp4."),
    "a region without a film": (("POST", "/v1/jobs", form(region=("mask.png", b"x"))),
        "film: expected a file, got none. A region belongs to a film: add it, as in curl's -F film=@film.mp4."),
    "a film and tracks": (("POST", "/v1/jobs", form(film=FILM, tracks=TRACKS)),
        "tracks: expected a film with its region, or tracks with what belongs to them, got film and tracks. Leave one of them out: the tracks and the mesh of a film are made from it."),
    "tracks twice": (("POST", "/v1/jobs", form(tracks=TRACKS, tracks_upload="whole")),
        "tracks_upload: expected either tracks or tracks_upload, got both. Leave one of them out."),
    "an unknown upload": (("POST", "/v1/jobs", form(tracks_upload="nothing")),
        "tracks_upload: expected the id of an upload, got 'nothing'. PUT it to /v1/uploads/nothing first; uploads that are not used expire."),
    "an upload that is not complete": (("POST", "/v1/jobs", form(tracks_upload="part")),
        "tracks_upload: expected a complete upload, got an incomplete one. Send the rest first, from the offset that HEAD returns."),
    "kept inputs and files": (("POST", "/v1/jobs", form(inputs_of="done", tracks=TRACKS)),
        "inputs_of: expected either inputs_of or files, got inputs_of and tracks. Leave one of them out."),
    "kept inputs read in another way": (("POST", "/v1/jobs", form(inputs_of="done", options='{"frames": "0:4"}')),
        "options.frames: expected no value, as the inputs of job 'done' were read, got '0:4'. Send the files again to read them in another way."),
    "kept inputs of no job": (("POST", "/v1/jobs", form(inputs_of="nobody")),
        "There is no job 'nobody'. List your jobs to see which exist; expired ones are removed."),
    "an unknown part": (("POST", "/v1/jobs", form(track=TRACKS)),
        PART.format("track", "track") + "Did you mean tracks? If not, leave it out."),
    "an option as a part": (("POST", "/v1/jobs", form(loss="huber")), PART.format("loss", "loss") + 'It is an option: send it in the part options, as in curl\'s -F \'options={"loss": …}\'.'),
    "a file as file": (("POST", "/v1/jobs", form(file=TRACKS)), PART.format("file", "file") + "Name the part tracks or film, as in curl's -F tracks=@tracks.npz or -F film=@film.mp4."),
    "a mask": (("POST", "/v1/jobs", form(mask=FILM)), PART.format("mask", "mask") + "Did you mean region? If not, leave it out."),
    "a part like no other": (("POST", "/v1/jobs", form(qwerty="1")), PART.format("qwerty", "qwerty") + "Leave it out."),
    "a MATLAB file as the film": (("POST", "/v1/jobs", form(film=("tracks.mat", b"MATLAB 5.0" + bytes(600)))),
        "film: expected an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures, got tracks.mat, a file of tracks. Send it as the tracks instead (on the page: under Tracks; REST: -F tracks=@tracks.npz; Python: submit('tracks.npz'); command line: pliant solve tracks.npz)."),
    "tracks as text": (("POST", "/v1/jobs", form(tracks="1,2,3")),
        "tracks: expected a file, got text. Give the part a file name, as in curl's -F tracks=@FILE."),
    "options that are no JSON": (("POST", "/v1/jobs", form(tracks=TRACKS, options="loss=l1")),
        "options: expected a JSON object, got text that is not JSON. For example {\"method\": \"robust\"}; the schema is at /v1/options."),
    "options that are a list": (("POST", "/v1/jobs", form(tracks=TRACKS, options="[]")),
        "options: expected a JSON object, got a JSON list. For example {\"method\": \"robust\"}; the schema is at /v1/options."),
    "options that are null": (("POST", "/v1/jobs", form(tracks=TRACKS, options="null")),
        "options: expected a JSON object, got null. For example {\"method\": \"robust\"}; the schema is at /v1/options."),
    "options that are a string": (("POST", "/v1/jobs", form(tracks=TRACKS, options='"l1"')),
        "options: expected a JSON object, got a JSON string. For example {\"method\": \"robust\"}; the schema is at /v1/options."),
    "a secret without a webhook": (("POST", "/v1/jobs", form(tracks=TRACKS, webhook_secret="whsec_x")),
        "webhook: expected an address beside webhook_secret, got nothing. Give the address that receives the finished job, or omit webhook_secret."),
    "a webhook without a secret": (("POST", "/v1/jobs", form(tracks=TRACKS, webhook="https://hooks.example/")),
        "webhook_secret: expected whsec_ and 24 to 64 random bytes in base64, got nothing. Make one with: echo whsec_$(openssl rand -base64 32)"),
    "a compressed form": (("POST", "/v1/jobs", {"content": b"abc", "headers": {"Content-Type": "multipart/form-data; boundary=x", "Content-Encoding": "gzip"}}),
        "Content-Encoding: expected a body that is not compressed, got gzip. Send it as it is; npz files and films are compressed already."),
    "a compressed upload": (("PUT", "/v1/uploads/packed", {"content": b"abc", "headers": {"Content-Encoding": "br"}}),
        "Content-Encoding: expected a body that is not compressed, got br. Send it as it is; npz files and films are compressed already."),
    "an upload whose end is a word": (("PUT", "/v1/uploads/ended", {"content": b"abc", "headers": {"Upload-Complete": "yes"}}),
        "Upload-Complete: expected '?1' or '?0', got 'yes'. Compare with the schema at /docs."),
    "an appended upload without an offset": (("PATCH", "/v1/uploads/part", {"content": b"c"}),
        "Upload-Offset: expected a value, got nothing. Compare with the schema at /docs."),
    "an unknown option": (("POST", "/v1/jobs", form(tracks=TRACKS, options='{"los": "l1"}')),
        "options.los: expected the name of an option, got the unknown name 'los'. Did you mean loss? Compare with the schema at /v1/options."),
    "an option of another value": (("POST", "/v1/jobs", form(tracks=TRACKS, options='{"loss": "l3"}')),
        "options.loss: expected 'l1', 'l2' or 'huber', got 'l3'. Compare with the schema at /v1/options."),
    "an option beyond its bounds": (("POST", "/v1/jobs", form(tracks=TRACKS, options='{"fps": 0}')),
        "options.fps: expected more than 0, got 0. Compare with the schema at /v1/options."),
    "an option of another form": (("POST", "/v1/jobs", form(tracks=TRACKS, options='{"image_size": "wide"}')),
        "options.image_size: expected width and height in pixels, such as 1920x1080, got 'wide'. Compare with the schema at /v1/options."),
    "frames of another form": (("POST", "/v1/jobs", form(tracks=TRACKS, options='{"frames": "10-20"}')),
        "options.frames: expected start:stop:step, such as 10:200:2, got '10-20'. Compare with the schema at /v1/options."),
    "a point of another form": (("POST", "/v1/jobs", form(tracks=TRACKS, options='{"principal_point": "320"}')),
        "options.principal_point: expected x,y in pixels, such as 319.5,239.5, got '320'. Compare with the schema at /v1/options."),
    "an unknown priority": (("POST", "/v1/jobs", form(tracks=TRACKS, priority="urgent")),
        "priority: expected high, normal or low, got 'urgent'. Leave it out for normal."),
    "a long name": (("POST", "/v1/jobs", form(tracks=TRACKS, name="a" * 201)),
        "name: expected at most 200 characters, got 201. Shorten it."),
    "an id of two letters": (("PUT", "/v1/jobs/ab", form(tracks=TRACKS)),
        "id: expected 3–64 letters, digits, underscores or dashes, got 'ab'. Choose another id or omit it."),
    "an id that is taken": (("PUT", "/v1/jobs/done", form(tracks=TRACKS, mesh="3x4")),
        "The id 'done' is already used by a different job. Choose another id."),
    "no form": (("POST", "/v1/jobs", {"content": b"abc"}),
        "The body must be a form: send multipart/form-data with a part `tracks`. An example is at /docs."),
    "no such job": (("GET", "/v1/jobs/nobody", {}),
        "There is no job 'nobody'. List your jobs to see which exist; expired ones are removed."),
    "no such file": (("GET", "/v1/jobs/done/artifacts/shapes.fbx", {}),
        "Job 'done' has no file 'shapes.fbx'. It has: shapes.npz, shapes.glb, shapes_ply.zip, metrics_frames.csv, metrics_points.csv, preview.bin, report.json."),
    "no files yet": (("GET", "/v1/jobs/running/artifacts/shapes.npz", {}),
        "Job 'running' has no file 'shapes.npz'. It has: none (only a succeeded job has files)."),
    "deleting a running job": (("DELETE", "/v1/jobs/running", {}),
        "Job 'running' has the status running: it cannot be deleted now. Cancel it first."),
    "cancelling a finished job": (("POST", "/v1/jobs/done/cancel", {}),
        "Job 'done' has the status succeeded: it cannot be cancelled now. It is finished; delete it if you do not need it."),
    "retrying a running job": (("POST", "/v1/jobs/running/retry", {}),
        "Job 'running' has the status running: it cannot be run again now. Wait until it ends, or cancel it first."),
    "retrying a job with a result": (("POST", "/v1/jobs/done/retry", {}),
        "Job 'done' has the status succeeded: it cannot be run again now. It already has a result."),
    "sharing a running job": (("POST", "/v1/jobs/running/shares", {"json": {}}),
        "Job 'running' has the status running: it cannot be shared now. Wait until it has succeeded."),
    "sharing for a second": (("POST", "/v1/jobs/done/shares", {"json": {"expires_in": 1}}),
        "expires_in: expected at least 60, got 1. Compare with the schema at /docs."),
    "a share that there is not": (("DELETE", "/v1/jobs/done/shares/nothing", {}),
        "Job 'done' has no share link 'nothing'; it may have expired. List the links to see which there are."),
    "outputs of a running job": (("POST", "/v1/jobs/running/outputs", {"json": {"outputs": ["glb"]}}),
        "Job 'running' has the status running: it cannot be exported to further files now. Wait until it has succeeded."),
    "outputs of another kind": (("POST", "/v1/jobs/done/outputs", {"json": {"outputs": ["fbx"]}}),
        "outputs.0: expected 'glb', 'ply', 'obj', 'usd', 'abc', 'mdd', 'mat' or 'csv', got 'fbx'. Compare with the schema at /docs."),
    "no outputs": (("POST", "/v1/jobs/done/outputs", {"json": {"outputs": []}}),
        "outputs: expected at least 1 item, got []. Compare with the schema at /docs."),
    "too many jobs on a page": (("GET", "/v1/jobs?limit=1000", {}),
        "limit: expected 1–200, got 1000. Request a page of that many; `next` continues with the following one."),
    "no jobs on a page": (("GET", "/v1/jobs?limit=0", {}),
        "limit: expected 1–200, got 0. Request a page of that many; `next` continues with the following one."),
    "a cursor that is none": (("GET", "/v1/jobs?cursor=abc", {}),
        "cursor: expected `next` of an earlier page, got 'abc'. Start again without a cursor."),
    "an unknown status": (("GET", "/v1/jobs?status=done", {}),
        "status: expected 'queued', 'running', 'cancelling', 'succeeded', 'failed' or 'cancelled', got 'done'. Compare with the schema at /docs."),
    "an event that is none": (("GET", "/v1/jobs/running/events", {"headers": {"Last-Event-ID": "abc"}}),
        "Last-Event-ID: expected the id of an event, got 'abc'. Omit it to get all events that are kept."),
    "a long idempotency key": (("POST", "/v1/jobs", {**form(tracks=TRACKS), "headers": {"Idempotency-Key": "a" * 256}}),
        "Idempotency-Key: expected 1–255 characters, got 256. A random UUID is a good key."),
    "an upload at another offset": (("PATCH", "/v1/uploads/part", {"content": b"c", "headers": {"Upload-Offset": "5"}}),
        "Upload-Offset: expected 2, got 5. Continue at 2."),
    "an upload that is complete": (("PATCH", "/v1/uploads/whole", {"content": b"c", "headers": {"Upload-Offset": "5"}}),
        "Upload 'whole' is complete. Use it, or delete it first."),
    "no such upload": (("HEAD", "/v1/uploads/nothing", {}),
        "There is no upload 'nothing'; uploads are removed when they expire. Send it again."),
    "no such address": (("GET", "/v1/job", {}),
        "No route has this path. All paths are listed at /docs."),
    "another method": (("PATCH", "/v1/jobs", {}),
        "This path does not support this method. The methods are listed at /docs."),
}  # fmt: skip


@pytest.mark.parametrize("name", REQUESTS)
def test_rejected_requests_have_the_exact_message(http: httpx.Client, name: str) -> None:
    (method, path, more), words = REQUESTS[name]
    answer = http.request(method, path, **more)
    assert (answer.is_error, answer.json()["detail"]) == (True, words)


@pytest.mark.parametrize(
    ("method", "path", "parts", "headers", "code", "members"),
    [
        ("PUT", "/v1/jobs/done", {"tracks": TRACKS, "mesh": "3x4"}, {}, "id_taken",
         ("id", "an id that no different job has", "'done'", "Choose another id.")),
        ("POST", "/v1/jobs", {"tracks": TRACKS, "mesh": "3x4"}, {"Idempotency-Key": "mine"}, "idempotency_conflict",
         ("Idempotency-Key", "a key that no different request has", "the key of the request that created job 'keyed'", "Use a new key.")),
        ("POST", "/v1/jobs", {"inputs_of": "nobody"}, {}, "unknown_job",
         ("inputs_of", "the id of one of your jobs", "'nobody'", "List your jobs to see which exist; expired ones are removed.")),
    ],
)  # fmt: skip
def test_conflicts_and_unknown_jobs_name_the_field_and_what_was_sent(
    http: httpx.Client, method: str, path: str, parts: Any, headers: dict[str, str], code: str, members: tuple[str, ...]
) -> None:
    own = {"Idempotency-Key": "mine"}
    assert http.put("/v1/jobs/keyed", headers=own, **form(tracks=TRACKS, mesh="none")).is_success
    problem = http.request(method, path, headers=headers, **form(**parts)).json()
    assert problem["code"] == code
    assert tuple(problem[name] for name in ("field", "expected", "got", "hint")) == members


ERRORS: dict[str, tuple[Exception, str]] = {
    "too many queued": (errors.TooManyQueued(3), "Queue limit reached: 3 jobs are already queued. Submit again when one of them has started, or cancel one."),
    "too many uploads": (errors.TooManyUploads(5), "Upload limit reached: there are already 5 uploads. Delete some, or wait until they expire."),
    "too many shares": (errors.TooManyShares("job-1", 10), "Job 'job-1' has 10 share links already. Revoke one, or wait until one expires."),
    "a full quota": (errors.QuotaExceeded(used=900, quota=1000, needed=200), "Disk quota reached: 900 of 1,000 bytes are used, and 200 more are needed. Delete jobs, wait until they expire, or raise PLIANT_DISK_QUOTA."),
    "a small quota": (errors.QuotaExceeded(used=0, quota=1000, needed=2000), "Disk quota too small: 2,000 bytes are needed, and the quota is 1,000. Send fewer frames or points, or raise PLIANT_DISK_QUOTA."),
    "a large upload": (errors.UploadTooLarge(1000, 2000), "body: expected at most 1,000 bytes, got 2,000 or more. Send fewer frames or points, or store float32; see /v1/limits."),
    "a store that is away": (errors.StoreUnavailable("Redis", reason="connection refused"), "Redis is unavailable (connection refused). No data was lost; try again in a few seconds."),
    "a directory in use": (errors.DataDirectoryInUse("/srv/pliant", holder="process 7"), "/srv/pliant is already used by process 7. Stop it first, or choose another directory (--data)."),
    "a job out of time": (errors.TimedOut(60.0), "The job exceeded its option time_limit of 60 s. Raise it, or send fewer points or frames."),
    "an unknown token": (errors.UnknownToken("t1"), "There is no token 't1'. `pliant token list` lists all tokens."),
    "newer data": (errors.NewerData(found=9, known=3), "The records were written by a newer Pliant (record format 9; this version reads up to 3). Install that Pliant, or restore a backup that was made before the upgrade."),
}  # fmt: skip


@pytest.mark.parametrize("name", ERRORS)
def test_worker_errors_have_the_exact_message(name: str) -> None:
    error, words = ERRORS[name]
    assert str(error) == words
