"""Parser slots are shared fairly: one owner's many slow inputs do not block another owner's."""

from __future__ import annotations

import threading
from functools import partial

import anyio
import pytest
from pliant.service.spool import ParserSlots


def test_slots_go_to_the_owner_with_fewest_and_every_input_is_parsed() -> None:
    began: list[str] = []
    steps = threading.Semaphore(0)

    def parse(name: str) -> str:
        began.append(name)
        assert steps.acquire(timeout=10)
        return name

    async def everything() -> None:
        slots = ParserSlots(2)
        async with anyio.create_task_group() as group:
            for number in range(8):
                group.start_soon(slots.run, "greedy", partial(parse, f"greedy {number}"))
            await until(lambda: len(began) == 2)
            group.start_soon(slots.run, "other", partial(parse, "other"))
            await anyio.sleep(0.05)
            steps.release()
            await until(lambda: len(began) == 3)
            assert began[2] == "other"
            for _ in range(8):
                steps.release()
        assert sorted(began) == sorted(["other", *(f"greedy {number}" for number in range(8))])
        steps.release()
        assert await slots.run("other", partial(parse, "afterwards")) == "afterwards"

    anyio.run(everything)


def test_disconnects_and_failures_release_the_slot() -> None:
    go_on = threading.Event()

    async def everything() -> None:
        slots = ParserSlots(1)
        async with anyio.create_task_group() as group:
            group.start_soon(slots.run, "a", go_on.wait)
            await anyio.sleep(0.02)
            with anyio.move_on_after(0.05) as scope:
                await slots.run("b", int)
            assert scope.cancelled_caught
            go_on.set()
        with pytest.raises(ZeroDivisionError):
            await slots.run("a", lambda: 1 // 0)
        with anyio.fail_after(5):
            assert await slots.run("c", int) == 0

    anyio.run(everything)


async def until(holds) -> None:  # type: ignore[no-untyped-def]
    with anyio.fail_after(10):
        while not holds():
            await anyio.sleep(0.005)
