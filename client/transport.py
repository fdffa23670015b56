"""Sending a call and reading its answer, repeated as often as that is allowed and sensible."""

from __future__ import annotations

from typing import TypeVar

import httpx
from pliant.client.errors import PliantError, UnexpectedAnswer, Unreachable, error_from
from pliant.client.flow import Call, Flow, Head, Open, Pause, Pull
from pliant.client.retry import Attempts, may_repeat
from pydantic import BaseModel, ValidationError

R = TypeVar("R", bound=BaseModel)


def opened(attempts: Attempts, call: Call) -> Flow[Head]:
    """Send a call, as often as that is allowed and sensible, until an answer below 400 begins.

    Raises
    ------
    Refused, UnexpectedAnswer, Unreachable, TimeIsUp
        See `pliant.client.errors`.
    """
    while True:
        fault: Exception
        try:
            head: Head = yield Open(call, attempts.remaining())
            attempts.answered()
            if head.status < 400:
                return head
            body = yield from rest()
            fault = error_from(head.status, head.headers, body)
        except httpx.TransportError as lost:
            fault = lost
        yield from pause_or_raise(attempts, call, fault)


def pause_or_raise(attempts: Attempts, call: Call, fault: Exception) -> Flow[None]:
    """Pause before the next try, or raise what the caller shall see."""
    if may_repeat(call, fault):
        yield Pause(attempts.pause_after(fault))
        return
    attempts.remaining()
    if isinstance(fault, PliantError):
        raise fault
    raise Unreachable(
        f"{call.method} {call.path} was interrupted ({str(fault) or type(fault).__name__}) and was not sent again, because "
        "it may have been carried out. Look at the job before repeating it."
    ) from fault


def rest() -> Flow[bytes]:
    """Read the open answer to its end."""
    chunks = []
    while (chunk := (yield Pull())) != b"":
        chunks.append(chunk)
    return b"".join(chunks)


def answered(attempts: Attempts, call: Call) -> Flow[tuple[Head, bytes]]:
    """Send a call and read the whole answer; an answer that breaks off counts as none."""
    while True:
        head = yield from opened(attempts, call)
        try:
            body = yield from rest()
        except httpx.TransportError as lost:
            yield from pause_or_raise(attempts, call, lost)
            continue
        attempts.succeeded()
        return head, body


def record(attempts: Attempts, call: Call, kind: type[R]) -> Flow[R]:
    """Send a call and read its answer as a record of the wire contract."""
    head, body = yield from answered(attempts, call)
    return parse(kind, body, head)


def parse(kind: type[R], body: bytes, head: Head) -> R:
    """Read JSON as a record.

    Raises
    ------
    UnexpectedAnswer
        It is something else.
    """
    try:
        return kind.model_validate_json(body)
    except ValidationError as fault:
        raise UnexpectedAnswer(
            f"Expected a {kind.__name__} with status {head.status}, got {body[:200].decode('utf-8', 'replace')!r} "
            f"({fault.error_count()} faults). Check that the address is a Pliant service of a version near this client's."
        ) from fault
