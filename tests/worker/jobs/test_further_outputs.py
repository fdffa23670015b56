"""Jobs that write further files: limits, races with deletion and cancellation, lost and damaged files."""

from __future__ import annotations

import dataclasses
import shutil
import struct
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from pliant.schemas.job import Job, Status
from pliant.schemas.options import Options
from pliant.schemas.outputs import OutputRequest
from pliant.worker.errors import Conflict, NotAllowedNow, QuotaExceeded, TooManyQueued, UnknownJob
from pliant.worker.execution.attempt import Attempt, work
from pliant.worker.execution.further_outputs import read_solution, write_further
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import InvalidInput, load_inputs, save_inputs
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.further_outputs import make_outputs
from pliant.worker.jobs.retry import retry
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.maintenance.fsck import findings
from worker_house import make_inputs

WANTED = OutputRequest(outputs=("obj",), axes="viewer")
OPTIONS = Options(method="pseudo_inverse", outputs=("ply",), refine_rotations=False)


def run(jobs: Jobs, job: Job, folder: Path, *, reconstruct: Callable[..., Finished] | None = None) -> Job:
    """Work on a queued job as a worker would; `reconstruct` replaces the solve."""
    attempt_id = jobs.records.get(job.id).attempt_id
    now = datetime.now(UTC)
    stored = jobs.records.update(job.id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=now))
    jobs.queue.remove(attempt_id)
    folder.mkdir(parents=True)
    attempt = Attempt(jobs=jobs, id=job.id, attempt_id=attempt_id, deadline=float("inf"))
    attempt.conclude(work(attempt, stored, folder, reconstruct=reconstruct))
    return jobs.get(job.id)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Finished]:
    """A folder with the inputs and the result files of one solve, and its outcome."""
    folder = tmp_path_factory.mktemp("kept")
    make_inputs(folder / "in.npz", frames=4, points=30)
    return folder, reconstruct(load_inputs(folder / "in.npz"), OPTIONS, folder / "artifacts", name="face")


@pytest.fixture
def solved(jobs: Jobs, kept: tuple[Path, Finished], tmp_path: Path) -> Job:
    """A job with that result."""
    folder, finished = kept

    def copy(inputs: object, options: object, results: Path, **_: object) -> Finished:
        shutil.copytree(folder / "artifacts", results)
        return finished

    shutil.copy(folder / "in.npz", tmp_path / "in.npz")
    read = load_inputs(folder / "in.npz").interpretation
    job = jobs.submit(tmp_path / "in.npz", Submission(options=OPTIONS, name="face"), interpretation=read)[0]
    done = run(jobs, job, tmp_path / "solving", reconstruct=copy)
    assert done.status is Status.SUCCEEDED, done.error
    return done


def test_further_outputs_equal_those_of_the_solving_job(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    more, new = make_outputs(jobs, solved.id, OutputRequest(outputs=("ply",)))
    assert new
    done = run(jobs, more, tmp_path / "w")
    assert done.status is Status.SUCCEEDED, done.error
    ours, theirs = ({each.name: each.sha256 for each in job.artifacts} for job in (done, solved))
    assert ours["shapes_ply.zip"] == theirs["shapes_ply.zip"]
    assert findings(jobs, pause=0) == []


def test_further_outputs_follow_the_uneven_times_of_a_film(jobs: Jobs, tmp_path: Path) -> None:
    times = np.array([5.0, 5.1, 5.2, 6.5])
    inputs = make_inputs(tmp_path / "even.npz", frames=4, points=30)
    save_inputs(dataclasses.replace(inputs, frame_times=times), tmp_path / "in.npz")
    options = OPTIONS.model_copy(update={"fps": 2.0})  # the mean rate: 3 frames in 1.5 s
    solved = jobs.submit(tmp_path / "in.npz", Submission(options=options), interpretation=inputs.interpretation)[0]
    assert run(jobs, solved, tmp_path / "solving").status is Status.SUCCEEDED
    more, _ = make_outputs(jobs, solved.id, OutputRequest(outputs=("mdd",)))
    assert run(jobs, more, tmp_path / "w").status is Status.SUCCEEDED
    written = b"".join(jobs.blobs.get(f"{jobs.stored(more.id).prefix}shapes.mdd").read())
    np.testing.assert_allclose(struct.unpack_from(">4f", written, 8), times - times[0], rtol=1e-6)


def test_further_outputs_survive_deletion_of_the_solved_job(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    more, _ = make_outputs(jobs, solved.id, WANTED)
    jobs.delete(solved.id)
    assert run(jobs, more, tmp_path / "w").status is Status.SUCCEEDED
    with pytest.raises(UnknownJob):
        make_outputs(jobs, solved.id, WANTED)


def test_further_outputs_of_a_new_job_of_the_same_id_are_its_own(jobs: Jobs, tmp_path: Path) -> None:
    made = []
    for frames in (4, 5):
        read = make_inputs(tmp_path / f"{frames}.npz", frames=frames, points=30).interpretation
        job = jobs.submit(tmp_path / f"{frames}.npz", Submission(options=OPTIONS, id="take-1"), interpretation=read)[0]
        assert run(jobs, job, tmp_path / f"solving {frames}").status is Status.SUCCEEDED
        more, new = make_outputs(jobs, "take-1", WANTED)
        assert new
        made.append(run(jobs, more, tmp_path / f"writing {frames}").interpretation.num_frames)
        jobs.delete("take-1")
    assert made == [4, 5]


def test_a_result_that_vanishes_before_copying_leaves_no_job_or_files(jobs: Jobs, solved: Job) -> None:
    stored = jobs.stored(solved.id)
    jobs.blobs.delete(f"{stored.prefix}shapes.npz")
    with pytest.raises(UnknownJob):
        make_outputs(jobs, solved.id, WANTED)
    assert jobs.count([Status.QUEUED]) == 0
    assert {key.split("/")[1] for key, _ in jobs.blobs.list("jobs/")} == {solved.id}


def test_a_cancelled_output_job_is_created_again_and_can_be_retried(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    more, _ = make_outputs(jobs, solved.id, WANTED)
    assert make_outputs(jobs, solved.id, WANTED) == (jobs.get(more.id), False)
    jobs.cancel(more.id)
    again, new = make_outputs(jobs, solved.id, WANTED)
    assert new
    assert again.id != more.id
    assert make_outputs(jobs, solved.id, WANTED) == (jobs.get(again.id), False), "and only once"
    jobs.cancel(again.id)
    third, new = make_outputs(jobs, solved.id, WANTED)
    assert new
    assert make_outputs(jobs, solved.id, WANTED) == (jobs.get(third.id), False)
    retried = retry(jobs, more.id)
    assert retried.outputs_of == solved.id
    assert run(jobs, retried, tmp_path / "w").artifacts[0].name == "shapes_obj.zip"
    kept, _ = make_outputs(jobs, solved.id, WANTED, idempotency_key="mine")
    jobs.cancel(kept.id)
    assert make_outputs(jobs, solved.id, WANTED, idempotency_key="mine")[0].id == kept.id
    with pytest.raises(Conflict):
        make_outputs(jobs, solved.id, OutputRequest(outputs=("csv",)), idempotency_key="mine")


def test_a_retried_output_job_keeps_metrics_and_verdict(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    said = ("metrics", "outcome", "sentence", "verdict", "verdict_reasons", "trust_sentence", "warnings")
    more, _ = make_outputs(jobs, solved.id, WANTED)
    jobs.cancel(more.id)
    retried = retry(jobs, more.id)
    done = run(jobs, retried, tmp_path / "w")
    assert done.status is Status.SUCCEEDED, done.error
    for job in (retried, done):
        assert {name: getattr(job, name) for name in said} == {name: getattr(solved, name) for name in said}
    assert (retried.retry_of, retried.attempt, retried.finished_at, retried.artifacts) == (more.id, 0, None, [])
    assert solved.metrics
    assert solved.verdict is not None


def test_output_jobs_count_against_queue_limit_and_quota(jobs: Jobs, solved: Job) -> None:
    one = dataclasses.replace(jobs, max_queued=1)
    make_outputs(one, solved.id, WANTED)
    with pytest.raises(TooManyQueued):
        make_outputs(one, solved.id, OutputRequest(outputs=("csv",)))
    full = dataclasses.replace(jobs, settings=dataclasses.replace(jobs.settings, disk_quota=jobs.used() + 10))
    with pytest.raises(QuotaExceeded):
        make_outputs(full, solved.id, OutputRequest(outputs=("csv",)))


def test_strangers_and_output_jobs_cannot_request_further_outputs(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    with pytest.raises(UnknownJob):
        make_outputs(jobs.of("stranger"), solved.id, WANTED)
    more, _ = make_outputs(jobs, solved.id, WANTED)
    with pytest.raises(NotAllowedNow) as caught:
        make_outputs(jobs, more.id, WANTED)
    assert str(caught.value) == (
        f"Job {more.id!r} has the status queued: it cannot be exported to further files now. "
        f"It holds further files of job {solved.id!r}: make them from that one."
    )
    with pytest.raises(NotAllowedNow, match="use that job"):
        jobs.kept_inputs(more.id, tmp_path / "kept.npz")


def test_a_damaged_result_fails_the_job_with_a_reason(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    more, _ = make_outputs(jobs, solved.id, WANTED)
    key = jobs.records.get(more.id).result
    assert key is not None
    jobs.blobs.delete(key)
    assert any("has lost the result that it works from" in each for each in findings(jobs, pause=0))
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 cut off")
    jobs.blobs.put(key, tmp_path / "bad.npz")
    done = run(jobs, more, tmp_path / "w")
    assert done.status is Status.FAILED
    assert done.error is not None
    assert done.error.code == "damaged_file"


def test_inconsistent_or_damaged_files_are_refused(jobs: Jobs, solved: Job, tmp_path: Path) -> None:
    np.savez(tmp_path / "r.npz", shapes=np.zeros((2, 3, 3)))
    with pytest.raises(InvalidInput, match=r"a shapes\.npz without"):
        read_solution(tmp_path / "r.npz", y_up=False)
    (tmp_path / "no.npz").write_bytes(b"no zip")
    with pytest.raises(InvalidInput, match="cannot be read back"):
        write_further(tmp_path / "no.npz", tmp_path / "r.npz", solved, tmp_path / "out")
    make_inputs(tmp_path / "other.npz", frames=4, points=20)
    stored = jobs.stored(solved.id)
    jobs.blobs.fetch(f"{stored.prefix}shapes.npz", tmp_path / "shapes.npz")
    with pytest.raises(InvalidInput, match="different sizes"):
        write_further(tmp_path / "other.npz", tmp_path / "shapes.npz", solved, tmp_path / "out")


def test_repeated_requests_find_their_job_after_the_original_is_deleted(
    jobs: Jobs, solved: Job, tmp_path: Path
) -> None:
    more, _ = make_outputs(jobs, solved.id, WANTED, idempotency_key="outputs once")
    jobs.cancel(more.id)
    again = retry(jobs, more.id, idempotency_key="retry once")
    jobs.delete(solved.id)
    jobs.delete(more.id)
    assert retry(jobs, more.id, idempotency_key="retry once").id == again.id
    with pytest.raises(Conflict):
        make_outputs(jobs, more.id, WANTED, idempotency_key="retry once")
    with pytest.raises(UnknownJob):
        make_outputs(jobs, solved.id, WANTED)
