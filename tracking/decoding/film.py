"""Films as upright frames, decoded one at a time."""

from __future__ import annotations

import os
import threading
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.decoding.containers import Container, recognise
from pliant.tracking.decoding.limits import FilmLimits
from pliant.tracking.decoding.pictures import checked, folder_pictures, gif_frames, read_picture, zip_pictures
from pliant.tracking.errors import FilmError

PICTURE_RATE = 30.0
"""Frames a second that are assumed of pictures, which carry no times."""

DEMUXERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
_OPENING = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a film."""

    index: int
    """Number in the film, from 0, counting also the frames that were not selected."""

    time: float
    """Seconds from the film's start."""

    image: NDArray[np.uint8]
    """Shape `(H, W, 3)`, RGB, upright."""


@dataclass(frozen=True, slots=True)
class Film:
    """A film that can be decoded, from its start, any number of times."""

    path: Path
    container: Container
    size: tuple[int, int]
    """Width and height in pixels, upright."""

    fps: float
    """Frames a second as the file states it; 30 for pictures."""

    stated_frames: int
    """Number of frames as the file states it; may be wrong. 0 if it states none."""

    selection: tuple[int, int | None, int]
    """Start, stop and step of the frames that are used."""

    limits: FilmLimits

    def frames(self) -> Generator[Frame, None, None]:
        """Decode the selected frames in order; memory does not grow with the film.

        Raises
        ------
        FilmError
            A frame of another size than the first, a broken picture, or a film beyond its limits.
        """
        start, stop, step = self.selection
        used = 0
        with closing(self._decode(start, stop, step)) as decoded:
            for frame in decoded:
                used += 1
                self._check(frame, used)
                yield frame

    def _check(self, frame: Frame, used: int) -> None:
        if used > self.limits.frames:
            raise FilmError(
                "too_many_frames", field="film", expected=f"at most {self.limits.frames} frames",
                got="more", hint="Use fewer frames, e.g. every second one: frames='::2'.",
            )  # fmt: skip
        if frame.time > self.limits.seconds:
            raise FilmError(
                "too_long", field="film", expected=f"at most {self.limits.seconds:g} seconds",
                got="more", hint="Cut the film, or select the frames of a part: frames='0:300'.",
            )  # fmt: skip
        height, width = frame.image.shape[:2]
        if (width, height) != self.size:
            raise FilmError(
                "changing_size", field="film", expected=f"all frames of {self.size[0]}×{self.size[1]} pixels",
                got=f"{width}×{height} in frame {frame.index}", hint="Export all frames in one size.",
            )  # fmt: skip

    def _decode(self, start: int, stop: int | None, step: int) -> Generator[Frame, None, None]:
        if self.container == "gif":
            for index, (time, image) in enumerate(gif_frames(self.path, self.limits)):
                if stop is not None and index >= stop:
                    return
                if index >= start and (index - start) % step == 0:
                    yield Frame(index, time, image)
        elif self.container in ("zip", "folder"):
            listed = (zip_pictures if self.container == "zip" else folder_pictures)(self.path, self.limits)
            for index in range(len(listed))[start:stop:step]:
                name, read = listed[index]
                yield Frame(index, index / PICTURE_RATE, read_picture(read(), name, self.limits))
        else:
            yield from _decode_video(self.path, self.fps, start, stop, step)


def open_film(path: Path | str, *, frames: int | slice | str | None = None, limits: FilmLimits | None = None) -> Film:
    """Open a film after checking what it is.

    Parameters
    ----------
    path
        An mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures (PNG, JPEG, WebP,
        BMP) in natural order. Playlists and files that refer to other files or addresses are refused.
    frames
        Which frames to use: a number (at most so many, evenly spaced), a slice, or its text, e.g. "0:300:2". All by default.
    limits
        Bytes, frames, pixels and seconds.

    Raises
    ------
    FilmError
        Not a film that can be used, beyond the limits, or a selection that cannot be read.
    """
    source, limits = Path(path).absolute(), limits or FilmLimits()
    container = recognise(source)
    if container != "folder" and source.stat().st_size > limits.bytes:
        raise FilmError(
            "too_many_bytes", field="film", expected=f"at most {limits.bytes:,} bytes",
            got=f"{source.name} of {source.stat().st_size:,}", hint="Cut the film, or compress it more.",
        )  # fmt: skip
    size, fps, stated = _facts(source, container, limits)
    film = Film(source, container, size, fps, stated, (0, None, 1), limits)
    return Film(source, container, size, fps, stated, _selection(film, frames), limits)


def _facts(path: Path, container: Container, limits: FilmLimits) -> tuple[tuple[int, int], float, int]:
    """Read size, rate and stated number of frames."""
    if container == "gif":
        height, width = next(gif_frames(path, limits))[1].shape[:2]
        return (width, height), PICTURE_RATE, 0
    if container in ("zip", "folder"):
        listed = (zip_pictures if container == "zip" else folder_pictures)(path, limits)
        name, read = listed[0]
        height, width = read_picture(read(), name, limits).shape[:2]
        return checked((width, height), name, limits), PICTURE_RATE, len(listed)
    capture = _open_capture(path)
    try:
        width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width < 1 or height < 1:
            raise _undecodable(path)
        rate = capture.get(cv2.CAP_PROP_FPS)
        stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    finally:
        capture.release()
    fps = rate if np.isfinite(rate) and 0.1 <= rate <= 1000 else PICTURE_RATE
    return checked((width, height), path.name, limits), fps, int(stated) if 0 < stated < 1e9 else 0


def _selection(film: Film, frames: int | slice | str | None) -> tuple[int, int | None, int]:
    if frames is None:
        return 0, None, 1
    text = isinstance(frames, str)
    try:
        if isinstance(frames, str):
            parts = [int(part) if part.strip() else None for part in frames.split(":")]
            frames = slice(*parts) if len(parts) in (2, 3) else parts[0] if len(parts) == 1 else None
        if isinstance(frames, slice):
            start, stop, step = frames.start or 0, frames.stop, 1 if frames.step is None else frames.step
            if start >= 0 and step >= 1 and (stop is None or stop > start):
                return int(start), None if stop is None else int(stop), int(step)
        elif isinstance(frames, int) and not isinstance(frames, bool) and frames >= 1:
            return 0, None, max(1, -(-_count(film) // frames))
    except ValueError:
        pass
    raise FilmError(
        "wrong_selection", field="frames",
        expected="a number of frames from 1, or start:stop:step with start ≥ 0, stop > start and step ≥ 1",
        got=repr(frames) if not text else f"'{frames}'", hint="For example '0:300:2', every second of the first 300 frames.",
    )  # fmt: skip


def _count(film: Film) -> int:
    """Count the frames by going through the film: what headers state is often wrong."""
    if film.container in ("zip", "folder"):
        return film.stated_frames
    if film.container == "gif":
        return sum(1 for _ in gif_frames(film.path, film.limits))
    capture = _open_capture(film.path)
    try:
        count = 0
        while capture.grab() and capture.get(cv2.CAP_PROP_POS_MSEC) <= 1000 * film.limits.seconds:
            count += 1
        return count
    finally:
        capture.release()


def _open_capture(path: Path) -> cv2.VideoCapture:
    """Open a film that `recognise` let pass, with FFmpeg confined to local files and the same containers."""
    with _OPENING:
        key = "OPENCV_FFMPEG_CAPTURE_OPTIONS"  # the only way OpenCV offers to reach FFmpeg's options
        before = os.environ.get(key)
        os.environ[key] = f"format_whitelist;{DEMUXERS}|protocol_whitelist;file|enable_drefs;0"
        level = cv2.utils.logging.setLogLevel(0)
        try:
            capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
            if before is None:
                del os.environ[key]
            else:
                os.environ[key] = before
    if not capture.isOpened():
        raise _undecodable(path)
    return capture


def _decode_video(path: Path, fps: float, start: int, stop: int | None, step: int) -> Iterator[Frame]:
    capture = _open_capture(path)
    try:
        index, last = 0, -1.0
        while (stop is None or index < stop) and capture.grab():
            time = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            # Some files have no times after the first frames, or times that stand still.
            time = time if np.isfinite(time) and time > last else max(last, 0.0) + (1 / fps if index else 0.0)
            last = time
            if index >= start and (index - start) % step == 0:
                found, image = capture.retrieve()
                if not found or image is None:
                    return
                yield Frame(index, time, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8))
            index += 1
        if index == 0:
            raise _undecodable(path)
    except cv2.error as error:
        raise _undecodable(path) from error
    finally:
        capture.release()


def _undecodable(path: Path) -> FilmError:
    return FilmError(
        "undecodable_film", field="film", expected="a film with a picture that FFmpeg decodes", got=path.name,
        hint="It may be damaged, hold sound only, or use a rare codec. Convert it: ffmpeg -i FILM film.mp4",
    )  # fmt: skip
