"""Receiving webhooks: creating a secret and verifying messages.

The scheme is Standard Webhooks 1.0 (standardwebhooks.com), for which there are libraries in other languages.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Mapping

from pliant.client.errors import BadArgument, InvalidSignature
from pliant.schemas.job import Job

PREFIX = "whsec_"
SHORTEST_KEY = 24
"""Minimum length of a secret, random bytes, as the service requires it."""


def new_secret() -> str:
    """Return a new value for `webhook_secret`: 32 random bytes. Store it where the receiver can read it."""
    return PREFIX + base64.b64encode(secrets.token_bytes(32)).decode()


def verified(
    headers: Mapping[str, str], body: bytes, *, secret: str, tolerance: float = 300.0, now: float | None = None
) -> Job:
    """Verify a message and return its job.

    A message may be delivered more than once, with the same `webhook-id`.

    Parameters
    ----------
    headers : mapping of str to str
        The request's headers, in any case.
    body : bytes
        The body as received, not parsed and serialised again.
    secret : str
        The value passed as `webhook_secret`.
    tolerance : float
        Largest difference between the message's time and this machine's, seconds; it prevents replays.
    now : float, optional
        Current time in seconds since 1970; defaults to the system clock.

    Returns
    -------
    Job
        The finished job.

    Raises
    ------
    InvalidSignature
        The message is forged, altered or too old.
    BadArgument
        The secret is malformed, empty or missing, or the body is not bytes.
    """
    if not isinstance(body, bytes | bytearray | memoryview):
        raise BadArgument(
            f"body: expected the bytes of the request, got a value of type {type(body).__name__}. "
            "Pass the body as it arrived, before it is decoded or parsed."
        )
    key = _key_of(secret)
    given = {name.lower(): value for name, value in headers.items()}
    try:
        name, moment, signatures = given["webhook-id"], given["webhook-timestamp"], given["webhook-signature"]
    except KeyError as missing:
        raise InvalidSignature(f"The message has no header {missing}: it is not from Pliant. Discard it.") from None
    if not moment.isascii() or not moment.isdigit():
        raise InvalidSignature("The message's webhook-timestamp is not a number: it is not from Pliant. Discard it.")
    wanted = hmac.new(key, f"{name}.{moment}.".encode() + bytes(body), hashlib.sha256).digest()
    right = f"v1,{base64.b64encode(wanted).decode()}".encode()
    if not any(hmac.compare_digest(each.encode(), right) for each in signatures.split(" ")):
        raise InvalidSignature(
            "The message's signature is wrong. Discard the message, and check that the secret is the right one."
        )
    age = (time.time() if now is None else now) - int(moment)
    if abs(age) > tolerance:
        when = f"{age:.0f} s ago" if age > 0 else f"{-age:.0f} s in the future, by this machine's clock"
        raise InvalidSignature(
            f"The message was signed {when}, more than {tolerance:.0f} s. Discard it: it may be a replay."
        )
    try:
        return Job.model_validate(json.loads(bytes(body))["data"])
    except (ValueError, KeyError, TypeError) as fault:
        raise InvalidSignature(
            "The message is signed but contains no job. It may come from another service."
        ) from fault


def _key_of(secret: str) -> bytes:
    """Return the bytes of a secret."""
    if not isinstance(secret, str):
        raise BadArgument(
            f"secret: expected the value passed as webhook_secret, got a value of type {type(secret).__name__}."
        )
    try:
        key = base64.b64decode(secret.removeprefix(PREFIX), validate=True)
    except ValueError:
        key = b""
    if len(key) < SHORTEST_KEY:  # anybody could sign with an empty one
        raise BadArgument(
            f"secret: expected {PREFIX} followed by {SHORTEST_KEY} bytes or more in base64, got something else. "
            "Use the value passed as webhook_secret."
        )
    return key
