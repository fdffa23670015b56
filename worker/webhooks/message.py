"""Webhooks: what is sent, how it is signed, and where it may go.

Signed by the scheme of Standard Webhooks 1.0 (standardwebhooks.com): HMAC-SHA256 over ``id.timestamp.body``. Whoever submits a job
names the address, so the address is an attack on the network that the service stands in until shown otherwise: a name is resolved
once, every address it has must be public, and the connection goes to the very address that was looked at.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ipaddress
import json
from urllib.parse import SplitResult, urlsplit

from pliant.schemas.job import Job
from pliant.worker.errors import InvalidRequest
from pliant.worker.records import Webhook

SECRET_PREFIX = "whsec_"  # noqa: S105 - what every secret begins with, not a secret
LONGEST_URL = 2000
SECRET_BYTES = range(24, 65)

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
_NAT64 = ipaddress.ip_network("64:ff9b::/96")


def parse_webhook(url: str, secret: str, *, networks: str = "") -> Webhook | None:
    """Return the webhook of a submission, None if it has none.

    Parameters
    ----------
    url : str
        ``http`` or ``https``, a host, no user name; empty: no webhook.
    secret : str
        ``whsec_`` and 24 to 64 random bytes in base64.
    networks : str
        `Settings.webhook_networks`.

    Raises
    ------
    InvalidRequest
        One without the other, or either is not what it must be.
    """
    if not url and not secret:
        return None
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
    literal = _literal(host)
    if literal is not None and not may_reach(literal, networks):
        raise InvalidRequest(
            "webhook_not_public", field="webhook", expected="an address of the public internet", got=host[:80],
            hint="Whoever runs the service may allow its network in PLIANT_WEBHOOK_NETWORKS.",
        )  # fmt: skip
    if _key(secret) is None:
        got = "none" if not secret else f"{len(secret)} characters"
        raise InvalidRequest(
            "invalid_webhook_secret", field="webhook_secret",
            expected=f"{SECRET_PREFIX} and {SECRET_BYTES.start} to {SECRET_BYTES.stop - 1} random bytes in base64", got=got,
            hint="Make one with: echo whsec_$(openssl rand -base64 32)",
        )  # fmt: skip
    return Webhook(url=url, secret=secret)


def message(job: Job) -> bytes:
    """Return the body that tells of a job's end; always the same bytes for the same record."""
    ended = job.finished_at.isoformat() if job.finished_at is not None else None
    return json.dumps(
        {"type": f"job.{job.status.value}", "timestamp": ended, "data": job.model_dump(mode="json")},
        separators=(",", ":"),
    ).encode()


def signed(secret: str, *, id: str, timestamp: int, body: bytes) -> dict[str, str]:
    """Return the headers that let the receiver check where a message comes from and that it is new.

    Parameters
    ----------
    id : str
        The same for every try at the same message, so that the receiver knows a repetition.
    timestamp : int
        Seconds since 1970 of this try.
    """
    key = _key(secret)
    assert key is not None, "checked when the job was submitted"
    digest = hmac.new(key, f"{id}.{timestamp}.".encode() + body, hashlib.sha256).digest()
    return {
        "webhook-id": id,
        "webhook-timestamp": str(timestamp),
        "webhook-signature": f"v1,{base64.b64encode(digest).decode()}",
    }


def may_reach(address: Address, networks: str = "") -> bool:
    """Tell whether a webhook may go to an address: one of the public internet, or of a network that was allowed.

    An IPv6 address that stands for an IPv4 address (mapped, 6to4, NAT64, Teredo) is judged as that one.
    """
    real = _meant(address)
    if any(
        each in ipaddress.ip_network(network)
        for network in networks.split(",")
        if network
        for each in (address, real)
        if each.version == ipaddress.ip_network(network).version
    ):
        return True
    judged = {real} if _is_translated(address) else {address, real}
    return all(each.is_global and not each.is_multicast and not each.is_reserved for each in judged)


def _is_translated(address: Address) -> bool:
    """Tell whether an IPv6 address is merely another way to write an IPv4 address; by itself it is then of no network."""
    return isinstance(address, ipaddress.IPv6Address) and (address.ipv4_mapped is not None or address in _NAT64)


def _meant(address: Address) -> Address:
    if isinstance(address, ipaddress.IPv4Address):
        return address
    if address in _NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    teredo = address.teredo
    return address.ipv4_mapped or address.sixtofour or (teredo[1] if teredo is not None else None) or address


def _split(url: str) -> SplitResult | None:
    """Return a URL's parts; None if it has none that we would use the same way as the next program."""
    if len(url) > LONGEST_URL or not url.isascii() or any(sign <= " " or sign in '\\"<>^`{|}' for sign in url):
        return None
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018 - raises if it is none
    except ValueError:
        return None
    return parts


def _literal(host: str) -> Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _key(secret: str) -> bytes | None:
    if not secret.startswith(SECRET_PREFIX):
        return None
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError):
        return None
    return key if len(key) in SECRET_BYTES else None
