"""How the double reads a submission: the canonical forms only."""

from __future__ import annotations

import io
import json
import zipfile
from email.message import Message
from email.parser import BytesParser
from typing import cast

import httpx
import numpy as np
from numpy.typing import NDArray
from pliant.client.testing.refusal import Refusal as Refusal
from pliant.client.testing.uploads import Uploads
from pliant.schemas.options import Options
from pydantic import ValidationError


def multipart(request: httpx.Request) -> tuple[dict[str, str], dict[str, bytes]]:
    """Split a multipart body into its text fields and its files."""
    header = b"Content-Type: " + request.headers.get("content-type", "").encode() + b"\r\n\r\n"
    fields, files = {}, {}
    message = BytesParser().parsebytes(header + request.content)
    if not message.is_multipart():
        raise Refusal(415, "not_multipart", "Expected multipart/form-data. Send the inputs as its parts.")
    for part in cast(list[Message], message.get_payload()):
        name = str(part.get_param("name", header="content-disposition"))
        data = cast(bytes, part.get_payload(decode=True))
        if part.get_filename() is None:
            fields[name] = data.decode()
        else:
            files[name] = data
    return fields, files


def inputs_of(request: httpx.Request, uploads: Uploads) -> tuple[dict[str, str], dict[str, bytes]]:
    """Return the text fields and the files of a submission, uploads that it names included; there are tracks among them."""
    fields, files = multipart(request)
    for part in ("tracks", "mesh", "ground_truth", "rotations"):
        if f"{part}_upload" in fields:
            files[part] = uploads.take(fields.pop(f"{part}_upload"), f"{part}_upload")
    if "tracks" not in files:
        raise Refusal(422, "missing_part", "tracks: expected a file, got none. Send one.", field="tracks")
    return fields, files


def options_of(text: str) -> Options:
    """Read the options part."""
    try:
        return Options.model_validate(json.loads(text))
    except ValueError as fault:
        first = fault.errors()[0]["loc"] if isinstance(fault, ValidationError) else ()
        name = ".".join(["options", *map(str, first)])
        raise Refusal(422, "invalid_option", f"{name}: {fault}. See /v1/options.", field=name) from fault


def tracks_of(data: bytes) -> NDArray[np.float64]:
    """Read canonical tracks: npz with `tracks` (F, P, 2)."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as held:
            points: NDArray[np.float64] = held["tracks"].astype(np.float64)
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, AttributeError) as fault:
        raise _wrong("unreadable", "an npz file with the array tracks", str(fault)) from fault
    if points.ndim != 3 or points.shape[2] != 2:
        raise _wrong("wrong_shape", "(frames, points, 2)", str(points.shape))
    if len(points) < 3:
        raise _wrong("too_few_frames", "at least 3 frames", str(len(points)))
    if not np.isfinite(points).any():
        raise _wrong("nothing_visible", "at least one finite, visible observation", "none")
    return points


def _wrong(code: str, expected: str, got: str) -> Refusal:
    detail = f"tracks: expected {expected}, got {got}. Check the file that was sent."
    return Refusal(422, code, detail, field="tracks", expected=expected, got=got, hint="Check the file that was sent.")
