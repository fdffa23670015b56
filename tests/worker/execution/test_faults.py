"""Real processes killed at different times: the record, acknowledged jobs, and leftovers afterwards."""

from __future__ import annotations

import dataclasses
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from pliant.schemas.job import Status
from pliant.solver.gallery import face
from pliant.worker.errors import NotAllowedNow
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import load_inputs
from pliant.worker.jobs.retry import retry
from pliant.worker.maintenance.fsck import findings
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from rq import Queue as RqQueue
from rq.serializers import JSONSerializer
from worker_house import SHORT, House, make_long_inputs, settled

from benchmarks.installation.instance import children, running

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")


@pytest.fixture(scope="module")
def house(
    valkey_data: Path, tmp_path_factory: pytest.TempPathFactory, inputs_files: tuple[Path, Path]
) -> Iterator[House]:
    """Two workers with short timeouts."""
    settings = Settings(
        data=tmp_path_factory.mktemp("house"), redis_url=Settings(data=valkey_data).redis,
        queue=f"faults-{secrets.token_hex(3)}", workers=2, threads=1, lost_after=2.0, cancel_grace=3.0, stop_grace=1.0,
    )  # fmt: skip
    with House(settings, inputs=inputs_files) as house:
        yield house


@pytest.fixture(autouse=True)
def left_running(request: pytest.FixtureRequest) -> Iterator[None]:
    """Cancel the jobs that a failed test leaves, which would occupy both workers during the next tests."""
    yield
    if "house" in request.fixturenames:
        house: House = request.getfixturevalue("house")
        left = [job.id for job in house.jobs.page(limit=200).jobs if not job.status.final]
        if left:
            house.thaw()
        for id in left:
            with suppress(NotAllowedNow):  # it has ended meanwhile
                house.jobs.cancel(id)
            house.final(id)


def test_a_queued_job_gives_the_same_bits_as_a_direct_call(house: House, tmp_path: Path) -> None:
    id = house.submit(name="same bits")
    job = house.final(id)
    assert (job.status, job.error, job.attempt) == (Status.SUCCEEDED, None, 1)
    direct = reconstruct(load_inputs(house.short_inputs), SHORT, tmp_path / "direct")
    assert job.metrics == direct.metrics
    assert (job.outcome, job.sentence) == (direct.outcome, direct.sentence)
    assert [each.name for each in job.artifacts] == [each.name for each in direct.artifacts]
    artifact, blob = house.jobs.artifact(id, "shapes.npz")
    (tmp_path / "queued.npz").write_bytes(b"".join(blob.read()))
    assert artifact.bytes == blob.size
    with np.load(tmp_path / "queued.npz") as queued, np.load(tmp_path / "direct" / "shapes.npz") as plain:
        assert set(queued) == set(plain)
        for name in queued:
            if name != "seconds":
                np.testing.assert_array_equal(queued[name], plain[name])
    assert "Wrote shapes.npz" in house.jobs.log(id)
    assert house.jobs.events(id)[-1].name == "job"
    settled(house)


@pytest.mark.slow
def test_progress_reports_fraction_objective_and_residual(house: House) -> None:
    id = house.submit(long=True)
    house.until(lambda: (house.jobs.get(id).progress or SHORT) and house.solving(id).progress.reweighting, "reweights")  # type: ignore[union-attr]
    progress = house.jobs.get(id).progress
    assert progress is not None
    assert progress.stage == "reweight"
    assert 0 < progress.fraction < 0.85
    assert progress.max_reweightings == 1000
    assert progress.objective is not None
    assert progress.residual is not None
    assert progress.seconds_left is None or progress.seconds_left > 0
    moments = [event for event in house.jobs.events(id) if event.name == "progress"]
    assert len(moments) >= 1
    house.jobs.cancel(id)
    house.final(id)


def test_a_running_job_is_cancelled(house: House) -> None:
    id = house.submit(long=True)
    house.solving(id)
    assert house.jobs.cancel(id).status is Status.CANCELLING
    job = house.final(id)
    assert (job.status, job.error, job.artifacts) == (Status.CANCELLED, None, [])
    settled(house)
    assert house.blobs_of(id) == {"inputs.npz"}


@pytest.mark.slow
def test_a_killed_job_process_fails_its_job_and_nothing_else(house: House) -> None:
    other = house.submit(long=True)
    house.solving(other)
    (bystander,) = house.job_processes()
    id = house.submit(long=True)
    house.solving(id)
    (victim,) = set(house.job_processes()) - {bystander}
    os.kill(victim, signal.SIGKILL)
    seconds = house.until(lambda: house.jobs.get(id).status.final, "the record says so", seconds=5)
    job = house.jobs.get(id)
    assert seconds < 5
    assert job.status is Status.FAILED
    assert job.error is not None
    assert (job.error.code, job.error.retryable) == ("worker_lost", True)
    assert "SIGKILL" in job.error.detail
    assert "retry" in job.error.detail
    assert house.jobs.get(other).status is Status.RUNNING
    again = retry(house.jobs, id)
    assert again.retry_of == id
    for each in (other, again.id):
        house.jobs.cancel(each)
        assert house.final(each).status is Status.CANCELLED
    assert house.final(house.submit()).status is Status.SUCCEEDED, "the service goes on"
    settled(house)


@pytest.mark.slow
def test_a_crash_leaves_its_stack_in_the_log(house: House) -> None:
    id = house.submit(long=True)
    house.solving(id)
    (victim,) = house.job_processes()
    os.kill(victim, signal.SIGSEGV)
    job = house.final(id)
    assert job.error is not None
    assert (job.error.code, "SIGSEGV" in job.error.detail) == ("worker_lost", True)
    assert "Traceback" not in job.error.detail
    assert "Segmentation fault" in house.jobs.log(id)


def test_the_job_of_a_killed_worker_is_completed_by_another(house: House) -> None:
    id = house.submit(long=True)
    house.solving(id)
    (job_process,) = house.job_processes()
    (worker,) = [pid for pid in house.worker_pids() if job_process in children(pid)]
    os.kill(worker, signal.SIGKILL)
    house.until(lambda: not running(job_process), "the job process dies with its worker")
    house.until(lambda: house.jobs.get(id).attempt == 2, "another worker begins it", seconds=30)
    assert "The worker was lost" in house.jobs.log(id)
    house.jobs.cancel(id)
    assert house.final(id).status is Status.CANCELLED


@pytest.mark.slow
def test_an_attempt_that_lost_its_job_writes_nothing(house: House) -> None:
    id = house.submit(long=True)
    house.solving(id)
    (job_process,) = house.job_processes()
    (worker,) = [pid for pid in house.worker_pids() if job_process in children(pid)]
    for pid in (worker, job_process):
        os.kill(pid, signal.SIGSTOP)
    house.until(lambda: house.jobs.get(id).attempt == 2, "another worker begins it", seconds=30)
    attempt_id = house.jobs.records.get(id).attempt_id
    for pid in (job_process, worker):
        os.kill(pid, signal.SIGCONT)
    house.until(lambda: not running(job_process), "the stale job process is put down")
    held = house.jobs.records.get(id)
    assert (held.attempt_id, held.job.status, held.job.attempt) == (attempt_id, Status.RUNNING, 2)
    house.jobs.cancel(id)
    assert house.final(id).status is Status.CANCELLED
    settled(house)


@pytest.mark.slow
def test_a_stopping_worker_requeues_its_job(house: House) -> None:
    id = house.submit(long=True)
    house.solving(id)
    (job_process,) = house.job_processes()
    (worker,) = [pid for pid in house.worker_pids() if job_process in children(pid)]
    os.kill(job_process, signal.SIGTERM)  # as service managers do, which signal every process
    os.kill(worker, signal.SIGTERM)
    house.until(lambda: house.jobs.get(id).attempt == 2, "it begins again")
    assert "worker_lost" not in str([event.data for event in house.jobs.events(id)])
    house.until(lambda: not running(worker), "the worker ends")
    house.jobs.cancel(id)
    assert house.final(id).status is Status.CANCELLED


@pytest.mark.slow
def test_a_stopping_worker_lets_a_short_job_finish(house: House, tmp_path: Path) -> None:
    settings = dataclasses.replace(
        house.settings, data=tmp_path, queue=f"calm-{secrets.token_hex(3)}", workers=1, stop_grace=60.0
    )
    with House(settings, inputs=(house.short_inputs, house.long_inputs)) as calm:
        id = calm.submit()
        calm.until(lambda: calm.jobs.get(id).status is not Status.QUEUED, "it is taken")
        (worker,) = calm.worker_pids()
        os.kill(worker, signal.SIGTERM)
        job = calm.final(id)
        assert (job.status, job.attempt) == (Status.SUCCEEDED, 1)


def test_a_delivery_of_another_function_is_rejected(house: House, tmp_path: Path) -> None:
    marks = [tmp_path / name for name in ("function", "callback")]
    raw = connect(house.settings.redis, decode=False)
    queue = RqQueue(house.settings.queue, connection=raw, serializer=JSONSerializer)
    queue.enqueue_call("os.mkdir", args=(str(marks[0]),), on_success=None)
    forged = queue.create_job("pliant.worker.execution.attempt.run", args=("no-such-job", "no-such-attempt_id"))
    forged.save()
    raw.hset(forged.key, mapping={"success_callback_name": "os.getcwd", "failure_callback_name": "os.getcwd"})
    queue.enqueue_job(forged)
    house.until(lambda: not house.jobs.queue.waiting(), "both are taken")
    assert house.final(house.submit()).status is Status.SUCCEEDED
    assert not any(mark.exists() for mark in marks)
    raw.close()


@pytest.mark.slow
def test_a_duplicate_delivery_is_dropped(house: House) -> None:
    id = house.submit(long=True)
    job = house.solving(id)
    attempt_id = house.jobs.records.get(id).attempt_id
    house.freeze()
    house.jobs.queue.push(id, attempt_id)
    house.until(lambda: not house.jobs.queue.waiting(), "the second delivery is taken")
    time.sleep(0.5)
    held = house.jobs.records.get(id)
    assert (held.attempt_id, held.job.status, held.job.attempt) == (attempt_id, Status.RUNNING, job.attempt)
    assert house.files_at_work() == [attempt_id], "the second worker has not cleared the first one's files away"
    house.thaw()
    house.jobs.cancel(id)
    house.final(id)


@pytest.mark.slow
def test_a_job_missing_from_the_queue_is_completed(house: House) -> None:
    first = house.submit(long=True)
    house.solving(first)
    house.freeze()
    second = house.submit(long=True)
    house.solving(second)
    id = house.submit()
    house.jobs.queue.remove(house.jobs.records.get(id).attempt_id)
    house.jobs.cancel(second)
    assert house.final(id).status is Status.SUCCEEDED
    assert "missing from the queue" in house.jobs.log(id)
    house.thaw()
    house.jobs.cancel(first)
    house.final(first)
    house.final(second)


@pytest.mark.slow
def test_lost_inputs_are_a_storage_failure_with_a_traceback_in_the_log(house: House) -> None:
    first, second = house.submit(long=True), house.submit(long=True)
    house.solving(first)
    house.solving(second)
    id = house.submit()
    house.jobs.blobs.delete(house.jobs.records.get(id).inputs)
    house.jobs.cancel(first)
    house.jobs.cancel(second)
    job = house.final(id)
    assert job.error is not None
    assert (job.error.code, job.error.status) == ("storage_failed", 503)
    assert "A stored file of the job is missing" in job.error.detail
    assert "Traceback" not in job.error.detail
    assert "Traceback" in house.jobs.log(id)
    house.final(first)
    house.final(second)
    # The worker removes the folders of ended attempts after their records have changed.
    lost = [f"Job {id} (failed) has lost its inputs."]
    house.until(lambda: findings(house.jobs, pause=0.1) == lost, "only the lost inputs are left")
    house.jobs.delete(id)
    settled(house)


@pytest.mark.slow
def test_a_job_over_its_time_limit_fails_as_timed_out(house: House, tmp_path: Path) -> None:
    settings = dataclasses.replace(
        house.settings, data=tmp_path, queue=f"late-{secrets.token_hex(3)}", workers=1, time_limit=1.5, memory_limit=0
    )
    with House(settings, inputs=(house.short_inputs, house.long_inputs)) as late:
        job = late.final(late.submit(long=True))
        assert job.error is not None
        assert (job.status, job.error.code, job.error.retryable) == (Status.FAILED, "timed_out", True)
        assert "1.5 s" in job.error.detail
        id = late.submit()
        late.until(lambda: late.jobs.get(id).status is not Status.QUEUED, "the worker takes the next one")
        late.final(id)
        settled(late)


@pytest.mark.slow
def test_a_job_over_its_memory_limit_fails_as_out_of_memory(house: House, tmp_path: Path) -> None:
    make_long_inputs(tmp_path / "big.npz", face(60, 30_000))
    settings = dataclasses.replace(
        house.settings, data=tmp_path, queue=f"lean-{secrets.token_hex(3)}", workers=1, memory_limit=640 << 20
    )
    with House(settings, inputs=(house.short_inputs, tmp_path / "big.npz")) as lean:
        job = lean.final(lean.submit(long=True))
        assert job.error is not None
        assert (job.status, job.error.code, job.error.retryable) == (Status.FAILED, "out_of_memory", True)
        assert "0.6 GiB" in job.error.detail
        assert lean.final(lean.submit()).status is Status.SUCCEEDED
        settled(lean)


@pytest.mark.slow
def test_invalid_arguments_and_settings_are_reported(tmp_path: Path) -> None:
    def run(*arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pliant.worker", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **env})

    wrong = run("dance")
    assert (wrong.returncode, "usage" in wrong.stderr) == (2, True)
    unset = run("reconcile", PLIANT_WORKERS="none")
    assert (unset.returncode, unset.stderr.count("\n")) == (1, 1)
    assert "PLIANT_WORKERS: expected a whole number" in unset.stderr
    for store, sentence in {
        "http://host": "PLIANT_REDIS_URL: expected a URL redis://, rediss:// or unix://, got another text.",
        "unix:///nowhere/none.sock": "The job store at unix:///nowhere/none.sock is unavailable (No such file or directory).",
    }.items():
        ended = run("work", PLIANT_REDIS_URL=store, PLIANT_DATA=str(tmp_path))
        assert (ended.returncode, ended.stderr.count("\n"), ended.stderr.startswith(sentence)) == (1, 1, True), (
            ended.stderr
        )


@pytest.mark.slow
def test_a_data_directory_that_cannot_be_made_is_named(settings: Settings, tmp_path: Path) -> None:
    """By each process that may be started alone; a worker ended with a traceback, the others named no directory."""
    (tmp_path / "file").touch()
    env = {**os.environ, **settings.to_environment(), "PLIANT_DATA": str(tmp_path / "file" / "data")}
    for command in (["pliant.worker", "work"], ["pliant.worker", "reconcile"], ["pliant.service"]):
        ended = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False, env=env)
        assert ended.returncode in (1, 2)
        assert ended.stderr.startswith("PLIANT_DATA: expected a folder that this user can create and write, got '")
        assert "(Not a directory). Make the folder for the user that runs Pliant" in ended.stderr


@pytest.mark.slow
def test_a_blob_folder_that_cannot_be_made_is_named(settings: Settings, tmp_path: Path) -> None:
    """By each process that may be started alone, as by `pliant up`; they said that the store is unavailable, and to try again."""
    (tmp_path / "file").touch()
    url = (tmp_path / "file" / "blobs").as_uri()
    env = {**os.environ, **settings.to_environment(), "PLIANT_BLOB_URL": url}
    for command in (["pliant.worker", "work"], ["pliant.worker", "reconcile"], ["pliant.service"]):
        ended = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False, env=env)
        assert ended.returncode in (1, 2)
        assert f"PLIANT_BLOB_URL: expected a folder that exists or can be made, got '{url}'" in ended.stderr


@pytest.mark.slow
def test_the_fsck_command_reports_inconsistencies(house: House) -> None:
    command = [sys.executable, "-m", "pliant.cli", "fsck"]
    env = {**os.environ, **house.settings.to_environment()}
    clean = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert (clean.returncode, clean.stdout) == (0, "✓ stored the stores are consistent with the job records\n")
    house.jobs.blobs.put("jobs/nobody/nobody-1/inputs.npz", house.short_inputs)
    found = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert "File jobs/nobody/nobody-1/inputs.npz belongs to no job." in found.stdout
    assert found.returncode == 8
    house.jobs.blobs.delete("jobs/nobody/")
