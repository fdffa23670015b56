"""One request at a time may write to a thing, and it is the latest.

A client that comes back after its connection broke must not wait until the service notices that the old one is dead, which can
take minutes: the newcomer stops it.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Hashable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import anyio
from pliant.service.problems import Refusal


@dataclass(frozen=True)
class _Turn:
    scope: anyio.CancelScope = field(default_factory=anyio.CancelScope)
    ended: anyio.Event = field(default_factory=anyio.Event)


class Turns:
    """Who writes to what in this process."""

    def __init__(self) -> None:
        self._held: dict[Hashable, _Turn] = {}

    @asynccontextmanager
    async def take(self, what: Hashable) -> AsyncIterator[None]:
        """Hold `what` within the block; whoever held it is stopped first.

        Raises
        ------
        Refusal
            409: another request took it over.
        """
        while (before := self._held.get(what)) is not None:
            before.scope.cancel()
            await before.ended.wait()
        mine = self._held[what] = _Turn()
        try:
            with mine.scope:
                yield
        finally:
            del self._held[what]
            mine.ended.set()
        if mine.scope.cancelled_caught:
            detail = "Another request writes to the same upload. Ask for its offset before you go on."
            raise Refusal(409, "upload_taken_over", detail=detail)
