"""A blocking wrapper for asynchronous objects, so that one test covers both kinds of client."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Iterator
from functools import partial
from typing import Any


class Blocking:
    """Runs calls on its own event loop; asynchronous results are wrapped as well."""

    def __init__(self, target: Any, runner: asyncio.Runner, wrapped: tuple[type, ...]) -> None:
        self._target, self._runner, self._wrapped = target, runner, wrapped

    def __repr__(self) -> str:
        return repr(self._target)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._target, name)
        return partial(self._call, value) if inspect.ismethod(value) else self._handed(value)

    def _call(self, method: Any, *given: Any, **named: Any) -> Any:
        value = method(*given, **named)
        if inspect.isasyncgen(value):
            return self._iterate(value)
        return self._handed(self._runner.run(_awaited(value)) if inspect.isawaitable(value) else value)

    def _iterate(self, values: AsyncIterator[Any]) -> Iterator[Any]:
        while True:
            try:
                value = self._runner.run(_awaited(anext(values)))
            except StopAsyncIteration:
                return
            yield self._handed(value)

    def _handed(self, value: Any) -> Any:
        return Blocking(value, self._runner, self._wrapped) if isinstance(value, self._wrapped) else value


async def _awaited(value: Any) -> Any:
    return await value
