"""Detects a process whose blob store is not the one of its installation: no job has its inputs there.

A missing file of one job is a lost file, as long as those of others are there. Inputs are stored before the record that names them, and
are kept as long as it.
"""

from __future__ import annotations

import os
from contextlib import suppress

from pliant.schemas.job import Status
from pliant.worker.errors import ForeignStore, StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings

NEWEST = 20
"""Number of jobs whose inputs are looked for, at most; a single one that is there ends the search."""


def check_blob_store(jobs: Jobs) -> None:
    """Check that the inputs of at least one of the newest jobs are in the blob store, if there are jobs.

    With the embedded Valkey, all processes are on one host and have the settings of one `pliant up`: missing files are lost.

    Raises
    ------
    ForeignStore
        None is there.
    StoreUnavailable
        A store does not answer.
    """
    if jobs.settings.redis_url is None:
        return
    newest, _ = jobs.records.page(cursor=None, limit=NEWEST, statuses=tuple(Status), owner=None)
    for stored in newest:
        with suppress(FileNotFoundError):
            jobs.blobs.get(stored.inputs)
            return
    if newest:
        raise ForeignStore(jobs.settings.blobs)


def check_at_start(jobs: Jobs) -> None:
    """Check the blob store like `check_blob_store`, unless a store does not answer: then the first job shows it.

    Raises
    ------
    ForeignStore
        The blob store has no inputs of the newest jobs.
    """
    with suppress(StoreUnavailable):
        check_blob_store(jobs)


def check_before_forking(settings: Settings) -> None:
    """Check like `check_at_start`, in a process of its own: the threads of the blob store's client must not exist when a worker forks.

    Raises
    ------
    ForeignStore
        The blob store has no inputs of the newest jobs.
    """
    process = os.fork()
    if process == 0:
        try:
            check_at_start(Jobs.open(settings))
        except ForeignStore:
            os._exit(os.EX_CONFIG)
        finally:
            os._exit(os.EX_OK)  # other faults end the worker when it meets them itself
    _, status = os.waitpid(process, 0)
    if os.waitstatus_to_exitcode(status) == os.EX_CONFIG:
        raise ForeignStore(settings.blobs)
