"""Server-sent events: their parser, and their application to a job record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pliant.client.errors import UnexpectedAnswer
from pliant.schemas.job import Job, Progress
from pydantic import ValidationError

MEDIA_TYPE = "text/event-stream"


@dataclass(frozen=True)
class Message:
    """One event of a stream."""

    id: str
    name: str
    """`job`: `data` is the whole record; `progress`: `data` is its progress only."""
    data: str


class Parser:
    """Incremental parser of an event stream (HTML standard, section 9.2.6).

    The caller feeds it bytes and so sees every chunk, including comments, which lets it enforce its time limit.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._id = ""
        self._name = ""
        self._data: list[str] = []

    def feed(self, chunk: bytes) -> Iterator[Message]:
        """Take the next bytes and yield the messages that they complete."""
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
class Position:
    """The latest job record and event id of a stream."""

    job: Job | None = None
    last_id: str = ""

    @property
    def final(self) -> bool:
        """True if the job's status is final, so that no event follows."""
        return self.job is not None and self.job.status.final


def merged(job: Job | None, message: Message) -> Job | None:
    """Apply an event to a job and return the result; unknown events are ignored.

    Raises
    ------
    UnexpectedAnswer
        The event's data is invalid.
    """
    try:
        if message.name == "job":
            return Job.model_validate_json(message.data)
        if message.name == "progress" and job is not None:
            return job.model_copy(update={"progress": Progress.model_validate_json(message.data)})
    except ValidationError as fault:
        raise UnexpectedAnswer(f"The event {message.data[:200]!r} cannot be read: {fault}") from fault
    return job
