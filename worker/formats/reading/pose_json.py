"""MediaPipe landmarks as JSON: a list of frames, each with the landmarks of one object.

MediaPipe has no file format of its own; this reads the output of `MessageToDict`, the Tasks API and the JavaScript solutions, if each
frame's result is appended to a list. A frame is a list of landmarks, an object that holds one (`landmarks`, `pose_landmarks`,
`poseLandmarks`, `faceLandmarks`, …), or null or empty if nothing was detected. Of several detected objects, the first is read.
"""

from __future__ import annotations

import json
from typing import IO, Any

import numpy as np
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import too_large
from pliant.worker.formats.point_names import MEDIAPIPE, names_array
from pliant.worker.formats.records import Arrays, Limits

MOST_BYTES = 64 << 20
"""Maximum bytes of a file; Python's objects take about ten times as many."""

CONFIDENCE = ("visibility", "presence", "score")

EXAMPLE = (
    'Write it as [[{"x": 0.51, "y": 0.32, "z": -0.1, "visibility": 0.99}, …], …], a list of landmarks for each frame.'
)


def read_landmarks(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Return the landmarks as `mediapipe (F, P, 2)`, NaN where nothing was detected, `likelihood (F, P)`, and `point_names` if known.

    Raises
    ------
    InvalidInput
        Codes too_large, damaged_file, unreadable_table.
    """
    most = min(limits.max_bytes, MOST_BYTES)
    text = stream.read(most + 1)
    if len(text) > most:
        raise too_large(field, expected=f"at most {most:,} bytes of JSON", got="more")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidInput(
            "damaged_file", field=field, expected="valid JSON", got=f"a file in which {_fault(error)}",
            hint="Write it with json.dump or JSON.stringify.",
        ) from error  # fmt: skip
    frames = [_landmarks(frame) for frame in _frames(document, field)]
    counts = {len(frame) for frame in frames if frame is not None and len(frame) > 0}
    for number, frame in enumerate(frames):
        if frame is None:
            raise _unreadable(field, f"no landmarks in frame {number}")
    if len(counts) != 1:
        got = (
            "frames with " + " and ".join(str(count) for count in sorted(counts)) + " landmarks"
            if counts
            else "no landmark in any frame"
        )
        raise _unreadable(field, got)
    shape = len(frames), counts.pop()
    if shape[0] * shape[1] * 24 > limits.max_bytes:
        raise too_large(field, expected=f"at most {limits.max_bytes:,} bytes as arrays", got="more")
    points, sure = np.full((*shape, 2), np.nan), np.zeros(shape)
    for number, frame in enumerate(frames):
        for place, landmark in enumerate(frame or ()):
            values = _values(landmark)
            if values is None:
                raise _unreadable(field, f"landmark {place} of frame {number}: {json.dumps(landmark)[:80]}")
            points[number, place], sure[number, place] = values[:2], values[2]
    return {"mediapipe": points, "likelihood": sure, **names_array(_names(next(frame for frame in frames if frame)))}


def _names(landmarks: list[Any]) -> list[str]:
    """Return the names of a frame's landmarks: their member `name`, or the names of MediaPipe's model with this number of landmarks."""
    given = [landmark.get("name") for landmark in landmarks]
    named = [name for name in given if isinstance(name, str)]
    return named if len(named) == len(given) else list(MEDIAPIPE.get(len(given), ()))


def _frames(document: Any, field: str) -> list[Any]:
    """Return the list of frames: the document itself, or the only list in it."""
    if isinstance(document, dict):
        lists = [value for value in document.values() if isinstance(value, list)]
        document = (
            document["frames"] if isinstance(document.get("frames"), list) else lists[0] if len(lists) == 1 else None
        )
    if not isinstance(document, list):
        raise _unreadable(field, "JSON without one list of frames")
    return document


def _landmarks(frame: Any) -> list[Any] | None:
    """Return the landmarks of a frame, empty if nothing was detected; None if there is no list of landmarks."""
    if frame is None:
        return []
    if isinstance(frame, dict):
        named = [
            value
            for name, value in frame.items()
            if name.lower().replace("_", "").endswith(("landmarks", "landmark", "keypoints"))
            and "world" not in name.lower()  # world landmarks are in metres instead of picture coordinates
        ]
        if not named:
            return None
        return _landmarks(named[0])
    if not isinstance(frame, list):
        return None
    return _landmarks(frame[0]) if frame and isinstance(frame[0], list) else frame


def _values(landmark: Any) -> tuple[float, float, float] | None:
    """Return x, y and the confidence of a landmark; None if it has no x or y."""
    if not isinstance(landmark, dict):
        return None
    numbers = [
        landmark.get("x"),
        landmark.get("y"),
        next((landmark[name] for name in CONFIDENCE if name in landmark), 1.0),
    ]
    given = [value for value in numbers if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(given) < len(numbers):
        return None
    try:
        x, y, sure = (float(value) for value in given)
    except OverflowError:
        return None
    return x, y, sure


def _fault(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"line {error.lineno}, column {error.colno} is not: {error.msg}"
    return "lists are nested too deeply" if isinstance(error, RecursionError) else "the text is not UTF-8"


def _unreadable(field: str, got: str) -> InvalidInput:
    return InvalidInput(
        "unreadable_table", field=field, expected="MediaPipe landmarks: a list of frames, each with landmarks x, y and visibility",
        got=got, hint=EXAMPLE,
    )  # fmt: skip
