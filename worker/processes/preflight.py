"""What is checked before processes are started, so that an invalid setting is reported once and by its name."""

from __future__ import annotations

import time
from collections.abc import Callable

from pliant.worker import tracing
from pliant.worker.environment import variable_of
from pliant.worker.errors import InvalidSetting, ServerFailed, StoreUnavailable
from pliant.worker.paths import make_data_directory
from pliant.worker.processes.memory import check_workers
from pliant.worker.processes.valkey import disk_is_full
from pliant.worker.settings import Settings

ASK_EVERY = 1.0
"""Seconds between two attempts to reach a server that does not answer."""


def check_settings(settings: Settings) -> None:
    """Check what the processes would end with at their start; no server is called.

    Raises
    ------
    InvalidSetting
        The workers do not fit into the memory, or what `check_process` finds.
    """
    check_workers(settings)
    check_process(settings)


def check_process(settings: Settings) -> None:
    """Check the settings that every process needs; no server is called.

    Raises
    ------
    InvalidSetting
        The URL of a store is malformed or names a folder that cannot be made, or the extra for tracing is not installed.
    """
    tracing.check(settings.tracing)
    # The clients are imported for given URLs only: they would stay in the memory of this process.
    if settings.redis_url is not None:
        from pliant.worker.store.connection import connect

        connect(settings.redis_url, decode=True).close()
    if settings.blob_url is not None:
        from pliant.worker.store.blobs import Blobs

        try:
            Blobs.open(settings.blob_url)
        except StoreUnavailable as fault:  # remote stores are not called here: this is a folder
            raise InvalidSetting(
                variable_of("blob_url"),
                expected="a folder that exists or can be made",
                got=repr(settings.blob_url),
                hint=f"Make the folder for the user that runs Pliant, or name another one ({fault.reason}).",
            ) from fault


def open_data_directory(settings: Settings) -> None:
    """Create the data directory and its folders.

    Raises
    ------
    InvalidSetting
        The user of this process cannot create or write it.
    """
    try:
        make_data_directory(settings.data)
    except OSError as fault:
        raise InvalidSetting(
            variable_of("data"),
            expected="a folder that this user can create and write",
            got=f"{str(fault.filename or settings.data)!r} ({fault.strerror})",
            hint="Make the folder for the user that runs Pliant, or name another one.",
        ) from fault


def check_disks(settings: Settings) -> None:
    """Check that the disks of the data directory and of a blob store in a directory have space: without, a service does not become ready.

    Raises
    ------
    ServerFailed
        One of them is full.
    """
    folders = [settings.data]
    if settings.blob_url is not None:
        from pliant.worker.store.blobs import Blobs

        directory = Blobs.open(settings.blob_url).directory
        folders += [] if directory is None else [directory]
    for folder in folders:
        if disk_is_full(folder):
            raise ServerFailed(f"The disk of {folder} is full: free some space, then start again.")


def wait_for_store(settings: Settings, tell: Callable[[str], None], *, within: float | None = None) -> None:
    """Wait until the server of PLIANT_REDIS_URL answers; return at once without that setting.

    Processes that start without it would end. `tell` gets a message at once and then ever less often. `within`: seconds; None: no
    limit.

    Raises
    ------
    StoreUnavailable
        It does not answer within that time.
    """
    if settings.redis_url is None:
        return
    from pliant.worker.store.connection import ping
    from pliant.worker.store.outage import Outage

    outage = Outage(redis_url=settings.redis_url, tell=tell)
    began = time.monotonic()
    while True:
        try:
            ping(settings.redis_url)
        except StoreUnavailable as error:
            if within is not None and time.monotonic() > began + within:
                raise
            outage.failed(error)
            time.sleep(ASK_EVERY)
        else:
            outage.answered()
            return
