"""Paths of the data directory and of its embedded Valkey."""

from __future__ import annotations

import errno
import hashlib
import os
from pathlib import Path

FOLDERS = ("blobs", "incoming", "uploads", "valkey", "work")
"""Folders of a data directory."""

LONGEST_SOCKET_PATH = 100
"""Maximum length of a socket path, bytes; the system's limit is 107 on Linux and 103 on macOS."""


def make_data_directory(data: Path) -> None:
    """Create the data directory and its folders, readable by their owner only, since they contain all inputs and results.

    An existing data directory keeps its mode; the folders inside it are closed to other users.

    Raises
    ------
    OSError
        A folder cannot be made, or belongs to another user.
    """
    data.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name in FOLDERS:
        folder = data / name
        folder.mkdir(exist_ok=True, mode=0o700)
        if folder.stat().st_uid == os.getuid():
            folder.chmod(0o700)
        if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))


def valkey_directory(data: Path) -> Path:
    """Return the directory of the server's append-only file, locks and log."""
    return data.absolute() / "valkey"


def socket_path(data: Path) -> Path:
    """Return the server's Unix socket: in the data directory, or in /tmp if that path is too long.

    The short path consists of the user id and a hash of the long path, and does not follow TMPDIR, so that all processes with the
    same data directory find the same socket.
    """
    plain = valkey_directory(data) / "valkey.sock"
    if len(os.fsencode(plain)) <= LONGEST_SOCKET_PATH:
        return plain
    digest = hashlib.sha256(os.fsencode(plain)).hexdigest()[:16]
    return Path("/tmp") / f"pliant-{os.getuid()}-{digest}" / "valkey.sock"  # noqa: S108 - `valkey` checks who owns the folder
