"""The data directory, and where its embedded Valkey lives."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

FOLDERS = ("blobs", "incoming", "uploads", "valkey", "work")
"""Folders of a data directory."""

LONGEST_SOCKET_PATH = 100
"""Bytes; the system's own bound is 107 on Linux and 103 on macOS."""


def make_data_directory(data: Path) -> None:
    """Make the data directory and its folders, readable by their owner alone: they hold everybody's inputs and results.

    A directory that exists keeps its mode, for it may be anything; the folders of ours inside it are closed to others.
    """
    data.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name in FOLDERS:
        folder = data / name
        folder.mkdir(exist_ok=True, mode=0o700)
        if folder.stat().st_uid == os.getuid():
            folder.chmod(0o700)


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
