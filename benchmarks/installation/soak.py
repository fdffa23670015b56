"""Soak test: submit jobs continuously and kill processes at random; no acknowledged job may be lost.

    python -m benchmarks.installation.soak --minutes 15

Prints a table of the faults with the outcomes of the jobs that were hit and the seconds until they ended, and lists what was lost. Exits
with 1 on any loss.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pliant.solver import gallery
from pliant.worker.errors import NotAllowedNow, StoreUnavailable
from pliant.worker.formats import Inputs, save_inputs
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.maintenance.fsck import findings
from pliant.worker.processes.supervisor import Supervisor, valkey_child, worker_children
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings

from benchmarks.installation.instance import children

FAULTS = (
    "kill job process",
    "kill worker",
    "stop worker for 5 s",
    "kill reconciler",
    "kill Valkey",
    "SIGTERM worker",
    "cancel",
)
OUTAGE = "Valkey hangs for 30 s"
"""Injected every five minutes instead of at random, because it takes so long."""
OUTAGE_EVERY = 300.0

ALLOWED = {"kill job process": Status.FAILED, "cancel": Status.CANCELLED}
"""Final status, besides succeeded, that a fault may cause."""

IN_HAND = 6
"""Number of unfinished jobs at any time."""


@dataclass
class Soak:
    """One run."""

    jobs: Jobs
    supervisor: Supervisor
    inputs: Path
    interpretation: Interpretation
    random: random.Random
    open: dict[str, float] = field(default_factory=dict)
    """Time of acknowledgement of each unfinished job."""
    hit: dict[str, list[tuple[str, float]]] = field(default_factory=lambda: defaultdict(list))
    """Faults that hit each unfinished job, and when."""
    outcomes: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    ends: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    refused: int = 0
    feeding: bool = True

    def submit(self) -> None:
        """Submit one job; a submission refused while a store restarts is not a loss."""
        options = Options(max_reweightings=self.random.choice((2, 10, 40)), tolerance=1e-12)
        try:
            job = self.jobs.submit(self.inputs, Submission(options=options), interpretation=self.interpretation)[0]
        except StoreUnavailable:
            self.refused += 1
        else:
            self.open[job.id] = time.monotonic()

    def collect(self) -> None:
        """Record the outcomes of jobs that have ended."""
        for id in list(self.open):
            job = self.jobs.get(id)
            if job.status.final:
                del self.open[id]
                self._note(job)

    def _note(self, job: Job) -> None:
        code = f" ({job.error.code})" if job.error is not None else ""
        self.ends[f"{job.status.value}{code}"] += 1
        hits = self.hit.pop(job.id, [])
        again = ", begun again" if job.attempt > 1 else ""
        for fault, since in hits:
            self.outcomes[fault][f"{job.status.value}{code}{again}"] += 1
            self.seconds[fault].append(time.monotonic() - since)
        allowed = {ALLOWED[fault] for fault, _ in hits if fault in ALLOWED} | {Status.SUCCEEDED}
        if job.status not in allowed:
            self.wrong.append(f"job {job.id} is {job.status.value}{code} after {[fault for fault, _ in hits]}")

    def strike(self, fault: str) -> None:
        """Inject one fault."""
        pids = self.supervisor.pids()
        workers = [pid for name, pid in pids.items() if name.startswith("worker")]
        now = time.monotonic()
        running = self.jobs.page(statuses=[Status.RUNNING]).jobs
        if fault == "cancel":
            if self.open:
                id = self.random.choice(list(self.open))
                try:
                    self.jobs.cancel(id)
                    self.hit[id].append((fault, now))
                except NotAllowedNow:
                    pass
            return
        victim = self.random.choice(workers) if workers else None
        if fault == "kill job process":
            victim = next(iter(children(victim)), None) if victim is not None else None
        elif fault == "kill reconciler":
            victim = pids.get("reconciler")
        elif fault in ("kill Valkey", OUTAGE):
            victim = pids.get("valkey")
        if victim is None:
            return
        for job in running:
            self.hit[job.id].append((fault, now))
        stops = {"stop worker for 5 s": 5.0, OUTAGE: 30.0}
        if fault in stops:
            _send(victim, signal.SIGSTOP)
            self.wait(stops[fault])
            _send(victim, signal.SIGCONT)
        else:
            _send(victim, signal.SIGTERM if fault == "SIGTERM worker" else signal.SIGKILL)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Supervise processes, collect and submit jobs for a while; return whether `until` became true."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.supervisor.look()
            try:
                self.collect()
                while self.feeding and len(self.open) < IN_HAND:
                    self.submit()
            except StoreUnavailable:
                pass
            if until():
                return True
            time.sleep(0.05)
        return until()


def main() -> int:
    """Run the soak; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--every", type=float, default=3.0, help="mean seconds between two faults")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            data=Path(folder), workers=given.workers, threads=1, lost_after=3.0, stop_grace=1.0, max_attempts=1000
        )
        valkey = Valkey.claim(settings.data)
        supervisor = Supervisor([valkey_child(valkey), *worker_children(settings)])
        supervisor.start()
        sequence = gallery.face(30, 400)
        inputs = settings.data / "inputs.npz"
        interpretation = Interpretation(
            num_frames=30, num_points=400, num_faces=0, hidden_fraction=0, mesh_source="given", has_ground_truth=False,
            has_rotations=False, layout="",
        )  # fmt: skip
        save_inputs(Inputs(sequence.tracks, sequence.mesh, None, None, interpretation), inputs)
        soak = Soak(Jobs.open(settings), supervisor, inputs, interpretation, random.Random(given.seed))
        try:
            return run(soak, given.minutes * 60, given.every)
        finally:
            supervisor.stop()
            valkey.release()


def run(soak: Soak, seconds: float, every: float) -> int:
    """Inject faults at random, wait until all jobs end, and print the report; return the exit code."""
    began, faults = time.monotonic(), Counter[str]()
    outage = began + OUTAGE_EVERY / 2
    while time.monotonic() < began + seconds:
        soak.wait(soak.random.expovariate(1 / every))
        fault = soak.random.choice(FAULTS)
        if time.monotonic() > outage:
            fault, outage = OUTAGE, time.monotonic() + OUTAGE_EVERY
        try:
            soak.strike(fault)
        except StoreUnavailable:
            continue
        faults[fault] += 1
    soak.feeding = False
    ended = soak.wait(120.0, until=lambda: not soak.open)
    soak.wrong += [] if ended else [f"job {id} has not ended" for id in soak.open]
    soak.wait(100.0, until=lambda: not findings(soak.jobs, pause=0.5))  # the reconciler cleans up every half minute
    soak.wrong += findings(soak.jobs)
    print(f"{sum(soak.ends.values())} jobs acknowledged in {seconds / 60:g} min, {sum(faults.values())} faults")
    print(f"{soak.refused} submissions refused while Valkey was being started again (never acknowledged)\n")
    print("| fault | times | the jobs that ran then | seconds to their end, median / largest |\n|---|---|---|---|")
    for fault in (*FAULTS, OUTAGE):
        counts = ", ".join(f"{count} {what}" for what, count in soak.outcomes[fault].most_common())
        times = sorted(soak.seconds[fault]) or [0.0]
        print(f"| {fault} | {faults[fault]} | {counts or 'none'} | {times[len(times) // 2]:.1f} / {times[-1]:.1f} |")
    print("\nEnds: " + ", ".join(f"{count} {what}" for what, count in soak.ends.most_common()))
    print("Lost, duplicated or left over: " + ("nothing" if not soak.wrong else "\n  ".join(["", *soak.wrong])))
    return 1 if soak.wrong else 0


def _send(pid: int, number: signal.Signals) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


if __name__ == "__main__":
    sys.exit(main())
