"""A lock on a partial file, so that only one call writes to it."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

fcntl: Any = None
with suppress(ImportError):  # Windows, where calls for the same file are not kept apart
    fcntl = import_module("fcntl")


def lock(path: Path) -> AbstractContextManager[object] | None:
    """Lock a file, created if missing, until the end of the returned context; return None if another call holds the lock."""
    if fcntl is None:
        path.touch()
        return nullcontext()
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return file
    except (BlockingIOError, FileNotFoundError):
        pass
    except OSError:  # a file system without locks
        return file
    file.close()  # locked by another call, or renamed or removed by the one that held the lock
    return None
