"""Films as upright frames, decoded one at a time."""

from __future__ import annotations

import itertools
import operator
import os
import threading
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.schemas.film_limits import FilmLimits
from pliant.tracking.decoding.containers import Container, edited_seconds, openable, recognise
from pliant.tracking.decoding.pictures import (
    checked,
    folder_pictures,
    gif_frames,
    gif_length,
    read_picture,
    zip_pictures,
)
from pliant.tracking.errors import FilmError

PICTURE_RATE = 30.0
"""Frames per second assumed for pictures, which have no timestamps."""

RATES = (0.1, 1000.0)
"""Minimum and maximum frames per second that are believed."""

TIMED_FRAMES, SAME_RATE = 60, 0.05
"""Frames whose times give the rate of a GIF and check that of a Matroska or WebM film, and the maximum share by which the two may differ.
Films that browsers record state no rate; FFmpeg then guesses one, often that of the container's clock, 1000 a second."""

WIDEST_PIXEL = 4.0
"""Maximum ratio of a pixel's sides; anamorphic and broadcast formats stay below 2."""

LEAST_FRAMES = 3
"""Minimum number of frames of a film that can be tracked."""

OF_PICTURES: dict[Container, str] = {"folder": "a folder of pictures", "zip": "a zip of pictures"}
"""Films made of picture files, in words."""

DEMUXERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"

FFMPEG = {
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": f"format_whitelist;{DEMUXERS}|protocol_whitelist;file|enable_drefs;0",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # quiet: faults of a film are reported by this module
}
"""Environment variables by which OpenCV passes options to FFmpeg; it offers no other way. The level is read once in a process."""

_OPENING = threading.Lock()


def decoder() -> tuple[str, bool]:
    """Return the name and version of the library that decodes films, and whether it was built with FFmpeg, which it needs."""
    return f"OpenCV {cv2.__version__}", cv2.CAP_FFMPEG in cv2.videoio_registry.getStreamBackends()


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a film."""

    index: int
    """Frame number in the whole film, from 0, counting frames that are not selected."""

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
    """Frames per second according to the file or, if it states none, the times of its first frames; 30 for pictures."""

    stated_frames: int
    """Number of frames according to the file, without those that its edit list leaves out, which may be wrong; 0 if it gives none."""

    rotation: int
    """Clockwise rotation, degrees, that turns the stored frames upright: 0, 90, 180 or 270."""

    pixel_aspect: float
    """Width over height of a stored pixel, upright; frames whose pixels are not square are stretched to `size`."""

    selection: tuple[int, int | None, int]
    """Start, stop and step of the selected frames."""

    limits: FilmLimits

    def too_few_frames(self, count: int) -> FilmError:
        """Return (not raise) the error for fewer than `LEAST_FRAMES` selected frames; it states how pictures were read."""
        kind = OF_PICTURES.get(self.container)
        hint = (
            "Film two seconds or more, while the object turns" if kind is None else "Add the other frames of the film"
        )
        if self.selection != (0, None, 1):
            known = f" of the {self.stated_frames} frames" if self.stated_frames >= LEAST_FRAMES else ""
            hint = f"Widen the selection{known}" if known else f"{hint}, or widen the selection"
        if self.container == "folder":
            hint += ". For a track file, give its own path"
        got = str(count) if kind is None else f"{count} pictures in {self.path.name}, read as {kind}"
        return FilmError(
            "too_few_frames", field="film", expected=f"at least {LEAST_FRAMES} frames", got=got, hint=f"{hint}."
        )

    def frames(self) -> Generator[Frame, None, None]:
        """Decode the selected frames in order; memory does not grow with the film.

        Raises
        ------
        FilmError
            A frame of another size than the first, a broken picture, a film whose frames are all equal, or one beyond its limits.
        """
        start, stop, step = self.selection
        used = 0
        with closing(self._decode(start, stop, step)) as decoded:
            for frame in decoded:
                used += 1
                self._check(frame, used)
                yield frame

    def reaching(self, frame: int) -> Film:
        """Return the film with its selection continued, in its own steps, to the region's frame before or after it.

        The limit on the number of frames applies to each of the two parts.

        Raises
        ------
        FilmError
            The frame is too far away.
        """
        start, stop, step = self.selection
        before = max(0, start - frame) // step
        after = 0 if stop is None else -(-max(0, frame + 1 - stop) // step)
        if before + after > self.limits.frames:
            raise FilmError(
                "too_many_frames", field="region_frame", expected=f"at most {self.limits.frames} frames from there to those used",
                got=str(before + after), hint="Draw the region on one of the frames used, and give its number.",
            )  # fmt: skip
        selection = start - before * step, stop if stop is None else max(stop, frame + 1), step
        return replace(
            self, selection=selection, limits=replace(self.limits, frames=self.limits.frames + before + after)
        )

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
            with (zip_pictures if self.container == "zip" else folder_pictures)(self.path, self.limits) as listed:
                for index in range(len(listed))[start:stop:step]:
                    name, read = listed[index]
                    yield Frame(index, index / PICTURE_RATE, read_picture(read(), name, self.limits))
        else:
            for frame in _decode_video(self.path, self.fps, start, stop, step):
                yield frame if self.pixel_aspect == 1 else self._stretched(frame)

    def _stretched(self, frame: Frame) -> Frame:
        """Resample a frame to square pixels."""
        size = _square((frame.image.shape[1], frame.image.shape[0]), self.pixel_aspect)
        image = cv2.resize(frame.image, size, interpolation=cv2.INTER_LINEAR)
        return Frame(frame.index, frame.time, np.asarray(image, dtype=np.uint8))


def open_film(path: Path | str, *, frames: int | slice | str | None = None, limits: FilmLimits | None = None) -> Film:
    """Open a film after checking its format.

    Parameters
    ----------
    path
        An mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures (PNG, JPEG, WebP,
        BMP) in natural order. Playlists and files that refer to other files or addresses are rejected.
    frames
        Frames to use: a maximum number, evenly spaced, a slice, or its text, e.g. "0:300:2". All by default.
    limits
        Limits on bytes, frames, pixels and seconds.

    Raises
    ------
    FilmError
        The film cannot be used or exceeds the limits, or the selection is invalid.
    """
    source, limits = Path(path).absolute(), limits or FilmLimits()
    container = recognise(source)
    with openable(source):
        size = 0 if container == "folder" else source.stat().st_size
    if size > limits.bytes:
        raise FilmError(
            "too_many_bytes", field="film", expected=f"at most {limits.bytes:,} bytes",
            got=f"{source.name} of {size:,}", hint="Cut the film, or compress it more.",
        )  # fmt: skip
    facts = _facts(source, container, limits)
    film = Film(source, container, **facts, selection=(0, None, 1), limits=limits)
    return replace(film, selection=_selection(film, frames))


class _Facts(TypedDict):
    """Fields of `Film` that are read from the file."""

    size: tuple[int, int]
    fps: float
    stated_frames: int
    rotation: int
    pixel_aspect: float


def _facts(path: Path, container: Container, limits: FilmLimits) -> _Facts:
    if container == "gif":
        first = [(time, image.shape) for time, image in itertools.islice(gif_frames(path, limits), TIMED_FRAMES)]
        height, width = first[0][1][:2]
        return _pictures((width, height), gif_length(path), _rate([time for time, _ in first]))
    if container in ("zip", "folder"):
        with (zip_pictures if container == "zip" else folder_pictures)(path, limits) as listed:
            name, read = listed[0]
            height, width = read_picture(read(), name, limits).shape[:2]
            return _pictures(checked((width, height), name, limits), len(listed), PICTURE_RATE)
    capture = _open_capture(path)
    try:
        width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width < 1 or height < 1:
            raise _undecodable(path)
        rate = capture.get(cv2.CAP_PROP_FPS)
        stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        rotation = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        aspect = _pixel_aspect(capture, rotation, path)
        size = checked(_square((width, height), aspect), path.name, limits)
        if container == "matroska" or not RATES[0] <= rate <= RATES[1]:
            timed = _rate(_first_times(capture))
            if not abs(rate - timed) <= SAME_RATE * timed:
                rate, stated = timed, 0  # the number of frames was computed from the rate
        shown = edited_seconds(path) if container == "mp4" else None
        stated = stated if shown is None else min(stated, round(shown * rate))
    finally:
        capture.release()
    return _Facts(
        size=size, fps=rate, stated_frames=int(stated) if 0 < stated < 1e9 else 0, rotation=rotation, pixel_aspect=aspect,
    )  # fmt: skip


def _pictures(size: tuple[int, int], count: int, fps: float) -> _Facts:
    return _Facts(size=size, fps=fps, stated_frames=count, rotation=0, pixel_aspect=1.0)


def _first_times(capture: cv2.VideoCapture) -> list[float]:
    times: list[float] = []
    while len(times) < TIMED_FRAMES and capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    return times


def _rate(times: list[float]) -> float:
    """Return the mean rate of frames at `times` in seconds; that of pictures if the times do not grow."""
    span = times[-1] - times[0] if times else 0.0
    return min((len(times) - 1) / span, RATES[1]) if span > 0 else PICTURE_RATE


def _pixel_aspect(capture: cv2.VideoCapture, rotation: int, path: Path) -> float:
    """Return width over height of an upright pixel (FFmpeg's sample aspect ratio); 1 if the film gives none."""
    across, down = (capture.get(key) for key in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    if not (across > 0 and down > 0):
        return 1.0
    aspect = float(across / down if rotation % 180 == 0 else down / across)
    if not 1 / WIDEST_PIXEL <= aspect <= WIDEST_PIXEL:
        raise FilmError(
            "unsupported_film", field="film", expected=f"pixels at most {WIDEST_PIXEL:g} times as wide as high, or as high as wide",
            got=f"{path.name} with pixels of {across:g}:{down:g}", hint="Convert it: ffmpeg -i FILM -vf setsar=1 film.mp4",
        )  # fmt: skip
    return aspect


def _square(size: tuple[int, int], aspect: float) -> tuple[int, int]:
    """Return a picture's size in square pixels: the shorter side of a pixel is stretched, as in browsers."""
    width, height = size
    return (round(width * aspect), height) if aspect >= 1 else (width, round(height / aspect))


def _selection(film: Film, frames: int | slice | str | None) -> tuple[int, int | None, int]:
    if frames is None:
        return 0, None, 1
    given = f"'{frames}'" if isinstance(frames, str) else repr(frames)
    try:
        if isinstance(frames, str):
            parts = [int(part) if part.strip() else None for part in frames.split(":")]
            frames = slice(*parts) if len(parts) in (2, 3) else parts[0] if len(parts) == 1 else None
        if isinstance(frames, slice):
            start, step = operator.index(frames.start or 0), 1 if frames.step is None else operator.index(frames.step)
            stop = None if frames.stop is None else operator.index(frames.stop)
            if start >= 0 and step >= 1 and (stop is None or stop > start):
                return start, stop, step
        elif not isinstance(frames, bool) and (most := operator.index(frames)) >= 1:  # type: ignore[arg-type]
            return 0, None, max(1, -(-_count(film) // most))
    except (TypeError, ValueError):
        pass
    raise FilmError(
        "wrong_selection", field="frames",
        expected="a number of frames from 1, or start:stop:step with start ≥ 0, stop > start and step ≥ 1",
        got=given, hint="For example '0:300:2', every second of the first 300 frames.",
    )  # fmt: skip


def _count(film: Film) -> int:
    """Count the frames by reading the film, because headers are often wrong."""
    if film.container in ("zip", "folder", "gif"):
        return film.stated_frames
    capture = _open_capture(film.path)
    try:
        count = 0
        while capture.grab() and capture.get(cv2.CAP_PROP_POS_MSEC) <= 1000 * film.limits.seconds:
            count += 1
        return count
    finally:
        capture.release()


def _open_capture(path: Path) -> cv2.VideoCapture:
    """Open a film accepted by `recognise`, with FFmpeg confined to local files and the same containers."""
    with _OPENING:
        before = {key: os.environ.get(key) for key in FFMPEG}
        os.environ.update(FFMPEG)
        level = cv2.utils.logging.setLogLevel(0)
        try:
            capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
            for key, value in before.items():
                if value is None:
                    del os.environ[key]
                else:
                    os.environ[key] = value
    if not capture.isOpened():
        raise _undecodable(path)
    return capture


def _decode_video(path: Path, fps: float, start: int, stop: int | None, step: int) -> Iterator[Frame]:
    capture = _open_capture(path)
    try:
        index, last, used = 0, -1.0, 0
        first: NDArray[np.uint8] | None = None
        while (stop is None or index < stop) and capture.grab():
            time = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            # Some files have no timestamps after the first frames, or repeat them.
            time = time if np.isfinite(time) and time > last else max(last, 0.0) + (1 / fps if index else 0.0)
            last = time
            if index >= start and (index - start) % step == 0:
                found, image = capture.retrieve()
                if not found or image is None:
                    return
                picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
                if used == 0 or (first is not None and not np.array_equal(picture, first)):
                    first = picture if used == 0 else None
                used += 1
                yield Frame(index, time, picture)
            index += 1
        if index == 0:
            raise _undecodable(path)
        if used > 1 and first is not None:
            raise _unchanging(path, used)
    except cv2.error as error:
        raise _undecodable(path) from error
    finally:
        capture.release()


def _undecodable(path: Path) -> FilmError:
    return FilmError(
        "undecodable_film", field="film", expected="a film with a picture that FFmpeg decodes", got=path.name,
        hint="It may be damaged, hold sound only, or use a codec that OpenCV lacks, such as AV1. Convert it: ffmpeg -i FILM film.mp4",
    )  # fmt: skip


def _unchanging(path: Path, count: int) -> FilmError:
    """Return (not raise) the error for a film whose frames are all equal.

    OpenCV reports no error where FFmpeg cannot convert a frame, as it cannot if the frame is interlaced, and returns the last content of
    its buffer.
    """
    return FilmError(
        "undecodable_film", field="film", expected="frames that differ", got=f"{count} equal frames in {path.name}",
        hint="If it is not a still picture, it is interlaced. Convert it: ffmpeg -i FILM -vf yadif film.mp4",
    )  # fmt: skip
