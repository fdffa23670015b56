"""fsck: compare the stores with the job records and list inconsistencies.

A consistent installation without running jobs has no findings. Changes in progress look like inconsistencies, so `findings`
checks each one again after `pause` seconds.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator

from pliant.schemas.job import Status
from pliant.worker.errors import UnknownJob
from pliant.worker.jobs.lifecycle import ACTIVE
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Stored
from pliant.worker.uploads.shared import open_uploads


def findings(jobs: Jobs, *, pause: float = 5.0) -> list[str]:
    """Return a sentence for each inconsistency that two checks, `pause` seconds apart, both find.

    Raises
    ------
    StoreUnavailable
        The job or blob store does not answer.
    """
    first = set(_look(jobs))
    if not first:
        return []
    time.sleep(pause)
    return sorted(first & set(_look(jobs)))


def _look(jobs: Jobs) -> Iterator[str]:
    records = list(_all(jobs))
    sizes = jobs.blobs.sizes("jobs/")
    for stored in records:
        yield from _of_record(stored, sizes)
    yield from _of_files(jobs, records, sizes)
    yield from _of_queue(jobs, records)
    yield from open_uploads(jobs.settings, jobs.blobs).findings(jobs.clock())
    used, counted = jobs.records.used(), sum(stored.bytes for stored in records)
    if used != counted:
        yield f"The jobs use {counted:,} bytes, but the counter is at {used:,}."


def _all(jobs: Jobs) -> Iterator[Stored]:
    for id in jobs.records.ids(*Status):
        try:
            stored = jobs.records.get(id)
        except UnknownJob:
            continue
        yield stored


def _of_record(stored: Stored, sizes: dict[str, int]) -> Iterator[str]:
    job = stored.job
    if stored.inputs not in sizes:
        yield f"Job {job.id} ({job.status.value}) has lost its inputs."
    if stored.result is not None and stored.result not in sizes:
        yield f"Job {job.id} ({job.status.value}) has lost the result that it works from."
    for artifact in job.artifacts:
        held = sizes.get(f"{stored.prefix}{artifact.name}")
        if held != artifact.bytes:
            yield f"Job {job.id}: {artifact.name} should have {artifact.bytes:,} bytes and has {held}."
    if job.status.final is not (job.finished_at is not None):
        yield f"Job {job.id} is {job.status.value} but finished_at is {job.finished_at}."
    if (job.status is Status.FAILED) is not (job.error is not None):
        yield f"Job {job.id} is {job.status.value} and its error is {job.error}."
    if (job.status is Status.SUCCEEDED) is not (stored.prefix is not None):
        yield f"Job {job.id} is {job.status.value} and its results are stored under {stored.prefix}."


def _of_files(jobs: Jobs, records: list[Stored], sizes: dict[str, int]) -> Iterator[str]:
    ours = {stored.job.id: stored for stored in records}
    for key in sizes:
        held = ours.get(key.split("/")[1])
        if held is None:
            yield f"File {key} belongs to no job."
        elif key not in (held.inputs, held.result) and not _counts(held, key):
            yield f"File {key} belongs to no current attempt of its job."
    attempt_ids = {stored.attempt_id for stored in records if stored.job.status in ACTIVE}
    work = jobs.settings.work
    for directory in work.iterdir() if work.exists() else ():
        if directory.name not in attempt_ids:
            yield f"Directory {directory} belongs to no running attempt."


def _counts(held: Stored, key: str) -> bool:
    if held.prefix is not None:
        return key.startswith(held.prefix)
    return held.job.status in ACTIVE and key.startswith(f"jobs/{held.job.id}/{held.attempt_id}/")


def _of_queue(jobs: Jobs, records: list[Stored]) -> Iterator[str]:
    waiting = Counter(jobs.queue.waiting())
    queued = {stored.attempt_id: stored.job.id for stored in records if stored.job.status is Status.QUEUED}
    for attempt_id, times in waiting.items():
        if attempt_id not in queued:
            yield f"The queue holds {attempt_id}, which no queued job owns."
        elif times > 1:
            yield f"The queue holds {attempt_id} {times} times."
    held = jobs.queue.held()
    for attempt_id, id in queued.items():
        if attempt_id not in waiting and attempt_id not in held:
            yield f"Job {id} is queued, but the queue does not hold it."
