"""Real processes for the fault tests: workers, reconciler, and Valkey if a test kills it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from long_jobs import LONG, long_sequence
from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pliant.solver import KnownCamera, Mesh, Tracks, gallery
from pliant.worker.formats import GroundTruth, Inputs, save_inputs
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.maintenance.fsck import findings
from pliant.worker.processes.supervisor import Child, Supervisor, valkey_child, worker_children
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings

from benchmarks.installation.instance import children, running

SHORT = Options(prior="smooth", max_reweightings=3, refine_rotations=False, surface="free", camera="orthographic")
"""Options of a short job: the default prior takes ten times as long."""


def make_inputs(path: Path, *, frames: int, points: int) -> Inputs:
    sequence = gallery.corrupt(gallery.face(frames, points), noise=0.5, outliers=0.1)
    return _saved(path, sequence.tracks, sequence.mesh, GroundTruth(sequence.shapes), None)


def make_long_inputs(path: Path, sequence: gallery.Sequence | None = None) -> Inputs:
    """Write canonical inputs of a job that runs until it is stopped."""
    sequence = sequence or long_sequence()
    return _saved(path, sequence.tracks, None, None, KnownCamera(sequence.rotations))


def _saved(
    path: Path, tracks: Tracks, mesh: Mesh | None, truth: GroundTruth | None, cameras: KnownCamera | None
) -> Inputs:
    interpretation = Interpretation(
        num_frames=tracks.num_frames,
        num_points=tracks.num_points,
        num_faces=0 if mesh is None else len(mesh.faces),
        hidden_fraction=0.0,
        mesh_source="none" if mesh is None else "given",
        has_ground_truth=truth is not None,
        has_rotations=cameras is not None,
        layout="tracks (F, P, 2)",
    )
    inputs = Inputs(tracks, mesh, truth, cameras, interpretation)
    save_inputs(inputs, path)
    return inputs


class House:
    """Processes that run inside `with` and must leave none behind."""

    def __init__(
        self,
        settings: Settings,
        *,
        own_valkey: bool = False,
        inputs: tuple[Path, Path],
        children: list[Child] | None = None,
    ) -> None:
        self.settings = settings
        self.short_inputs, self.long_inputs = inputs
        self._valkey = Valkey.claim(settings.data) if own_valkey else None
        first = [] if self._valkey is None else [valkey_child(self._valkey)]
        workers = worker_children(settings) if children is None else children
        self._num_workers = sum(child.name.startswith("worker") for child in workers)
        self.supervisor = Supervisor([*first, *workers])
        self.jobs = Jobs.open(settings)

    def __enter__(self) -> House:
        self.supervisor.start()
        self.until(lambda: len(self.jobs.queue.workers()) >= self._num_workers, "workers are up", seconds=60)
        return self

    def __exit__(self, *_: object) -> None:
        pids = [*self.supervisor.pids().values(), *self.job_processes()]
        self.supervisor.stop()
        if self._valkey is not None:
            self._valkey.release()
        alive = [pid for pid in pids if Path(f"/proc/{pid}").exists() and running(pid)]
        assert not alive, f"processes left behind: {alive}"

    def submit(self, *, long: bool = False, **more: object) -> str:
        file = self.long_inputs if long else self.short_inputs
        interpretation = Interpretation(
            num_frames=4, num_points=4, num_faces=0, hidden_fraction=0, mesh_source="given", has_ground_truth=True,
            has_rotations=False, layout="",
        )  # fmt: skip
        options = Options.model_validate(LONG) if long else SHORT
        submission = Submission(options=options, **more)  # type: ignore[arg-type]
        return self.jobs.submit(file, submission, interpretation=interpretation)[0].id

    def until(self, condition: Callable[[], object], what: str, *, seconds: float = 20.0) -> float:
        """Poll while the supervisor keeps the children running; return the seconds it took."""
        began = time.monotonic()
        while not condition():
            self.supervisor.look()
            assert time.monotonic() - began < seconds, f"not within {seconds} s: {what}"
            time.sleep(0.02)
        return time.monotonic() - began

    def final(self, id: str, *, seconds: float = 30.0) -> Job:
        self.until(lambda: self.jobs.get(id).status.final, f"job {id} ends", seconds=seconds)
        return self.jobs.get(id)

    def solving(self, id: str) -> Job:
        """Wait until the solver is running the job."""

        def midst() -> bool:
            job = self.jobs.get(id)
            return job.status is Status.RUNNING and job.progress is not None and job.progress.stage != "loading"

        self.until(midst, "the solver runs")
        return self.jobs.get(id)

    def worker_pids(self) -> list[int]:
        return [pid for name, pid in self.supervisor.pids().items() if name.startswith("worker")]

    def job_processes(self) -> list[int]:
        return [child for pid in self.worker_pids() for child in children(pid)]

    def freeze(self) -> None:
        """Stop the job processes: their workers keep them alive, and they take no processor time."""
        for pid in self.job_processes():
            os.kill(pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let the job processes go on, so that they can end when their jobs are cancelled."""
        for pid in self.job_processes():
            os.kill(pid, signal.SIGCONT)

    def files_at_work(self) -> list[str]:
        return [path.name for path in self.settings.work.iterdir()]

    def blobs_of(self, id: str) -> set[str]:
        return {key.rsplit("/", 1)[1] for key, _ in self.jobs.blobs.list(f"jobs/{id}/")}


def settled(house: House) -> None:
    """Wait until no job process runs and no working files are left; check the stores against the job records."""
    house.until(lambda: not house.job_processes() and not house.files_at_work(), "nothing is left behind")
    assert findings(house.jobs, pause=0.5) == []
