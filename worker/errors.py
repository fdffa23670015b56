"""Errors of the jobs' machinery.

    WorkerError                 base: catch this one
    ├── UnknownJob              no job of that id (or not yours)
    ├── UnknownArtifact         the job has no such file
    ├── UnknownExample          there is no such made-up sequence, or it has no such file
    ├── UnknownToken            there is no token of that id
    ├── UnknownUpload           no upload of that id (or not yours)
    ├── NotAllowedNow           the job's status does not allow it
    ├── Conflict                an id or idempotency key is already used for something else
    │   └── OffsetMismatch      bytes that do not belong where the upload stands
    ├── InvalidRequest          an id or cursor that cannot be one
    │   └── UploadTooLarge      more bytes than one upload may have
    ├── TooManyUploads          more uploads than one owner may have
    ├── InvalidSetting          a setting does not parse or is out of its range
    ├── TooManyQueued           as many jobs of yours wait as may
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

from pliant.schemas.invalid import Invalid
from pliant.schemas.job import Status


class WorkerError(Exception):
    """Something the jobs' machinery cannot do.

    Attributes
    ----------
    code : str
        Stable machine-readable name.
    retryable : bool
        True if the same request may succeed later.
    retry_after : int or None
        Seconds after which it may.
    """

    code = "worker_error"
    retryable = False
    retry_after: int | None = None


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


class UnknownUpload(WorkerError):
    """There is no upload of that id, or it belongs to somebody else."""

    code = "unknown_upload"

    def __init__(self, id: str) -> None:
        super().__init__(f"There is no upload {id!r}; uploads are removed when they expire. Send it again.")
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


class OffsetMismatch(Invalid, Conflict):
    """Bytes were sent that do not belong where the upload stands."""

    def __init__(self, id: str, *, expected: int, got: int) -> None:
        super().__init__(
            "upload_offset_mismatch",
            field="Upload-Offset",
            expected=str(expected),
            got=str(got),
            hint=f"Go on at {expected}.",
        )
        self.id, self.offset = id, expected


class InvalidRequest(Invalid, WorkerError):
    """An id, cursor or key that cannot be one."""


class UploadTooLarge(InvalidRequest):
    """An upload has more bytes than it may have."""

    def __init__(self, most: int, got: int) -> None:
        super().__init__(
            "upload_too_large", field="body", expected=f"at most {most} bytes", got=f"{got} or more",
            hint="Take fewer frames or points, or store float32; see /v1/limits.",
        )  # fmt: skip


class TooManyUploads(WorkerError):
    """An owner has as many uploads as he may have."""

    code = "too_many_uploads"
    retryable = True

    def __init__(self, most: int) -> None:
        super().__init__(f"There are {most} uploads already. Delete some, or wait until they expire.")


class InvalidSetting(Invalid, WorkerError):
    """A setting does not parse, is out of its range, or leaves an installation that nobody could use."""

    def __init__(
        self, variable: str, *, expected: str, got: str, hint: str = "Correct the variable or leave it unset."
    ) -> None:
        super().__init__("invalid_setting", field=variable, expected=expected, got=got, hint=hint)


class TooManyQueued(WorkerError):
    """As many jobs of one owner wait as may."""

    code = "too_many_queued"
    retryable = True
    retry_after = 10

    def __init__(self, limit: int) -> None:
        super().__init__(
            f"{limit} of your jobs wait already, and no more may. Send the next one when one of them has begun, or cancel one."
        )
        self.limit = limit


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
    retry_after = 2

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
