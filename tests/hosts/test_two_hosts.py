"""Faults of an installation across several hosts, each a network namespace.

After each fault every acknowledged job has ended once, as it should; `fsck` has no findings; no working file and no file of a stale
attempt is left. The last test writes the table of all faults to `build/two-hosts.md`.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from hosts import HOSTS, Hosts
from network import Network, clock_shift, reason_against

pytestmark = [pytest.mark.root, pytest.mark.s3, pytest.mark.slow]

TABLE = Path(__file__).parents[2] / "build" / "two-hosts.md"
ROWS: list[tuple[str, ...]] = []
UNDER_WAY: list[tuple[str, ...]] = []
LEASE = 2.0
"""`PLIANT_LOST_AFTER` of the installation, seconds."""


@pytest.fixture(scope="module")
def hosts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hosts]:
    reason = reason_against()
    if reason is not None:
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    with Network(HOSTS) as network, network.on("front"), Hosts(tmp_path_factory.mktemp("hosts"), network) as hosts:
        yield hosts


@pytest.fixture(autouse=True)
def sound(hosts: Hosts) -> Iterator[None]:
    """Require two workers before each fault, and nothing lost, duplicated or left over after it."""
    hosts.until(lambda: hosts.workers() == 2, "both workers are there")
    yield
    misfits = hosts.misfits()
    counts = tuple(str(len(found)) for found in misfits.values())
    ROWS.extend((*each, *counts) for each in UNDER_WAY)
    UNDER_WAY.clear()
    assert misfits == {"lost": [], "duplicated": [], "left over": []}


def row(fault: str, *, noticed: float | None = None, moved: float | None = None) -> None:
    """Record a row of the table."""
    UNDER_WAY.append((fault, *("–" if each is None else f"{each:.1f} s" for each in (noticed, moved))))


def moved(hosts: Hosts, id: str, began: float) -> tuple[float, float]:
    """Wait until a job is taken from its worker and solved by another; return both times since the fault."""
    hosts.until(lambda: hosts.get(id).get("attempt") != 1 or hosts.get(id)["status"] == "queued", "it is noticed")
    noticed = time.monotonic() - began
    hosts.until(lambda: hosts.get(id).get("attempt") == 2 and hosts.get(id)["progress"], "another worker has it")
    return noticed, time.monotonic() - began


def test_a_killed_host_loses_nothing(hosts: Hosts) -> None:
    id = hosts.submit()
    host = hosts.host_of(id)
    began = time.monotonic()
    hosts.network.pull(host)
    hosts.signal(host, signal.SIGKILL)
    times = moved(hosts, id, began)
    hosts.cancelled(id)
    hosts.network.plug(host)
    for left in hosts.at_work(host):  # age them: younger ones may belong to a worker being reaped
        os.utime(hosts.folder / host / "data" / "work" / left, (time.time() - 120, time.time() - 120))
    hosts.start_workers(host)
    hosts.until(lambda: not hosts.at_work(host), "the host clears what its killed worker left")
    row("a worker's host is killed", noticed=times[0], moved=times[1])
    assert times[0] < LEASE + 6


@pytest.mark.long
def test_a_cut_cable_loses_nothing_and_the_stale_attempt_writes_nothing(hosts: Hosts) -> None:
    id = hosts.submit()
    host = hosts.host_of(id)
    (stale,) = hosts.job_process(host)
    began = time.monotonic()
    hosts.network.pull(host)
    times = moved(hosts, id, began)
    assert hosts.job_process(host) == [stale], "it computes on, and does not know yet"
    hosts.network.plug(host)
    hosts.until(lambda: not Path(f"/proc/{stale}").exists(), "the stale attempt ends once its host is reachable")
    assert hosts.get(id)["attempt"] == 2
    hosts.cancelled(id)
    assert hosts.blobs(id) == ["inputs.npz"]
    row("a worker's cable is cut, and put back", noticed=times[0], moved=times[1])


@pytest.mark.long
def test_redis_cut_off_for_longer_than_a_lease_moves_no_job(hosts: Hosts) -> None:
    id = hosts.submit()
    hosts.host_of(id)
    hosts.network.pull("valkey")
    began = time.monotonic()
    answer = hosts.http.get(f"/v1/jobs/{id}")
    assert answer.status_code == 503
    assert time.monotonic() - began < 12
    time.sleep(max(0.0, began + 3 * LEASE - time.monotonic()))
    hosts.network.plug("valkey")
    hosts.until(lambda: hosts.get(id).get("status") == "running", "it is back")
    before = hosts.get(id)["progress"]
    hosts.until(lambda: hosts.get(id).get("progress") != before, "it reports on")
    assert hosts.get(id)["attempt"] == 1
    hosts.cancelled(id)
    row("Redis is cut off while S3 stays")


@pytest.mark.long
def test_a_redis_restart_during_a_job_moves_no_job(hosts: Hosts) -> None:
    id = hosts.submit()
    hosts.host_of(id)
    hosts.signal("valkey", signal.SIGKILL)
    waiting = time.monotonic()
    hosts.restart("valkey")
    hosts.until(lambda: hosts.get(id).get("status") == "running", "it is back")
    before = hosts.get(id)["progress"]
    hosts.until(lambda: hosts.get(id).get("progress") != before, "it reports on")
    assert (hosts.get(id)["attempt"], time.monotonic() - waiting < 20) == (1, True)
    hosts.cancelled(id)
    row("Redis is killed and started again")


def test_one_key_at_two_api_processes_makes_one_job(hosts: Hosts) -> None:
    with ThreadPoolExecutor(4) as pool:
        ids = list(
            pool.map(
                lambda number: hosts.submit(url=hosts.urls[number % 2], headers={"Idempotency-Key": "one key"}),
                range(4),
            )
        )
    assert len(set(ids)) == 1
    hosts.acknowledged[:] = sorted(set(hosts.acknowledged))
    assert httpx.get(f"{hosts.urls[1]}/v1/jobs/{ids[0]}", timeout=20).json()["id"] == ids[0]
    hosts.cancelled(ids[0])
    row("one request at two API processes at once")


def test_an_upload_resumes_at_another_api_process_after_a_kill(hosts: Hosts) -> None:
    data = hosts.tracks()
    half = {"Upload-Complete": "?0", "Upload-Length": str(len(data))}
    begun = httpx.put(f"{hosts.urls[0]}/v1/uploads/across", content=data[:5000], headers=half, timeout=20)
    assert begun.status_code == 201, begun.text
    hosts.signal("api", signal.SIGKILL)
    other = f"{hosts.urls[1]}/v1/uploads/across"
    arrived = int(httpx.head(other, timeout=20).headers["Upload-Offset"])
    assert arrived == 5000
    rest = httpx.patch(other, content=data[arrived:], headers={"Upload-Offset": str(arrived)}, timeout=20)
    assert rest.json()["complete"], rest.text
    hosts.restart("api")
    hosts.until(lambda: hosts.answers(f"{hosts.urls[0]}/healthz"), "the first one is back")
    id = hosts.submit(upload="across")
    assert httpx.delete(other, timeout=20).status_code == 204
    hosts.cancelled(id)
    row("an upload's API process is killed, and it continues at the other")


@contextmanager
def s3_away(hosts: Hosts, how: str) -> Iterator[None]:
    """Make S3 drop packets, or refuse connections, while the block runs."""
    if how == "dropped":
        hosts.network.pull("s3")
    else:
        hosts.signal("s3", signal.SIGKILL)
    try:
        yield
    finally:
        if how == "dropped":
            hosts.network.plug("s3")
        else:
            hosts.restart("s3")


@pytest.mark.parametrize("how", [pytest.param("dropped", marks=pytest.mark.long), "refused"])
def test_a_job_that_finishes_during_an_s3_outage_keeps_its_result(hosts: Hosts, how: str) -> None:
    id = hosts.submit(reweightings=4)
    hosts.host_of(id)
    with s3_away(hosts, how):
        hosts.until(lambda: hosts.get(id).get("progress", {})["stage"] == "exporting", "it has its result")
        with ThreadPoolExecutor(8) as pool:  # others query readiness meanwhile
            began = time.monotonic()
            asked = [pool.submit(httpx.get, f"{hosts.urls[0]}/readyz", timeout=30) for _ in range(8)]
            slowest = 0.0
            for _ in range(20):
                each = time.monotonic()
                assert hosts.get(id)["status"] == "running", "its status needs no S3, and it waits"
                assert hosts.answers(f"{hosts.urls[0]}/healthz")
                slowest = max(slowest, time.monotonic() - each)
                time.sleep(0.1)
            assert [each.result().status_code for each in asked] == [503] * 8
            assert time.monotonic() - began < 12
    job = hosts.final(id)
    assert (job["status"], job["attempt"], job["error"]) == ("succeeded", 1, None)
    assert slowest < 1.0
    artifact = hosts.http.get(f"/v1/jobs/{id}/artifacts/shapes.npz")
    assert len(artifact.content) == next(each["bytes"] for each in job["artifacts"] if each["name"] == "shapes.npz")
    row(f"S3 is away when a job ends ({how})")


def test_an_attempt_frozen_past_its_lease_writes_nothing_when_resumed(hosts: Hosts) -> None:
    id = hosts.submit(reweightings=4)
    host = hosts.host_of(id)
    hosts.signal(host, signal.SIGSTOP)
    times = moved(hosts, id, time.monotonic())
    frozen = hosts.tree(host)
    job = hosts.final(id)
    before = hosts.blobs(id)
    hosts.signal(host, signal.SIGCONT)
    hosts.until(lambda: hosts.workers() == 2, "the frozen worker is back")
    hosts.until(lambda: not hosts.at_work(host), "it clears its working files")
    assert len(frozen) >= 4, "supervisor, worker, job process and reconciler"
    assert (job["status"], job["attempt"]) == ("succeeded", 2)
    assert hosts.get(id) == job
    assert hosts.blobs(id) == before
    row("a worker is frozen past its lease, and resumed", noticed=times[0], moved=times[1])


@pytest.mark.long
def test_jobs_succeed_with_worker_clocks_ten_minutes_apart(hosts: Hosts) -> None:
    shifts = [clock_shift(300), clock_shift(-300)]
    if None in shifts:
        pytest.skip("the clock is shifted with libfaketime: pip install libfaketime")
    try:
        for host, shift in zip(("one", "two"), shifts, strict=True):
            hosts.signal(host, signal.SIGTERM)
            hosts.start_workers(host, shift)
        hosts.until(lambda: hosts.workers() == 2, "both are back", seconds=60)
        long, short = hosts.submit(), [hosts.submit(reweightings=3) for _ in range(3)]
        done = [hosts.final(id) for id in short]
        assert [job["status"] for job in done] == ["succeeded"] * 3
        assert {job["attempt"] for job in done} == {1}
        assert hosts.get(long)["attempt"] == 1, "a lease does not depend on clocks"
        hosts.cancelled(long)
    finally:
        for host in ("one", "two"):
            hosts.signal(host, signal.SIGTERM)
            hosts.start_workers(host)
    row("the clocks of the workers' hosts are 5 min fast and 5 min slow")


@pytest.mark.long
def test_jobs_succeed_with_valkey_and_s3_at_a_fifth_of_their_speed(hosts: Hosts) -> None:
    """Valkey and S3 run a fifth of the time, in slices, as on a disk that cannot keep up."""
    stop = threading.Event()

    def slow() -> None:
        pids = [pid for name in ("valkey", "s3") for pid in hosts.tree(name)]
        while not stop.wait(0.1):
            for pid in pids:
                os.kill(pid, signal.SIGSTOP)
            time.sleep(0.4)
            for pid in pids:
                os.kill(pid, signal.SIGCONT)

    thread = threading.Thread(target=slow)
    thread.start()
    try:
        ids = [hosts.submit(reweightings=3) for _ in range(2)]
        done = [hosts.final(id, seconds=90) for id in ids]
    finally:
        stop.set()
        thread.join()
    assert [(job["status"], job["attempt"]) for job in done] == [("succeeded", 1)] * 2
    row("Valkey and S3 run at a fifth of their speed")


def test_the_table_is_written(hosts: Hosts) -> None:
    assert len(ROWS) >= 5
    lines = ["| fault | noticed after | moved after | lost | duplicated | left over |", "|---|---|---|---|---|---|"]
    lines += [f"| {' | '.join(cells)} |" for cells in ROWS]
    TABLE.parent.mkdir(exist_ok=True)
    TABLE.write_text("\n".join(lines) + "\n")
