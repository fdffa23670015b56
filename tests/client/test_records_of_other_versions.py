from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest
from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pydantic import ValidationError


def test_jobs_with_unknown_fields_of_a_newer_service_are_accepted() -> None:
    interpretation = Interpretation(
        num_frames=3, num_points=4, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="",
    )  # fmt: skip
    job = Job(
        id="job",
        status=Status.QUEUED,
        created_at=datetime.now(UTC),
        options=Options(seed=3),
        interpretation=interpretation,
    )
    newer = json.loads(job.model_dump_json())
    newer["options"]["invented_later"] = 1
    newer["mood"] = "good"
    assert Job.model_validate_json(json.dumps(newer)) == job
    with pytest.raises(ValidationError, match="invented_later"):
        Options.model_validate(newer["options"])
