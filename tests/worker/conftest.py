"""Real stores for the worker's tests: one embedded Valkey for the session, a fresh key prefix for each test."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest
from pliant.schemas.job import Interpretation, Job
from pliant.schemas.options import Options
from pliant.worker.formats import Limits
from pliant.worker.formats.reading import containers
from pliant.worker.formats.reading.parsers import PARSERS
from pliant.worker.formats.records import Arrays
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.connection import connect
from pliant.worker.store.memory import MemoryQueue, MemoryRecords
from pliant.worker.store.queue import RedisQueue
from pliant.worker.store.redis import RedisRecords
from worker_house import make_inputs, make_long_inputs


@pytest.fixture(scope="session")
def valkey_data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    data = tmp_path_factory.mktemp("valkey")
    valkey = Valkey.claim(data)
    server = valkey.start()
    yield data
    server.terminate()
    server.wait(10)
    valkey.release()


@pytest.fixture
def settings(valkey_data: Path, tmp_path: Path) -> Settings:
    """Settings on the session's Valkey, with separate blobs and keys for each test."""
    return Settings(
        data=tmp_path, redis_url=Settings(data=valkey_data).redis, queue=f"test-{secrets.token_hex(4)}", lost_after=2.0
    )


@pytest.fixture(params=["redis", "memory"])
def jobs(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Jobs]:
    """The job operations, on the real stores and on their in-memory doubles."""
    if request.param == "memory":
        yield Jobs(
            records=MemoryRecords(),
            blobs=Blobs.open("memory:///"),
            queue=MemoryQueue(),
            settings=Settings(data=tmp_path),
        )
        return
    settings: Settings = request.getfixturevalue("settings")
    text, raw = connect(settings.redis, decode=True), connect(settings.redis, decode=False)
    yield Jobs(
        records=RedisRecords(text, prefix=settings.queue),
        blobs=Blobs.open(settings.blobs),
        queue=RedisQueue(raw, name=settings.queue),
        settings=settings,
    )
    text.close()
    raw.close()


@pytest.fixture
def interpretation() -> Interpretation:
    return Interpretation(
        num_frames=4,
        num_points=5,
        num_faces=0,
        hidden_fraction=0.0,
        mesh_source="none",
        has_ground_truth=False,
        has_rotations=False,
        layout="tracks (F, P, 2)",
    )


@pytest.fixture
def inputs_file(tmp_path: Path) -> Path:
    path = tmp_path / "some-inputs.npz"
    path.write_bytes(b"x" * 3_000_000)
    return path


@pytest.fixture
def options() -> Options:
    return Options()


@pytest.fixture
def submit(jobs: Jobs, inputs_file: Path, options: Options, interpretation: Interpretation):  # type: ignore[no-untyped-def]
    def call(door: Jobs = jobs, **more: object) -> Job:
        submission = Submission(options=options, **more)  # type: ignore[arg-type]
        return door.submit(inputs_file, submission, interpretation=interpretation)[0]

    return call


@pytest.fixture(scope="session")
def inputs_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Canonical inputs of a short job, and of a long one that the tests have to stop."""
    folder = tmp_path_factory.mktemp("inputs")
    make_inputs(folder / "short.npz", frames=6, points=40)
    make_long_inputs(folder / "long.npz")
    return folder / "short.npz", folder / "long.npz"


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse in this process, to save the half second that a child takes to start; formats/test_containers.py starts one."""

    def parse_here(parser: str, path: Path, *, field: str, limits: Limits) -> Arrays:
        with path.open("rb") as stream:
            return PARSERS[parser](stream, field=field, limits=limits)

    monkeypatch.setattr(containers, "parse_in_sandbox", parse_here)
