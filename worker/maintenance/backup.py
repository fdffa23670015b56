"""Backup of a running installation into a directory, and its restoration into an empty one.

    manifest.json    when and by which version it was made, and the SHA-256 of the other two
    jobs.jsonl       a job a line: record, log, undelivered webhook
    rest.json        tokens (as SHA-256) and tallies
    blobs/…          inputs and results, under the keys that they have in the blob store

A blob never changes under its key, and a record names all its blobs. So a record that is read first and its blobs that are copied
afterwards fit together, whatever happens to other jobs meanwhile; a job that is deleted between the two is left out. Jobs that were
running are queued again by the restoration.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pliant.schemas.job import Status
from pliant.worker.errors import BadBackup, NewerData, StaleAttempt
from pliant.worker.execution.failures import worker_lost
from pliant.worker.ids import new_attempt_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import order_waiting
from pliant.worker.records import Stored, utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.schema import CURRENT, prepare
from pliant.worker.store.snapshot import Snapshot

FORMAT = 1
"""Version of the layout of a backup's directory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What a backup holds."""

    jobs: int
    blobs: int
    bytes: int
    copied: int
    """Blobs that were not there yet."""


def write_backup(settings: Settings, target: Path) -> Summary:
    """Write a backup while the installation runs. A directory that holds an earlier one is brought up to date.

    The earlier backup stays whole until the new manifest replaces its own in one step.

    Raises
    ------
    BadBackup
        The directory holds something else.
    StoreUnavailable
        A store does not answer.
    """
    if target.is_file() or (target.is_dir() and any(target.iterdir()) and not (target / "manifest.json").exists()):
        raise BadBackup(f"{target} holds something that is no backup. Name an empty or a new directory.")
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
        out.flush()
        os.fsync(out.fileno())
    rest = target / f"rest-{tag}.json"
    rest.write_text(json.dumps(snapshot.rest()), encoding="utf-8")
    manifest = {
        "format": FORMAT, "pliant": version("pliant"), "schema": CURRENT, "created_at": utc_now().isoformat(), "jobs": count,
        "files": {each.name: _sha256(each) for each in (records, rest)}, "blobs": kept,
    }  # fmt: skip
    fresh = target / "manifest.json.new"
    fresh.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    fresh.replace(target / "manifest.json")
    _prune(target, manifest)
    return Summary(jobs=count, blobs=len(kept), bytes=sum(kept.values()), copied=copied)


def restore_backup(settings: Settings, source: Path) -> Summary:
    """Write a backup into an installation without jobs and tokens, whose service need not run.

    Raises
    ------
    BadBackup
        It is none, is damaged, or there are jobs already. A damaged one is noticed before anything is written.
    NewerData
        A newer version wrote it.
    StoreUnavailable
        A store does not answer.
    """
    manifest = _manifest(source)
    records, rest = _verified(source, manifest)
    prepare(settings)
    snapshot, jobs = Snapshot(settings), Jobs.open(settings)
    if not snapshot.is_empty():
        raise BadBackup("The installation has jobs or tokens already. Restore into an empty one.")
    kinds = _media_types(records)
    for key in manifest["blobs"]:
        jobs.blobs.put(key, source / "blobs" / key, media_type=kinds.get(key, "application/octet-stream"))
    snapshot.write_rest(json.loads(rest.read_text(encoding="utf-8")))
    owners = []
    for line in _lines(records):
        stored = snapshot.write(json.loads(line))
        _queue_again(jobs, stored)
        owners.append(stored.owner)
    order_waiting(jobs.records, jobs.queue, set(owners))
    sizes = manifest["blobs"].values()
    return Summary(jobs=len(owners), blobs=len(sizes), bytes=sum(sizes), copied=len(sizes))


def _copy_blobs(jobs: Jobs, stored: Stored, target: Path, kept: dict[str, int]) -> int | None:
    """Copy the blobs of a record; return how many were not there, None if the job was deleted meanwhile."""
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
                part.replace(file)
                new += 1
        except FileNotFoundError:
            return None
        found[key] = size
    kept.update(found)
    return new


def _media_types(records: Path) -> dict[str, str]:
    """Return the media type of each artifact by its blob key."""
    held = (json.loads(line)["record"] for line in _lines(records))
    return {f"{each['prefix']}{one['name']}": one["media_type"] for each in held for one in each["job"]["artifacts"]}


def _queue_again(jobs: Jobs, stored: Stored) -> None:
    """Queue a restored job that has not ended."""
    if stored.job.status in lifecycle.ACTIVE:
        change = partial(
            lifecycle.requeue, attempt_id=stored.attempt_id, fresh=new_attempt_id(stored.job.id), max_attempts=None,
            problem=worker_lost("The installation was restored from a backup."), now=jobs.clock(),
            retention=jobs.settings.retention,
        )  # fmt: skip
        with suppress(StaleAttempt):
            stored = jobs.records.update(stored.job.id, change)
    if stored.job.status is Status.QUEUED:
        jobs.queue.push(stored.job.id, stored.attempt_id)


def _manifest(source: Path) -> dict[str, Any]:
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
    """Check the digests of the records and results and the size of every blob, before anything is restored."""
    for name, digest in manifest["files"].items():
        if not (source / name).is_file() or _sha256(source / name) != digest:
            raise BadBackup(f"{source / name} is missing or was changed. Use another backup.")
    for key, size in manifest["blobs"].items():
        file = source / "blobs" / key
        if ".." in Path(key).parts or not file.is_file() or file.stat().st_size != size:
            raise BadBackup(f"{file} is missing or was changed. Use another backup.")
    records, rest = (
        next(source / name for name in manifest["files"] if name.startswith(start)) for start in ("jobs-", "rest-")
    )
    for line in _lines(records):
        record = json.loads(line)["record"]
        for artifact in record["job"]["artifacts"]:
            file = source / "blobs" / f"{record['prefix']}{artifact['name']}"
            if _sha256(file) != artifact["sha256"]:
                raise BadBackup(f"{file} was changed: its SHA-256 is not that of the record. Use another backup.")
    return records, rest


def _lines(records: Path) -> Iterator[str]:
    with records.open(encoding="utf-8") as lines:
        yield from lines


def _prune(target: Path, manifest: dict[str, Any]) -> None:
    """Remove what belongs to an earlier backup alone."""
    _remove(target, lambda path: path.name.startswith(("jobs-", "rest-")) and path.name not in manifest["files"])
    blobs = target / "blobs"
    for path in sorted(blobs.rglob("*"), reverse=True):  # files before their folders
        if path.is_file() and path.relative_to(blobs).as_posix() not in manifest["blobs"]:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _remove(folder: Path, unwanted: Callable[[Path], bool]) -> None:
    for path in folder.iterdir():
        if path.is_file() and unwanted(path):
            path.unlink()


def _sha256(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
