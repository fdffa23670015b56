"""SHA-256 digests of files, as records and requests state them."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path

REPR_DIGEST = "Repr-Digest"
"""Header with the digest of a complete file (RFC 9530)."""


def sha256(path: Path) -> str:
    """Hash a file without loading it into memory; return 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def repr_digest(digest: str) -> str:
    """Return the value of `Repr-Digest` for a SHA-256 in hexadecimal."""
    return f"sha-256=:{base64.b64encode(bytes.fromhex(digest)).decode()}:"
