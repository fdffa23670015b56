"""Waiting and slow local work, for each kind of client: `make client` replaces the asynchronous functions by the synchronous ones."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


async def async_sleep(seconds: float) -> None:
    """Wait without blocking the event loop."""
    await asyncio.sleep(seconds)


async def in_thread(function: Callable[[], T]) -> T:
    """Run slow local work, such as hashing a file, in a thread."""
    return await asyncio.to_thread(function)


def sleep(seconds: float) -> None:
    """Wait."""
    time.sleep(seconds)


def in_place(function: Callable[[], T]) -> T:
    """Run slow local work."""
    return function()
