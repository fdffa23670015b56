"""Conditional and range requests for one file (RFC 9110, sections 13 and 14), as pure functions of the request's headers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

_ONE_RANGE = re.compile(r"\s*bytes\s*=\s*(\d{0,18})\s*-\s*(\d{0,18})\s*")
_TAG = re.compile(r'(?:W/)?"[^"]*"')


@dataclass(frozen=True)
class Slice:
    """The bytes of a file to send, `length` of them from `start` on, and the status of the response."""

    status: int
    """200: the whole file; 206: a range; 304: the client has the file; 412: the client expects another file; 416: invalid range."""
    start: int = 0
    length: int = 0


def decide(headers: Mapping[str, str], *, size: int, etag: str, ranges: bool = True) -> Slice:
    """Return status and bytes of the response to a GET with these headers; `etag` is the strong entity tag, with its quotes.

    `ranges` is False for methods that do not know ranges, such as HEAD.

    Preconditions come first (If-Match, If-None-Match), then Range if If-Range matches. A request for several ranges gets the
    whole file, as RFC 9110 §14.2 allows, because resuming a download needs only one.
    """
    if "if-match" in headers and not _matches(headers["if-match"], etag, strong=True):
        return Slice(412)
    if "if-none-match" in headers and _matches(headers["if-none-match"], etag, strong=False):
        return Slice(304)
    wanted = headers.get("range") if ranges else None
    # If-Range with a date never matches, because responses have no Last-Modified.
    if wanted is None or headers.get("if-range", etag).strip() != etag:
        return Slice(200, 0, size)
    return _of_range(wanted, size)


def _of_range(wanted: str, size: int) -> Slice:
    """Return the bytes for a Range header, which is ignored unless it is a single byte range."""
    match = _ONE_RANGE.fullmatch(wanted)
    if match is None or match.groups() == ("", ""):
        return Slice(200, 0, size)
    first, last = match.groups()
    if not first:  # the last n bytes
        start, stop = max(size - int(last), 0), size
    else:
        start, stop = int(first), min(int(last) + 1 if last else size, size)
        if last and int(last) < int(first):
            return Slice(200, 0, size)
    if start >= size or stop <= start:
        return Slice(416)
    return Slice(206, start, stop - start)


def _matches(listed: str, etag: str, *, strong: bool) -> bool:
    """Return True if an If-Match or If-None-Match list contains this entity tag."""
    if listed.strip() == "*":
        return True
    tags = _TAG.findall(listed)
    return etag in (tags if strong else [tag.removeprefix("W/") for tag in tags])
