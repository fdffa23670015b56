"""Estimates of memory and time, and the jobs that are refused or put back because of them."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pliant.schemas.job import Interpretation, Status
from pliant.schemas.options import Options
from pliant.worker.errors import InvalidRequest, InvalidSetting
from pliant.worker.formats import read_inputs
from pliant.worker.formats.cost import LIBRARIES, estimated, largest_that_fits
from pliant.worker.jobs.admission import check_fits
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.processes.memory import IDLE_WORKER, check_workers, memory_for_a_job
from pliant.worker.processes.memory import LIBRARIES as UNUSED
from pliant.worker.settings import Settings
from pliant.worker.store.queue import alive_key
from worker_house import House

MEASURE = """
import re, sys, tempfile
from pathlib import Path
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import gallery, threads_limited
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import Inputs
frames, points, prior = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
sequence = gallery.face(frames, points)
stated = Interpretation(num_frames=frames, num_points=points, num_faces=0, hidden_fraction=0, mesh_source="given",
                        has_ground_truth=False, has_rotations=False, layout="")
with threads_limited(1), tempfile.TemporaryDirectory() as folder:
    options = Options(prior=prior, max_reweightings=2, camera="scaled_orthographic")
    reconstruct(Inputs(sequence.tracks, sequence.mesh, None, None, stated), options, Path(folder))
# Not ru_maxrss, which starts at the size of the process that began this one.
peak = re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())
print(sequence.tracks.num_points, int(peak[1]) * 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads kilobytes")
@pytest.mark.parametrize(
    ("frames", "points", "prior"), [pytest.param(8, 500, "gaussian", marks=pytest.mark.long), (10, 20_000, "smooth")]
)
def test_the_memory_estimate_is_within_a_factor_of_two_of_a_real_job(frames: int, points: int, prior: str) -> None:
    env = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", MEASURE, str(frames), str(points), prior]
    ran = subprocess.run(command, env=env, capture_output=True, text=True, check=True, timeout=250)
    count, peak = map(int, ran.stdout.split())
    estimate = estimated(frames, count, Options(prior=prior)).memory_bytes  # type: ignore[arg-type]
    assert peak / 2 < estimate < 2 * peak, (peak, estimate)


@pytest.mark.parametrize("other", [{"method": "temporal"}, {"preset": "paper"}])
def test_the_estimate_without_a_learned_prior_is_that_of_the_smooth_prior(other: dict[str, Any]) -> None:
    assert estimated(100, 10_000, Options(**other)) == estimated(100, 10_000, Options(prior="smooth"))
    assert largest_that_fits(10**9, 100, 10_000, Options(**other)) == largest_that_fits(
        10**9, 100, 10_000, Options(prior="smooth")
    )


def test_the_largest_job_that_fits_just_meets_the_memory_limit() -> None:
    for prior in ("gaussian", "smooth", "smooth+low_rank"):
        options = Options(prior=prior)
        points, frames = largest_that_fits(2_000_000_000, 50, 1000, options)
        assert (
            estimated(50, points, options).memory_bytes
            <= 2_000_000_000
            < estimated(50, points + 1, options).memory_bytes
        )
        assert (
            estimated(frames, 1000, options).memory_bytes
            <= 2_000_000_000
            < estimated(frames + 1, 1000, options).memory_bytes
        )
    assert largest_that_fits(LIBRARIES - 1, 50, 1000, Options()) == (0, 0)


SECONDS = (
    (10, 500, {}, 2.4), (100, 500, {}, 12.4), (20, 1_000, {}, 3.3), (30, 5_000, {}, 5.1), (80, 300, {}, 9.5), (10, 20_000, {}, 3.3),
    (100, 500, {"prior": "smooth"}, 5.2), (30, 5_000, {"prior": "smooth"}, 2.1), (100, 500, {"has_rotations": True}, 4.4),
    (30, 5_000, {"has_rotations": True}, 2.2),
)  # fmt: skip
"""Frames, points, what differs from the default, and measured processor seconds."""


@pytest.mark.parametrize(("frames", "points", "given", "seconds"), SECONDS)
def test_the_time_estimate_is_within_a_factor_of_two_of_measurements(
    frames: int, points: int, given: dict[str, Any], seconds: float
) -> None:
    options = Options(**{name: value for name, value in given.items() if name == "prior"})
    estimate = estimated(frames, points, options, has_rotations="has_rotations" in given)
    assert seconds / 2 < estimate.seconds < 2 * seconds


@pytest.mark.parametrize("measured", [1.0, 1.1, 1.7, 1.8, 2.1, 2.4])
def test_the_time_with_a_known_lens_is_within_a_factor_of_two_of_measurements(measured: float) -> None:
    plain = estimated(50, 500, Options())
    near = estimated(50, 500, Options(image_size="640x480"))
    assert measured / 2 < near.seconds / plain.seconds < 2 * measured
    assert near.memory_bytes == plain.memory_bytes
    assert estimated(50, 500, Options(focal=500)) == estimated(50, 500, Options(camera="perspective")) == near
    assert estimated(50, 500, Options(image_size="640x480", camera="orthographic")) == plain


MEMORY = ((50, 20_000, "gaussian", 0.34e9), (10, 60_000, "smooth", 0.24e9), (30, 20_000, "smooth+low_rank", 0.31e9),
          (50, 200_000, "gaussian", 2.9e9), (100, 1_000_000, "gaussian", 11.6e9))  # fmt: skip
"""Frames, points, prior, and measured peak memory in bytes: the first three in jobs, the others in the solver."""


@pytest.mark.parametrize(("frames", "points", "prior", "peak"), MEMORY)
def test_the_memory_estimate_is_within_a_factor_of_two_of_measurements(
    frames: int, points: int, prior: str, peak: float
) -> None:
    estimate = estimated(frames, points, Options(prior=prior)).memory_bytes  # type: ignore[arg-type]
    assert peak / 2 < estimate < 2 * peak


def test_the_time_estimate_holds_for_a_hundred_million_observations() -> None:
    assert 520 / 2 < estimated(100, 1_000_000, Options()).seconds < 2 * 520


def interpretation(frames: int, points: int) -> Interpretation:
    return Interpretation(
        num_frames=frames, num_points=points, num_faces=0, hidden_fraction=0.0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="", estimate=estimated(frames, points, Options()),
    )  # fmt: skip


def test_a_job_too_large_for_every_worker_is_refused_with_a_size_that_fits() -> None:
    large = interpretation(100, 100_000)
    with pytest.raises(InvalidRequest) as caught:
        check_fits(large, Options(), [1_000_000_000, 2_000_000_000])
    error = caught.value
    assert (error.code, error.field) == ("needs_more_memory", "tracks")
    assert "2.0 GB" in error.expected
    points = int(error.hint.split("max_points=")[1].split()[0])
    check_fits(interpretation(100, points), Options(), [2_000_000_000])
    with pytest.raises(InvalidRequest):
        check_fits(interpretation(100, points + 1), Options(), [2_000_000_000])
    with pytest.raises(InvalidRequest, match="more memory"):
        check_fits(interpretation(3, 4), Options(), [50_000_000])
    check_fits(large, Options(), [])
    check_fits(large, Options(), [0])
    check_fits(large.model_copy(update={"estimate": None}), Options(), [1])


def test_inputs_include_their_cost_estimate(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    paths = generator.normal(size=(6, 40, 2)).cumsum(axis=0) + 100 * generator.normal(size=(40, 2))
    np.save(tmp_path / "t.npy", paths)
    found = read_inputs(tracks=tmp_path / "t.npy", mesh=None, ground_truth=None, rotations=None, options=Options())
    assert found.interpretation.estimate == estimated(6, 40, Options())


def test_memory_for_a_job_is_its_limit_or_its_share_of_the_machine(tmp_path: Path) -> None:
    group = tmp_path / "memory.max"
    group.write_text("max\n")
    physical = memory_for_a_job(Settings(), groups=[group])
    assert physical == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    group.write_text("3000000000\n")
    assert memory_for_a_job(Settings(), groups=[group]) == 3_000_000_000
    assert memory_for_a_job(Settings(workers=3), groups=[group]) == 1_000_000_000
    (around := tmp_path / "around.max").write_text("2000000000\n")
    assert memory_for_a_job(Settings(), groups=[group, around]) == 2_000_000_000
    assert memory_for_a_job(Settings(memory_limit=2 << 30), groups=[group]) == (2 << 30) - UNUSED
    assert memory_for_a_job(Settings(), groups=[tmp_path / "none"]) == physical


def test_workers_that_do_not_fit_into_the_memory_are_refused(tmp_path: Path) -> None:
    group = tmp_path / "memory.max"
    group.write_text(f"{3 * IDLE_WORKER}\n")
    check_workers(Settings(workers=3), groups=[group])
    with pytest.raises(InvalidSetting, match=r"PLIANT_WORKERS: expected at most 3, .* 0\.2 GB .*, got 4\. Lower it"):
        check_workers(Settings(workers=4), groups=[group])
    group.write_text("1000\n")
    check_workers(Settings(workers=1), groups=[group])


@pytest.fixture
def jobs(settings: Settings) -> Jobs:
    return Jobs.open(settings)


def alive(jobs: Jobs, name: str, memory: int) -> None:
    from pliant.worker.store.connection import connect

    client = connect(jobs.settings.redis, decode=True)
    client.sadd(f"rq:workers:{jobs.settings.queue}", f"rq:worker:{name}")
    client.hset(f"rq:worker:{name}", "state", "busy")  # the clean-up removes names without a record
    client.set(alive_key(jobs.settings.queue, name), f"1 {memory}", ex=60)
    client.close()


def test_a_submission_is_checked_against_the_running_workers(jobs: Jobs, inputs_file: Path) -> None:
    large, submission = interpretation(100, 100_000), Submission(options=Options())
    assert jobs.queue.memories() == {}
    jobs.submit(inputs_file, submission, interpretation=large)
    alive(jobs, "unknown", 0)
    alive(jobs, "small", 500_000_000)
    assert jobs.queue.memories() == {"unknown": 0, "small": 500_000_000}
    with pytest.raises(InvalidRequest, match=r"0\.5 GB"):
        jobs.submit(inputs_file, submission, interpretation=large)
    assert jobs.count(list(Status)) == 1
    alive(jobs, "large", 64_000_000_000)
    jobs.submit(inputs_file, submission, interpretation=large)


@pytest.mark.slow
def test_a_worker_puts_back_a_job_that_is_too_large_for_it(settings: Settings, inputs_files: tuple[Path, Path]) -> None:
    """A larger worker is registered but does not run, so the job stays queued."""
    small = replace(settings, memory_limit=UNUSED + (1 << 30), threads=1)
    with House(small, inputs=inputs_files) as house:
        alive(house.jobs, "large", 1 << 60)
        big = interpretation(100, 1_000_000)
        submission = Submission(options=Options(max_reweightings=2))
        id = house.jobs.submit(house.short_inputs, submission, interpretation=big)[0].id
        other = house.submit()
        assert house.final(other).status is Status.SUCCEEDED
        assert house.jobs.get(id).status is Status.QUEUED
        assert (
            house.jobs.queue.waiting() == [house.jobs.records.get(id).attempt_id] or house.jobs.queue.place(id) is None
        )
        house.jobs.cancel(id)
