"""Many inputs in one call, on the real application in memory."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from pliant.client import AsyncClient, BadArgument, Client, InvalidRequest, PliantError
from pliant.schemas.job import LONGEST_NAME
from pliant.service.testing import InMemoryService


def inputs(count: int) -> list[np.ndarray]:
    return [np.random.default_rng(seed).normal(size=(5, 10 + seed, 2)) for seed in range(count)]


def test_results_come_in_the_order_of_the_inputs() -> None:
    with Client("http://pliant.test", transport=InMemoryService(steps=1)) as client:
        results = list(client.map(inputs(4), at_once=2, mesh="none", options={"outputs": []}))
    assert [result.shapes.shape for result in results] == [(5, 10 + seed, 3) for seed in range(4)]


def test_map_submits_at_most_at_once_jobs_ahead() -> None:
    with Client("http://pliant.test", transport=InMemoryService(steps=1)) as client:
        most = []
        for number, _ in enumerate(client.map(iter(inputs(5)), at_once=2, mesh="none", load=False)):
            most.append(len(list(client.list())) - number)
    assert max(most) == 2


def test_the_asynchronous_client_maps_too() -> None:
    async def run() -> list[tuple[int, ...]]:
        async with AsyncClient("http://pliant.test", transport=InMemoryService(steps=1)) as client:
            return [result.shapes.shape async for result in client.map(inputs(2), mesh="none")]

    assert asyncio.run(run()) == [(5, 10, 3), (5, 11, 3)]


def test_a_rejected_input_ends_the_map_or_is_reported() -> None:
    wrong = [*inputs(1), np.ones((2, 9, 2)), *inputs(1)]
    with Client("http://pliant.test", transport=InMemoryService(steps=1)) as client:
        with pytest.raises(InvalidRequest):
            list(client.map(wrong, mesh="none", load=False))
        failed: list[tuple[int, PliantError]] = []
        done = list(client.map(wrong, mesh="none", load=False, on_failure=lambda *each: failed.append(each)))
    assert len(done) == 2
    assert [number for number, _ in failed] == [1]
    assert isinstance(failed[0][1], InvalidRequest)


def test_at_least_one_job_is_submitted_ahead() -> None:
    with Client("http://pliant.test") as client, pytest.raises(BadArgument, match="at_once: expected at least 1 job"):
        list(client.map(inputs(1), at_once=0))


def test_the_same_key_returns_the_existing_jobs() -> None:
    with Client("http://pliant.test", transport=InMemoryService(steps=1)) as client:
        first = [result.job.id for result in client.map(inputs(3), key="tonight", mesh="none", load=False)]
        again = [result.job.id for result in client.map(inputs(3), key="tonight", mesh="none", load=False)]
        assert again == first
        assert len(list(client.list())) == 3


def test_jobs_are_named_after_their_files_up_to_the_length_limit(tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.npz" for name in ("face", "x" * 230)]
    for file, tracks in zip(files, inputs(2), strict=True):
        np.savez(file, tracks=tracks)
    with Client("http://pliant.test", transport=InMemoryService(steps=1)) as client:
        names = [result.job.name for result in client.map(files, mesh="none", load=False)]
    assert names == ["face", "x" * LONGEST_NAME]


@pytest.mark.parametrize("one", ["tracks.npz", Path("tracks.npz"), inputs(1)[0], {"tracks": inputs(1)[0]}])
def test_map_refuses_a_single_input(one: object) -> None:
    with (
        Client("http://pliant.test", transport=InMemoryService()) as client,
        pytest.raises(BadArgument, match="inputs: expected a list of inputs, got one"),
    ):
        list(client.map(one))  # type: ignore[arg-type]
