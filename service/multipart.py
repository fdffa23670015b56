"""Receive a multipart form: file parts are streamed to disk with a size limit and a SHA-256, never held in memory.

FastAPI's `UploadFile` reads the whole body into a temporary file before the route is entered, and the route copies it again.
Here a thread parses the body in batches as it arrives, so a 300 MB part is written once and takes a few hundred kilobytes of memory.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from anyio import to_thread
from pliant.schemas.option_faults import shown
from pliant.schemas.problems import ProblemCode
from pliant.service.problems import Refusal, wrong_input
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect, Request

LONGEST_FILE_NAME = 200
"""Maximum length of a file's name, characters, the same as for a job's name; longer names are truncated."""

BATCH = 2**18
"""Bytes gathered before a thread parses and writes them; the switch costs about 50 µs, which would dominate smaller batches."""
_SUFFIX = re.compile(r"\.[a-z0-9]{1,8}")


@dataclass(frozen=True)
class FormRules:
    """The parts that a form may have.

    Attributes
    ----------
    files : frozenset of str
        Parts that are written to disk if they have a file name.
    texts : frozenset of str
        Parts that may be text; a part that is also in `files` is text if it has no file name.
    max_body_bytes : int
        Limit on the complete body.
    max_text_bytes : int
        Limit on one text.
    stall_seconds : float
        Seconds without a byte after which the request is refused.
    hint : callable
        Returns what to do about a part of an unknown name.
    """

    files: frozenset[str]
    texts: frozenset[str]
    max_body_bytes: int
    max_text_bytes: int
    stall_seconds: float = 60.0
    hint: Callable[[str], str] = lambda _: "Leave it out."


@dataclass(frozen=True)
class File:
    """A part on disk."""

    path: Path
    bytes: int
    sha256: str
    name: str = ""
    """File name that the client sent, without its folder; empty if there is none."""


@dataclass(frozen=True)
class Form:
    """A received form: files by part name, texts by part name."""

    files: Mapping[str, File]
    texts: Mapping[str, str]

    @property
    def fingerprint(self) -> str:
        """SHA-256 over every part's name and content, independent of the order of the parts."""
        parts = {name: ["file", file.sha256] for name, file in self.files.items()}
        parts |= {name: ["text", text] for name, text in self.texts.items()}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


async def receive_form(request: Request, folder: Path, *, rules: FormRules) -> Form:
    """Receive a multipart form into an empty folder, which the caller removes.

    Raises
    ------
    Refusal
        415: not a multipart form; 400: malformed or incomplete; 413: too large; 408: stalled; 422: unknown, repeated or invalid part.
    """
    kind, parameters = parse_options_header(request.headers.get("content-type"))
    if kind != b"multipart/form-data":
        raise Refusal(
            ProblemCode.UNSUPPORTED_MEDIA_TYPE,
            detail="The body must be a form: send multipart/form-data with a part `tracks`. An example is at /docs.",
            field="Content-Type",
            expected="multipart/form-data",
            got=kind.decode("latin-1") or "nothing",
        )
    if not parameters.get(b"boundary"):
        raise _malformed("the Content-Type names no boundary")
    try:
        reader = _Reader(parameters[b"boundary"], folder, rules)
    except FormParserError as error:
        raise _malformed(str(error)) from error
    try:
        async for batch in batches(request, max_bytes=rules.max_body_bytes, stall_seconds=rules.stall_seconds):
            await to_thread.run_sync(reader.feed, batch)
        return reader.finish()
    finally:
        reader.close()


async def batches(request: Request, *, max_bytes: int, stall_seconds: float) -> AsyncIterator[bytes]:
    """Yield the unread body in pieces of about `BATCH` bytes.

    Raises
    ------
    Refusal
        415: the body is encoded; 413: the declared or actual size exceeds `max_bytes`; 408: no byte arrives for `stall_seconds`.
    ClientDisconnect
        The body is incomplete. Then, and before a 408, the bytes that have arrived are yielded first.
    """
    coding = request.headers.get("content-encoding", "").strip().lower()
    if coding not in ("", "identity"):  # an inflated body could be far larger than any limit
        raise wrong_input(
            ProblemCode.UNSUPPORTED_MEDIA_TYPE, field="Content-Encoding", expected="a body that is not compressed", got=coding[:80],
            hint="Send it as it is; npz files and films are compressed already.", headers={"Accept-Encoding": "identity"},
        )  # fmt: skip
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > max_bytes:
        raise _too_large(max_bytes, f"{declared} bytes declared")
    stream = request.stream()
    gathered: list[bytes] = []
    held = total = 0
    while True:
        try:
            async with asyncio.timeout(stall_seconds):
                piece = await anext(stream, None)
        except (TimeoutError, ClientDisconnect) as error:
            if gathered:  # uploads keep the bytes that have arrived
                yield b"".join(gathered)
            if isinstance(error, ClientDisconnect):
                raise
            detail = f"No byte of the body arrived for {stall_seconds:g} s. Send the request again."
            raise Refusal(ProblemCode.BODY_STALLED, detail=detail) from None
        if piece is None:
            break
        total += len(piece)
        if total > max_bytes:
            raise _too_large(max_bytes, "more")
        gathered.append(piece)
        held += len(piece)
        if held >= BATCH:
            yield b"".join(gathered)
            gathered, held = [], 0
    if gathered:
        yield b"".join(gathered)


@dataclass
class _Part:
    """The part being read: its headers so far, then either a file or a growing text."""

    header_name: bytearray = field(default_factory=bytearray)
    header_value: bytearray = field(default_factory=bytearray)
    disposition: bytes = b""
    name: str = ""
    file_name: str = ""
    path: Path | None = None
    sink: BinaryIO | None = None
    text: bytearray = field(default_factory=bytearray)
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)
    size: int = 0


class _Reader:
    """Parses a form piece by piece. Belongs to one request; `feed` is called from one thread at a time."""

    def __init__(self, boundary: bytes, folder: Path, rules: FormRules) -> None:
        self._folder, self._rules = folder, rules
        self._files: dict[str, File] = {}
        self._texts: dict[str, str] = {}
        self._part = _Part()
        self._ended = False
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin,
                "on_header_field": lambda data, start, end: self._part.header_name.extend(data[start:end]),
                "on_header_value": lambda data, start, end: self._part.header_value.extend(data[start:end]),
                "on_header_end": self._header,
                "on_headers_finished": self._open,
                "on_part_data": self._data,
                "on_part_end": self._end,
                "on_end": self._all,
            },
        )

    def feed(self, piece: bytes) -> None:
        """Parse and write a piece of the body."""
        try:
            self._parser.write(piece)
        except FormParserError as error:
            raise _malformed(str(error)) from error

    def finish(self) -> Form:
        """Return the form, after the complete body was fed."""
        if not self._ended:
            raise _malformed("it ends before its closing boundary")
        return Form(files=self._files, texts=self._texts)

    def close(self) -> None:
        """Close the file being written, if any."""
        if self._part.sink is not None:
            self._part.sink.close()

    def _begin(self) -> None:
        self._part = _Part()

    def _header(self) -> None:
        part = self._part
        if part.header_name.lower() == b"content-disposition":
            part.disposition = bytes(part.header_value)
        part.header_name.clear()
        part.header_value.clear()

    def _open(self) -> None:
        part, rules = self._part, self._rules
        kind, options = parse_options_header(part.disposition)
        part.name = options.get(b"name", b"").decode("utf-8", "replace")
        if kind != b"form-data" or not part.name:
            raise _malformed("a part has no Content-Disposition: form-data with a name")
        known = rules.files | rules.texts
        if part.name not in known:
            expected = "one of " + ", ".join(sorted(known))
            raise wrong_input(
                ProblemCode.UNKNOWN_PART,
                field=part.name[:80],
                expected=expected,
                got=shown(part.name),
                hint=rules.hint(part.name),
            )
        if part.name in self._files or part.name in self._texts:
            code = ProblemCode.REPEATED_PART
            raise wrong_input(code, field=part.name, expected="the part once", got="it twice", hint="Send it once.")
        # A part that can only be text is text even if the client gave it a file name, as several HTTP libraries do.
        if part.name in rules.files and b"filename" in options:
            part.file_name = own_name(options[b"filename"].decode("utf-8", "replace"))
            suffix = Path(part.file_name).suffix.lower()
            part.path = self._folder / f"{part.name}{suffix if _SUFFIX.fullmatch(suffix) else ''}"
            part.sink = part.path.open("xb")
        elif part.name not in rules.texts:
            raise wrong_input(
                ProblemCode.NOT_A_FILE,
                field=part.name,
                expected="a file",
                got="text",
                hint=f"Give the part a file name, as in curl's -F {part.name}=@FILE.",
            )

    def _data(self, data: bytes, start: int, end: int) -> None:
        part = self._part
        part.size += end - start
        if part.sink is None:
            if part.size > self._rules.max_text_bytes:
                raise wrong_input(
                    ProblemCode.TEXT_TOO_LARGE,
                    field=part.name,
                    expected=f"at most {self._rules.max_text_bytes} bytes",
                    got="more",
                    hint="Shorten it.",
                )
            part.text.extend(data[start:end])
            return
        piece = memoryview(data)[start:end]
        part.sink.write(piece)
        part.digest.update(piece)

    def _end(self) -> None:
        part = self._part
        if part.sink is None:
            try:
                self._texts[part.name] = part.text.decode()
            except UnicodeDecodeError:
                hint = "Send it in UTF-8."
                code = ProblemCode.NOT_UTF8
                raise wrong_input(
                    code, field=part.name, expected="text in UTF-8", got="other bytes", hint=hint
                ) from None
            return
        part.sink.close()
        assert part.path is not None
        self._files[part.name] = File(part.path, part.size, part.digest.hexdigest(), part.file_name)
        part.sink = None

    def _all(self) -> None:
        self._ended = True


def own_name(given: str) -> str:
    """Return the last component of a client's file name, on one line and with at most `LONGEST_FILE_NAME` characters."""
    last = given.replace("\\", "/").rpartition("/")[2]
    return "".join(each if each.isprintable() else " " for each in last)[:LONGEST_FILE_NAME].strip()


def _malformed(why: str) -> Refusal:
    detail = f"The form is malformed: {why.rstrip('.')}. Let an HTTP library write the body, or compare it with /docs."
    return Refusal(ProblemCode.MALFORMED_FORM, detail=detail)


def _too_large(limit: int, got: str) -> Refusal:
    return wrong_input(
        ProblemCode.BODY_TOO_LARGE,
        field="body",
        expected=f"at most {limit} bytes",
        got=got,
        hint="Send fewer frames or points, or store float32; see /v1/limits.",
    )
