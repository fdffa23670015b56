"""In-memory record store and queue for tests; the same test suite runs on them and on Redis."""

from __future__ import annotations

import threading
import weakref
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime

from pliant.schemas.job import Status
from pliant.worker.errors import QuotaExceeded, TooManyQueued, UnknownJob
from pliant.worker.records import LOG_KEPT, Changes, Event, Heartbeat, Records, Stored, counted, event_of, events_kept
from pliant.worker.store.changes import MemoryChanges
from pliant.worker.store.queue import Queue


class MemoryRecords(Records):
    """Thread-safe records of one process."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._followers: weakref.WeakSet[MemoryChanges] = weakref.WeakSet()
        self._records: dict[str, Stored] = {}
        self._keys: dict[str, str] = {}
        self._deleted: dict[str, datetime] = {}
        self._beats: dict[str, int] = {}
        self._events: dict[str, list[Event]] = {}
        self._logs: dict[str, list[str]] = {}
        self._tallies: Counter[str] = Counter()
        self._clock = 0

    def create(self, stored: Stored, *, max_queued: int = 0, max_bytes: int = 0) -> Stored:
        id = stored.job.id
        with self._lock:
            taken = self._keys.get(stored.key) if stored.key is not None else None
            if taken is not None:
                return self._records[taken]
            if id in self._records:
                return self._records[id]
            if 0 < max_queued <= self.count([Status.QUEUED], owner=stored.owner):
                raise TooManyQueued(max_queued)
            if 0 < max_bytes < (used := self.used()) + stored.bytes:
                raise QuotaExceeded(used=used, quota=max_bytes, needed=stored.bytes, results=stored.reserved)
            if stored.key is not None:
                self._keys[stored.key] = id
            self._records[id] = stored
            self._beats[id] = 0
            self._note(None, stored)
            return stored

    def get(self, id: str) -> Stored:
        with self._lock:
            if id not in self._records:
                raise UnknownJob(id)
            return self._records[id]

    def find(self, key: str) -> Stored | None:
        with self._lock:
            id = self._keys.get(key)
            return None if id is None else self._records[id]

    def replace(self, before: Stored, after: Stored) -> bool:
        id = before.job.id
        with self._lock:
            held = self._records.get(id)
            if held is None or held.version != before.version:
                return False
            self._records[id] = after
            self._tallies.update(counted(before, after))
            self._note(before, after)
            return True

    def delete(self, stored: Stored, *, at: datetime) -> None:
        id = stored.job.id
        with self._lock:
            if self.look(id, stored.attempt_id) is None:
                return
            gone = self._records.pop(id)
            self._deleted[id] = at
            if gone.key is not None:
                self._keys.pop(gone.key, None)
            for kept in (self._beats, self._events, self._logs):
                kept.pop(id, None)
            self._publish(id)

    def deleted(self) -> dict[str, datetime]:
        with self._lock:
            return dict(self._deleted)

    def forget_deleted(self, id: str) -> None:
        with self._lock:
            self._deleted.pop(id, None)

    def page(
        self, *, cursor: str | None, limit: int, statuses: Sequence[Status], owner: str | None
    ) -> tuple[list[Stored], str | None]:
        with self._lock:
            fitting = [
                each
                for each in self._records.values()
                if each.job.status in statuses
                and (owner is None or each.owner == owner)
                and (cursor is None or each.sort_key < cursor)
            ]
        fitting.sort(key=lambda each: each.sort_key, reverse=True)
        page = fitting[:limit]
        return page, page[-1].sort_key if len(fitting) > limit else None

    def ids(self, *statuses: Status) -> list[str]:
        with self._lock:
            held = [(each.job.status, each.sort_key) for each in self._records.values()]
        fitting = [key for status in statuses for key in sorted(key for own, key in held if own is status)]
        return [key.split(":", 1)[1] for key in fitting]

    def count(self, statuses: Sequence[Status], *, owner: str | None = None) -> int:
        with self._lock:
            return sum(
                each.job.status in statuses and (owner is None or each.owner == owner)
                for each in self._records.values()
            )

    def oldest(self, status: Status) -> datetime | None:
        with self._lock:
            return min(
                (each.job.created_at for each in self._records.values() if each.job.status is status), default=None
            )

    def tallies(self) -> dict[str, float]:
        with self._lock:
            return dict(self._tallies)

    def used(self) -> int:
        with self._lock:
            return sum(each.bytes for each in self._records.values())

    def beat(self, id: str, attempt_id: str) -> Status | None:
        with self._lock:
            status = self.look(id, attempt_id)
            if status is not None:
                self._beats[id] += 1
            return status

    def look(self, id: str, attempt_id: str) -> Status | None:
        with self._lock:
            held = self._records.get(id)
            return held.job.status if held is not None and held.attempt_id == attempt_id else None

    def beats(self, ids: Iterable[str]) -> dict[str, Heartbeat]:
        with self._lock:
            held = {id: self._records[id] for id in ids if id in self._records}
            return {
                id: Heartbeat(each.attempt_id, self._beats[id], each.owner, each.max_running, each.job.priority)
                for id, each in held.items()
            }

    def events(self, id: str, *, after: str | None) -> list[Event]:
        with self._lock:
            return [each for each in self._events.get(id, []) if after is None or _later(each.id, after)]

    def changes(self) -> Changes:
        subscription = MemoryChanges()
        self._followers.add(subscription)
        return subscription

    def append_log(self, id: str, lines: Sequence[str]) -> None:
        with self._lock:
            if id in self._records:
                self._logs[id] = [*self._logs.get(id, []), *lines][-LOG_KEPT:]

    def log(self, id: str) -> list[str]:
        with self._lock:
            return list(self._logs.get(id, []))

    def ping(self) -> None:
        """See `Records.ping`."""

    def _note(self, before: Stored | None, after: Stored) -> None:
        event = event_of(before, after)
        if event is not None:
            self._clock += 1
            events = self._events.setdefault(after.job.id, [])
            events.append(Event(f"{self._clock}-0", *event))
            del events[: -events_kept(after)]
        self._publish(after.job.id)

    def _publish(self, id: str) -> None:
        for each in list(self._followers):
            each.add(id)


def _later(one: str, other: str) -> bool:
    first, second = (tuple(int(part) for part in each.split("-")) for each in (one, other))
    return first > second


class MemoryQueue(Queue):
    """A queue of one process."""

    def __init__(self) -> None:
        self._attempt_ids: list[str] = []
        self._held: set[str] = set()

    def push(self, id: str, attempt_id: str, *, front: bool = False) -> None:  # noqa: ARG002
        if attempt_id not in self._attempt_ids:
            self._attempt_ids.insert(0 if front else len(self._attempt_ids), attempt_id)

    def remove(self, attempt_id: str) -> None:
        self.release(attempt_id)
        if attempt_id in self._attempt_ids:
            self._attempt_ids.remove(attempt_id)

    def hold(self, attempt_id: str) -> None:
        self._held.add(attempt_id)

    def held(self) -> set[str]:
        return set(self._held)

    def release(self, attempt_id: str) -> None:
        self._held.discard(attempt_id)

    def waiting(self) -> list[str]:
        return list(self._attempt_ids)

    def place(self, attempt_id: str) -> int | None:
        return self._attempt_ids.index(attempt_id) if attempt_id in self._attempt_ids else None

    def clean_up(self) -> None:
        """See `Queue.clean_up`."""

    def workers(self) -> list[str]:
        return ["memory"]

    def order(self, ranks: Mapping[str, int]) -> None:
        places = [place for place, each in enumerate(self._attempt_ids) if each in ranks]
        ordered = sorted((self._attempt_ids[place] for place in places), key=ranks.__getitem__)
        for place, each in zip(places, ordered, strict=True):
            self._attempt_ids[place] = each

    def memories(self) -> dict[str, int]:
        return {}


class MemoryHash:
    """The Redis hash commands that `pliant.worker.tokens.Tokens` uses."""

    def __init__(self) -> None:
        self._hashes: dict[str, dict[str, str]] = {}

    def hset(self, key: str, name: str, value: str) -> None:
        """Set a field of a hash."""
        self._hashes.setdefault(key, {})[name] = value

    def hget(self, key: str, name: str) -> str | None:
        """Return a field of a hash, None if there is none."""
        return self._hashes.get(key, {}).get(name)

    def hvals(self, key: str) -> list[str]:
        """Return every value of a hash."""
        return list(self._hashes.get(key, {}).values())
