"""Webhooks before sending: validation, signature, and allowed addresses."""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import json
from datetime import UTC, datetime

import pytest
from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pliant.worker.errors import InvalidRequest
from pliant.worker.webhooks.message import may_reach, message, parse_webhook, signed

SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()

PRIVATE = [
    "127.0.0.1", "127.8.8.8", "10.0.0.1", "172.16.0.1", "172.31.255.255", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0",
    "255.255.255.255", "224.0.0.1", "239.1.1.1", "240.0.0.1", "192.0.2.1", "198.18.0.1", "203.0.113.9", "::", "::1", "fe80::1",
    "fc00::1", "fd12::1", "ff02::1", "2001:db8::1", "::ffff:127.0.0.1", "::ffff:10.0.0.1", "::ffff:169.254.169.254",
    "64:ff9b::7f00:1", "64:ff9b::a9fe:a9fe", "64:ff9b:1::1", "2002:7f00:1::", "2002:a9fe:a9fe::1", "2002:c0a8:101::",
    "2001:0:4136:e378:8000:63bf:3fff:fdd2", "100::1",
]  # fmt: skip
PUBLIC = ["1.1.1.1", "93.184.216.34", "172.32.0.1", "2606:4700::1111", "64:ff9b::101:101", "::ffff:1.1.1.1"]


@pytest.mark.parametrize("address", PRIVATE)
def test_addresses_that_are_not_public_are_rejected(address: str) -> None:
    assert not may_reach(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    with pytest.raises(InvalidRequest) as caught:
        parse_webhook(f"http://{host}/x", SECRET)
    assert caught.value.code == "webhook_not_public"


@pytest.mark.parametrize("address", PUBLIC)
def test_public_addresses_are_allowed(address: str) -> None:
    assert may_reach(ipaddress.ip_address(address))


def test_only_the_configured_private_networks_are_allowed() -> None:
    for address, networks, reached in (
        ("10.1.2.3", "10.0.0.0/8", True),
        ("11.1.2.3", "12.0.0.0/8", True),
        ("192.168.0.1", "10.0.0.0/8", False),
        ("127.0.0.1", "10.0.0.0/8,127.0.0.0/8", True),
        ("::1", "127.0.0.0/8", False),
        ("::1", "::1/128", True),
        ("::ffff:127.0.0.1", "127.0.0.0/8", True),
    ):
        assert may_reach(ipaddress.ip_address(address), networks) is reached, (address, networks)


@pytest.mark.parametrize(
    "url",
    [
        "ftp://example.org/", "example.org", "//example.org/x", "http://", "http:///x", "javascript:alert(1)", "file:///etc/passwd",
        "http://user@example.org/", "http://user:pw@example.org/", "http://@example.org/", "http://example.org:99999/",
        "http://example.org:port/", "http://exa mple.org/", "http://example.org/\r\nX: y", "http://example.org/\t", "http://exämple.org/",
        "http://[::1", "http://example.org\\@evil.example/", "http://example.org/" + "x" * 2000, " ", "gopher://example.org",
    ],
)  # fmt: skip
def test_an_invalid_url_is_rejected(url: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        parse_webhook(url, SECRET)
    assert caught.value.code == "invalid_webhook"
    assert caught.value.field == "webhook"


@pytest.mark.parametrize(
    "secret",
    [
        "", "whsec_", "whsec_!!!!", SECRET.removeprefix("whsec_"), SECRET[:-5],
        "whsec_" + base64.b64encode(b"x" * 23).decode(), "whsec_" + base64.b64encode(b"x" * 65).decode(),
    ],
)  # fmt: skip
def test_a_webhook_without_a_valid_secret_is_rejected(secret: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        parse_webhook("https://example.org/hook", secret)
    assert caught.value.code == "invalid_webhook_secret"
    assert secret not in str(caught.value) or len(secret) < 12, "a secret is not repeated"


def test_a_secret_without_a_url_is_rejected() -> None:
    with pytest.raises(InvalidRequest, match="webhook"):
        parse_webhook("", SECRET)
    assert parse_webhook("", "") is None
    webhook = parse_webhook("https://example.org:8443/a?b=c", SECRET)
    assert webhook is not None
    assert (webhook.url, webhook.secret) == ("https://example.org:8443/a?b=c", SECRET)


def test_the_signature_matches_the_example_of_the_specification() -> None:
    """The example of the specification's reference libraries."""
    headers = signed(
        "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw",
        id="msg_p5jXN8AQM9LWM0D4loKWxJek",
        timestamp=1614265330,
        body=b'{"test": 2432232314}',
    )
    assert headers == {
        "webhook-id": "msg_p5jXN8AQM9LWM0D4loKWxJek",
        "webhook-timestamp": "1614265330",
        "webhook-signature": "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=",
    }


def test_the_signature_covers_id_time_and_body() -> None:
    given = {"id": "msg_1", "timestamp": 1700000000, "body": b"{}"}
    key = base64.b64decode(SECRET.removeprefix("whsec_"))
    digest = hmac.new(key, b"msg_1.1700000000.{}", hashlib.sha256).digest()
    made = signed(SECRET, **given)["webhook-signature"]
    assert made == f"v1,{base64.b64encode(digest).decode()}"
    for other in ({"id": "msg_2"}, {"timestamp": 1700000001}, {"body": b"{ }"}):
        assert signed(SECRET, **(given | other))["webhook-signature"] != made


def test_a_message_contains_event_and_job_but_no_secret(interpretation: Interpretation) -> None:
    moment = datetime(2030, 1, 1, tzinfo=UTC)
    job = Job(
        id="one",
        status=Status.CANCELLED,
        created_at=moment,
        finished_at=moment,
        options=Options(),
        interpretation=interpretation,
    )
    event = json.loads(message(job))
    assert (event["type"], event["timestamp"]) == ("job.cancelled", moment.isoformat())
    assert Job.model_validate(event["data"]) == job
    assert message(job) == message(job)
