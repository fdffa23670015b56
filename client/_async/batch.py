"""Many inputs: a limited number of jobs is submitted ahead, and results are returned in the order of the inputs."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pliant.client._async.job import AsyncRemoteJob, AsyncResult
from pliant.client.errors import BadArgument, PliantError
from pliant.client.input_files import Source, job_name

if TYPE_CHECKING:
    from pliant.client._async.client import AsyncClient

OnFailure = Callable[[int, PliantError], None]
"""Called with the index of an input that has no result, and the error."""


async def mapped(
    client: AsyncClient,
    inputs: Iterable[Source | Mapping[str, Any]],
    *,
    at_once: int,
    key: str | None,
    on_failure: OnFailure | None,
    load: bool,
    timeout: float | None,
    submission: Mapping[str, Any],
) -> AsyncGenerator[AsyncResult, None]:
    """Submit inputs and yield their results: see `AsyncClient.map`."""
    if at_once < 1:
        raise BadArgument(f"at_once: expected at least 1 job, got {at_once}.")
    if isinstance(inputs, (str, bytes, Path, Mapping)) or getattr(inputs, "ndim", 4) < 4:
        raise BadArgument(
            f"inputs: expected a list of inputs, got one ({type(inputs).__name__}). Put it into a list, or use submit."
        )
    ahead: deque[tuple[int, AsyncRemoteJob]] = deque()

    async def finished() -> AsyncResult | None:
        number, job = ahead.popleft()
        try:
            return await job.wait(load=load, timeout=timeout)
        except PliantError as error:
            if on_failure is None:
                raise
            on_failure(number, error)
            return None

    for number, each in enumerate(inputs):
        given = {"name": named(each), **submission}
        if key is not None:
            given["idempotency_key"] = f"{key}/{number}"
        try:
            ahead.append((number, await client.submit(each, **given)))
        except PliantError as error:
            if on_failure is None:
                raise
            on_failure(number, error)
        if len(ahead) >= at_once and (result := await finished()) is not None:
            yield result
    while ahead:
        if (result := await finished()) is not None:
            yield result


def named(source: object) -> str:
    """Return the label of a job: its file's name without extension, truncated to the service's limit; empty for arrays."""
    return job_name(Path(source).stem) if isinstance(source, (str, Path)) else ""
