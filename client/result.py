"""What a finished job gives: arrays and a report, held locally."""

from __future__ import annotations

import json
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pliant.client.errors import NotLoaded
from pliant.schemas.job import Job

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARRAYS = "shapes.npz"
REPORT = "report.json"
ANIMATION = "shapes.glb"
LOADED = (ARRAYS, REPORT)
"""What `wait` and `result` fetch by themselves; everything else on demand."""


class Reconstruction:
    """A job that succeeded, and its files in a folder of this machine.

    Attributes
    ----------
    job : Job
        The final record: options, interpretation, metrics, warnings, artifacts.
    folder : Path
        Where fetched files are; a temporary one goes with this object.
    """

    def __init__(self, job: Job, folder: Path | str | None) -> None:
        self.job = job
        if folder is None:
            self.folder = Path(tempfile.mkdtemp(prefix="pliant-result-"))
            weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)
        else:
            self.folder = Path(folder)

    @property
    def shapes(self) -> NDArray[np.float64]:
        """Points of every frame, shape (F, P, 3), world axes, the tracks' unit, centred per frame."""
        return self.arrays["shapes"]

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Camera from world, shape (F, 3, 3); orthographic: the first two rows project."""
        return self.arrays["rotations"]

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
        """The report: options as run, metrics, choices with their reasons, trace, timings, versions."""
        value: dict[str, Any] = json.loads(self._local(REPORT).read_text(encoding="utf-8"))
        return value

    @property
    def metrics(self) -> dict[str, float]:
        """Error metrics by name, as far as the inputs allow them."""
        return self.job.metrics if self.job.metrics is not None else {}

    def plot(self, frames: int = 4) -> Figure:
        """Draw some frames of the shape in 3-D, as a lit surface where there is a mesh; needs matplotlib.

        Parameters
        ----------
        frames : int
            How many, evenly spread over the sequence.

        Returns
        -------
        matplotlib.figure.Figure
            With one set of axes for each frame; nothing is shown or saved.
        """
        from pliant.client.plot import draw

        return draw(self.shapes, self.faces, frames, title=self.job.name if self.job.name != "" else self.job.id)

    def _local(self, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise NotLoaded(f"{name} has not been fetched yet: call load() on this result first.")
        return path


def copied(source: Path, path: Path | str) -> Path:
    """Copy a fetched file to where the user wants it, making folders as needed."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return target
