"""Where the embedded Valkey of a data directory lives, for those who talk to it and for the one who starts it."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

LONGEST_SOCKET_PATH = 100
"""Bytes; the system's own bound is 107 on Linux and 103 on macOS."""


def valkey_directory(data: Path) -> Path:
    """Return the directory of the server's append-only file, locks and log."""
    return data.absolute() / "valkey"


def socket_path(data: Path) -> Path:
    """Return the server's Unix socket: inside the data directory, or in the temporary one when that lies too deep.

    The short name is a hash of the long one and of the user, so that everybody who is given the same data
    directory finds the same socket.
    """
    plain = valkey_directory(data) / "valkey.sock"
    if len(os.fsencode(plain)) <= LONGEST_SOCKET_PATH:
        return plain
    digest = hashlib.sha256(os.fsencode(plain)).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"pliant-{os.getuid()}-{digest}" / "valkey.sock"
