"""Output of libraries that write to a path instead of an open file."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def path_beside(file: IO[bytes], suffix: str) -> Iterator[Path]:
    """Yield the path of a temporary file beside `file`; its content is copied into `file` at the end, and it is removed.

    The suffix is the extension that the library requires, e.g. ``".abc"``.
    """
    path = Path(f"{file.name}{suffix}")
    path.unlink(missing_ok=True)
    try:
        yield path
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)
    finally:
        path.unlink(missing_ok=True)
