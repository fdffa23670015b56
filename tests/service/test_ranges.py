from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pliant.service.ranges import Slice, decide

TAG = '"abc"'


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("bytes=0-0", Slice(206, 0, 1)),
        ("bytes=0-99", Slice(206, 0, 100)),
        ("bytes=0-100", Slice(206, 0, 100)),  # clipped to the end
        ("bytes=90-", Slice(206, 90, 10)),
        ("bytes=-10", Slice(206, 90, 10)),
        ("bytes=-1000", Slice(206, 0, 100)),
        ("bytes=100-", Slice(416)),
        ("bytes=100-200", Slice(416)),
        ("bytes=-0", Slice(416)),
        ("bytes=5-4", Slice(200, 0, 100)),  # not a range at all, so ignored (RFC 9110 §14.1.1)
        ("bytes=-", Slice(200, 0, 100)),
        ("bytes=0-1,5-6", Slice(200, 0, 100)),
        ("lines=0-1", Slice(200, 0, 100)),
        ("bytes=a-b", Slice(200, 0, 100)),
        ("bytes=" + "9" * 30 + "-", Slice(200, 0, 100)),
    ],
)
def test_a_range_header_selects_the_expected_bytes(wanted: str, expected: Slice) -> None:
    assert decide({"range": wanted}, size=100, etag=TAG) == expected


@given(first=st.integers(0, 120), last=st.integers(0, 120), size=st.integers(1, 100))
def test_a_range_equals_a_python_slice(first: int, last: int, size: int) -> None:
    part = decide({"range": f"bytes={first}-{last}"}, size=size, etag=TAG)
    whole = bytes(i % 251 for i in range(size))
    wanted = whole[first : last + 1]
    if last < first:
        assert part == Slice(200, 0, size)
    elif not wanted:
        assert part == Slice(416)
    else:
        assert part.status == 206
        assert whole[part.start : part.start + part.length] == wanted


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"if-none-match": TAG}, 304),
        ({"if-none-match": f'"x", W/{TAG}'}, 304),
        ({"if-none-match": "*"}, 304),
        ({"if-none-match": '"x"'}, 200),
        ({"if-match": TAG}, 200),
        ({"if-match": "*"}, 200),
        ({"if-match": f"W/{TAG}"}, 412),  # If-Match compares strongly
        ({"if-match": '"x"', "if-none-match": TAG}, 412),
        ({"range": "bytes=1-2", "if-range": TAG}, 206),
        ({"range": "bytes=1-2", "if-range": '"x"'}, 200),
        ({"range": "bytes=1-2", "if-range": "Mon, 04 May 2026 09:30:00 GMT"}, 200),
        ({"range": "bytes=1-2", "if-none-match": TAG}, 304),
    ],
)
def test_preconditions_take_precedence_over_the_range(headers: dict[str, str], status: int) -> None:
    assert decide(headers, size=10, etag=TAG).status == status


def test_a_range_of_an_empty_file_is_not_satisfiable() -> None:
    assert decide({"range": "bytes=0-"}, size=0, etag=TAG).status == 416
    assert decide({}, size=0, etag=TAG) == Slice(200, 0, 0)
