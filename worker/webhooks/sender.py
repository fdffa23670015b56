"""The webhook sender: send the messages of the outbox, with retries for about a day. It runs in the reconciler's process.

Jobs never wait for receivers. Up to `CONCURRENT` messages are sent at once, at most `PER_RECEIVER` of them to one host, so that an
unresponsive receiver does not delay other messages.
"""

from __future__ import annotations

import asyncio
import logging
import random
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from urllib.parse import urlsplit

from pliant.worker.errors import StoreUnavailable, UnknownJob
from pliant.worker.records import Records, Webhook, dated
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.store.outage import Outage, warn
from pliant.worker.store.outbox import Lease, Outbox
from pliant.worker.webhooks.address_policy import Address, NotPublic, checked_addresses, resolve
from pliant.worker.webhooks.message import message, signed

logger = logging.getLogger(__name__)

PAUSES = (5.0, 30.0, 120.0, 600.0, 1800.0, 7200.0, 21600.0, 54000.0)
"""Seconds between attempts, about a day in total; each is extended randomly by up to 20 %."""

CONCURRENT = 16
"""Maximum number of messages sent at once."""

PER_RECEIVER, PER_OWNER = 2, 8
"""Maximum number of messages sent at once to one host, and for one owner, so that slow receivers leave capacity for others."""

POSTPONED = 2.0
"""Seconds by which a message is postponed if its receiver has reached `PER_RECEIVER` or its owner `PER_OWNER`."""

WITHIN = 20.0
"""Seconds that one attempt may take, from name resolution to the response headers."""

LOOKUPS = 64
"""Maximum number of concurrent name lookups, in dedicated threads. A lookup cannot be cancelled, and without an answer it takes longer
than `WITHIN`: the resolver queries each of up to three servers twice for 5 s. An owner then holds at most twice `PER_OWNER` threads."""

LEASE = 60.0
"""Seconds after which a message leased by a killed process is sent by another; more than `WITHIN`."""

LOOK_EVERY = 0.5

Resolve = Callable[[str, int], list[Address]]


@dataclass(kw_only=True)
class WebhookSender:
    """Sends the messages of one installation. Any number may run: each message is leased by one sender at a time."""

    records: Records
    outbox: Outbox
    outage: Outage
    networks: str = ""
    """`Settings.webhook_networks`."""
    resolve: Resolve = resolve
    clock: Callable[[], float] = time.time
    """Seconds since 1970."""
    pauses: tuple[float, ...] = PAUSES
    trusted: ssl.SSLContext = field(default_factory=lambda: trusted_by_default())
    """TLS context with the trusted certificate authorities."""
    _lookups: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(LOOKUPS, thread_name_prefix="webhook names")
    )
    _ended: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    @classmethod
    def open(cls, settings: Settings, records: Records) -> WebhookSender:
        """Return the sender for the stores in the settings."""
        outbox = Outbox(connect(settings.redis, decode=True), prefix=settings.queue)
        outage = Outage(redis_url=settings.redis, tell=warn(logger, "webhooks: "))
        return cls(records=records, outbox=outbox, outage=outage, networks=settings.webhook_networks)

    def start(self) -> None:
        """Start a thread that sends messages."""
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="webhook sender", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread is running; it ends by itself only after an unexpected error."""
        return self._thread is not None and self._thread.is_alive()

    def stop(self) -> None:
        """Stop the thread; messages in progress are sent again by the next sender."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(2 * LOOK_EVERY + 1)

    async def _run(self) -> None:
        try:
            await self._send_due()
        finally:
            self._lookups.shutdown(wait=False, cancel_futures=True)

    async def _send_due(self) -> None:
        """Send due messages until the sender is stopped."""
        under_way: set[asyncio.Task[None]] = set()
        busy: Counter[str] = Counter()
        while not self._ended.is_set():
            taken = None
            if len(under_way) < CONCURRENT:
                try:
                    taken = await asyncio.to_thread(self._take, busy)
                except StoreUnavailable as error:
                    self.outage.failed(error)
                else:
                    self.outage.answered()
            if taken is None:
                await asyncio.sleep(LOOK_EVERY)
                continue
            lease, limits = taken
            task = asyncio.create_task(self._deliver(lease))
            under_way.add(task)
            busy.update(limits)
            task.add_done_callback(under_way.discard)
            task.add_done_callback(partial(_release, busy, limits))
            task.add_done_callback(_log_error)
        for task in under_way:
            task.cancel()

    def _take(self, busy: Counter[str]) -> tuple[Lease, list[str]] | None:
        """Lease a due message whose receiver and owner are below their limits; postpone the others.

        Returns the lease, and the keys of receiver and owner in `busy`.
        """
        while True:
            now = self.clock()
            taken = self.outbox.take(now=int(now * 1000), until=int((now + LEASE) * 1000))
            if taken is None:
                return None
            try:
                stored = self.records.get(taken.id)
            except UnknownJob:
                self.outbox.given_up(taken)
                continue
            host = "" if stored.webhook is None else urlsplit(stored.webhook.url).netloc
            receiver, owner = f"receiver {host}", f"owner {stored.owner}"
            if busy[receiver] < PER_RECEIVER and busy[owner] < PER_OWNER:
                return taken, [receiver, owner]
            self.outbox.postpone(taken, due=int((now + POSTPONED) * 1000))

    async def _deliver(self, lease: Lease) -> None:
        """Send the message once and record the outcome."""
        try:
            try:
                stored = await asyncio.to_thread(self.records.get, lease.id)
            except UnknownJob:
                return await asyncio.to_thread(self.outbox.given_up, lease)
            if stored.webhook is None or lease.tries > len(self.pauses) + 1:  # attempts of killed processes count, too
                return await asyncio.to_thread(self._give_up, lease, "the maximum number of attempts is reached.")
            body = message(stored.job)
            try:
                async with asyncio.timeout(WITHIN):
                    # The attempt's id, because a new job may have the id of a deleted one.
                    status = await self._post(stored.webhook, id=f"msg_{stored.attempt_id}", body=body)
            except NotPublic as error:
                await asyncio.to_thread(self._give_up, lease, str(error))
            except _failures() as error:
                await asyncio.to_thread(self._again, lease, _why(error))
            else:
                await asyncio.to_thread(self._handle_status, lease, status)
        except StoreUnavailable as error:  # the message is sent again after the lease
            logger.warning("webhook of job %s: %s", lease.id, error, extra={"job": lease.id})

    async def _post(self, webhook: Webhook, *, id: str, body: bytes) -> int:
        """Send to the first checked address that accepts a connection; return the status of the response, whose body is not read."""
        import httpx

        parts = urlsplit(webhook.url)
        host = parts.hostname or ""
        port = parts.port or (443 if parts.scheme == "https" else 80)
        addresses = await asyncio.get_running_loop().run_in_executor(self._lookups, self.resolve, host, port)
        checked = checked_addresses(host, addresses, self.networks)
        timeout = httpx.Timeout(WITHIN, connect=WITHIN / len(checked))
        request = httpx.Request(
            "POST",
            httpx.URL(webhook.url).copy_with(host=str(checked[0]), port=port, fragment=None),
            content=body,
            headers={
                "Host": parts.netloc,
                "Content-Type": "application/json",
                "User-Agent": "Pliant-Webhook/1",
                **signed(webhook.secret, id=id, timestamp=int(self.clock()), body=body),
            },
            # The certificate must match the host name, although the connection is made to the address.
            extensions={"sni_hostname": host, "timeout": timeout.as_dict()},
        )
        # No proxies, which would resolve the name again, and no redirects to other addresses.
        async with httpx.AsyncClient(
            trust_env=False, follow_redirects=False, timeout=WITHIN, verify=self.trusted
        ) as client:
            for address in checked:
                request.url = request.url.copy_with(host=str(address))
                try:
                    answer = await client.send(request, stream=True)
                except (httpx.ConnectError, httpx.ConnectTimeout):
                    if address == checked[-1]:
                        raise
                else:
                    await answer.aclose()
                    return answer.status_code
        raise AssertionError("unreachable: the last address returns or raises")

    # Log before the outbox changes: a finished message has its log line even if the process is killed in between.

    def _handle_status(self, lease: Lease, status: int) -> None:
        if 200 <= status < 300:
            self._log(lease.id, f"Webhook delivered: the receiver returned {status} (attempt {lease.tries}).")
            self.outbox.delivered(lease)
        elif status == 410:
            self._give_up(lease, "the receiver returned 410 Gone.")
        else:
            self._again(lease, f"the receiver returned {status}")

    def _again(self, lease: Lease, why: str) -> None:
        if lease.tries > len(self.pauses):
            self._give_up(lease, f"{why} (attempt {lease.tries}, the last one).")
            return
        pause = self.pauses[lease.tries - 1] * (1 + 0.2 * random.random())  # noqa: S311 - spreads the retries
        self._log(lease.id, f"Webhook not delivered: {why} (attempt {lease.tries}); next attempt in {pause:.0f} s.")
        self.outbox.later(lease, due=int((self.clock() + pause) * 1000))

    def _give_up(self, lease: Lease, why: str) -> None:
        self._log(lease.id, f"Webhook abandoned: {why}")
        self.outbox.given_up(lease)

    def _log(self, id: str, sentence: str) -> None:
        logger.info("job %s: %s", id, sentence, extra={"job": id})
        self.records.append_log(id, dated(sentence))


def trusted_by_default() -> ssl.SSLContext:
    """Return a TLS context that trusts certifi's authorities and the system's, among them a company's own."""
    import httpx

    context = httpx.create_ssl_context(trust_env=False)  # certifi's
    context.load_default_certs()
    return context


def _release(busy: Counter[str], limits: list[str], _: asyncio.Task[None]) -> None:
    busy -= Counter(limits)  # in place; drops counts of zero


def _log_error(task: asyncio.Task[None]) -> None:
    """Log an unexpected error; the message is sent again after its lease."""
    if not task.cancelled() and (error := task.exception()) is not None:
        logger.error("webhook not sent", exc_info=error)


def _why(error: BaseException) -> str:
    """Return the type of the error, which reveals nothing about internal hosts, or what is wrong with the receiver's certificate."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            return f"the receiver's certificate is not accepted: {cause.verify_message.rstrip('.')}"
        cause = cause.__cause__ or cause.__context__
    return type(error).__name__


def _failures() -> tuple[type[Exception], ...]:
    """Return the exceptions of a failed request; TimeoutError is an OSError, and too long a host label raises UnicodeError."""
    import httpx

    return OSError, UnicodeError, httpx.TransportError, httpx.InvalidURL
