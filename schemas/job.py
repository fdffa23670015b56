"""The wire contract: what travels between client and service, and what is stored of a job."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from pliant.schemas.options import Options
from pliant.schemas.problems import type_of
from pydantic import BaseModel, ConfigDict, Field, field_validator


class Status(StrEnum):
    """Where a job stands. The last three are final and never change."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """True if the job will not change any more."""
        return self in (Status.SUCCEEDED, Status.FAILED, Status.CANCELLED)


Priority = Literal["high", "normal", "low"]
"""Order among the waiting jobs of one owner."""


class Record(BaseModel):
    """Base of everything on the wire: unknown fields are ignored, so that an older client reads a newer service."""

    model_config = ConfigDict(frozen=True, extra="ignore", json_schema_serialization_defaults_required=True)


class Problem(Record):
    """An error as RFC 9457 problem details, with what a person or a program needs to act on it."""

    title: str
    status: int = Field(description="The HTTP status code; for a failed job, the one that fits best.")
    detail: str = Field(description="A whole sentence that ends with what to do next.")
    code: str = Field(description="Stable machine-readable name, e.g. `wrong_shape` or `worker_lost`.")
    type: str = Field(
        default_factory=lambda given: type_of(given.get("code", "")),
        description="Reference to the explanation of the code.",
    )
    field: str | None = Field(None, description="The input at fault, e.g. `tracks` or `options.loss`.")
    expected: str | None = None
    got: str | None = None
    hint: str | None = Field(None, description="What to do.")
    retryable: bool = Field(False, description="True if the same request may succeed later.")
    choices: list[dict[str, Any]] | None = Field(
        None, description="The readings that fit, where the input is ambiguous."
    )


class Progress(Record):
    """How far a running job is."""

    stage: str = Field(
        description="`track` (films), `loading`, `cameras`, `initialise`, `reweight`, `finish` or `exporting`."
    )
    fraction: float = Field(ge=0, le=1)
    reweighting: int = 0
    max_reweightings: int = 0
    objective: float | None = None
    residual: float | None = Field(None, description="Median visible reprojection residual, the tracks' unit.")
    seconds_left: float | None = Field(None, description="Estimate; null while there is nothing to base it on.")
    updated_at: datetime


class Artifact(Record):
    """A result file."""

    name: str
    media_type: str
    bytes: int
    sha256: str
    description: str = ""


class Estimate(Record):
    """What a job is expected to need, from the numbers of its frames and points. Right within a factor of about two."""

    memory_bytes: int = Field(description="Largest memory of the process that works on the job.")
    seconds: float = Field(description="Processor seconds on one core of a usual machine.")


class Interpretation(Record):
    """How the inputs were understood."""

    num_frames: int
    num_points: int
    num_faces: int
    hidden_fraction: float = Field(description="Share of the F·P observations that carry no weight.")
    mesh_source: str = Field(description="`given`, `grid`, `delaunay`, `film` or `none`.")
    mesh_grid: tuple[int, int] | None = Field(
        None, description="Rows and columns, where the points are a whole grid, row after row."
    )
    has_ground_truth: bool
    has_rotations: bool
    layout: str = Field(
        description="How the track array was read, e.g. `tracks (F, P, 2)` or `W (2F, P), rows interleaved`."
    )
    format: str = Field(
        "",
        description="Whose output the tracks were recognised as, e.g. `CoTracker`; else `canonical`, `matrix` or `unnamed`.",
    )
    coordinates: str = Field(
        "pixels",
        description="How x and y came: `pixels` (or a unit of their own), `unit` or `signed` fractions of the picture, or `projected`.",
    )
    y_axis: str = Field("down", description="`down` (pixels) or `up`.")
    given_frames: int | None = Field(None, description="Frames in the file, of which `num_frames` are worked on.")
    given_points: int | None = Field(None, description="Points in the file, of which `num_points` are worked on.")
    num_left_out: int = Field(
        0,
        description="Points seen in too few frames to be solved for; they keep their place and follow their neighbours on the mesh.",
    )
    left_out_points: list[int] = Field(
        default_factory=list, description="Their indices in the result, the first thousand."
    )
    notes: list[str] = Field(
        default_factory=list, description="Sentences: the evidence, what was dropped, what was assumed."
    )
    estimate: Estimate | None = Field(
        None, description="Memory and time the job will need; null for films, whose points are not known before they are tracked."
    )


class Inspection(Interpretation):
    """How inputs would be understood, and a glimpse of them."""

    sample: list[list[int]] = Field(
        default_factory=list,
        description="Some frames of some points, for a picture: x and y in turn, 0 to 1000, y down; -1 twice where hidden.",
    )


class Job(Record):
    """One request to reconstruct, and everything known of it."""

    id: str
    name: str = Field("", description="The user's own label.")
    status: Status
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    expires_at: datetime | None = Field(None, description="When the job and its files are removed; null: never.")
    attempt: int = Field(0, description="How often a worker has begun it.")
    retry_of: str | None = Field(None, description="The finished job whose inputs and options this one runs again.")
    priority: Priority = Field("normal", description="Order among the waiting jobs of one owner; jobs of others are not passed.")
    place_in_queue: int | None = Field(None, description="0 is next; null when not queued.")
    options: Options
    interpretation: Interpretation
    progress: Progress | None = None
    metrics: dict[str, float] | None = Field(
        None, description="Every error metric that the inputs allow, by its documented name."
    )
    outcome: str | None = Field(None, description="How the solver ended: `converged`, `max_reweightings`.")
    sentence: str | None = Field(None, description="The outcome in words.")
    verdict: Literal["good", "with_care", "do_not_use"] | None = Field(
        None, description="Whether the result can be used, judged without ground truth; null: not judged."
    )
    verdict_reasons: list[str] = Field(
        default_factory=list,
        description="A sentence with a figure for each sign against the result, the gravest first.",
    )
    trust_sentence: str | None = Field(None, description="The expected error and what depth rests on, in words.")
    warnings: list[str] = Field(default_factory=list, description="What the user should read about this result.")
    artifacts: list[Artifact] = Field(default_factory=list)
    error: Problem | None = None

    @field_validator("options", mode="before")
    @classmethod
    def _leave_out_unknown_options(cls, given: object) -> object:
        """Read a job that a newer service wrote: a request with an unknown option is refused, a record with one is not."""
        if not isinstance(given, dict):
            return given
        return {name: value for name, value in given.items() if name in Options.model_fields}


class Upload(Record):
    """A large input on its way, or waiting for jobs to name it."""

    id: str
    offset: int = Field(description="Bytes that have arrived.")
    length: int | None = Field(None, description="Bytes of the whole; null while nobody has said.")
    complete: bool = Field(description="True once all of it is there; only then may a job name it.")
    sha256: str | None = Field(None, description="Of the whole; null until it is complete.")
    expires_at: datetime | None = Field(None, description="When it is removed unless used before; null: never.")


class JobPage(Record):
    """One page of jobs, newest first."""

    jobs: list[Job]
    next: str | None = Field(None, description="Pass as `cursor` for the page after this one; null at the end.")


class ServiceLimits(Record):
    """What a service accepts; beyond these it refuses."""

    max_body_bytes: int = Field(description="Largest body of one request.")
    max_text_bytes: int = Field(description="Largest text field of a form.")
    max_upload_bytes: int = Field(0, description="Largest upload, over all its requests; 0: there are no uploads.")
    max_bytes: int = Field(description="Largest file, and all arrays read from it, inflated.")
    max_frames: int
    max_points: int
    max_observations: int = Field(description="Frames times points.")
    max_faces: int
    max_wait_seconds: int = Field(description="Longest `Prefer: wait=n` that is honoured.")
    max_page: int = Field(description="Most jobs on one page.")
    max_queued: int = Field(0, description="Jobs of yours that may wait at once; 0: any number. Beyond: 429.")
    max_running: int = Field(
        0, description="Jobs of yours that are worked on at once, the others wait; 0: as many as there are workers."
    )
    requests_per_minute: int = Field(0, description="Requests in a minute; 0: any number. Beyond: 429.")
