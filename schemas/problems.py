"""Every error code of Pliant. Status, title, cause and remedy of each are in problems.toml beside this file.

The service serves an entry at ``/errors/CODE`` and names that address in `Problem.type`. The reference page of the documentation
is generated from the same table, and a test compares the table with the codes that the sources raise.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from enum import StrEnum, auto
from functools import cache
from pathlib import Path

RETRYABLE_STATUSES = frozenset({408, 429, 503, 504, 507})
"""Statuses after which the same request can succeed later."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """The table's entry for an error code."""

    section: str
    title: str
    cause: str
    remedy: str
    status: int | None = None


class ProblemCode(StrEnum):
    """Stable machine-readable name of an error."""

    @property
    def section(self) -> str:
        """Section of the table and of the reference page."""
        return explanations()[self].section

    @property
    def status(self) -> int | None:
        """Usual HTTP status; None if no HTTP answer carries the code, or its status varies."""
        return explanations()[self].status

    @property
    def heading(self) -> str:
        """Short human-readable name."""
        return explanations()[self].title

    @property
    def cause(self) -> str:
        """When the error occurs."""
        return explanations()[self].cause

    @property
    def remedy(self) -> str:
        """What to do."""
        return explanations()[self].remedy

    @property
    def retryable(self) -> bool:
        """True if the same request can succeed later."""
        return self.status in RETRYABLE_STATUSES

    # Requests
    BAD_REQUEST = auto()
    MALFORMED_FORM = auto()
    NO_SUCH_ADDRESS = auto()
    METHOD_NOT_ALLOWED = auto()
    BODY_STALLED = auto()
    PRECONDITION_FAILED = auto()
    BODY_TOO_LARGE = auto()
    TEXT_TOO_LARGE = auto()
    UNSUPPORTED_MEDIA_TYPE = auto()
    RANGE_NOT_SATISFIABLE = auto()
    UNKNOWN_HOST = auto()
    INVALID_REQUEST = auto()
    UNKNOWN_PARAMETER = auto()
    UNKNOWN_PART = auto()
    REPEATED_PART = auto()
    MISSING_PART = auto()
    CONFLICTING_PARTS = auto()
    NOT_A_FILE = auto()
    NOT_UTF8 = auto()
    INVALID_PRIORITY = auto()
    NAME_TOO_LONG = auto()
    INVALID_LIMIT = auto()
    INVALID_CURSOR = auto()
    INVALID_EVENT_ID = auto()
    HTTP_ERROR = auto()
    INTERNAL_ERROR = auto()
    NOT_READY = auto()
    CONFLICTING_HEADERS = auto()

    # Access
    UNAUTHORIZED = auto()
    INVALID_TOKEN = auto()
    EXPIRED_TOKEN = auto()
    INVALID_SHARE = auto()
    EXPIRED_SHARE = auto()
    BEYOND_SHARE = auto()
    INSUFFICIENT_SCOPE = auto()
    CROSS_SITE_REQUEST = auto()
    TOO_MANY_REQUESTS = auto()

    # Jobs
    UNKNOWN_JOB = auto()
    UNKNOWN_ARTIFACT = auto()
    UNKNOWN_EXAMPLE = auto()
    NOT_ALLOWED_NOW = auto()
    NOT_FINISHED = auto()
    ID_TAKEN = auto()
    IDEMPOTENCY_CONFLICT = auto()
    INVALID_ID = auto()
    INVALID_IDEMPOTENCY_KEY = auto()
    TOO_MANY_QUEUED = auto()
    UNKNOWN_OPTION = auto()
    INVALID_OPTION = auto()
    OUTPUT_UNAVAILABLE = auto()
    INVALID_WEBHOOK = auto()
    INVALID_WEBHOOK_SECRET = auto()
    WEBHOOK_NOT_PUBLIC = auto()
    ARTIFACT_GONE = auto()
    UNKNOWN_SHARE = auto()
    TOO_MANY_SHARES = auto()

    # Failed jobs
    TIMED_OUT = auto()
    OUT_OF_MEMORY = auto()
    WORKER_LOST = auto()
    STORAGE_FAILED = auto()
    INTERRUPTED = auto()
    STALE_ATTEMPT = auto()

    # Storage
    STORE_UNAVAILABLE = auto()
    STORAGE_FULL = auto()
    QUOTA_EXCEEDED = auto()
    WORKER_ERROR = auto()

    # Uploads
    UNKNOWN_UPLOAD = auto()
    UPLOAD_INCOMPLETE = auto()
    UPLOAD_COMPLETE = auto()
    UPLOAD_OFFSET_MISMATCH = auto()
    UPLOAD_BUSY = auto()
    UPLOAD_TAKEN_OVER = auto()
    UPLOAD_TOO_LARGE = auto()
    INCONSISTENT_UPLOAD_LENGTH = auto()
    INVALID_DIGEST = auto()
    DIGEST_MISMATCH = auto()
    TOO_MANY_UPLOADS = auto()

    # Input files
    NOT_A_RESULT = auto()
    FILM_AS_TRACKS = auto()
    TRACKS_AS_FILM = auto()
    PICTURE_AS_TRACKS = auto()
    UNREADABLE_TABLE = auto()
    UNKNOWN_FORMAT = auto()
    EMPTY_FILE = auto()
    DAMAGED_FILE = auto()
    PICKLE_REFUSED = auto()
    OBJECT_ARRAY = auto()
    UNSUPPORTED_FEATURE = auto()
    TOO_LARGE = auto()
    NEEDS_MORE_MEMORY = auto()
    TOO_SLOW = auto()
    MEMBER_NAME = auto()
    DUPLICATE_MEMBER = auto()
    DUPLICATE_OBSERVATION = auto()
    MISSING_ARRAY = auto()

    # Films
    FILM_UNAVAILABLE = auto()
    UNSUPPORTED_FILM = auto()
    UNREADABLE_FILM = auto()
    EMPTY_FILM = auto()
    PLAYLIST = auto()
    EXTERNAL_REFERENCE = auto()
    TRUNCATED_FILM = auto()
    UNDECODABLE_FILM = auto()
    NO_PICTURE = auto()
    BROKEN_PICTURE = auto()
    CHANGING_SIZE = auto()
    TOO_SMALL = auto()
    TOO_MANY_STREAMS = auto()
    TOO_MANY_PICTURES = auto()
    TOO_MANY_BYTES = auto()
    TOO_MANY_PIXELS = auto()
    TOO_MANY_FRAMES = auto()
    TOO_LONG = auto()
    WRONG_SELECTION = auto()
    NO_SUCH_FRAME = auto()
    UNREADABLE_REGION = auto()
    WRONG_REGION = auto()
    WRONG_REGION_SIZE = auto()
    WRONG_POLYGON = auto()
    EMPTY_REGION = auto()
    REGION_LOST = auto()
    NO_TEXTURE = auto()
    TRACKS_LOST = auto()
    UNWRITABLE_FILM = auto()
    STOPPED = auto()

    # Meaning of the input
    AMBIGUOUS_LAYOUT = auto()
    AMBIGUOUS_COORDINATES = auto()
    MISSING_IMAGE_SIZE = auto()
    OUTSIDE_PICTURE = auto()
    PRINCIPAL_POINT_FAR = auto()
    WRONG_TYPE = auto()
    WRONG_SHAPE = auto()
    OUT_OF_RANGE = auto()
    NOT_FINITE = auto()
    TOO_FEW_FRAMES = auto()
    TOO_FEW_POINTS = auto()
    NO_FRAMES_LEFT = auto()
    NOTHING_VISIBLE = auto()
    TOO_LITTLE_SEEN = auto()
    NO_EXTENT = auto()
    VERTEX_COUNT_MISMATCH = auto()
    TRANSPOSED_GRID = auto()
    MESH_MISMATCH = auto()
    INDEX_OUT_OF_RANGE = auto()
    DEGENERATE_FACE = auto()
    NOT_A_ROTATION = auto()
    CAMERA_MISMATCH = auto()

    # Command line and start-up
    INVALID_ARGUMENT = auto()
    UNUSABLE_PATH = auto()
    MISSING_EXTRA = auto()
    UNREACHABLE = auto()
    UNEXPECTED_ANSWER = auto()
    CORRUPT_DOWNLOAD = auto()
    WAIT_TIMEOUT = auto()
    NOT_LOADED = auto()
    JOB_CANCELLED = auto()
    INVALID_SIGNATURE = auto()
    INVALID_SETTING = auto()
    DATA_DIRECTORY_IN_USE = auto()
    NEWER_DATA = auto()
    BAD_BACKUP = auto()
    SERVER_FAILED = auto()
    UNKNOWN_TOKEN = auto()
    INVALID_TOKEN_NAME = auto()
    INVALID_TOKEN_TEXT = auto()
    INVALID_DURATION = auto()
    NO_SCOPE = auto()


@cache
def explanations() -> dict[str, Explanation]:
    """Return the table: the entry for every code, in the order of the file."""
    table = tomllib.loads(Path(__file__).with_name("problems.toml").read_text(encoding="utf-8"))
    return {
        code: Explanation(section=section, **entry) for section, codes in table.items() for code, entry in codes.items()
    }


def type_of(code: str) -> str:
    """Return the `type` of a problem document: a relative reference to the explanation of the code."""
    return f"/errors/{code}"


def find_code(code: str) -> ProblemCode | None:
    """Return the error code with this name, or None if this version does not know it."""
    return ProblemCode.__members__.get(code.upper())
