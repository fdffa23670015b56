"""The soak benchmark submits jobs that its installation accepts."""

from __future__ import annotations

import random
from pathlib import Path

from pliant.schemas.job import Interpretation
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.memory import MemoryQueue, MemoryRecords


def test_a_submitted_job_is_stored_with_its_interpretation_and_counts_as_open(bench, tmp_path: Path) -> None:
    records, blobs = MemoryRecords(), Blobs.open("memory:///")
    jobs = Jobs(records=records, blobs=blobs, queue=MemoryQueue(), settings=Settings(data=tmp_path))
    inputs = tmp_path / "inputs.npz"
    inputs.write_bytes(b"canonical")
    interpretation = Interpretation(
        num_frames=4, num_points=5, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="",
    )  # fmt: skip
    soak = bench("installation.soak").Soak(jobs, None, inputs, interpretation, random.Random(0))
    soak.submit()
    (job,) = jobs.page().jobs
    assert list(soak.open) == [job.id]
    assert job.interpretation == interpretation
