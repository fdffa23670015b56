# Generated from client/_async/batch.py by `make client`. Edit that file instead.
"""Many inputs: a limited number of jobs is submitted ahead, and results are returned in the order of the inputs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pliant.client._sync.job import RemoteJob, Result
from pliant.client.errors import BadArgument, PliantError
from pliant.client.input_files import Source, job_name

if TYPE_CHECKING:
    from pliant.client._sync.client import Client

OnFailure = Callable[[int, PliantError], None]
"""Called with the index of an input that has no result, and the error."""


def mapped(
    client: Client,
    inputs: Iterable[Source | Mapping[str, Any]],
    *,
    at_once: int,
    key: str | None,
    on_failure: OnFailure | None,
    load: bool,
    timeout: float | None,
    submission: Mapping[str, Any],
) -> Generator[Result, None, None]:
    """Submit inputs and yield their results: see `Client.map`."""
    if at_once < 1:
        raise BadArgument(f"at_once: expected at least 1 job, got {at_once}.")
    if isinstance(inputs, (str, bytes, Path, Mapping)) or getattr(inputs, "ndim", 4) < 4:
        raise BadArgument(
            f"inputs: expected a list of inputs, got one ({type(inputs).__name__}). Put it into a list, or use submit."
        )
    ahead: deque[tuple[int, RemoteJob]] = deque()

    def finished() -> Result | None:
        number, job = ahead.popleft()
        try:
            return job.wait(load=load, timeout=timeout)
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
            ahead.append((number, client.submit(each, **given)))
        except PliantError as error:
            if on_failure is None:
                raise
            on_failure(number, error)
        if len(ahead) >= at_once and (result := finished()) is not None:
            yield result
    while ahead:
        if (result := finished()) is not None:
            yield result


def named(source: object) -> str:
    """Return the label of a job: its file's name without extension, truncated to the service's limit; empty for arrays."""
    return job_name(Path(source).stem) if isinstance(source, (str, Path)) else ""
