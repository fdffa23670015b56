"""The webhook sender: sends the messages of the outbox, with retries for about a day. It runs in the reconciler's process.

No job waits for a receiver. Up to `CONCURRENT` messages are sent at once, at most `PER_RECEIVER` of them to one host, so a receiver that
does not answer delays nobody else's messages.
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
from dataclasses import dataclass, field
from functools import partial
from urllib.parse import urlsplit

from pliant.worker.errors import StoreUnavailable, UnknownJob
from pliant.worker.records import Records, Webhook
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.store.outbox import Outbox
from pliant.worker.webhooks.address_policy import Address, NotPublic, checked_address, resolve
from pliant.worker.webhooks.message import message, signed

logger = logging.getLogger(__name__)

PAUSES = (5.0, 30.0, 120.0, 600.0, 1800.0, 7200.0, 21600.0, 54000.0)
"""Seconds between the tries, a day in all; each is stretched by chance, up to a fifth."""

CONCURRENT = 16
"""Messages that are sent at once."""

PER_RECEIVER, PER_OWNER = 2, 8
"""The same to one host, and of the jobs of one owner: one that is silent leaves the others their share."""

POSTPONED = 2.0
"""Seconds after which a message is looked at again whose receiver or owner had reached its share."""

WITHIN = 20.0
"""Seconds that one try may take from the name's look-up to the answer's headers."""

LEASE = 60.0
"""Seconds after which a message that a killed process had taken is sent by another; more than `WITHIN`."""

LOOK_EVERY = 0.5

Resolve = Callable[[str, int], list[Address]]


@dataclass(kw_only=True)
class WebhookSender:
    """Sends the messages of one installation. Any number may run: a message is taken by one of them at a time."""

    records: Records
    outbox: Outbox
    networks: str = ""
    """`Settings.webhook_networks`."""
    resolve: Resolve = resolve
    clock: Callable[[], float] = time.time
    """Seconds since 1970."""
    pauses: tuple[float, ...] = PAUSES
    trusted: ssl.SSLContext | None = None
    """Which certificates count; None: those of the usual authorities."""
    _ended: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    @classmethod
    def open(cls, settings: Settings, records: Records) -> WebhookSender:
        """Connect to what the settings name."""
        outbox = Outbox(connect(settings.redis, decode=True), prefix=settings.queue)
        return cls(records=records, outbox=outbox, networks=settings.webhook_networks)

    def start(self) -> None:
        """Begin, on a thread of its own."""
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="webhook sender", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """False if the thread has ended, which it does by itself only through a defect."""
        return self._thread is not None and self._thread.is_alive()

    def stop(self) -> None:
        """End; what is under way is sent again by the next one."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(2 * LOOK_EVERY + 1)

    async def _run(self) -> None:
        under_way: set[asyncio.Task[None]] = set()
        busy: Counter[str] = Counter()
        while not self._ended.is_set():
            taken = None
            if len(under_way) < CONCURRENT:
                try:
                    taken = await asyncio.to_thread(self._take, busy)
                except StoreUnavailable as error:
                    logger.warning("webhooks: %s", error)
            if taken is None:
                await asyncio.sleep(LOOK_EVERY)
                continue
            id, tries, limits = taken
            task = asyncio.create_task(self._deliver(id, tries))
            under_way.add(task)
            busy.update(limits)
            task.add_done_callback(under_way.discard)
            task.add_done_callback(partial(_release, busy, limits))
            task.add_done_callback(_complain)
        for task in under_way:
            task.cancel()

    def _take(self, busy: Counter[str]) -> tuple[str, int, list[str]] | None:
        """Take a message that is due and whose receiver and owner have few under way; postpone the others.

        Returns
        -------
        id : str
            The job.
        tries : int
            How often it was tried, this time among them.
        limits : list of str
            The receiver and the owner, as they are counted in `busy`.
        """
        while True:
            now = self.clock()
            taken = self.outbox.take(now=int(now * 1000), until=int((now + LEASE) * 1000))
            if taken is None:
                return None
            try:
                stored = self.records.get(taken[0])
            except UnknownJob:
                self.outbox.given_up(taken[0])
                continue
            host = "" if stored.webhook is None else urlsplit(stored.webhook.url).netloc
            receiver, owner = f"receiver {host}", f"owner {stored.owner}"
            if busy[receiver] < PER_RECEIVER and busy[owner] < PER_OWNER:
                return *taken, [receiver, owner]
            self.outbox.postpone(taken[0], due=int((now + POSTPONED) * 1000))

    async def _deliver(self, id: str, tries: int) -> None:
        """Try once, and write down what came of it."""
        try:
            try:
                stored = await asyncio.to_thread(self.records.get, id)
            except UnknownJob:
                return await asyncio.to_thread(self.outbox.given_up, id)
            if stored.webhook is None or tries > len(self.pauses) + 1:  # a try that kills its process counts, too
                return await asyncio.to_thread(self._give_up, id, "it was tried often enough.")
            body = message(stored.job)
            try:
                async with asyncio.timeout(WITHIN):
                    status = await self._post(stored.webhook, id=id, body=body)
            except NotPublic as error:
                await asyncio.to_thread(self._give_up, id, str(error))
            except _failures() as error:
                await asyncio.to_thread(self._again, id, tries, type(error).__name__)
            else:
                await asyncio.to_thread(self._answered, id, tries, status)
        except StoreUnavailable as error:  # the lease ends, and it is tried again
            logger.warning("webhook of job %s: %s", id, error)

    async def _post(self, webhook: Webhook, *, id: str, body: bytes) -> int:
        """Send, to the very address that was found good; return the status of the answer, whose body is not read."""
        import httpx

        parts = urlsplit(webhook.url)
        host = parts.hostname or ""
        port = parts.port or (443 if parts.scheme == "https" else 80)
        addresses = await asyncio.to_thread(self.resolve, host, port)
        address = checked_address(host, addresses, self.networks)
        request = httpx.Request(
            "POST",
            httpx.URL(webhook.url).copy_with(host=str(address), port=port, fragment=None),
            content=body,
            headers={
                "Host": parts.netloc,
                "Content-Type": "application/json",
                "User-Agent": "Pliant-Webhook/1",
                **signed(webhook.secret, id=f"msg_{id}", timestamp=int(self.clock()), body=body),
            },
            # The certificate must be the name's, though the connection goes to the number.
            extensions={"sni_hostname": host, "timeout": httpx.Timeout(WITHIN).as_dict()},
        )
        # No proxy from the environment, which would look the name up again; no redirect, which would lead elsewhere.
        async with httpx.AsyncClient(
            trust_env=False, follow_redirects=False, timeout=WITHIN, verify=self.trusted or True
        ) as client:
            answer = await client.send(request, stream=True)
            await answer.aclose()
        return answer.status_code

    # Each is said before it is settled: what is owed no longer has its sentence in the log, whenever we are killed.

    def _answered(self, id: str, tries: int, status: int) -> None:
        if 200 <= status < 300:
            self._say(id, f"Webhook delivered: the receiver answered {status} (try {tries}).")
            self.outbox.delivered(id)
        elif status == 410:
            self._give_up(id, "the receiver answered 410, it wants no more.")
        else:
            self._again(id, tries, f"the receiver answered {status}")

    def _again(self, id: str, tries: int, why: str) -> None:
        if tries > len(self.pauses):
            self._give_up(id, f"{why}, at try {tries}, the last.")
            return
        pause = self.pauses[tries - 1] * (1 + 0.2 * random.random())  # noqa: S311 - so that not all return at once
        self._say(id, f"Webhook not delivered: {why} (try {tries}); again in {pause:.0f} s.")
        self.outbox.later(id, due=int((self.clock() + pause) * 1000))

    def _give_up(self, id: str, why: str) -> None:
        self._say(id, f"Webhook given up: {why}")
        self.outbox.given_up(id)

    def _say(self, id: str, sentence: str) -> None:
        logger.info("job %s: %s", id, sentence)
        self.records.append_log(id, [sentence])


def _release(busy: Counter[str], limits: list[str], _: asyncio.Task[None]) -> None:
    busy.subtract(limits)


def _complain(task: asyncio.Task[None]) -> None:
    """Say what nobody foresaw; the lease ends, and the message is tried again."""
    if not task.cancelled() and (error := task.exception()) is not None:
        logger.error("webhook not sent", exc_info=error)


def _failures() -> tuple[type[Exception], ...]:
    """Return what is raised when there is no answer; TimeoutError is an OSError, a name with too long a label a UnicodeError."""
    import httpx

    return OSError, UnicodeError, httpx.TransportError, httpx.InvalidURL
