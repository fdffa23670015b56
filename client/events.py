"""Following a job by server-sent events: parsed as they arrive, taken up again where they broke off."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import httpx
from pliant.client.errors import UnexpectedAnswer
from pliant.client.flow import Call, Emit, Flow, Pause, Pull
from pliant.client.retry import Attempts
from pliant.client.transport import opened, pause_or_raise, record
from pliant.schemas.job import Job, Progress
from pydantic import ValidationError

MEDIA_TYPE = "text/event-stream"


@dataclass(frozen=True)
class Message:
    """One event of a stream."""

    id: str
    name: str
    """`job`: `data` is the whole record. `progress`: its progress alone."""
    data: str


class Parser:
    """Turns bytes into messages, as the HTML standard's section 9.2.6 says, however the bytes are cut."""

    def __init__(self) -> None:
        self._rest = b""
        self._id = ""
        self._name = ""
        self._data: list[str] = []

    def feed(self, chunk: bytes) -> Iterator[Message]:
        """Take the next bytes and give the messages that are now complete."""
        buffer = self._rest + chunk
        held = b"\r" if buffer.endswith(b"\r") else b""  # its "\n" may be in the next chunk
        lines = buffer[: len(buffer) - len(held)].replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
        self._rest = lines.pop() + held
        for line in lines:
            message = self._line(line.decode("utf-8", "replace"))
            if message is not None:
                yield message

    def _line(self, line: str) -> Message | None:
        if line == "":
            whole = Message(self._id, self._name or "message", "\n".join(self._data)) if len(self._data) > 0 else None
            self._name, self._data = "", []
            return whole
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if name == "data":
            self._data.append(value)
        elif name == "event":
            self._name = value
        elif name == "id" and "\0" not in value:
            self._id = value
        return None


@dataclass
class Seen:
    """What a follower knows so far."""

    job: Job | None = None
    last_id: str = ""

    @property
    def over(self) -> bool:
        """True if nothing more will come."""
        return self.job is not None and self.job.status.final


def events(attempts: Attempts, path: str) -> Flow[Job]:
    """Emit the job each time something about it is new; end with its final record, which is also returned.

    A stream that breaks off is opened again from the last event on (`Last-Event-ID`), as patiently as any call.
    """
    seen = Seen()
    while True:
        yield from _stream(attempts, path, seen)
        if seen.job is None or not seen.over:
            now = yield from record(attempts, Call(method="GET", path=path), Job)
            if now != seen.job:
                seen.job = now
                yield Emit(now)
        if seen.job is not None and seen.over:
            return seen.job
        attempts.remaining()
        yield Pause(attempts.policy.poll_interval)


def _stream(attempts: Attempts, path: str, seen: Seen) -> Flow[None]:
    """Follow one stream as far as it goes."""
    headers = {"Accept": MEDIA_TYPE} if seen.last_id == "" else {"Accept": MEDIA_TYPE, "Last-Event-ID": seen.last_id}
    call = Call(method="GET", path=f"{path}/events", headers=headers)
    head = yield from opened(attempts, call)
    if not head.headers.get("content-type", "").startswith(MEDIA_TYPE):
        raise UnexpectedAnswer(f"Expected {MEDIA_TYPE}, got {head.headers.get('content-type', 'no content type')}.")
    parser = Parser()
    try:
        while (chunk := (yield Pull())) != b"":
            attempts.succeeded()
            attempts.remaining()
            for message in parser.feed(chunk):
                seen.last_id = message.id or seen.last_id
                if message.name == "progress" and seen.job is None:
                    return  # the record is no longer among the events that are kept: the caller asks for it
                job = merged(seen.job, message)
                if job is not None and job != seen.job:
                    seen.job = job
                    yield Emit(job)
                if seen.over:
                    return
    except httpx.TransportError as lost:
        yield from pause_or_raise(attempts, call, lost)


def merged(job: Job | None, message: Message) -> Job | None:
    """Return the job as it is after an event; events of unknown kinds change nothing.

    Raises
    ------
    UnexpectedAnswer
        The data cannot be read.
    """
    try:
        if message.name == "job":
            return Job.model_validate_json(message.data)
        if message.name == "progress" and job is not None:
            return job.model_copy(update={"progress": Progress.model_validate_json(message.data)})
    except ValidationError as fault:
        raise UnexpectedAnswer(f"An event that cannot be read, {message.data[:200]!r}: {fault}") from fault
    return job


def told(flow: Flow[Job], tell: Callable[[Job], None]) -> Flow[Job]:
    """Run a flow, telling somebody what it emits instead of emitting it."""
    try:
        wish = next(flow)
        while True:
            if isinstance(wish, Emit):
                tell(wish.value)
                wish = flow.send(None)
                continue
            try:
                reply = yield wish
            except httpx.TransportError as lost:
                wish = flow.throw(lost)
            else:
                wish = flow.send(reply)
    except StopIteration as done:
        job: Job = done.value
        return job
    finally:
        flow.close()
