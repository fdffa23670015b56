"""A film's grey frames in a temporary file, lossless, so that they can be read in any order with flat memory."""

from __future__ import annotations

import tempfile
import threading
from collections import OrderedDict
from types import TracebackType

import cv2
import numpy as np
from pliant.tracking.flow import Grey

CACHED = 24
"""Decompressed frames kept in memory: the template, the 8 before t, t, and some for threads that run ahead."""


class FrameStore:
    """Append frames, then read them by index; leaving the `with` block deletes the file.

    The film itself cannot be read in any order: seeking is inexact for several containers, and decoding backwards costs a decode of all
    earlier frames.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="pliant-film-")  # noqa: SIM115  closed by __exit__
        self._places: list[tuple[int, int]] = []
        self._cache: OrderedDict[int, Grey] = OrderedDict()
        self._lock = threading.Lock()

    def __enter__(self) -> FrameStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._cache.clear()

    def append(self, frame: Grey) -> None:
        """Add a grey frame, shape `(H, W)`, dtype uint8."""
        # Without a search for repetitions, which films lack, packing takes a quarter less time and a tenth less space.
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
        packed = cv2.imencode(".png", frame, options)[1].tobytes()
        start = sum(self._places[-1]) if self._places else 0
        self._file.seek(start)
        self._file.write(packed)
        self._places.append((start, len(packed)))

    def read(self, index: int) -> Grey:
        """Return frame `index`; thread-safe."""
        with self._lock:
            if index in self._cache:
                self._cache.move_to_end(index)
                return self._cache[index]
            start, length = self._places[index]
            self._file.seek(start)
            packed = np.frombuffer(self._file.read(length), dtype=np.uint8)
            frame = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
            self._cache[index] = frame
            while len(self._cache) > CACHED:
                self._cache.popitem(last=False)
            return frame
