"""Processes whose blob store is not that of the service: no job fails, and nothing runs until it is the right one."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from pliant.schemas.job import Job, Status
from pliant.worker.errors import ForeignStore, StoreUnavailable
from pliant.worker.jobs.foreign_store import check_at_start, check_before_forking, check_blob_store
from pliant.worker.jobs.service import Jobs
from pliant.worker.processes.supervisor import worker_children
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from worker_house import House, settled

Submit = Callable[..., Job]


@pytest.fixture
def jobs(jobs: Jobs) -> Jobs:
    """Jobs of an installation with a Redis of its own."""
    settings = dataclasses.replace(jobs.settings, redis_url=jobs.settings.redis_url or "redis://unused")
    return dataclasses.replace(jobs, settings=settings)


def elsewhere(jobs: Jobs, folder: Path) -> Jobs:
    return dataclasses.replace(jobs, blobs=Blobs.open((folder / "elsewhere").as_uri()))


def test_a_store_without_the_files_of_any_job_is_foreign(jobs: Jobs, submit: Submit, tmp_path: Path) -> None:
    check_blob_store(jobs)
    check_blob_store(elsewhere(jobs, tmp_path))  # there are no jobs yet
    kept, lost = submit(), submit()
    check_blob_store(jobs)
    with pytest.raises(ForeignStore, match=r"^PLIANT_BLOB_URL: expected the blob store in which the service keeps"):
        check_blob_store(elsewhere(jobs, tmp_path))
    jobs.blobs.delete(jobs.records.get(lost.id).inputs)
    check_blob_store(jobs)
    jobs.blobs.delete(jobs.records.get(kept.id).inputs)
    with pytest.raises(ForeignStore, match="the files were lost: delete these jobs"):
        check_at_start(jobs)


def test_files_that_were_lost_beside_the_embedded_valkey_keep_nothing_from_starting(
    jobs: Jobs, submit: Submit, tmp_path: Path
) -> None:
    embedded = dataclasses.replace(jobs.settings, redis_url=None)
    submit()
    check_blob_store(dataclasses.replace(elsewhere(jobs, tmp_path), settings=embedded))


def test_a_start_does_not_wait_for_stores(jobs: Jobs, submit: Submit, tmp_path: Path) -> None:
    submit()
    away = Settings(data=tmp_path, redis_url=f"unix://{tmp_path}/none.sock")
    with pytest.raises(StoreUnavailable):
        check_blob_store(Jobs.open(away))
    check_at_start(Jobs.open(away))
    check_before_forking(away)


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
def test_a_worker_with_another_store_fails_no_job_and_is_not_ready(
    settings: Settings, inputs_files: tuple[Path, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """It failed one job after the other."""
    right = dataclasses.replace(settings, threads=1)
    wrong = dataclasses.replace(right, blob_url=(tmp_path / "wrong").as_uri())
    with House(right, inputs=inputs_files, children=worker_children(wrong)[:1]) as house:
        waiting = [house.submit()]
        words = ""

        def told() -> bool:
            nonlocal words
            words += capfd.readouterr().err
            return words.count("PLIANT_BLOB_URL: expected the blob store in which the service keeps the files") >= 2

        house.until(told, "the worker ends, and does not start again", seconds=60)
        assert "Traceback" not in words
        waiting.append(house.submit())
        assert house.jobs.ready()["workers"] == "No worker is running; start one with `pliant work`."
        jobs = [house.jobs.get(id) for id in waiting]
        assert [(job.status, job.error, job.attempt) for job in jobs] == [
            (Status.QUEUED, None, 1),
            (Status.QUEUED, None, 0),
        ]
        assert "The files of the job are not in the blob store of its worker" in house.jobs.log(waiting[0])
        assert house.files_at_work() == []
    env = {**os.environ, **wrong.to_environment()}
    command = [sys.executable, "-m", "pliant.worker", "reconcile"]
    ended = subprocess.run(command, env=env, check=False, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1
    assert ended.stderr.startswith("PLIANT_BLOB_URL: expected the blob store")
    with House(right, inputs=inputs_files) as house:
        assert [house.final(id).status for id in waiting] == [Status.SUCCEEDED] * 2
        settled(house)
