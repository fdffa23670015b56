"""The message of a webhook: its body, its signature, and the check of a submission's address and secret.

Messages are signed as in Standard Webhooks 1.0 (standardwebhooks.com): HMAC-SHA256 over ``id.timestamp.body``.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from urllib.parse import SplitResult, urlsplit

from pliant.schemas.job import Job
from pliant.worker.errors import InvalidRequest
from pliant.worker.records import Webhook
from pliant.worker.webhooks.address_policy import literal_address, may_reach

SECRET_PREFIX = "whsec_"  # noqa: S105 - prefix of secrets, not a secret
LONGEST_URL = 2000
SECRET_BYTES = range(24, 65)


def parse_webhook(url: str, secret: str, *, networks: str = "") -> Webhook | None:
    """Return the webhook of a submission, None if both URL and secret are empty.

    The URL must be ``http`` or ``https`` with a host and without a user name. The secret must be ``whsec_`` followed by 24 to 64
    random bytes in base64. `networks` is `Settings.webhook_networks`.

    Raises
    ------
    InvalidRequest
        URL or secret is missing or malformed.
    """
    if not url and not secret:
        return None
    if not url:
        raise InvalidRequest(
            "invalid_webhook", field="webhook", expected="an address beside webhook_secret", got="nothing",
            hint="Give the address that receives the finished job, or omit webhook_secret.",
        )  # fmt: skip
    parts = _split(url)
    host = parts.hostname if parts is not None else None
    if parts is None or parts.scheme not in ("http", "https") or not host or parts.username is not None:
        raise InvalidRequest(
            "invalid_webhook",
            field="webhook",
            expected=f"an http or https address of at most {LONGEST_URL} characters, without a user name",
            got=repr(url)[:80],
            hint="For example https://example.org/pliant.",
        )
    literal = literal_address(host)
    if literal is not None and not may_reach(literal, networks):
        raise InvalidRequest(
            "webhook_not_public", field="webhook", expected="an address of the public internet", got=host[:80],
            hint="The operator can allow its network with PLIANT_WEBHOOK_NETWORKS.",
        )  # fmt: skip
    if _key(secret) is None:
        got = f"{len(secret)} characters" if secret else "nothing"
        raise InvalidRequest(
            "invalid_webhook_secret", field="webhook_secret",
            expected=f"{SECRET_PREFIX} and {SECRET_BYTES.start} to {SECRET_BYTES.stop - 1} random bytes in base64", got=got,
            hint="Make one with: echo whsec_$(openssl rand -base64 32)",
        )  # fmt: skip
    return Webhook(url=url, secret=secret)


def message(job: Job) -> bytes:
    """Return the body of a job's webhook: the same bytes for the same record."""
    ended = job.finished_at.isoformat() if job.finished_at is not None else None
    return json.dumps(
        {"type": f"job.{job.status.value}", "timestamp": ended, "data": job.model_dump(mode="json")},
        separators=(",", ":"),
    ).encode()


def signed(secret: str, *, id: str, timestamp: int, body: bytes) -> dict[str, str]:
    """Return the headers by which the receiver verifies the sender and the age of a message.

    The id is the same for all attempts at one message, so that the receiver recognises duplicates; the timestamp is the time of
    this attempt.
    """
    key = _key(secret)
    assert key is not None, "checked when the job was submitted"
    digest = hmac.new(key, f"{id}.{timestamp}.".encode() + body, hashlib.sha256).digest()
    return {
        "webhook-id": id,
        "webhook-timestamp": str(timestamp),
        "webhook-signature": f"v1,{base64.b64encode(digest).decode()}",
    }


def _split(url: str) -> SplitResult | None:
    """Return the parts of a URL; None if different parsers may disagree about them."""
    if len(url) > LONGEST_URL or not url.isascii() or any(sign <= " " or sign in '\\"<>^`{|}' for sign in url):
        return None
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018 - raises if it is none
    except ValueError:
        return None
    return parts


def _key(secret: str) -> bytes | None:
    if not secret.startswith(SECRET_PREFIX):
        return None
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except ValueError:
        return None
    return key if len(key) in SECRET_BYTES else None
