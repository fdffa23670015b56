"""Faults of a complete installation at every stage; afterwards nothing is lost, duplicated, half-written or left over.

`python -m benchmarks.installation.faults` tabulates the same faults. Those that tests/worker injects into workers alone are not repeated.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc"),
    pytest.mark.slow,
]

WANTED = (
    "job_process_writing", "job_process_storing", "valkey_down", "api_uploading", "api_receiving", "api_waiting", "api_downloading",
    "everything", "stopped", "frozen", "twice", "cancel_queued", "cancel_loading", "cancel_cameras", "cancel_reweight",
    "cancel_exporting",
)  # fmt: skip

AGAIN = {
    "valkey_down", "api_uploading", "api_receiving", "frozen", "stopped", "job_process_storing",
    "cancel_queued", "cancel_loading", "cancel_cameras", "cancel_exporting", "api_waiting",
}  # fmt: skip
"""Faults that are also covered by `tests/hosts`, `tests/client`, by stopping a worker (`tests/worker`), or in another state."""


@pytest.fixture(scope="module", autouse=True)
def root() -> Iterator[None]:
    """Make the benchmarks importable from the root of the repository, as they import each other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2]))
        yield


@pytest.fixture(scope="module")
def instance(root: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with import_module("benchmarks.installation.instance").Instance(tmp_path_factory.mktemp("instance")) as instance:
        yield instance


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name in AGAIN else name for name in WANTED]
)
def test_nothing_is_lost_duplicated_half_written_or_left_over(instance: Any, name: str) -> None:
    listed = import_module("benchmarks.installation.faults").FAULTS
    _, inject = listed[name]
    outcome = inject(instance)
    assert outcome.record
    assert instance.misfits() == []


def test_every_tested_fault_is_defined_in_the_benchmarks(root: None) -> None:
    assert set(WANTED) < set(import_module("benchmarks.installation.faults").FAULTS)
