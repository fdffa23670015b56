"""The result of a job: arrays and a report, read from local files."""

from __future__ import annotations

import copy
import json
import re
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray
from pliant.client.errors import BadArgument, JobCancelled, JobFailed, NotAllowedNow, NotFound, NotLoaded
from pliant.client.input_files import expanded, folder_to_fill
from pliant.schemas.job import Job, Problem, Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARRAYS = "shapes.npz"
REPORT = "report.json"
ANIMATION = "shapes.glb"
LOADED = (ARRAYS, REPORT)
"""Files that `wait` and `result` download; the others are downloaded on demand."""


class TemporaryFolder:
    """A temporary folder that is removed together with the last object that refers to it."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="pliant-result-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class Reconstruction:
    """A job that succeeded, and its files in a local folder."""

    job: Job
    """The final record: options, interpretation, metrics, warnings, artifacts."""

    folder: Path
    """Folder of the downloaded files; a temporary folder is removed together with this object and its copies."""

    def __init__(self, job: Job, folder: Path | str | None) -> None:
        self.job = job
        if folder is None:
            self._kept = TemporaryFolder()
            self.folder = self._kept.path
        else:
            self.folder = folder_to_fill(folder)

    def __getstate__(self) -> dict[str, Any]:
        files = {"arrays": ARRAYS, "report": REPORT}
        held = {
            name: getattr(self, name)
            for name, file in files.items()
            if name in vars(self) or (self.folder / file).is_file()
        }
        return {"job": self.job, "folder": None if "_kept" in vars(self) else self.folder, **held}

    def __setstate__(self, state: dict[str, Any]) -> None:
        Reconstruction.__init__(self, state["job"], state["folder"])
        vars(self).update({name: state[name] for name in ("arrays", "report") if name in state})

    def __copy__(self) -> Self:
        twin = type(self).__new__(type(self))
        vars(twin).update(vars(self))
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        twin = copy.copy(self)
        own = {name: value for name, value in vars(self).items() if name in ("job", "arrays", "report")}
        vars(twin).update(copy.deepcopy(own, memo))
        return twin

    def __repr__(self) -> str:
        size = f"{self.job.interpretation.num_frames} frames × {self.job.interpretation.num_points} points"
        ended = ", ".join(str(each) for each in (self.job.verdict, self.job.outcome) if each is not None)
        return f"<{type(self).__name__} of job {self.job.id}: {size}, {ended}>"

    @property
    def shapes(self) -> NDArray[np.float64]:
        """Points of every frame, shape (F, P, 3), world axes, the tracks' unit, centred per frame."""
        return self.arrays["shapes"]

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Rotations from world to camera, shape (F, 3, 3); orthographic cameras project with the first two rows."""
        return self.arrays["rotations"]

    @property
    def shapes_std(self) -> NDArray[np.float32] | None:
        """Standard deviation of every position, shape (F, P), the tracks' unit; None if the prior has no posterior."""
        return self.arrays.get("shapes_std")

    @property
    def inlier_probability(self) -> NDArray[np.float32] | None:
        """Posterior probability that an observation is an inlier, shape (F, P): 0 where rejected, NaN where hidden."""
        return self.arrays.get("inlier_probability")

    @property
    def point_names(self) -> tuple[str, ...] | None:
        """Names of the P points in the track file (DeepLabCut, SLEAP, MediaPipe, named columns, `point_names`); None if it has none."""
        names = self.arrays.get("point_names")
        return None if names is None else tuple(names.tolist())

    @property
    def verdict(self) -> str | None:
        """Whether the result can be used: `good`, `with_care` or `do_not_use`; None without a verdict."""
        return self.job.verdict

    @property
    def camera(self) -> dict[str, Any]:
        """The report's camera model and lens: `model`, `focal`, `focal_std`, `field_of_view`, `sentence` and more."""
        camera: dict[str, Any] = self.report["camera"]
        return camera

    @property
    def focal(self) -> float | None:
        """Focal length in pixels of the tracks; None for orthographic cameras."""
        focal: float | None = self.camera["focal"]
        return focal

    @property
    def field_of_view(self) -> float | None:
        """Horizontal field of view in degrees; None for orthographic cameras or if `image_size` is unknown."""
        angle: float | None = self.camera.get("field_of_view")
        return angle

    @property
    def faces(self) -> NDArray[np.int32]:
        """Triangles (T, 3) or quads (T, 4): indices into the points."""
        return self.arrays["faces"]

    @cached_property
    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Every array of shapes.npz by its documented name."""
        with np.load(self._local(ARRAYS), allow_pickle=False) as held:
            return {name: held[name] for name in held.files}

    @cached_property
    def report(self) -> dict[str, Any]:
        """The report: options, metrics, choices with their reasons, trace, timings, versions."""
        value: dict[str, Any] = json.loads(self._local(REPORT).read_text(encoding="utf-8"))
        return value

    @property
    def metrics(self) -> dict[str, float]:
        """Error metrics by name; which ones depends on the inputs."""
        return self.job.metrics if self.job.metrics is not None else {}

    def plot(self, frames: int | Sequence[int] = 4) -> Figure:
        """Draw frames of the shape in 3-D, as a lit surface if the job has a mesh. Needs matplotlib.

        Parameters
        ----------
        frames : int or sequence of int
            Number of frames, evenly spaced over the sequence; or the frames themselves, counted from 0.

        Returns
        -------
        matplotlib.figure.Figure
            One set of axes per frame; the figure is neither shown nor saved. Notebooks show it as the value of a cell after
            ``%matplotlib inline``.

        Raises
        ------
        BadArgument
            `frames` is neither.
        """
        from pliant.client.plot import draw

        title = self.job.name if self.job.name != "" else self.job.id
        return draw(self.shapes, self.faces, frames, title=title, y_axis=self.job.interpretation.y_axis)

    def _local(self, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise NotLoaded(f"{name} has not been downloaded yet: call load() on this result first.")
        return path


def without_client(job: Job) -> BadArgument:
    """Return the error for a download through a result that was pickled."""
    return BadArgument(
        f"This result was pickled and has no client. Download with `client.download({job.id!r}, folder)` of a new client."
    )


def copied(source: Path, path: Path | str) -> Path:
    """Copy a downloaded file to `path`, creating folders as needed; it may be there already."""
    target = expanded(path, "path")
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.exists() or not target.samefile(source):
        shutil.copyfile(source, target)
    return target


def loaded(job: Job) -> tuple[str, ...]:
    """Return the files that `wait` and `result` download; a job that only writes further files has no arrays."""
    return LOADED if job.outputs_of is None else (REPORT,)


def job_path(job: str) -> str:
    """Return the address of a job, relative to the service.

    Raises
    ------
    BadArgument
        The id is malformed.
    """
    if not isinstance(job, str) or re.fullmatch(r"[A-Za-z0-9_-]{1,128}", job) is None:
        raise BadArgument(f"Expected the id of a job (letters, digits, - and _), got {job!r}.")
    return f"/v1/jobs/{job}"


def succeeded(job: Job) -> Job:
    """Return a finished job if it has a result.

    Raises
    ------
    JobFailed, JobCancelled
        The job has no result.
    """
    if job.status is Status.FAILED:
        raise JobFailed(job)
    if job.status is Status.CANCELLED:
        raise JobCancelled(job)
    return job


def finished(job: Job) -> Job:
    """Return the job if it is finished and has a result.

    Raises
    ------
    NotAllowedNow, JobFailed, JobCancelled
        The job is not finished, or has no result.
    """
    if not job.status.final:
        raise NotAllowedNow(
            Problem.of(
                "not_finished",
                409,
                detail=f"Job {job.id} is {job.status}; there is no result yet. Wait for it.",
                retryable=True,
            )
        )
    return succeeded(job)


def unknown_file(job: Job, name: str) -> NotFound:
    """Return the error for a file that a job does not have."""
    held = ", ".join(artifact.name for artifact in job.artifacts) or "none"
    return NotFound(
        Problem.of("unknown_artifact", detail=f"Job {job.id} ({job.status}) has no file {name!r}. Its files: {held}.")
    )
