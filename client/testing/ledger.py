"""The double's jobs, and what becomes of them."""

from __future__ import annotations

import hashlib
import io
import json
import math
import secrets
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from pliant.client.testing.reading import Refusal
from pliant.schemas.job import Artifact, Interpretation, Job, Problem, Progress, Status
from pliant.schemas.options import Options


@dataclass(kw_only=True)
class Entry:
    """One job of the double."""

    job: Job
    points: NDArray[np.float64]
    content: bytes
    looks: int = 0
    files: dict[str, bytes] = field(default_factory=dict)
    history: list[str] = field(default_factory=list)
    """The record as JSON after each change: the job's events."""

    def __post_init__(self) -> None:
        self.history.append(self.job.model_dump_json())

    def change(self, **fields: object) -> None:
        """Replace fields of the record."""
        self.job = self.job.model_copy(update=fields)
        self.history.append(self.job.model_dump_json())

    def sha256(self, name: str) -> str:
        """Hash of a file."""
        return hashlib.sha256(self.files[name]).hexdigest()


class Ledger:
    """All jobs of the double."""

    def __init__(
        self,
        reconstruct: Callable[[NDArray[np.float64], Options], NDArray[np.float64]],
        *,
        looks: float,
        problem: Problem | None,
    ) -> None:
        self.looks = looks
        self._reconstruct = reconstruct
        self._problem = problem
        self._entries: dict[str, Entry] = {}
        self._keys: dict[str, str] = {}

    def submit(
        self,
        *,
        points: NDArray[np.float64],
        options: Options,
        name: str,
        ground_truth: bool,
        rotations: bool,
        job_id: str | None,
        key: str | None,
        content: bytes,
    ) -> tuple[Entry, bool]:
        """Return the entry, and whether it is new; the same key with the same content is the same job."""
        if key is not None and key in self._keys:
            entry = self.find(self._keys[key])
            if entry.content != content:
                raise Refusal(409, "idempotency_conflict", "The same key came with other content. Use a new key.")
            return entry, False
        job = Job(
            id=job_id if job_id is not None else secrets.token_hex(8),
            name=name,
            status=Status.QUEUED,
            created_at=datetime.now(UTC),
            place_in_queue=0,
            options=options,
            interpretation=understood(points, ground_truth=ground_truth, rotations=rotations),
        )
        entry = self._entries[job.id] = Entry(job=job, points=points, content=content)
        if key is not None:
            self._keys[key] = job.id
        return entry, True

    def find(self, job_id: str) -> Entry:
        """Return an entry, or refuse."""
        if job_id not in self._entries:
            raise Refusal(404, "unknown_job", f"There is no job {job_id}. It may have been deleted.")
        return self._entries[job_id]

    def newest_first(self) -> list[Entry]:
        """Return every entry."""
        return list(reversed(self._entries.values()))

    def look(self, entry: Entry) -> None:
        """Let time pass for a job: it begins at the first look and is over after `looks` more."""
        if entry.job.status.final:
            return
        entry.looks += 1
        if entry.looks > self.looks:
            self._end(entry)
            return
        done = entry.looks / (self.looks + 1) if math.isfinite(self.looks) else 0.5
        now = datetime.now(UTC)
        entry.change(
            status=Status.RUNNING,
            started_at=entry.job.started_at or now,
            attempt=max(1, entry.job.attempt),
            place_in_queue=None,
            progress=Progress(
                stage="reweight", fraction=done, reweighting=entry.looks, max_reweightings=30, updated_at=now
            ),
        )

    def cancel(self, job_id: str) -> Entry:
        """Cancel a job that is not over; a cancelled one stays as it is."""
        entry = self.find(job_id)
        if entry.job.status in (Status.SUCCEEDED, Status.FAILED):
            raise Refusal(409, "not_allowed_now", f"Job {job_id} is {entry.job.status}: there is nothing to cancel.")
        entry.change(status=Status.CANCELLED, finished_at=datetime.now(UTC), place_in_queue=None, progress=None)
        return entry

    def retry(self, job_id: str, *, key: str | None = None) -> Entry:
        """Queue a new job with what a failed or cancelled one had; the same key is the same new job."""
        entry = self.find(job_id)
        if key is not None and key in self._keys:
            return self.find(self._keys[key])
        if entry.job.status not in (Status.FAILED, Status.CANCELLED):
            raise Refusal(409, "not_allowed_now", f"Job {job_id} is {entry.job.status}. Wait for it to end.")
        fresh = Job(
            id=secrets.token_hex(8),
            name=entry.job.name,
            status=Status.QUEUED,
            created_at=datetime.now(UTC),
            retry_of=job_id,
            place_in_queue=0,
            options=entry.job.options,
            interpretation=entry.job.interpretation,
        )
        again = self._entries[fresh.id] = Entry(job=fresh, points=entry.points, content=entry.content)
        if key is not None:
            self._keys[key] = fresh.id
        return again

    def delete(self, job_id: str) -> None:
        """Remove a job that is over."""
        entry = self.find(job_id)
        if not entry.job.status.final:
            raise Refusal(409, "not_allowed_now", f"Job {job_id} is {entry.job.status}. Cancel it first.")
        del self._entries[job_id]

    def _end(self, entry: Entry) -> None:
        now = datetime.now(UTC)
        if self._problem is not None:
            entry.change(status=Status.FAILED, finished_at=now, error=self._problem, progress=None)
            return
        shapes = self._reconstruct(entry.points, entry.job.options)
        entry.files = {"shapes.npz": _npz(shapes), "report.json": _report(entry.job), "shapes.glb": _empty_glb()}
        artifacts = [
            Artifact(name=name, media_type="application/octet-stream", bytes=len(data), sha256=entry.sha256(name))
            for name, data in entry.files.items()
        ]
        entry.change(
            status=Status.SUCCEEDED,
            finished_at=now,
            artifacts=artifacts,
            outcome="converged",
            sentence="Converged.",
            metrics={"reprojection_median": 0.0},
            progress=Progress(stage="exporting", fraction=1.0, updated_at=now),
        )


def understood(points: NDArray[np.float64], *, ground_truth: bool, rotations: bool) -> Interpretation:
    """Say how canonical tracks were read."""
    frames, count, _ = points.shape
    return Interpretation(
        num_frames=frames,
        num_points=count,
        num_faces=0,
        hidden_fraction=float((~np.isfinite(points).all(axis=2)).mean()),
        mesh_source="none",
        has_ground_truth=ground_truth,
        has_rotations=rotations,
        layout="tracks (F, P, 2)",
    )


def _npz(shapes: NDArray[np.float64]) -> bytes:
    frames, count, _ = shapes.shape
    file = io.BytesIO()
    np.savez(
        file,
        shapes=shapes,
        rotations=np.tile(np.eye(3), (frames, 1, 1)),
        scales=np.ones(frames),
        translations=np.zeros((frames, 2)),
        faces=np.zeros((0, 3), np.int32),
        residuals=np.zeros((frames, count)),
        weights=np.ones((frames, count)),
    )
    return file.getvalue()


def _report(job: Job) -> bytes:
    return json.dumps({"options": job.options.model_dump(), "outcome": "converged"}).encode()


def _empty_glb() -> bytes:
    """Return the smallest valid binary glTF: no scene."""
    text = b'{"asset":{"version":"2.0"}} '
    return struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text
