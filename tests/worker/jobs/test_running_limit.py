"""The limit of running jobs, with two real workers and a real reconciler."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
from pliant.schemas.job import Status
from pliant.worker.settings import Settings
from worker_house import House, settled


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
@pytest.mark.slow
def test_two_workers_respect_the_running_limit_and_finish_all_jobs(
    settings: Settings, inputs_files: tuple[Path, Path]
) -> None:
    limited = dataclasses.replace(settings, workers=2, max_running=1, threads=1)
    with House(limited, inputs=inputs_files) as house:
        long = house.submit(long=True)
        house.solving(long)
        house.freeze()
        shorts = [house.submit() for _ in range(2)]
        most = 0

        def watched() -> bool:
            nonlocal most
            states = [house.jobs.get(id).status for id in (long, *shorts)]
            most = max(most, states.count(Status.RUNNING))
            return all(state.final for state in states)

        house.until(lambda: house.jobs.get(shorts[0]).status is Status.QUEUED, "held back", seconds=1)
        house.thaw()
        house.jobs.cancel(long)
        house.until(watched, "all are done", seconds=60)
        assert most == 1
        assert [house.jobs.get(id).status for id in shorts] == [Status.SUCCEEDED] * 2
        assert not any("forgotten" in house.jobs.log(id) for id in shorts)
        settled(house)
