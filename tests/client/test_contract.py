"""What every Pliant service answers, asked through both clients: of the double in memory, and of the real thing."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pliant.client import (
    AsyncClient,
    Client,
    InvalidRequest,
    JobCancelled,
    NotAllowedNow,
    NotFound,
    Policy,
    Status,
)
from pliant.client.testing import FakeService

PATIENT = Policy(shortest_pause=0.01, poll_interval=0.02)


def moving_points(frames: int = 6, count: int = 16) -> np.ndarray:
    rng = np.random.default_rng(3)
    surface = rng.normal(size=(count, 3))
    angles = np.linspace(0, 1, frames)
    turns = np.stack([np.stack([np.cos(angles), 0 * angles, np.sin(angles)], 1), np.tile([0, 1.0, 0], (frames, 1))], 1)
    return 100 + 20 * np.einsum("fij,pj->fpi", turns, surface)


@pytest.fixture
def client() -> Iterator[Client]:
    with Client("http://pliant.test", transport=FakeService(), policy=PATIENT) as client:
        yield client


def test_submit_wait_shapes_is_one_line(client: Client) -> None:
    points = moving_points()
    shapes = client.submit(points).wait(timeout=60).shapes
    assert shapes.shape == (6, 16, 3)
    np.testing.assert_allclose(shapes.mean(axis=1), 0, atol=1e-9)


def test_a_result_holds_arrays_report_and_job(client: Client, tmp_path: Path) -> None:
    result = client.submit(moving_points(), name="one").wait(timeout=60, folder=tmp_path / "kept")
    np.testing.assert_allclose(
        result.rotations @ result.rotations.transpose(0, 2, 1), np.tile(np.eye(3), (6, 1, 1)), atol=1e-9
    )
    assert result.report["outcome"] in ("converged", "max_reweightings")
    assert result.job.name == "one"
    assert result.job.status is Status.SUCCEEDED
    assert result.save_glb(tmp_path / "deep" / "it.glb").read_bytes()[:4] == b"glTF"
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"shapes.npz", "report.json", "shapes.glb"}


def test_what_the_service_refuses_is_a_typed_error_with_its_sentence(client: Client) -> None:
    with pytest.raises(InvalidRequest) as caught:
        client.submit(np.zeros((2, 9, 2)))
    assert caught.value.code == "too_few_frames"
    assert caught.value.status == 422
    assert caught.value.problem.field == "tracks"
    assert str(caught.value) == caught.value.problem.detail
    assert list(client.list()) == []


def test_the_same_idempotency_key_makes_one_job(client: Client) -> None:
    points = moving_points()
    first = client.submit(points, idempotency_key="monday")
    assert client.submit(points, idempotency_key="monday").id == first.id
    assert client.submit(points).id != first.id
    with pytest.raises((NotAllowedNow, InvalidRequest)):
        client.submit(points + 1, idempotency_key="monday")


def test_a_job_may_bring_its_own_id(client: Client) -> None:
    points = moving_points()
    assert client.submit(points, job_id="take-7").id == "take-7"
    assert client.submit(points, job_id="take-7").id == "take-7"
    assert [job.id for job in client.list()] == ["take-7"]


def test_jobs_are_listed_newest_first_over_pages_and_by_status(client: Client) -> None:
    ids = [client.submit(moving_points(), name=str(i)).id for i in range(5)]
    assert [job.id for job in client.list(page_size=2)] == ids[::-1]
    client.wait(ids[2], timeout=60)
    assert ids[2] in [job.id for job in client.list(statuses=["succeeded"])]
    assert all(job.status is Status.SUCCEEDED for job in client.list(statuses=[Status.SUCCEEDED]))


def test_a_finished_job_can_be_deleted_but_not_cancelled(client: Client) -> None:
    job = client.submit(moving_points())
    job.wait(timeout=60)
    with pytest.raises(NotAllowedNow):
        job.cancel()
    job.delete()
    with pytest.raises(NotFound):
        client.get(job.id)


def test_an_unknown_job_and_an_unknown_file_are_not_found(client: Client, tmp_path: Path) -> None:
    with pytest.raises(NotFound) as caught:
        client.get("no-such-job")
    assert caught.value.code == "unknown_job"
    result = client.submit(moving_points()).wait(timeout=60)
    with pytest.raises(NotFound, match=r"nonsense\.obj.*shapes\.npz"):
        result.download(tmp_path, names=["nonsense.obj"])


def test_the_service_describes_its_options_and_limits(client: Client) -> None:
    assert client.options()["properties"]["loss"]["default"] == "l1"
    assert client.limits()["max_frames"] > 100


def test_the_asynchronous_client_does_the_same(tmp_path: Path) -> None:
    async def use() -> None:
        async with AsyncClient("http://pliant.test", transport=FakeService(), policy=PATIENT) as client:
            jobs = await asyncio.gather(*(client.submit(moving_points() + i, name=str(i)) for i in range(3)))
            results = await asyncio.gather(*(job.wait(timeout=60) for job in jobs))
            assert [result.shapes.shape for result in results] == [(6, 16, 3)] * 3
            assert {job.id async for job in client.list(page_size=2)} == {job.id for job in jobs}
            files = await results[0].download(tmp_path)
            assert (await results[1].save_glb(tmp_path / "b.glb")).is_file()
            assert files["shapes.npz"].is_file()
            assert (await jobs[2].refresh()).status is Status.SUCCEEDED
            await jobs[2].delete()
            with pytest.raises(NotFound):
                await client.get(jobs[2].id)
            assert "properties" in await client.options()
            assert "max_points" in await client.limits()

    asyncio.run(use())


def test_cancelling_a_running_job_ends_the_wait() -> None:
    with Client("http://pliant.test", transport=FakeService(looks=float("inf")), policy=PATIENT) as client:
        job = client.submit(moving_points())

        def stop(seen: object) -> None:
            if job.refresh().status is Status.RUNNING:
                job.cancel()

        with pytest.raises(JobCancelled):
            job.wait(timeout=60, on_progress=stop)
        assert job.retry().status is Status.QUEUED
