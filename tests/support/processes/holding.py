"""A function for a separate process: hold some memory."""

from __future__ import annotations

import numpy as np


def hold(watch: object, size: int) -> int:
    """Fill `size` bytes and return how many numbers that was."""
    return np.ones(size // 8).size
