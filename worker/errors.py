"""Errors of the worker package; `WorkerError` is the base of all.

Each error has a stable `code` and a message that is a complete sentence.
"""

from __future__ import annotations

from pliant.schemas.invalid import Invalid, Picklable
from pliant.schemas.job import Status


class WorkerError(Picklable):
    """Base class of the errors of the worker package.

    Attributes
    ----------
    code : str
        Stable machine-readable name.
    retry_after : int or None
        Seconds to wait before the next attempt.
    """

    code = "worker_error"
    retry_after: int | None = None


class UnknownJob(WorkerError):
    """No job has this id, or it belongs to another owner."""

    code = "unknown_job"

    def __init__(self, id: str) -> None:
        super().__init__(f"There is no job {id!r}. List your jobs to see which exist; expired ones are removed.")


class UnknownArtifact(WorkerError):
    """The job has no such file."""

    code = "unknown_artifact"

    def __init__(self, id: str, name: str, *, names: list[str]) -> None:
        have = ", ".join(names) if names else "none (only a succeeded job has files)"
        super().__init__(f"Job {id!r} has no file {name!r}. It has: {have}.")


class UnknownExample(WorkerError):
    """There is no such example, or it has no such file."""

    code = "unknown_example"

    def __init__(self, name: str, file: str, *, known: list[str]) -> None:
        super().__init__(f"There is no example file {name}/{file}. There are: {', '.join(known)}.")


class UnknownShare(WorkerError):
    """The job has no such share link."""

    code = "unknown_share"

    def __init__(self, id: str, share: str) -> None:
        super().__init__(
            f"Job {id!r} has no share link {share!r}; it may have expired. List the links to see which there are."
        )


class UnknownToken(WorkerError):
    """No token has this id."""

    code = "unknown_token"

    def __init__(self, id: str) -> None:
        super().__init__(f"There is no token {id!r}. `pliant token list` lists all tokens.")


class UnknownUpload(WorkerError):
    """No upload has this id, or it belongs to another owner."""

    code = "unknown_upload"

    def __init__(self, id: str) -> None:
        super().__init__(f"There is no upload {id!r}; uploads are removed when they expire. Send it again.")


class NotAllowedNow(WorkerError):
    """The operation is not possible in the job's status."""

    code = "not_allowed_now"

    def __init__(self, id: str, status: Status, *, wanted: str, hint: str) -> None:
        super().__init__(f"Job {id!r} has the status {status.value}: it cannot be {wanted} now. {hint}")
        self.hint = hint


class Conflict(WorkerError):
    """An id or an idempotency key is already used for a different request, or an upload is in another state."""

    def __init__(self, code: str, *, id: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code
        self.id = id


class Taken(Conflict):
    """An id or an idempotency key is already used for a different request; `id` is the job that has it."""

    def __init__(self, code: str, *, id: str, field: str, expected: str, got: str, sentence: str, hint: str) -> None:
        super().__init__(code, id=id, sentence=f"{sentence} {hint}")
        self.field = field
        self.expected = expected
        self.got = got
        self.hint = hint


class OffsetMismatch(Invalid, Conflict):
    """The offset of the request differs from the current size of the upload."""

    def __init__(self, id: str, *, expected: int, got: int) -> None:
        hint = f"Continue at {expected}."
        super().__init__(
            "upload_offset_mismatch", field="Upload-Offset", expected=str(expected), got=str(got), hint=hint
        )
        self.id, self.offset = id, expected


class InvalidRequest(Invalid, WorkerError):
    """A value in a request, such as an id, a cursor or a key, is malformed or out of range."""


class UploadTooLarge(InvalidRequest):
    """An upload exceeds its maximum size."""

    def __init__(self, most: int, got: int) -> None:
        super().__init__(
            "upload_too_large", field="body", expected=f"at most {most:,} bytes", got=f"{got:,} or more",
            hint="Send fewer frames or points, or store float32; see /v1/limits.",
        )  # fmt: skip


class TooManyUploads(WorkerError):
    """The owner's limit on uploads is reached."""

    code = "too_many_uploads"

    def __init__(self, most: int) -> None:
        super().__init__(
            f"Upload limit reached: there are already {most} uploads. Delete some, or wait until they expire."
        )


class TooManyShares(WorkerError):
    """The job's limit on valid share links is reached."""

    code = "too_many_shares"

    def __init__(self, id: str, most: int) -> None:
        super().__init__(f"Job {id!r} has {most} share links already. Revoke one, or wait until one expires.")


class InvalidSetting(Invalid, WorkerError):
    """A setting does not parse, is out of range, or makes the installation unusable."""

    def __init__(
        self, variable: str, *, expected: str, got: str, hint: str = "Correct the variable or leave it unset."
    ) -> None:
        super().__init__("invalid_setting", field=variable, expected=expected, got=got, hint=hint)


class TooManyQueued(WorkerError):
    """The owner's limit on queued jobs is reached."""

    code = "too_many_queued"
    retry_after = 10

    def __init__(self, limit: int) -> None:
        super().__init__(
            f"Queue limit reached: {limit} jobs are already queued. Submit again when one of them has started, or cancel one."
        )


class QuotaExceeded(WorkerError):
    """A job or an upload does not fit into the disk quota beside the others, or is larger than the quota, which is not `retryable`."""

    code = "quota_exceeded"

    def __init__(self, *, used: int, quota: int, needed: int, results: int = 0) -> None:
        self.retryable = needed <= quota
        of_them = f" (about {results:,} for the results)" if results else ""
        super().__init__(
            f"Disk quota reached: {used:,} of {quota:,} bytes are used, and {needed:,} more are needed{of_them}. "
            "Delete jobs, wait until they expire, or raise PLIANT_DISK_QUOTA."
            if self.retryable
            else f"Disk quota too small: {needed:,} bytes are needed{of_them}, and the quota is {quota:,}. "
            "Send fewer frames or points, or raise PLIANT_DISK_QUOTA."
        )


JOB_STORE = "The job store"
"""Name of Redis in messages."""


class StoreUnavailable(WorkerError):
    """Redis or the blob store does not answer, or is full."""

    code = "store_unavailable"
    retry_after = 2

    def __init__(self, what: str, *, reason: str) -> None:
        super().__init__(f"{what} is unavailable ({reason}). No data was lost; try again in a few seconds.")
        self.what, self.reason = what, reason


class StoreForbidden(StoreUnavailable):
    """The access rules (ACL) of Redis forbid its user a command, a key or a channel that Pliant needs."""

    remedy = "Grant it to the user in PLIANT_REDIS_URL; docs/how-to/two-hosts.md lists the access rules."

    def __init__(self, forbidden: str) -> None:
        reason = f"its access rules forbid {forbidden}"
        super().__init__(JOB_STORE, reason=reason)
        self.args = (
            f"{JOB_STORE} is unavailable ({reason}). No data was lost; the operator must grant the permission.",
        )


class ForeignStore(InvalidSetting):
    """The blob store has no inputs of the newest jobs: it is probably not the one of the installation."""

    def __init__(self, url: str) -> None:
        super().__init__(
            variable="PLIANT_BLOB_URL",
            expected="the blob store in which the service keeps the files of its jobs",
            got=f"{url!r}, which has no files of the newest jobs",
            hint="Give every process the service's PLIANT_BLOB_URL. If it is the same, the files were lost: delete these jobs.",
        )


class DataDirectoryInUse(WorkerError):
    """Another Pliant process uses the data directory."""

    code = "data_directory_in_use"

    def __init__(self, data: str, *, holder: str) -> None:
        super().__init__(f"{data} is already used by {holder}. Stop it first, or choose another directory (--data).")


class NewerData(WorkerError):
    """The stored data was written by a newer version."""

    code = "newer_data"

    def __init__(self, *, found: int, known: int) -> None:
        super().__init__(
            f"The records were written by a newer Pliant (record format {found}; this version reads up to {known}). "
            "Install that Pliant, or restore a backup that was made before the upgrade."
        )


class BadBackup(WorkerError):
    """A backup cannot be written or restored."""

    code = "bad_backup"


class ServerFailed(WorkerError):
    """The embedded Valkey or the API cannot be started."""

    code = "server_failed"

    def __init__(self, sentence: str, *, log: str = "") -> None:
        super().__init__(f"{sentence} Its log ends with: {log}" if log else sentence)


class Interrupted(WorkerError):
    """A reconstruction was stopped on request."""

    code = "interrupted"

    def __init__(self) -> None:
        super().__init__("The reconstruction was stopped on request.")


class TimedOut(WorkerError):
    """A reconstruction took longer than its option `time_limit` allows."""

    code = "timed_out"

    def __init__(self, limit: float) -> None:
        super().__init__(
            f"The job exceeded its option time_limit of {limit:g} s. Raise it, or send fewer points or frames."
        )


class StaleAttempt(WorkerError):
    """An attempt that no longer owns its job tried to write; nothing was written."""

    code = "stale_attempt"

    def __init__(self, id: str) -> None:
        super().__init__(f"This attempt at job {id!r} no longer owns it; nothing was written.")
