"""Back up a running installation into a directory, and restore it into an empty installation.

    manifest.json    time and version of the backup, SHA-256 of the next two files, sizes of the blobs
    jobs-….jsonl     one job per line: record, log, undelivered webhook
    rest-….json      tokens (as SHA-256) and counters
    blobs/…          inputs and results, under their keys in the blob store

Blobs are immutable, and a record names all its blobs. A record that is read before its blobs are copied is therefore consistent with
them, even while jobs run. A job that is deleted in between is omitted. Restoring requeues jobs that were running, and holds all queued
ones back: the service's reconciler, which knows its limit of running jobs, queues them.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pliant.schemas.digests import sha256
from pliant.schemas.job import Status
from pliant.worker.errors import BadBackup, NewerData, StaleAttempt, UnknownJob
from pliant.worker.execution.failures import worker_lost
from pliant.worker.ids import new_attempt_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Stored, utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.schema import CURRENT, migrated
from pliant.worker.store.snapshot import Snapshot

FORMAT = 1
"""Version of the layout of a backup's directory."""

_OWN = re.compile(r"blobs|manifest\.json(\.new)?|jobs-[0-9a-f]{8}\.jsonl|rest-[0-9a-f]{8}\.json")
"""Names in a backup's directory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Contents of a backup."""

    jobs: int
    blobs: int
    bytes: int
    copied: int
    """Blobs that were copied; a backup reuses those already in its directory."""


def write_backup(settings: Settings, target: Path) -> Summary:
    """Back up an installation, which may be running. An earlier backup in the directory is updated.

    The earlier backup stays valid until the new manifest atomically replaces the old one. A backup that was interrupted is continued.

    Raises
    ------
    BadBackup
        The target is a file, or a directory that is neither empty nor a backup; or a job has lost a file.
    StoreUnavailable
        A store does not answer.
    """
    if target.is_file() or (target.is_dir() and not all(_OWN.fullmatch(each.name) for each in target.iterdir())):
        raise BadBackup(f"{target} is not a backup. Choose an empty or new directory.")
    target.mkdir(parents=True, exist_ok=True, mode=0o700)
    snapshot, jobs = Snapshot(settings), Jobs.open(settings)
    kept: dict[str, int] = {}
    copied = count = 0
    tag = secrets.token_hex(4)
    records = target / f"jobs-{tag}.jsonl"
    with records.open("w", encoding="utf-8") as out:
        for found in snapshot.jobs():
            stored = Stored.model_validate(found["record"])
            fetched = _copy_blobs(jobs, stored, target, kept)
            if fetched is None:
                continue
            copied, count = copied + fetched, count + 1
            out.write(json.dumps(found, ensure_ascii=False, separators=(",", ":")) + "\n")
    rest = target / f"rest-{tag}.json"
    rest.write_text(json.dumps(snapshot.rest()), encoding="utf-8")
    manifest = {
        "format": FORMAT, "pliant": version("pliant"), "schema": CURRENT, "created_at": utc_now().isoformat(), "jobs": count,
        "files": {each.name: sha256(each) for each in (records, rest)}, "blobs": kept,
    }  # fmt: skip
    fresh = target / "manifest.json.new"
    fresh.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    os.sync()  # what the manifest names must outlast a power failure before the manifest replaces the old one
    fresh.replace(target / "manifest.json")
    os.sync()  # and the new manifest before the files that only the old one names are removed
    _prune(target, manifest)
    return Summary(jobs=count, blobs=len(kept), bytes=sum(kept.values()), copied=copied)


def restore_backup(settings: Settings, source: Path) -> Summary:
    """Restore a backup into an installation without jobs and tokens; its service need not run.

    Raises
    ------
    BadBackup
        There is no valid backup, or the installation has jobs or tokens. Damage is detected before anything is written.
    NewerData
        The backup was written by a newer version.
    StoreUnavailable
        A store does not answer.
    """
    manifest = read_manifest(source)
    records, rest = _verified(source, manifest)
    snapshot, jobs = Snapshot(settings), Jobs.open(settings)
    if not snapshot.is_empty():
        raise BadBackup("The installation already has jobs or tokens. Restore into an empty one.")
    kinds = _media_types(records)
    for key in manifest["blobs"]:
        jobs.blobs.put(key, source / "blobs" / key, media_type=kinds.get(key, "application/octet-stream"))
    snapshot.write_rest(json.loads(rest.read_text(encoding="utf-8")))
    for line in _lines(records):
        _requeue(jobs, snapshot.write(json.loads(line)))
    sizes = manifest["blobs"].values()
    return Summary(jobs=manifest["jobs"], blobs=len(sizes), bytes=sum(sizes), copied=len(sizes))


def _copy_blobs(jobs: Jobs, stored: Stored, target: Path, kept: dict[str, int]) -> int | None:
    """Copy the missing blobs of a record; return their number, None if the job was deleted meanwhile."""
    sizes = {f"{stored.prefix}{each.name}": each.bytes for each in stored.job.artifacts}
    given = [key for key in (stored.inputs, stored.result) if key is not None]
    found: dict[str, int] = {}
    new = 0
    for key in (*given, *sizes):
        file = target / "blobs" / key
        try:
            size = sizes[key] if key in sizes else jobs.blobs.get(key).size
            if not file.exists() or file.stat().st_size != size:
                file.parent.mkdir(parents=True, exist_ok=True)
                part = file.with_name(f"{file.name}.part")
                part.unlink(missing_ok=True)
                jobs.blobs.fetch(key, part)
                if part.stat().st_size != size:
                    raise FileNotFoundError(key)  # it was cut off
                part.replace(file)
                new += 1
        except FileNotFoundError:
            _check_deleted(jobs, stored, key)
            return None
        found[key] = size
    kept.update(found)
    return new


def _check_deleted(jobs: Jobs, stored: Stored, key: str) -> None:
    """Raise BadBackup if a job whose file is missing was not deleted meanwhile."""
    try:
        lost = jobs.records.get(stored.job.id).inputs == stored.inputs  # or a new job has its id
    except UnknownJob:
        lost = False
    if lost:
        raise BadBackup(
            f"Job {stored.job.id} has lost its file {key}: it is not complete in {jobs.settings.blobs}. Check that PLIANT_BLOB_URL is that "
            "of the service; otherwise delete the job. An earlier backup in the directory stays as it is."
        )


def _media_types(records: Path) -> dict[str, str]:
    """Return the media type of each artifact by its blob key."""
    held = (json.loads(line)["record"] for line in _lines(records))
    return {f"{each['prefix']}{one['name']}": one["media_type"] for each in held for one in each["job"]["artifacts"]}


def _requeue(jobs: Jobs, stored: Stored) -> None:
    """Make a restored job that has not ended a queued one, and hold it back until the service runs."""
    if stored.job.status in lifecycle.ACTIVE:
        change = partial(
            lifecycle.requeue, attempt_id=stored.attempt_id, fresh=new_attempt_id(stored.job.id), max_attempts=None,
            problem=worker_lost("The installation was restored from a backup."), now=jobs.clock(),
            retention=jobs.settings.retention,
        )  # fmt: skip
        with suppress(StaleAttempt):
            stored = jobs.records.update(stored.job.id, change)
    if stored.job.status is Status.QUEUED:
        jobs.queue.hold(stored.attempt_id)


def read_manifest(source: Path) -> dict[str, Any]:
    """Return what a backup says about itself.

    Raises
    ------
    BadBackup
        There is no backup, or one of another layout.
    NewerData
        The backup was written by a newer version.
    """
    try:
        manifest: dict[str, Any] = json.loads((source / "manifest.json").read_text(encoding="utf-8"))
        known = manifest["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadBackup(f"{source} holds no backup: its manifest.json cannot be read.") from error
    if not known:
        raise BadBackup(f"{source} has layout {manifest['format']}; this Pliant reads layout {FORMAT}.")
    if manifest["schema"] > CURRENT:
        raise NewerData(found=manifest["schema"], known=CURRENT)
    return manifest


def _verified(source: Path, manifest: dict[str, Any]) -> tuple[Path, Path]:
    """Check the digests of records and results and the size of every blob; return the two files of records."""
    for name, digest in manifest["files"].items():
        if not (source / name).is_file() or sha256(source / name) != digest:
            raise BadBackup(f"{source / name} is missing or was changed. Use another backup.")
    for key, size in manifest["blobs"].items():
        file = source / "blobs" / key
        if ".." in Path(key).parts or not file.is_file() or file.stat().st_size != size:
            raise BadBackup(f"{file} is missing or was changed. Use another backup.")
    records, rest = (
        next(source / name for name in manifest["files"] if name.startswith(start)) for start in ("jobs-", "rest-")
    )
    for line in _lines(records):
        record = migrated(json.loads(line)["record"])  # refuses one of a newer version
        for artifact in record["job"]["artifacts"]:
            file = source / "blobs" / f"{record['prefix']}{artifact['name']}"
            if sha256(file) != artifact["sha256"]:
                raise BadBackup(f"{file} was changed: its SHA-256 does not match the record. Use another backup.")
    return records, rest


def _lines(records: Path) -> Iterator[str]:
    with records.open(encoding="utf-8") as lines:
        yield from lines


def _prune(target: Path, manifest: dict[str, Any]) -> None:
    """Remove files that only an earlier backup uses."""
    for path in target.iterdir():
        if path.name.startswith(("jobs-", "rest-")) and path.name not in manifest["files"]:
            path.unlink()
    blobs = target / "blobs"
    for path in sorted(blobs.rglob("*"), reverse=True):  # files before their folders
        if path.is_file() and path.relative_to(blobs).as_posix() not in manifest["blobs"]:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()
