"""The wire contract: the models exchanged between client and service."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from http import HTTPStatus
from typing import Any, Literal

from pliant.schemas.options import Options
from pliant.schemas.problems import RETRYABLE_STATUSES, find_code, type_of
from pydantic import BaseModel, ConfigDict, Field, field_validator

HEARTBEAT_SECONDS = 15.0
"""Seconds between two comments of an event stream in which nothing happens, unless the operator sets another period."""

LONGEST_NAME = 200
"""Maximum length of a job's name, characters."""

LONGEST_KEY = 255
"""Maximum length of an idempotency key, characters."""

LARGEST_PAGE = 200
"""Maximum number of jobs on a page of a list."""


class Status(StrEnum):
    """Status of a job. The last three are final and never change."""

    QUEUED = "queued"
    """It waits for a worker."""

    RUNNING = "running"
    """A worker works on it."""

    CANCELLING = "cancelling"
    """It was running when it was cancelled, and ends at its next step."""

    SUCCEEDED = "succeeded"
    """It has a result."""

    FAILED = "failed"
    """It has no result; `error` gives the reason."""

    CANCELLED = "cancelled"
    """It was cancelled before it had a result."""

    @property
    def final(self) -> bool:
        """True if the status is final."""
        return self in (Status.SUCCEEDED, Status.FAILED, Status.CANCELLED)


Priority = Literal["high", "normal", "low"]
"""Order among the waiting jobs of one owner."""


class Record(BaseModel):
    """Base of all models: unknown fields are ignored, so that older clients work with newer services."""

    model_config = ConfigDict(frozen=True, extra="ignore", json_schema_serialization_defaults_required=True)


class Problem(Record):
    """An error as RFC 9457 problem details."""

    title: str = Field(description="Short name of the error.")
    status: int = Field(description="The HTTP status code; for a failed job, the most similar one.")
    detail: str = Field(description="A complete sentence that ends with what to do.")
    code: str = Field(description="Stable machine-readable name, e.g. `wrong_shape` or `worker_lost`.")
    type: str = Field(
        default_factory=lambda given: type_of(given.get("code", "")),
        description="Reference to the explanation of the code.",
    )
    field: str | None = Field(default=None, description="The invalid input, e.g. `tracks` or `options.loss`.")
    expected: str | None = Field(default=None, description="What the input should be.")
    got: str | None = Field(default=None, description="What it is.")
    hint: str | None = Field(default=None, description="What to do.")
    retryable: bool = Field(default=False, description="True if the same request may succeed later.")
    choices: list[dict[str, Any]] | None = Field(
        default=None, description="The possible interpretations of an ambiguous input."
    )

    @classmethod
    def of(cls, code: str, status: int | None = None, *, detail: str, **members: Any) -> Problem:
        """Return the problem of a code, with the title and the status of the code's entry in the table.

        Parameters
        ----------
        code : str
            Stable machine-readable name.
        status : int, optional
            HTTP status code, if not the code's own.
        detail : str
            A complete sentence that ends with what to do.
        **members
            Further members, e.g. those of an error: `pliant.schemas.invalid.members_of`.
        """
        known = find_code(code)
        status = status or (known.status if known is not None else None) or 500
        title = HTTPStatus(status).phrase if known is None else known.heading
        members.setdefault("retryable", status in RETRYABLE_STATUSES)
        return cls(title=title, status=status, code=code, detail=detail, **members)


class FollowedPoints(Record):
    """A sample of a film's points in the frame that was tracked last."""

    frame: int = Field(ge=0, description="Number of the frame in the film, from 0.")
    seconds: float = Field(ge=0, description="From the film's start.")
    width: int = Field(ge=1, description="Of the film, pixels.")
    height: int = Field(ge=1, description="Of the film, pixels.")
    points: list[int] = Field(
        max_length=400, description="x and y of each visible point in turn, rounded to the film's pixels."
    )


class Progress(Record):
    """Progress of a running job."""

    stage: str = Field(
        description="`track` (films), `loading`, `cameras`, `initialise`, `reweight`, `finish` or `exporting`."
    )
    fraction: float = Field(ge=0, le=1, description="Completed share of the job, estimated.")
    reweighting: int = Field(default=0, description="Number of finished reweightings of the robust loss.")
    max_reweightings: int = Field(default=0, description="Maximum number of reweightings.")
    objective: float | None = Field(
        default=None, description="Objective of the solve, normalized units; null before the first shapes."
    )
    residual: float | None = Field(default=None, description="Median visible reprojection residual, the tracks' unit.")
    seconds_left: float | None = Field(default=None, description="Estimate; null until one is possible.")
    followed: FollowedPoints | None = Field(default=None, description="Points that the stage `track` tracked last.")
    updated_at: datetime = Field(description="When this was reported.")


class Artifact(Record):
    """A result file."""

    name: str = Field(description="File name, e.g. `shapes.npz`.")
    media_type: str = Field(description="Media type, e.g. `model/gltf-binary`.")
    bytes: int = Field(description="Size.")
    sha256: str = Field(description="SHA-256 of the file, 64 hexadecimal digits.")
    description: str = Field(default="", description="What it contains, in a sentence.")


class Estimate(Record):
    """Expected memory and time of a job, from its numbers of frames and points. Correct within a factor of about two."""

    memory_bytes: int = Field(description="Largest memory of the process that works on the job.")
    seconds: float = Field(
        description="Processor seconds of the reconstruction on one core of a usual machine, without the test for an isometric surface."
    )
    tracking_seconds: float | None = Field(
        default=None, description="Seconds of tracking a film before, measured on one of its frames; null for tracks."
    )


class Interpretation(Record):
    """Interpretation of the inputs."""

    num_frames: int = Field(description="F, frames that are used.")
    num_points: int = Field(description="P, points that are used.")
    num_faces: int = Field(description="Faces of the mesh.")
    hidden_fraction: float = Field(description="Share of the F·P observations with weight 0.")
    mesh_source: str = Field(description="`given`, `grid`, `delaunay`, `film` or `none`.")
    mesh_grid: tuple[int, int] | None = Field(
        default=None, description="Rows and columns, if the points form a complete grid, row by row."
    )
    has_ground_truth: bool = Field(description="Whether true shapes were given, which error metrics need.")
    has_rotations: bool = Field(description="Whether cameras were given.")
    has_region: bool = Field(
        default=False, description="Whether the region of a film was given, as a mask picture or a polygon."
    )
    layout: str = Field(
        description="How the track array was read, e.g. `tracks (F, P, 2)` or `W (2F, P), rows interleaved`."
    )
    format: str = Field(
        default="",
        description="Program whose format was recognised, e.g. `CoTracker`; else `canonical`, `matrix` or `unnamed`.",
    )
    coordinates: str = Field(
        default="pixels",
        description="Original coordinates: `pixels` (or another common unit), `unit` or `signed` fractions of the picture, or `projected`.",
    )
    y_axis: str = Field(default="down", description="`down` (pixels) or `up`.")
    image_size: str | None = Field(
        default=None,
        description="WIDTHxHEIGHT of the picture where the input states it, as films and files of `pliant track` do; used unless the "
        "options give another.",
    )
    fps: float | None = Field(
        default=None, description="Frames per second where the input states them; used unless the options give others."
    )
    given_frames: int | None = Field(default=None, description="Frames in the file, of which `num_frames` are used.")
    given_points: int | None = Field(default=None, description="Points in the file, of which `num_points` are used.")
    num_left_out: int = Field(
        default=0,
        description="Points visible in too few frames and excluded; they keep their index and follow their neighbours on the mesh.",
    )
    left_out_points: list[int] = Field(
        default_factory=list, description="Their indices in the result, the first thousand."
    )
    notes: list[str] = Field(default_factory=list, description="Sentences with evidence, exclusions and assumptions.")
    estimate: Estimate | None = Field(
        default=None,
        description="Memory and time; null for films that are not tracked yet, whose points are unknown: an inspection estimates them.",
    )


class Inspection(Interpretation):
    """Interpretation of inputs, with a sample of tracks or the first frame of a film."""

    sample: list[list[int]] = Field(
        default_factory=list,
        repr=False,
        description="Some points in some frames, for a picture: x and y in turn, 0 to 1000, y down; -1 twice where hidden.",
    )
    first_frame: str | None = Field(
        default=None,
        repr=False,
        description="First frame of a film, for a picture: a JPEG in base64, at most 800 pixels a side; `image_size` states the film's own "
        "pixels. Null for tracks.",
        json_schema_extra={"contentEncoding": "base64", "contentMediaType": "image/jpeg"},
    )


class Job(Record):
    """A reconstruction job."""

    id: str = Field(description="3 to 64 letters, digits, underscores or dashes.")
    name: str = Field(default="", description="Label chosen by the user.")
    status: Status = Field(description="Status of the job; `succeeded`, `failed` and `cancelled` are final.")
    created_at: datetime = Field(description="When it was submitted.")
    started_at: datetime | None = Field(default=None, description="When its attempt began; null while it waits.")
    finished_at: datetime | None = Field(default=None, description="When the status became final; null until then.")
    expires_at: datetime | None = Field(
        default=None,
        description="When the job and its files are removed; null until the job has ended, and if they are kept.",
    )
    attempt: int = Field(default=0, description="Number of attempts so far.")
    retry_of: str | None = Field(default=None, description="The finished job that this one repeats.")
    outputs_of: str | None = Field(
        default=None,
        description="The finished job whose result this one writes in further files, without solving again.",
    )
    priority: Priority = Field(
        default="normal",
        description="`high`, `normal` or `low`: order among the waiting jobs of one owner; "
        "it does not put a job ahead of other owners' jobs.",
    )
    place_in_queue: int | None = Field(
        default=None,
        description="Number of queued jobs ahead; null if not queued, while held back by `max_running`, and in events.",
    )
    options: Options = Field(description="All options, also those that were not given.")
    interpretation: Interpretation = Field(description="How the inputs were read.")
    progress: Progress | None = Field(
        default=None, description="Latest progress of its attempt; null before there is any."
    )
    metrics: dict[str, float] | None = Field(
        default=None, description="Every error metric for which the inputs suffice, by its documented name."
    )
    outcome: str | None = Field(
        default=None, description="Outcome of the solver: `converged`, `max_reweightings` or `rejected`."
    )
    sentence: str | None = Field(default=None, description="The outcome as a sentence.")
    verdict: Literal["good", "with_care", "do_not_use"] | None = Field(
        default=None, description="Whether the result can be used, estimated without ground truth; null: no verdict."
    )
    verdict_reasons: list[str] = Field(
        default_factory=list,
        description="A sentence with a figure for each reason against the result, most severe first.",
    )
    trust_sentence: str | None = Field(
        default=None, description="A sentence with the expected error and the evidence for depth."
    )
    warnings: list[str] = Field(
        default_factory=list, description="Warnings about this result, or about the film of a failed job."
    )
    artifacts: list[Artifact] = Field(default_factory=list, description="Result files; empty until the job succeeds.")
    error: Problem | None = Field(default=None, description="Why the job failed; null unless it did.")

    @field_validator("options", mode="before")
    @classmethod
    def _leave_out_unknown_options(cls, given: object) -> object:
        """Drop unknown options, so that jobs of newer services can be read; in requests they are an error."""
        if not isinstance(given, dict):
            return given
        return {name: value for name, value in given.items() if name in Options.model_fields}


class Upload(Record):
    """A large input that is uploaded separately and then referenced by jobs."""

    id: str = Field(description="The id in the upload's address.")
    offset: int = Field(description="Bytes received.")
    length: int | None = Field(default=None, description="Bytes of the complete upload; null while unknown.")
    complete: bool = Field(description="True once all bytes are received; only then can a job use it.")
    sha256: str | None = Field(default=None, description="Digest of the complete upload; null until it is complete.")
    expires_at: datetime | None = Field(
        default=None, description="When it is removed unless it is used before; null: never."
    )


class JobPage(Record):
    """One page of jobs, newest first."""

    jobs: list[Job] = Field(description="Jobs of this page.")
    next: str | None = Field(default=None, description="Pass as `cursor` to get the next page; null at the end.")


class ServiceLimits(Record):
    """Limits of a service."""

    max_body_bytes: int = Field(description="Largest body of one request.")
    max_text_bytes: int = Field(description="Largest text field of a form.")
    max_upload_bytes: int = Field(
        default=0, description="Largest upload, over all its requests; 0: uploads are not available."
    )
    max_bytes: int = Field(description="Largest file, and all arrays read from it, inflated.")
    max_frames: int = Field(description="Most frames of one input.")
    max_points: int = Field(description="Most points of one input.")
    max_observations: int = Field(description="Frames times points.")
    max_faces: int = Field(description="Most faces of a mesh.")
    max_wait_seconds: int = Field(description="Maximum n of `Prefer: wait=n`.")
    max_page: int = Field(description="Maximum number of jobs on one page.")
    max_queued: int = Field(
        default=0, description="Maximum number of your queued jobs, above which submissions fail with 429; 0: no limit."
    )
    max_running: int = Field(
        default=0, description="Maximum number of your running jobs, the others wait; 0: no limit."
    )
    requests_per_minute: int = Field(
        default=0, description="Maximum number of requests per minute, above which requests fail with 429; 0: no limit."
    )
