"""The tracker's warnings about a film, which the result of its tracks repeats."""

from __future__ import annotations

from pliant.worker.formats.errors import damaged
from pliant.worker.formats.point_names import decoded, one_line
from pliant.worker.formats.records import Arrays

ARRAY = "warnings"

MAX_WARNINGS, MAX_LENGTH = 100, 1000
"""Maximum number of warnings, and of characters of one; the tracker gives at most about ten."""


def read_warnings(arrays: Arrays, *, field: str) -> tuple[str, ...]:
    """Return the warnings among the arrays of `pliant track`, each on one line; none without them.

    Raises
    ------
    InvalidInput
        Code damaged_file: not a list of at most `MAX_WARNINGS` texts of at most `MAX_LENGTH` characters.
    """
    given = arrays.get(ARRAY)
    if given is None:
        return ()
    if given.dtype.kind != "U" or given.ndim != 1 or len(given) > MAX_WARNINGS or given.itemsize > 4 * MAX_LENGTH:
        raise damaged(field, f"{ARRAY} of shape {given.shape} and type {given.dtype}")
    return tuple(one_line(each) for each in decoded(given, f"{field}.{ARRAY}"))
