"""Upload locks: one request at a time writes to an upload, and the newest wins.

A client that reconnects must not wait until the service notices that its old connection is dead, which can take minutes, so
the new request stops the old one.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Hashable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import anyio
from pliant.schemas.problems import ProblemCode
from pliant.service.problems import Refusal


@dataclass(frozen=True)
class _Lock:
    scope: anyio.CancelScope = field(default_factory=anyio.CancelScope)
    ended: anyio.Event = field(default_factory=anyio.Event)


class UploadLocks:
    """The locks of uploads that requests of this process write to."""

    def __init__(self) -> None:
        self._held: dict[Hashable, _Lock] = {}

    @asynccontextmanager
    async def take(self, what: Hashable) -> AsyncIterator[None]:
        """Hold the lock of `what` within the block; a request that already holds it is stopped first.

        Raises
        ------
        Refusal
            409: a newer request took the lock.
        """
        while (before := self._held.get(what)) is not None:
            before.scope.cancel()
            await before.ended.wait()
        mine = self._held[what] = _Lock()
        try:
            with mine.scope:
                yield
        finally:
            del self._held[what]
            mine.ended.set()
        if mine.scope.cancelled_caught:
            detail = "A newer request writes to the same upload. Query its offset before you continue."
            raise Refusal(ProblemCode.UPLOAD_TAKEN_OVER, detail=detail)
