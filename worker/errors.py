"""Errors of the jobs' machinery.

    WorkerError                 base: catch this one
    ├── UnknownJob              no job of that id (or not yours)
    ├── UnknownArtifact         the job has no such file
    ├── UnknownExample          there is no such made-up sequence, or it has no such file
    ├── UnknownToken            there is no token of that id
    ├── NotAllowedNow           the job's status does not allow it
    ├── Conflict                an id or idempotency key is already used for something else
    ├── InvalidRequest          an id or cursor that cannot be one
    ├── InvalidSetting          a setting does not parse or is out of its range
    ├── QuotaExceeded           the jobs together hold as many bytes as they may
    ├── StoreUnavailable        Redis or the blob store does not answer, or is full
    ├── DataDirectoryInUse      another Pliant runs on the data directory
    ├── ServerFailed            the embedded Valkey does not start
    ├── Interrupted             a reconstruction was asked to stop, and did
    ├── TimedOut                a reconstruction took longer than its options allow
    └── StaleAttempt            an attempt that no longer owns its job tried to write

Every one carries a stable `code`, a whole sentence (`str(error)`) and whether the same request may succeed later.
"""

from __future__ import annotations

from pliant.client.schemas import Status


class WorkerError(Exception):
    """Something the jobs' machinery cannot do.

    Attributes
    ----------
    code : str
        Stable machine-readable name.
    retryable : bool
        True if the same request may succeed later.
    """

    code = "worker_error"
    retryable = False


class UnknownJob(WorkerError):
    """There is no job of that id, or it belongs to somebody else."""

    code = "unknown_job"

    def __init__(self, id: str) -> None:
        super().__init__(f"There is no job {id!r}. List the jobs to see which there are; expired ones are removed.")
        self.id = id


class UnknownArtifact(WorkerError):
    """The job has no such file."""

    code = "unknown_artifact"

    def __init__(self, id: str, name: str, *, names: list[str]) -> None:
        have = ", ".join(names) if names else "none (only a succeeded job has files)"
        super().__init__(f"Job {id!r} has no file {name!r}. It has: {have}.")
        self.id, self.name, self.names = id, name, names


class UnknownExample(WorkerError):
    """There is no such example, or it has no such file."""

    code = "unknown_example"

    def __init__(self, name: str, file: str, *, known: list[str]) -> None:
        super().__init__(f"There is no example file {name}/{file}. There are: {', '.join(known)}.")
        self.name, self.file = name, file


class UnknownToken(WorkerError):
    """There is no token of that id."""

    code = "unknown_token"

    def __init__(self, id: str) -> None:
        super().__init__(f"There is no token {id!r}. `pliant token list` shows which there are.")
        self.id = id


class NotAllowedNow(WorkerError):
    """The job's status does not allow what was asked."""

    code = "not_allowed_now"

    def __init__(self, id: str, status: Status, *, wanted: str, hint: str) -> None:
        super().__init__(f"Job {id!r} is {status.value}; it cannot be {wanted} now. {hint}")
        self.id, self.status, self.hint = id, status, hint


class Conflict(WorkerError):
    """An id or an idempotency key is already used for a different request."""

    def __init__(self, code: str, *, id: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code
        self.id = id


class InvalidRequest(WorkerError):
    """An id, cursor or key that cannot be one."""

    def __init__(self, code: str, *, field: str, expected: str, got: str, hint: str) -> None:
        super().__init__(f"{field}: expected {expected}, got {got}. {hint}")
        self.code, self.field, self.expected, self.got, self.hint = code, field, expected, got, hint


class InvalidSetting(WorkerError):
    """A setting does not parse or is out of its range."""

    code = "invalid_setting"

    def __init__(self, name: str, *, expected: str, got: str) -> None:
        super().__init__(f"{name}: expected {expected}, got {got!r}. Correct the variable or leave it unset.")
        self.name, self.expected, self.got = name, expected, got


class QuotaExceeded(WorkerError):
    """The jobs together hold as many bytes as they may."""

    code = "quota_exceeded"
    retryable = True

    def __init__(self, *, used: int, quota: int) -> None:
        super().__init__(
            f"The jobs hold {used:,} bytes and may hold {quota:,}. Delete jobs, wait until old ones expire, or raise PLIANT_DISK_QUOTA."
        )
        self.used, self.quota = used, quota


class StoreUnavailable(WorkerError):
    """Redis or the blob store does not answer, or is full."""

    code = "store_unavailable"
    retryable = True

    def __init__(self, what: str, *, reason: str) -> None:
        super().__init__(f"{what} cannot be used now ({reason}). Nothing was lost; try again in a few seconds.")
        self.what, self.reason = what, reason


class DataDirectoryInUse(WorkerError):
    """Another Pliant runs on the data directory."""

    code = "data_directory_in_use"

    def __init__(self, data: str, *, holder: str) -> None:
        super().__init__(
            f"{data} is already used by {holder}. Stop that one first, or give another directory (--data)."
        )
        self.data, self.holder = data, holder


class ServerFailed(WorkerError):
    """The embedded Valkey does not start."""

    code = "server_failed"

    def __init__(self, sentence: str, *, log: str) -> None:
        super().__init__(f"{sentence} Its log ends with: {log}" if log else sentence)
        self.log = log


class Interrupted(WorkerError):
    """A reconstruction was asked to stop, and did."""

    code = "interrupted"

    def __init__(self) -> None:
        super().__init__("The reconstruction was stopped on request.")


class TimedOut(WorkerError):
    """A reconstruction took longer than its options allow."""

    code = "timed_out"
    retryable = True

    def __init__(self, limit: float) -> None:
        super().__init__(
            f"The job took longer than the {limit:g} s of its option time_limit. Give it more, send fewer points or frames, "
            "or lower max_reweightings."
        )
        self.limit = limit


class StaleAttempt(WorkerError):
    """An attempt that no longer owns its job tried to write; nothing was written."""

    code = "stale_attempt"

    def __init__(self, id: str) -> None:
        super().__init__(f"This attempt at job {id!r} no longer owns it; nothing was written.")
        self.id = id
