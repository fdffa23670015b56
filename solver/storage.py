"""Arrays in memory, or memory-mapped to a temporary file."""

from __future__ import annotations

import mmap
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


def allocated(shape: tuple[int, ...], scratch: str | Path | None, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return an array of zeros in memory, or mapped to a temporary file in the folder `scratch`.

    The file is anonymous where the system allows it, and is deleted with the array. Its space is reserved at once, so a full disk raises an
    error here instead of crashing the process at a later write.

    Raises
    ------
    OSError
        The folder is missing, cannot be written to, or has too little space.
    """
    if scratch is None:
        return np.zeros(shape, dtype)
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    with tempfile.TemporaryFile(dir=scratch, prefix="pliant-") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        return np.asarray(np.memmap(file, dtype=dtype, mode="w+", shape=shape))


def let_go(*arrays: NDArray[Any] | None) -> None:
    """Release the memory of mapped arrays and of views of them; their file is read when they are used again."""
    for array in arrays:
        owner = array
        while isinstance(owner, np.ndarray) and not isinstance(owner, np.memmap):
            owner = owner.base
        mapped = getattr(owner, "_mmap", None)
        if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            mapped.madvise(mmap.MADV_DONTNEED)
