"""The double's uploads: bytes by id, with the offsets and refusals of the real thing."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

from pliant.client.testing.refusal import Refusal
from pliant.schemas.job import Upload


@dataclass
class Held:
    """One upload."""

    data: bytes = b""
    length: int | None = None
    complete: bool = False


@dataclass
class Uploads:
    """All uploads of the double."""

    held: dict[str, Held] = field(default_factory=dict)

    def get(self, upload_id: str) -> Upload:
        """Return where one stands, or refuse."""
        there = self._find(upload_id)
        digest = hashlib.sha256(there.data).hexdigest() if there.complete else None
        length = len(there.data) if there.complete else there.length
        return Upload(
            id=upload_id, offset=len(there.data), length=length, complete=there.complete, sha256=digest, expires_at=None
        )

    def write(self, upload_id: str, body: bytes, headers: Mapping[str, str]) -> Upload:
        """Go on with one, or begin it."""
        offset, last = int(headers.get("upload-offset", "0")), headers.get("upload-complete", "?1") == "?1"
        if offset == 0 and not self._whole(upload_id):
            self.held[upload_id] = Held()
        there = self._find(upload_id)
        if there.complete:
            raise Refusal(409, "upload_complete", f"Upload {upload_id!r} is whole. Use it, or delete it first.")
        if len(there.data) != offset:
            held = len(there.data)
            detail = f"Upload {upload_id!r} holds {held} bytes, and what was sent begins at {offset}. Go on at {held}."
            raise Refusal(409, "upload_offset_mismatch", detail, expected=str(held), got=str(offset))
        data, told = there.data + body, headers.get("upload-length")
        if last and told is not None and int(told) != len(data):
            detail = (
                f"Upload-Length: expected {told} bytes in all, got {len(data)}. Send what is missing, or begin anew."
            )
            raise Refusal(422, "inconsistent_upload_length", detail, field="Upload-Length")
        if last and _differs(headers.get("repr-digest"), data):
            del self.held[upload_id]
            raise Refusal(
                422, "digest_mismatch", "The bytes changed on their way. Send them again.", field="Repr-Digest"
            )
        self.held[upload_id] = Held(data, int(told) if told is not None else there.length, last)
        return self.get(upload_id)

    def take(self, upload_id: str, field: str) -> bytes:
        """Return the bytes of a whole one, for a job that names it."""
        if upload_id not in self.held:
            raise Refusal(422, "unknown_upload", f"There is no upload {upload_id!r}. Send it again.", field=field)
        if not self._whole(upload_id):
            raise Refusal(422, "upload_incomplete", f"Upload {upload_id!r} is not whole. Send the rest.", field=field)
        return self.held[upload_id].data

    def delete(self, upload_id: str) -> None:
        """Remove one, or refuse."""
        self._find(upload_id)
        del self.held[upload_id]

    def _find(self, upload_id: str) -> Held:
        if upload_id not in self.held:
            raise Refusal(404, "unknown_upload", f"There is no upload {upload_id!r}. Send it again.")
        return self.held[upload_id]

    def _whole(self, upload_id: str) -> bool:
        return upload_id in self.held and self.held[upload_id].complete


def _differs(told: str | None, data: bytes) -> bool:
    return told is not None and base64.b64encode(hashlib.sha256(data).digest()).decode() not in told
