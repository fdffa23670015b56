"""The double's side of the wire: requests in, answers out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray
from pliant.client.errors import PROBLEM_TYPE
from pliant.client.testing.ledger import Entry, Ledger, understood
from pliant.client.testing.reading import Refusal, inputs_of, options_of, tracks_of
from pliant.client.testing.uploads import Uploads
from pliant.schemas.job import JobPage, Problem, ServiceLimits, Status
from pliant.schemas.options import Options

Reconstruct = Callable[[NDArray[np.float64], Options], NDArray[np.float64]]
"""From points (F, P, 2) and options to shapes (F, P, 3)."""

WHOLE_PAGE = 200
LIMITS = ServiceLimits(
    max_body_bytes=1 << 30,
    max_text_bytes=1 << 20,
    max_upload_bytes=1 << 30,
    max_bytes=1 << 30,
    max_frames=1000,
    max_points=100_000,
    max_observations=10_000_000,
    max_faces=200_000,
    max_wait_seconds=60,
    max_page=WHOLE_PAGE,
)


def flat(points: NDArray[np.float64], options: Options) -> NDArray[np.float64]:  # noqa: ARG001 - the signature of `Reconstruct`
    """Return the points, centred in every frame, with depth 0."""
    seen = np.nan_to_num(points)
    return np.concatenate([seen - seen.mean(axis=1, keepdims=True), np.zeros((*seen.shape[:2], 1))], axis=2)


class FakeService(httpx.MockTransport):
    """A Pliant service in memory; give it to `Client` or `AsyncClient` as `transport`.

    Parameters
    ----------
    reconstruct : callable
        Stands for the solver.
    looks : int
        How many looks at a running job it takes until it is over, so that waiting has something to wait for.
        `math.inf`: it runs until it is cancelled.
    problem : Problem, optional
        Every job fails with it.
    token : str, optional
        Demand this token.

    Attributes
    ----------
    requests : list of httpx.Request
        What was received, for asserting on.
    uploads : Uploads
        Large inputs that were sent ahead of their jobs and not removed yet.
    """

    def __init__(
        self,
        reconstruct: Reconstruct = flat,
        *,
        looks: float = 2,
        problem: Problem | None = None,
        token: str | None = None,
    ) -> None:
        super().__init__(self._answer)
        self.requests: list[httpx.Request] = []
        self.uploads = Uploads()
        self._token = token
        self._ledger = Ledger(reconstruct, looks=looks, problem=problem)

    def _answer(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        try:
            if self._token is not None and request.headers.get("authorization") != f"Bearer {self._token}":
                raise Refusal(401, "unauthorized", "A token is needed: send Authorization: Bearer and a token.")
            return self._route(request)
        except Refusal as refusal:
            return httpx.Response(
                refusal.problem.status,
                content=refusal.problem.model_dump_json(exclude_none=True),
                headers={"Content-Type": PROBLEM_TYPE},
            )

    def _route(self, request: httpx.Request) -> httpx.Response:
        for method, pattern, handler in _ROUTES:
            found = re.fullmatch(pattern, request.url.path)
            if found is not None and method == request.method:
                return handler(self, request, *found.groups())
        raise Refusal(404, "not_found", f"There is nothing at {request.method} {request.url.path}.")

    def _submit(self, request: httpx.Request, job_id: str | None = None) -> httpx.Response:
        fields, files = inputs_of(request, self.uploads)
        key = request.headers.get("idempotency-key") if job_id is None else f"id:{job_id}"
        entry, new = self._ledger.submit(
            points=tracks_of(files["tracks"]),
            options=options_of(fields.get("options", "{}")),
            name=fields.get("name", ""),
            ground_truth="ground_truth" in files,
            rotations="rotations" in files,
            job_id=job_id,
            key=key,
            content=json.dumps(sorted(fields.items())).encode() + b"".join(files[name] for name in sorted(files)),
        )
        return self._job(entry, status=202 if new else 200, headers={"Location": f"/v1/jobs/{entry.job.id}"})

    def _inspect(self, request: httpx.Request) -> httpx.Response:
        fields, files = inputs_of(request, self.uploads)
        options_of(fields.get("options", "{}"))
        points = tracks_of(files["tracks"])
        said = understood(points, ground_truth="ground_truth" in files, rotations="rotations" in files)
        return _json(200, said.model_dump_json())

    def _get(self, request: httpx.Request, job_id: str) -> httpx.Response:
        entry = self._ledger.find(job_id)
        asked = re.search(r"wait=(\d+)", request.headers.get("prefer", ""))
        if asked is None:
            self._ledger.look(entry)
            return self._job(entry)
        while not entry.job.status.final and math.isfinite(self._ledger.looks):
            self._ledger.look(entry)
        return self._job(entry, headers={"Preference-Applied": f"wait={asked.group(1)}"})

    def _events(self, request: httpx.Request, job_id: str) -> httpx.Response:
        """Tell what is new since the last event, up to the job's end; of an endless job, one step at a time."""
        entry = self._ledger.find(job_id)
        self._ledger.look(entry)
        while not entry.job.status.final and math.isfinite(self._ledger.looks):
            self._ledger.look(entry)
        first = int(request.headers.get("last-event-id", "-1")) + 1
        told = [f"id: {n}\nevent: job\ndata: {data}\n\n" for n, data in enumerate(entry.history) if n >= first]
        return httpx.Response(200, content="".join(told), headers={"Content-Type": "text/event-stream"})

    def _log(self, _request: httpx.Request, job_id: str) -> httpx.Response:
        lines = [json.loads(record)["status"] for record in self._ledger.find(job_id).history]
        return httpx.Response(200, text="\n".join(lines))

    def _list(self, request: httpx.Request) -> httpx.Response:
        wanted = [Status(name) for name in request.url.params.get_list("status")]
        entries = [entry for entry in self._ledger.newest_first() if len(wanted) == 0 or entry.job.status in wanted]
        first = int(request.url.params.get("cursor", "0"))
        count = min(int(request.url.params.get("limit", "50")), WHOLE_PAGE)
        rest = first + count < len(entries)
        page = JobPage(
            jobs=[entry.job for entry in entries[first : first + count]], next=str(first + count) if rest else None
        )
        return _json(200, page.model_dump_json())

    def _cancel(self, _request: httpx.Request, job_id: str) -> httpx.Response:
        return self._job(self._ledger.cancel(job_id))

    def _retry(self, request: httpx.Request, job_id: str) -> httpx.Response:
        entry = self._ledger.retry(job_id, key=request.headers.get("idempotency-key"))
        return self._job(entry, status=202, headers={"Location": f"/v1/jobs/{entry.job.id}"})

    def _delete(self, _request: httpx.Request, job_id: str) -> httpx.Response:
        self._ledger.delete(job_id)
        return httpx.Response(204)

    def _send(self, request: httpx.Request, upload_id: str) -> httpx.Response:
        begun = upload_id in self.uploads.held
        there = self.uploads.write(upload_id, request.content, request.headers)
        return _json(200 if begun else 201, there.model_dump_json())

    def _upload(self, _request: httpx.Request, upload_id: str) -> httpx.Response:
        there = self.uploads.get(upload_id)
        state = {"Upload-Offset": str(there.offset), "Upload-Complete": "?1" if there.complete else "?0"}
        return _json(200, there.model_dump_json(), state)

    def _remove(self, _request: httpx.Request, upload_id: str) -> httpx.Response:
        self.uploads.delete(upload_id)
        return httpx.Response(204)

    def _artifacts(self, _request: httpx.Request, job_id: str) -> httpx.Response:
        held = self._ledger.find(job_id).job.artifacts
        return _json(200, json.dumps([artifact.model_dump() for artifact in held]))

    def _artifact(self, request: httpx.Request, job_id: str, name: str) -> httpx.Response:
        entry = self._ledger.find(job_id)
        if name not in entry.files:
            raise Refusal(404, "unknown_artifact", f"Job {job_id} has no file {name!r}.")
        return _ranged(request, entry.files[name], etag=f'"{entry.sha256(name)}"')

    def _options(self, _request: httpx.Request) -> httpx.Response:
        return _json(200, json.dumps(Options.model_json_schema()))

    def _limits(self, _request: httpx.Request) -> httpx.Response:
        return _json(200, LIMITS.model_dump_json())

    def _healthy(self, _request: httpx.Request) -> httpx.Response:
        return _json(200, '{"status": "ok"}')

    def _ready(self, _request: httpx.Request) -> httpx.Response:
        return _json(200, '{"redis": "ok", "blobs": "ok", "workers": "ok"}')

    def _job(self, entry: Entry, *, status: int = 200, headers: Mapping[str, str] | None = None) -> httpx.Response:
        return _json(status, entry.job.model_dump_json(), headers)


_JOB = r"/v1/jobs/([A-Za-z0-9_-]+)"
_UPLOAD = r"/v1/uploads/([A-Za-z0-9_-]+)"
_ROUTES: tuple[tuple[str, str, Callable[..., httpx.Response]], ...] = (
    ("POST", r"/v1/jobs", FakeService._submit),
    ("POST", r"/v1/inspect", FakeService._inspect),
    ("GET", r"/v1/jobs", FakeService._list),
    ("PUT", _JOB, FakeService._submit),
    ("GET", _JOB, FakeService._get),
    ("DELETE", _JOB, FakeService._delete),
    ("GET", _JOB + "/events", FakeService._events),
    ("GET", _JOB + "/log", FakeService._log),
    ("POST", _JOB + "/cancel", FakeService._cancel),
    ("POST", _JOB + "/retry", FakeService._retry),
    ("GET", _JOB + "/artifacts", FakeService._artifacts),
    ("GET", _JOB + r"/artifacts/([^/]+)", FakeService._artifact),
    ("PUT", _UPLOAD, FakeService._send),
    ("PATCH", _UPLOAD, FakeService._send),
    ("GET", _UPLOAD, FakeService._upload),
    ("DELETE", _UPLOAD, FakeService._remove),
    ("GET", r"/v1/options", FakeService._options),
    ("GET", r"/v1/limits", FakeService._limits),
    ("GET", r"/healthz", FakeService._healthy),
    ("GET", r"/readyz", FakeService._ready),
)


def _json(status: int, text: str, headers: Mapping[str, str] | None = None) -> httpx.Response:
    return httpx.Response(status, content=text, headers={"Content-Type": "application/json", **(headers or {})})


def _ranged(request: httpx.Request, data: bytes, *, etag: str) -> httpx.Response:
    headers: dict[str, Any] = {"ETag": etag, "Accept-Ranges": "bytes", "Content-Type": "application/octet-stream"}
    asked = re.fullmatch(r"bytes=(\d+)-(\d*)", request.headers.get("range", ""))
    if asked is None or request.headers.get("if-range", etag) != etag:
        return httpx.Response(200, content=data, headers=headers)
    first, last = int(asked[1]), min(int(asked[2] or len(data)), len(data) - 1)
    if first > last:
        raise Refusal(416, "range_not_satisfiable", f"The file has {len(data)} bytes. Ask for a range inside it.")
    headers["Content-Range"] = f"bytes {first}-{last}/{len(data)}"
    return httpx.Response(206, content=data[first : last + 1], headers=headers)
