"""The result of a successful attempt."""

from __future__ import annotations

from dataclasses import dataclass

from pliant.schemas.job import Artifact, Interpretation
from pliant.schemas.options import Options


@dataclass(frozen=True, slots=True, eq=False)
class Finished:
    """Outcome of a job and the files in its directory."""

    metrics: dict[str, float]
    """All finite metrics that the inputs allow, by their documented names."""

    outcome: str
    """Outcome of the solver: `converged`, `max_reweightings` or `rejected`."""

    sentence: str
    """The outcome in words."""

    warnings: tuple[str, ...]
    """Warnings about this result."""

    artifacts: tuple[Artifact, ...]
    """The files by their names in the directory."""

    interpretation: Interpretation | None = None
    """Interpretation of the inputs if it was not known at submission, as for the tracks of a film."""

    options: Options | None = None
    """The options if the job determined one, as the frame rate of a film."""

    verdict: str | None = None
    """`good`, `with_care` or `do_not_use`; None if the solver gave no verdict."""

    verdict_reasons: tuple[str, ...] = ()
    """A sentence for each reason against the result, most severe first."""

    trust_sentence: str | None = None
    """A sentence with the expected error and the evidence for depth."""

    camera_sentence: str | None = None
    """The camera model, with focal length and field of view if it is perspective."""
