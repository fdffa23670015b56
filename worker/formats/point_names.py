"""Names of points, as pose trackers export them: body parts, nodes of a skeleton, landmarks.

Between processes and in stored inputs, names are one array of bytes: UTF-8, one name per line.
"""

from __future__ import annotations

import sys
import unicodedata
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged

ARRAY = "point_names"

MAX_POINT_NAME = 100
"""Maximum characters of a name; longer names are truncated."""

LISTED_NAMES = 4
"""Number of names that a note lists."""

POSE = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer", "left_ear", "right_ear",
    "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_pinky",
    "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee",
    "left_ankle", "right_ankle", "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
_FINGERS = ("index_finger", "middle_finger", "ring_finger", "pinky")
HAND = (
    "wrist", "thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip",
    *(f"{finger}_{joint}" for finger in _FINGERS for joint in ("mcp", "pip", "dip", "tip")),
)  # fmt: skip
FACE, IRISES = (tuple(f"face_{index}" for index in range(count)) for count in (468, 478))
"""Vertices of MediaPipe's face mesh, without and with irises. Its documentation gives only their numbers, and groups such as the lips."""

MEDIAPIPE = {len(names): names for names in (POSE, HAND, FACE, IRISES)}
"""Names of MediaPipe's landmarks by their number, from its documentation, since exports have none. The 543 landmarks of the holistic model
have no documented order and therefore no names."""


def one_line(text: str) -> str:
    """Return a text on one line: characters that cannot be printed become spaces, and runs of spaces become one."""
    return " ".join("".join(sign if sign.isprintable() else " " for sign in text).split())


def names_array(names: Sequence[str]) -> dict[str, NDArray[np.generic]]:
    """Return the names in a file as a named array; nothing if every name is blank or a number."""
    lines = [_clean(name) for name in names]
    return {} if all(line == "" or line.isdecimal() for line in lines) else {ARRAY: pack(lines)}


def pack(names: Sequence[str]) -> NDArray[np.uint8]:
    """Return names, each on one line, as an array of bytes."""
    return np.frombuffer("\n".join(names).encode(), dtype=np.uint8)


def stated(array: NDArray[np.generic], count: int) -> tuple[str, ...]:
    """Return the names in a NumPy array of strings, each on one line.

    Raises
    ------
    InvalidInput
        Codes wrong_shape, damaged_file: not one name for each of `count` points, or strings that are not Unicode.
    """
    field = f"tracks.{ARRAY}"
    if array.shape != (count,):
        raise InvalidInput(
            "wrong_shape", field=field, expected=f"({count},), one name for each point", got=str(array.shape),
            hint="Give as many names as the tracks have points, or leave them out.",
        )  # fmt: skip
    return tuple(_clean(each) for each in decoded(array, field))


def decoded(array: NDArray[np.generic], field: str) -> list[str]:
    """Return a one-dimensional NumPy array of strings as a list.

    Raises
    ------
    InvalidInput
        Code damaged_file: strings that are not Unicode.
    """
    if array.dtype.kind == "U" and (np.ascontiguousarray(array).view(np.uint32) > sys.maxunicode).any():
        raise damaged(field, "texts that are not Unicode")
    return [each.decode("utf-8", "replace") if isinstance(each, bytes) else each for each in array.tolist()]


def unpack(array: NDArray[np.generic] | None, count: int) -> tuple[str, ...] | None:
    """Return the names in a packed array; None if there is none, or if it does not hold `count` names."""
    if array is None or array.dtype != np.uint8:
        return None
    names = tuple(_clean(line) for line in array.tobytes().decode("utf-8", "replace").split("\n"))
    return names if len(names) == count else None


def note(names: Sequence[str]) -> str:
    """Return a sentence that lists the first names."""
    more = ", …" if len(names) > LISTED_NAMES else ""
    return f"The file names its {len(names)} points: {', '.join(names[:LISTED_NAMES])}{more}."


def _clean(name: str) -> str:
    whole = unicodedata.normalize("NFC", name.encode("utf-8", "replace").decode())
    return one_line(whole)[:MAX_POINT_NAME].strip()
