"""Films for tests: rendered ones with truth, and files that are broken or hostile on purpose."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from pliant.solver.gallery import Sequence
from pliant.tracking import TrackedFilm
from pliant.tracking.rendering import RenderedFilm, render_film

SIZE = (160, 120)


def rendered(sequence: Sequence, path: Path, **options: object) -> RenderedFilm:
    film = render_film(sequence, size=options.pop("size", SIZE), **options)  # type: ignore[arg-type]
    film.write(path)
    return film


def accuracy(tracked: TrackedFilm, film: RenderedFilm) -> dict[str, float]:
    """Compare tracks with the truth: error of correctly visible points in pixels, precision and recall of visibility."""
    start = int(tracked.film.frame_indices[tracked.template])
    true, seen, _ = film.follow(tracked.tracks[tracked.template].astype(float), start)
    true, seen = true[tracked.film.frame_indices], seen[tracked.film.frame_indices]
    on = np.isfinite(true).all(axis=(0, 2))
    error = np.linalg.norm(tracked.tracks - true, axis=-1)
    right = tracked.visibility & seen & on
    return {
        "median": float(np.median(error[right])),
        "p95": float(np.percentile(error[right], 95)),
        "precision": right.sum() / tracked.visibility[:, on].sum(),
        "recall": right.sum() / (seen & on).sum(),
    }


def textured_pictures(
    count: int, size: tuple[int, int] = (64, 48), *, step: int = 1, seed: int = 0
) -> list[np.ndarray]:
    """Pictures of one texture that moves to the right, RGB."""
    noise = np.random.default_rng(seed).normal(size=(size[1], size[0] + step * count, 3))
    wide = cv2.GaussianBlur(noise, (0, 0), 1.5)
    wide = np.clip(128 + 60 * wide / wide.std(), 0, 255).astype(np.uint8)
    return [wide[:, step * (count - k) : step * (count - k) + size[0]] for k in range(count)]


def write_film(path: Path, pictures: list[np.ndarray], fps: float = 30.0) -> Path:
    code = {".mp4": "mp4v", ".mov": "mp4v", ".webm": "VP80", ".avi": "MJPG", ".mkv": "FFV1"}[path.suffix]
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), fps, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def zip_of(path: Path, entries: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return path


def png(picture: np.ndarray) -> bytes:
    return cv2.imencode(".png", picture[..., ::-1])[1].tobytes()


def gif(pictures: list[np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    first, *others = [Image.fromarray(picture).quantize(64) for picture in pictures]
    first.save(buffer, "GIF", save_all=True, append_images=others)
    return buffer.getvalue()


def box(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I4s", 8 + len(body), kind) + body


def patched(path: Path, kind: bytes, offset: int, new: bytes) -> Path:
    """Overwrite bytes at an offset from the first occurrence of a four-letter code."""
    data = bytearray(path.read_bytes())
    place = data.index(kind) + offset
    data[place : place + len(new)] = new
    path.write_bytes(data)
    return path


def turned_by_90(path: Path) -> Path:
    """Set the rotation flag of an MP4 film: the matrix of its track header."""
    return patched(path, b"tkhd", 44, struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30))


def with_uneven_times(path: Path, first: int) -> Path:
    """Make the frames of an MP4 film after the first ones last three times as long: a second entry in `stts`."""
    data = bytearray(path.read_bytes())
    place = data.index(b"stts")
    count, delta = struct.unpack(">II", data[place + 12 : place + 20])
    data[place + 8 : place + 20] = struct.pack(">5I", 2, first, delta, count - first, 3 * delta)
    at = 0
    for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        at = data.index(kind, at)
        data[at - 4 : at] = struct.pack(">I", struct.unpack(">I", data[at - 4 : at])[0] + 8)
    path.write_bytes(data)
    return path


def like_a_recording(path: Path) -> Path:
    """Make a WebM film like one that a browser records: uneven times, and no frame rate."""
    data = bytearray(path.read_bytes())
    pending = [(0, len(data))]
    while pending:
        place, end = pending.pop()
        while place < end:
            _, body = _vint(data, place)
            size, content = _vint(data, body)
            name, size = bytes(data[place:body]).hex(), size & ~(1 << 7 * (content - body))
            if name in ("18538067", "1654ae6b", "ae", "1f43b675"):  # Segment, Tracks, TrackEntry, Cluster
                pending.append((content, content + size))
            elif name == "23e383":  # DefaultDuration, which becomes Void
                data[place : place + 2] = bytes([0xEC, 0x80 | content + size - place - 2])
            elif name == "a3":  # SimpleBlock, with its time in ms
                time = struct.unpack(">h", data[content + 1 : content + 3])[0]
                data[content + 1 : content + 3] = struct.pack(">h", time + time * 7 % 20)
            place = content + size
    path.write_bytes(data)
    return path


def _vint(data: bytearray, place: int) -> tuple[int, int]:
    """Return an EBML number with its marker bit, and the place after it."""
    end = place + 9 - data[place].bit_length()
    return int.from_bytes(data[place:end], "big"), end
