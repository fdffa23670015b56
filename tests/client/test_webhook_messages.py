"""Webhooks at the receiver: messages of the service are verified, all others rejected."""

from __future__ import annotations

import base64
import hashlib
import hmac
from datetime import UTC, datetime

import numpy as np
import pytest
from pliant.client import AsyncClient, BadArgument, Client, InvalidSignature
from pliant.client.webhooks import new_secret, verified
from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pliant.service.testing import InMemoryService
from pliant.worker.webhooks.message import message, parse_webhook, signed

NOW = 1_900_000_000
SECRET = new_secret()


@pytest.fixture
def job() -> Job:
    read = Interpretation(
        num_frames=4, num_points=5, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="tracks (F, P, 2)",
    )  # fmt: skip
    moment = datetime(2030, 1, 1, tzinfo=UTC)
    return Job(
        id="one", status=Status.CANCELLED, created_at=moment, finished_at=moment, options=Options(), interpretation=read
    )


def test_messages_signed_by_the_service_are_verified(job: Job) -> None:
    body = message(job)
    headers = signed(SECRET, id="msg_one", timestamp=NOW, body=body)
    assert verified(headers, body, secret=SECRET, now=NOW) == job
    upper = {name.title(): value for name, value in headers.items()}
    assert verified(upper, body, secret=SECRET, now=NOW + 299) == job
    rotated = headers | {
        "webhook-signature": f"v1,{base64.b64encode(b'x' * 32).decode()} {headers['webhook-signature']}"
    }
    assert verified(rotated, body, secret=SECRET, now=NOW - 299) == job


def test_altered_messages_are_rejected(job: Job) -> None:
    body = message(job)
    headers = signed(SECRET, id="msg_one", timestamp=NOW, body=body)
    changed = [
        (headers | {"webhook-id": "msg_two"}, body, SECRET),
        (headers | {"webhook-timestamp": str(NOW + 1)}, body, SECRET),
        (headers | {"webhook-timestamp": "now"}, body, SECRET),
        (headers | {"webhook-timestamp": "٣"}, body, SECRET),
        (headers | {"webhook-signature": ""}, body, SECRET),
        (headers | {"webhook-signature": headers["webhook-signature"].replace("v1,", "v2,")}, body, SECRET),
        (headers | {"webhook-signature": "v1,é"}, body, SECRET),
        (headers, body.replace(b"cancelled", b"succeeded"), SECRET),
        (headers, body + b" ", SECRET),
        (headers, body, new_secret()),
        *(({name: value for name, value in headers.items() if name != left}, body, SECRET) for left in headers),
    ]
    for sent_headers, sent, secret in changed:
        with pytest.raises(InvalidSignature):
            verified(sent_headers, sent, secret=secret, now=NOW)


@pytest.mark.parametrize("now", [NOW + 301, NOW - 301])
def test_old_and_future_messages_are_rejected(job: Job, now: int) -> None:
    body = message(job)
    with pytest.raises(InvalidSignature, match="replay"):
        verified(signed(SECRET, id="m", timestamp=NOW, body=body), body, secret=SECRET, now=now)


@pytest.mark.parametrize("body", [b"", b"[]", b"{}", b'{"data": 1}', b'{"data": {"id": "x"}}', b"\xff"])
def test_a_signed_message_without_a_job_is_an_error(body: bytes) -> None:
    with pytest.raises(InvalidSignature, match="contains no job"):
        verified(signed(SECRET, id="m", timestamp=NOW, body=body), body, secret=SECRET, now=NOW)


def test_what_is_neither_a_body_nor_a_secret_is_named(job: Job) -> None:
    body = message(job)
    headers = signed(SECRET, id="msg_one", timestamp=NOW, body=body)
    with pytest.raises(
        BadArgument, match=r"^body: expected the bytes of the request, got a value of type str\. Pass the body as it"
    ):
        verified(headers, body.decode(), secret=SECRET, now=NOW)  # type: ignore[arg-type]
    with pytest.raises(
        BadArgument, match=r"^secret: expected the value passed as webhook_secret, got a value of type NoneType\."
    ):
        verified(headers, body, secret=None, now=NOW)  # type: ignore[arg-type]
    with pytest.raises(InvalidSignature, match="signed 3600 s in the future, by this machine's clock, more than 300 s"):
        verified(headers, body, secret=SECRET, now=NOW - 3600)
    assert verified(headers, bytearray(body), secret=SECRET, now=NOW) == job  # type: ignore[arg-type]


def test_secrets_are_random_and_accepted_by_the_service() -> None:
    assert new_secret() != new_secret()
    assert parse_webhook("https://receiver.example/", new_secret()) is not None


@pytest.mark.parametrize("secret", ["whsec_é!", "", "whsec_", "whsec_" + base64.b64encode(b"k" * 23).decode()])
def test_a_secret_that_anybody_could_guess_verifies_nothing(job: Job, secret: str) -> None:
    body, stamp = message(job), f"m.{NOW}."
    key = b"" if "é" in secret else base64.b64decode(secret.removeprefix("whsec_"))
    digest = hmac.new(key, stamp.encode() + body, hashlib.sha256).digest()
    signature = f"v1,{base64.b64encode(digest).decode()}"
    forged = {"webhook-id": "m", "webhook-timestamp": str(NOW), "webhook-signature": signature}
    with pytest.raises(BadArgument, match="secret: expected whsec_ followed by 24 bytes or more in base64"):
        verified(forged, body, secret=secret, now=NOW)


async def _submitted(service: InMemoryService, **given: str) -> None:
    async with AsyncClient("http://pliant.test", transport=service) as client:
        await client.submit(100 * np.random.default_rng(0).random((4, 5, 2)), **given)


def test_both_clients_send_the_webhook_parts() -> None:
    import asyncio

    given = {"webhook": "https://receiver.example/x", "webhook_secret": SECRET}
    one, other = InMemoryService(), InMemoryService()
    Client("http://pliant.test", transport=one).submit(100 * np.random.default_rng(0).random((4, 5, 2)), **given)
    asyncio.run(_submitted(other, **given))
    for service in (one, other):
        sent = next(request for request in service.requests if request.url.path == "/v1/jobs").content
        assert b'name="webhook"\r\n\r\nhttps://receiver.example/x\r\n' in sent
        assert f'name="webhook_secret"\r\n\r\n{SECRET}\r\n'.encode() in sent
