"""The object's name in the result files: the job's name, in the characters that each format allows."""

from __future__ import annotations

import re
import unicodedata

from pliant.worker.formats.point_names import one_line

DEFAULT = "shape"
"""Name of an object whose job has none, or none that a format can write."""

MAX_OBJECT_NAME = 200
"""Maximum characters of a name."""


def object_name(text: str) -> str:
    """Return a display name, for formats that allow any text (glTF).

    Names are composed (NFC), so that a file's name is the same on every system; bytes of a path that are not UTF-8 become `?`.
    """
    whole = unicodedata.normalize("NFC", text.encode("utf-8", "replace").decode())
    return one_line(whole)[:MAX_OBJECT_NAME].strip() or DEFAULT


def identifier(text: str) -> str:
    """Return an identifier for USD and Alembic: ASCII letters, digits and underscores, not starting with a digit.

    Accents are removed; each run of other characters becomes one underscore.
    """
    word = re.sub(r"[^A-Za-z0-9]+", "_", _ascii(object_name(text))).strip("_")
    return f"_{word}" if word[:1].isdigit() else word or DEFAULT


def header_line(text: str) -> str:
    """Return a name for the header of a PLY file, which is ASCII and ends at the word `end_header`."""
    return one_line(_ascii(object_name(text)).replace("end_header", "end header")) or DEFAULT


def word(text: str) -> str:
    """Return a name as one word of letters and digits of any script, `_`, `-` and `.`, for OBJ."""
    return re.sub(r"[^\w.-]+", "_", object_name(text)).strip("_") or DEFAULT


def _ascii(text: str) -> str:
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
