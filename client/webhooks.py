"""Webhooks at the receiver's side: a secret, and the proof that a message comes from the service and is new.

The scheme is Standard Webhooks 1.0 (standardwebhooks.com), for which there are libraries in other languages.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Mapping

from pliant.client.errors import BadArgument, NotGenuine
from pliant.schemas.job import Job
from pydantic import ValidationError

PREFIX = "whsec_"


def new_secret() -> str:
    """Return a secret for `webhook_secret`: 32 random bytes. Keep it where the receiver finds it."""
    return PREFIX + base64.b64encode(secrets.token_bytes(32)).decode()


def verified(
    headers: Mapping[str, str], body: bytes, *, secret: str, tolerance: float = 300.0, now: float | None = None
) -> Job:
    """Return the job that a message tells of, once it is proved genuine.

    The same message may come more than once: its `webhook-id` is the same then.

    Parameters
    ----------
    headers : mapping of str to str
        The request's; upper and lower case do not matter.
    body : bytes
        As it came; not parsed and written again.
    secret : str
        What was given as `webhook_secret`.
    tolerance : float
        Seconds by which the message's time may differ from ours, so that an old one cannot be replayed.
    now : float, optional
        Seconds since 1970; the clock's when not given.

    Raises
    ------
    NotGenuine
        It is not from the service, was changed on the way, or is too old.
    BadArgument
        The secret is none.
    """
    try:
        key = base64.b64decode(secret.removeprefix(PREFIX), validate=True)
    except (binascii.Error, ValueError):
        raise BadArgument(
            f"secret: expected {PREFIX} and base64, got something else. Use what you gave as webhook_secret."
        ) from None
    said = {name.lower(): value for name, value in headers.items()}
    try:
        name, moment, signatures = said["webhook-id"], said["webhook-timestamp"], said["webhook-signature"]
    except KeyError as missing:
        raise NotGenuine(f"The message has no header {missing}. It does not come from Pliant; drop it.") from None
    if not moment.isascii() or not moment.isdigit():
        raise NotGenuine("The message's webhook-timestamp is no number. It does not come from Pliant; drop it.")
    wanted = hmac.new(key, f"{name}.{moment}.".encode() + body, hashlib.sha256).digest()
    right = f"v1,{base64.b64encode(wanted).decode()}".encode()
    if not any(hmac.compare_digest(each.encode(), right) for each in signatures.split(" ")):
        raise NotGenuine("The message's signature does not fit. Drop it, or check that the secret is the right one.")
    age = (time.time() if now is None else now) - int(moment)
    if abs(age) > tolerance:
        raise NotGenuine(
            f"The message was signed {age:.0f} s ago, more than {tolerance:.0f}. Drop it: it may be a replay."
        )
    try:
        return Job.model_validate(json.loads(body)["data"])
    except (ValueError, KeyError, TypeError, ValidationError) as fault:
        raise NotGenuine("The message is signed, but tells of no job. Is it from another service?") from fault
