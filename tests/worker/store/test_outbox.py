"""Outbox and webhook sender with real receivers and a real store: delivery, retries, giving up."""

from __future__ import annotations

import base64
import collections
import dataclasses
import hashlib
import hmac
import ipaddress
import json
import re
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pliant.worker.jobs.retry import retry
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.records import Webhook
from pliant.worker.settings import Settings
from pliant.worker.store import outbox as outbox_module
from pliant.worker.store.connection import connect
from pliant.worker.store.outbox import Lease, Outbox
from pliant.worker.webhooks.sender import (
    CONCURRENT,
    PAUSES,
    PER_OWNER,
    PER_RECEIVER,
    WebhookSender,
    _release,
    resolve,
    trusted_by_default,
)
from serving import until

SECRET = "whsec_" + base64.b64encode(b"k" * 32).decode()
LOOPBACK = "127.0.0.0/8"
SOON = 0.05
"""Seconds between looks for messages, and for the end of a receiver: tenfold as often as outside tests."""


class Receiver:
    """A web server that records requests and sends the answers it was given."""

    def __init__(self) -> None:
        self.got: list[tuple[str, dict[str, str], bytes]] = []
        self.answers: list[int] = []
        self.open = threading.Event()
        """While it is cleared, requests are accepted but not answered."""
        self.open.set()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                receiver.got.append((self.path, {name.lower(): value for name, value in self.headers.items()}, body))
                receiver.open.wait(20)
                status = receiver.answers.pop(0) if receiver.answers else 204
                self.send_response(status)
                if 300 <= status < 400:
                    self.send_header("Location", f"http://127.0.0.1:{receiver.port}/elsewhere")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self.server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}/hook?x=1"
        threading.Thread(target=self.server.serve_forever, args=(SOON,), daemon=True).start()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.server.shutdown()
    made.server.server_close()


@pytest.fixture
def inputs_file(tmp_path: Path) -> Path:
    """Small inputs, since these tests submit dozens of jobs."""
    path = tmp_path / "small.npz"
    path.write_bytes(b"x" * 1000)
    return path


@pytest.fixture
def door(settings: Settings) -> Jobs:
    return Jobs.open(dataclasses.replace(settings, webhook_networks=LOOPBACK))


Made = Callable[..., Job]


@pytest.fixture
def made(door: Jobs, inputs_file: Path, interpretation: Interpretation) -> Made:
    """Submit a job and cancel it at once, so that its webhook is pending."""

    def call(url: str, *, end: bool = True, owner: str | None = None) -> Job:
        hook = Webhook(url=url, secret=SECRET)
        job, _ = (door if owner is None else door.of(owner)).submit(
            inputs_file, Submission(options=Options(), name="hooked", webhook=hook), interpretation=interpretation
        )
        return door.cancel(job.id) if end else job

    return call


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.worker.webhooks.sender.LOOK_EVERY", SOON)


@pytest.fixture
def webhook_sender(door: Jobs, soon: None) -> Iterator[WebhookSender]:
    """A sender with short pauses; the test starts it."""
    carrier = WebhookSender.open(door.settings, door.records)
    carrier.pauses = (0.05, 0.05)
    yield carrier
    carrier.stop()
    assert not carrier.alive


def pending(outbox: Outbox) -> int:
    """The number of messages that are not sent yet."""
    return int(outbox._take.registered_client.zcard(f"{outbox._at}outbox"))


def test_the_end_of_a_job_is_sent_once_with_signature_and_body(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    waiting = made(receiver.url, end=False)
    assert pending(webhook_sender.outbox) == 0
    job = door.cancel(waiting.id)
    assert pending(webhook_sender.outbox) == 1
    webhook_sender.start()
    until(lambda: pending(webhook_sender.outbox) == 0)
    ((path, headers, body),) = receiver.got
    assert path == "/hook?x=1"
    assert headers["host"] == f"127.0.0.1:{receiver.port}"
    assert headers["content-type"] == "application/json"
    assert headers["webhook-id"] == f"msg_{door.records.get(job.id).attempt_id}"
    assert abs(int(headers["webhook-timestamp"]) - time.time()) < 10
    content = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    digest = hmac.new(b"k" * 32, content, hashlib.sha256).digest()
    assert headers["webhook-signature"] == f"v1,{base64.b64encode(digest).decode()}"
    event = json.loads(body)
    assert (event["type"], Job.model_validate(event["data"])) == ("job.cancelled", job)
    assert SECRET.encode() not in body
    until(lambda: "Webhook delivered: the receiver returned 204 (attempt 1)." in door.log(job.id))
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ Webhook delivered.*\n", door.log(job.id))
    time.sleep(4 * SOON)
    assert len(receiver.got) == 1


def test_a_failed_delivery_is_repeated_with_the_same_id(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    receiver.answers = [500, 302]
    job = made(receiver.url)
    webhook_sender.start()
    until(lambda: pending(webhook_sender.outbox) == 0)
    assert [headers["webhook-id"] for _, headers, _ in receiver.got] == [
        f"msg_{door.records.get(job.id).attempt_id}"
    ] * 3
    assert {path for path, _, _ in receiver.got} == {"/hook?x=1"}, "a redirect is not followed"
    assert len({body for _, _, body in receiver.got}) == 1
    log = door.log(job.id)
    assert "the receiver returned 500 (attempt 1); next attempt in" in log
    assert "the receiver returned 302 (attempt 2)" in log
    assert "(attempt 3)" in log


def test_delivery_is_abandoned_after_the_last_attempt_or_a_410(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    receiver.answers = [500, 500, 500]
    job = made(receiver.url)
    webhook_sender.start()
    until(lambda: pending(webhook_sender.outbox) == 0)
    until(lambda: "abandoned: the receiver returned 500 (attempt 3, the last one)." in door.log(job.id))
    receiver.answers = [410]
    other = made(receiver.url)
    until(lambda: "abandoned: the receiver returned 410" in door.log(other.id))
    assert len(receiver.got) == 4
    until(lambda: door.records.tallies()["webhooks:given_up"] == 2)  # after the log
    assert door.records.tallies()["webhooks:tried"] == 4


def test_a_refused_connection_counts_as_a_failed_attempt(door: Jobs, made: Made, webhook_sender: WebhookSender) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        job = made(f"http://127.0.0.1:{unused.getsockname()[1]}/")
        webhook_sender.start()
        until(lambda: "ConnectError (attempt 3, the last one)." in door.log(job.id))


@pytest.mark.parametrize(
    "name", ["x" * 64 + ".example", "no-such-name.invalid", "a..b"], ids=["too long", "unknown", "empty label"]
)
def test_an_invalid_host_name_counts_as_a_failed_attempt(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender, name: str
) -> None:
    bad, good = made(f"http://{name}/"), made(receiver.url)
    webhook_sender.start()
    until(lambda: "Webhook delivered" in door.log(good.id))
    until(lambda: "abandoned" in door.log(bad.id), seconds=30)


def test_a_host_with_an_internal_address_is_abandoned_without_connecting(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    webhook_sender.networks = ""
    job = made(f"http://localhost:{receiver.port}/")
    mixed = made(f"http://mixed.example:{receiver.port}/")
    inside, outside = ipaddress.ip_address("127.0.0.1"), ipaddress.ip_address("1.1.1.1")
    webhook_sender.resolve = lambda host, port: [outside, inside] if host == "mixed.example" else resolve(host, port)
    webhook_sender.start()
    until(lambda: "localhost resolves to an address that is not on the public internet" in door.log(job.id))
    until(lambda: "mixed.example resolves to" in door.log(mixed.id))
    assert "1.1.1.1" not in door.log(mixed.id), "nor does anybody learn what a name inside stands for"
    until(lambda: pending(webhook_sender.outbox) == 0)
    assert receiver.got == []


def test_the_host_is_resolved_once_and_that_address_is_connected(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    """DNS rebinding: an allowed address when it is checked, another one when it is used."""
    asked: list[str] = []

    def rebinding(host: str, port: int) -> list[ipaddress.IPv4Address | ipaddress.IPv6Address]:
        del port
        asked.append(host)
        return [ipaddress.ip_address("127.0.0.1" if len(asked) == 1 else "127.0.0.2")]

    webhook_sender.resolve = rebinding
    job = made(f"http://rebinding.example:{receiver.port}/hook")
    webhook_sender.start()
    until(lambda: "Webhook delivered" in door.log(job.id))
    assert asked == ["rebinding.example"]
    ((_, headers, _),) = receiver.got
    assert headers["host"] == f"rebinding.example:{receiver.port}"


def test_an_address_without_a_listener_is_followed_by_the_next(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    """A host with an IPv6 address that does not work is reached at its IPv4 address."""
    webhook_sender.resolve = lambda host, port: [ipaddress.ip_address(each) for each in ("127.0.0.2", "127.0.0.1")]
    job = made(f"http://both.example:{receiver.port}/hook")
    webhook_sender.start()
    until(lambda: "Webhook delivered" in door.log(job.id))
    assert "(attempt 1)" in door.log(job.id)
    assert len(receiver.got) == 1


@pytest.fixture
def certificate(receiver: Receiver, tmp_path: Path) -> Path:
    """A self-signed certificate for right.example, which the receiver uses."""
    if shutil.which("openssl") is None:
        pytest.skip("needs the command openssl to make a certificate")
    pem = tmp_path / "both.pem"
    names = ["-subj", "/CN=x", "-addext", "subjectAltName=DNS:right.example"]
    files = ["-keyout", str(pem), "-out", str(tmp_path / "cert.pem")]
    kind = ["-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
    command = ["openssl", "req", *kind, *names, *files]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "cert.pem", pem)
    receiver.server.socket = context.wrap_socket(receiver.server.socket, server_side=True)
    return tmp_path / "cert.pem"


def test_the_certificate_must_match_the_host_name(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender, certificate: Path
) -> None:
    webhook_sender.resolve = lambda host, port: [ipaddress.ip_address("127.0.0.1")]
    webhook_sender.trusted = ssl.create_default_context(cafile=str(certificate))
    right, wrong = (made(f"https://{name}.example:{receiver.port}/") for name in ("right", "wrong"))
    webhook_sender.start()
    until(lambda: "Webhook delivered" in door.log(right.id))
    refused = "abandoned: the receiver's certificate is not accepted: "
    until(lambda: f"{refused}Hostname mismatch" in door.log(wrong.id))
    webhook_sender.trusted = trusted_by_default()
    stranger = made(f"https://right.example:{receiver.port}/")
    until(lambda: f"{refused}self" in door.log(stranger.id))
    assert len(receiver.got) == 1


def test_certificate_authorities_of_the_system_are_trusted(
    door: Jobs, made: Made, receiver: Receiver, certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as a company's own. Public ones are trusted too, even if the system has no list of them."""
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    carrier = WebhookSender.open(door.settings, door.records)
    carrier.resolve = lambda host, port: [ipaddress.ip_address("127.0.0.1")]
    job = made(f"https://right.example:{receiver.port}/")
    carrier.start()
    try:
        until(lambda: "Webhook delivered" in door.log(job.id))
    finally:
        carrier.stop()
    others = len(carrier.trusted.get_ca_certs()) - len(ssl.create_default_context().get_ca_certs())
    assert others == len(httpx.create_ssl_context(trust_env=False).get_ca_certs())


def test_proxy_variables_are_ignored(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    job = made(receiver.url)
    webhook_sender.start()
    until(lambda: "Webhook delivered" in door.log(job.id))


def test_a_slow_receiver_delays_no_other_messages(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    slow = Receiver()
    slow.open.clear()
    try:
        for _ in range(2 * CONCURRENT):
            made(slow.url)
        webhook_sender.start()
        until(lambda: len(slow.got) == PER_RECEIVER)
        quick = made(receiver.url)
        until(lambda: "Webhook delivered" in door.log(quick.id), seconds=5)
        assert len(slow.got) == PER_RECEIVER, "the others wait their turn"
        until(
            lambda: pending(webhook_sender.outbox) == 2 * CONCURRENT
        )  # the log is written before the message is removed
        assert door.records.tallies()["webhooks:tried"] == PER_RECEIVER + 1, (
            "a message that was postponed was not tried"
        )
    finally:
        slow.open.set()
        slow.server.shutdown()
        slow.server.server_close()


def test_a_slow_name_lookup_delays_no_other_messages(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    asked: list[str] = []
    answered = threading.Event()

    def slowly(host: str, port: int) -> list[ipaddress.IPv4Address | ipaddress.IPv6Address]:
        asked.append(host)
        if host.startswith("slow"):
            answered.wait(30)
        return resolve("127.0.0.1", port)

    webhook_sender.resolve = slowly
    try:
        for number in range(PER_OWNER):
            made(f"http://slow{number}.example:{receiver.port}/", owner="somebody")
        webhook_sender.start()
        until(lambda: len(asked) == PER_OWNER, seconds=30)
        quick = made(receiver.url)
        until(lambda: "Webhook delivered" in door.log(quick.id), seconds=5)
        assert len(receiver.got) == 1
    finally:
        answered.set()


def test_releasing_removes_counters_that_reach_zero() -> None:
    busy = collections.Counter({"receiver a": 1, "owner b": 2})
    _release(busy, ["receiver a", "owner b"], None)  # type: ignore[arg-type]
    assert dict(busy) == {"owner b": 1}


def test_one_owner_does_not_occupy_all_connections(door: Jobs, made: Made, webhook_sender: WebhookSender) -> None:
    job = made("http://a.example/")
    busy = collections.Counter({f"owner {door.records.get(job.id).owner}": PER_OWNER})
    assert webhook_sender._take(busy) is None
    assert webhook_sender._take(collections.Counter()) is None, "postponed"
    webhook_sender.clock = lambda: time.time() + 3
    taken = webhook_sender._take(collections.Counter())
    assert taken is not None
    assert (taken[0].id, taken[0].tries) == (job.id, 1)


def test_a_message_survives_a_sender_killed_while_sending_it(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    job = made(receiver.url)
    now = int(time.time() * 1000)
    assert webhook_sender.outbox.take(now=now + 10, until=now + 1500) == Lease(job.id, 1, now + 1500), (
        "and then it was killed"
    )
    assert webhook_sender.outbox.take(now=now + 10, until=now + 1500) is None, "nobody else sends it meanwhile"
    webhook_sender.start()
    until(lambda: "(attempt 2)" in door.log(job.id))
    assert len(receiver.got) == 1


def test_a_message_that_always_kills_its_sender_is_abandoned(
    door: Jobs, made: Made, receiver: Receiver, webhook_sender: WebhookSender
) -> None:
    job = made(receiver.url)
    for _ in range(4):
        webhook_sender.outbox.take(now=int(time.time() * 1000) + 10, until=0)
    webhook_sender.start()
    until(lambda: "maximum number of attempts" in door.log(job.id))
    assert receiver.got == []


def test_a_deleted_job_sends_nothing(door: Jobs, made: Made, receiver: Receiver, settings: Settings) -> None:
    job = made(receiver.url)
    outbox = Outbox(connect(settings.redis, decode=True), prefix=settings.queue)
    lease = outbox.take(now=int(time.time() * 1000) + 10, until=int(time.time() * 1000) + 60_000)
    assert lease is not None
    door.delete(job.id)
    assert pending(outbox) == 0
    outbox.later(lease, due=0)
    outbox.postpone(lease, due=0)
    assert pending(outbox) == 0, "nor does a try that was under way bring it back"
    assert door.records.tallies()["webhooks:tried"] == 1


@pytest.mark.parametrize("script", [outbox_module._TAKE, outbox_module._LATER, outbox_module._CLOSE])
def test_no_script_negates_an_argument(script: str) -> None:
    """Redis 7.0 passes -0 on as "-0", which HINCRBY refuses: each retry ended with a traceback in the log. Valkey passes 0."""
    assert "-ARGV" not in script


def test_a_retried_job_sends_its_webhook_and_a_job_without_one_does_not(
    door: Jobs,
    made: Made,
    receiver: Receiver,
    webhook_sender: WebhookSender,
    inputs_file: Path,
    interpretation: Interpretation,
) -> None:
    again = retry(door, made(receiver.url).id)
    door.cancel(again.id)
    plain = door.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0]
    assert door.cancel(plain.id).status is Status.CANCELLED
    assert pending(webhook_sender.outbox) == 2
    webhook_sender.start()
    until(lambda: len(receiver.got) == 2 and pending(webhook_sender.outbox) == 0)
    assert len({headers["webhook-id"] for _, headers, _ in receiver.got}) == 2


def test_a_new_job_with_the_id_of_a_deleted_one_sends_another_message(
    door: Jobs, receiver: Receiver, webhook_sender: WebhookSender, inputs_file: Path, interpretation: Interpretation
) -> None:
    hooked = Submission(options=Options(), id="take-1", webhook=Webhook(url=receiver.url, secret=SECRET))
    webhook_sender.start()
    for number in (1, 2):
        door.submit(inputs_file, hooked, interpretation=interpretation)
        door.cancel("take-1")
        until(lambda: pending(webhook_sender.outbox) == 0)
        door.delete("take-1")
        assert len({headers["webhook-id"] for _, headers, _ in receiver.got}) == number


def test_a_job_submitted_while_the_message_of_its_deleted_namesake_is_sent_keeps_its_message(
    door: Jobs, receiver: Receiver, webhook_sender: WebhookSender, inputs_file: Path, interpretation: Interpretation
) -> None:
    hooked = Submission(options=Options(), id="take-1", webhook=Webhook(url=receiver.url, secret=SECRET))
    door.submit(inputs_file, hooked, interpretation=interpretation)
    door.cancel("take-1")
    receiver.open.clear()
    webhook_sender.start()
    until(lambda: len(receiver.got) == 1)
    door.delete("take-1")
    door.submit(inputs_file, hooked, interpretation=interpretation)
    door.cancel("take-1")
    receiver.open.set()
    until(lambda: len(receiver.got) == 2 and pending(webhook_sender.outbox) == 0)
    assert len({headers["webhook-id"] for _, headers, _ in receiver.got}) == 2


def test_retry_pauses_increase_and_sum_to_about_a_day() -> None:
    assert list(PAUSES) == sorted(PAUSES)
    assert 20 * 3600 < sum(PAUSES) < 28 * 3600
