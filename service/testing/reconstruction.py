"""A replacement for the solver, which maps points to shapes, and the worker thread that calls it."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.job import Problem
from pliant.schemas.options import Options
from pliant.solver import Camera, Choices, Mesh, Outcome, Solution, Step, Trace, Tracks
from pliant.worker.errors import StaleAttempt, UnknownJob
from pliant.worker.execution import pipeline
from pliant.worker.execution.attempt import Attempt, work
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.store.memory import MemoryQueue

Reconstruct = Callable[[NDArray[np.float64], Options], NDArray[np.float64]]
"""Maps points (F, P, 2), NaN where hidden, and options to shapes (F, P, 3)."""

STEP_SECONDS = 0.02
"""Seconds between two steps of a job in the worker thread."""


def flat(points: NDArray[np.float64], options: Options) -> NDArray[np.float64]:  # noqa: ARG001 - signature of `Reconstruct`
    """Return the points, centred in each frame, with depth 0."""
    seen = np.nan_to_num(points)
    return np.concatenate([seen - seen.mean(axis=1, keepdims=True), np.zeros((*seen.shape[:2], 1))], axis=2)


class DeliveringQueue(MemoryQueue):
    """An in-memory queue that delivers pushed jobs to the worker thread."""

    def __init__(self) -> None:
        super().__init__()
        self.deliveries: queue.SimpleQueue[tuple[str, str] | None] = queue.SimpleQueue()

    def push(self, id: str, attempt_id: str, *, front: bool = False) -> None:
        """See `Queue.push`."""
        super().push(id, attempt_id, front=front)
        self.deliveries.put((id, attempt_id))


class Worker:
    """A thread that runs the jobs of a `DeliveringQueue`, one after the other, until `stop`.

    Parameters
    ----------
    jobs : Jobs
        The jobs, on in-memory stores.
    reconstruct : Reconstruct, optional
        Replaces the solver; None runs the real one.
    steps : float
        Progress reports before a job ends; `math.inf` runs it until it is cancelled.
    problem : Problem, optional
        Every job fails with this error.
    """

    def __init__(self, jobs: Jobs, reconstruct: Reconstruct | None, *, steps: float, problem: Problem | None) -> None:
        self._jobs = jobs
        self._reconstruct = reconstruct
        self.steps = steps
        self._problem = problem
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pliant-in-memory-worker", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; a running job stays unfinished."""
        self._stopped.set()
        assert isinstance(self._jobs.queue, DeliveringQueue)
        self._jobs.queue.deliveries.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(10)

    def _run(self) -> None:
        jobs = self._jobs
        assert isinstance(jobs.queue, DeliveringQueue)
        while (delivery := jobs.queue.deliveries.get()) is not None and not self._stopped.is_set():
            id, attempt_id = delivery
            if attempt_id not in jobs.queue.waiting():
                continue
            jobs.queue.remove(attempt_id)
            try:
                self._attempt(id, attempt_id)
            except (StaleAttempt, UnknownJob):  # cancelled or deleted meanwhile
                continue

    def _attempt(self, id: str, attempt_id: str) -> None:
        claim = partial(lifecycle.claim, attempt_id=attempt_id, worker="in-memory", now=datetime.now(UTC))
        stored = self._jobs.records.update(id, claim)
        attempt = Attempt(jobs=self._jobs, id=id, attempt_id=attempt_id, deadline=math.inf)
        attempt.log("Attempt 1 began in memory.")
        if self._problem is not None:
            attempt.conclude(self._problem)
            return
        options, reconstruct = stored.job.options, None
        if self._reconstruct is not None:
            reconstruct = partial(pipeline.reconstruct, solver=partial(self._solve, options=options))
        with TemporaryDirectory(prefix="pliant-in-memory-") as folder:
            attempt.conclude(work(attempt, stored, Path(folder), reconstruct=reconstruct))

    def _solve(
        self,
        tracks: Tracks,
        mesh: Mesh | None,  # noqa: ARG002 - signature of `solve`
        *,
        options: Options,
        on_step: Callable[[Step], None],
        should_stop: Callable[[], bool],
        **_: Any,
    ) -> Solution:
        """Report the steps, then call the function."""
        assert self._reconstruct is not None
        outcome, step = Outcome.CONVERGED, 0
        while step < self.steps:
            step += 1
            share = step / (self.steps + 1) if math.isfinite(self.steps) else 0.5
            on_step(Step(stage="reweight", fraction=share, reweighting=step, max_reweightings=30))
            if self._stopped.wait(STEP_SECONDS) or should_stop():
                outcome = Outcome.STOPPED
                break
        points = np.where(tracks.visible[..., None] > 0, tracks.points, np.nan)
        return solution(self._reconstruct(points, options), points, outcome)


def solution(shapes: NDArray[np.float64], points: NDArray[np.float64], outcome: Outcome) -> Solution:
    """Return shapes as a solution with the identity as camera."""
    frames = len(shapes)
    began = time.perf_counter()
    seen = np.isfinite(points).all(axis=2)
    means = np.nan_to_num(points).mean(axis=1)
    residuals = np.nan_to_num(np.linalg.norm(points - means[:, None] - shapes[..., :2], axis=2))
    return Solution(
        shapes=shapes,
        camera=Camera(np.tile(np.eye(3), (frames, 1, 1)), np.ones(frames), means),
        residuals=residuals,
        weights=np.where(seen, 1.0, 0.0),
        trace=Trace(np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.int64)),
        outcome=outcome,
        choices=Choices(
            basis_size=1, temporal_weight=0.0, spatial_weight=0.0, robust_scale=1.0, temporal_order=1,
            low_rank_weight=0.0, laplacian="none", unit=1.0, noise=0.0,
        ),
        seconds={"reweight": time.perf_counter() - began},
        inlier_probability=np.where(seen, 1.0, np.nan),
    )  # fmt: skip
