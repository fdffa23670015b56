"""Results of the readers: validated inputs, and the limits of the readers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.solver import InvalidInput, KnownCamera, Mesh, Tracks
from pliant.solver.limits import MAX_COORDINATE

if TYPE_CHECKING:  # not needed in the sandbox process
    from pliant.schemas.job import Interpretation
    from pliant.worker.formats.texture import Texture

Arrays = dict[str, NDArray[np.generic]]
"""Named arrays of a file, not yet interpreted; members of nested structures have dotted names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of the inputs of one job; readers check them before they allocate memory."""

    max_bytes: int = 1 << 30
    """Size of one file, and of all arrays that are read from it, inflated."""

    max_frames: int = 10_000
    """Frames after selection."""

    max_points: int = 1_000_000
    """Points after selection."""

    max_observations: int = 40_000_000
    """Frames times points, after selection."""

    max_faces: int = 4_000_000
    """Faces of the mesh."""

    max_members: int = 256
    """Members of one zip file."""

    parse_seconds: float = 60.0
    """Processor time, and half the wall time, that parsing one file may take."""

    parse_memory: int = 4 << 30
    """Address space of the process that parses a file."""

    read_seconds: float = 600.0
    """Wall time of the process that reads large inputs."""

    read_memory: int = 8 << 30
    """Address space of the process that reads large inputs."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """Ground truth, used for metrics only."""

    shapes: NDArray[np.float64]
    """Shape `(F, P, 3)`, any unit, finite."""

    rotations: NDArray[np.float64] | None = None
    """Shape `(F, 3, 3)`, camera from world, or None."""

    @classmethod
    def from_arrays(cls, shapes: ArrayLike, rotations: ArrayLike | None, *, like: tuple[int, int]) -> GroundTruth:
        """Check true shapes `(F, P, 3)` and cameras `(F, 2|3, 3)` against `like`, frames and points of the tracks.

        Raises
        ------
        InvalidInput
            Wrong type or shape, not finite, a frame without extent, or rows that are not orthonormal.
        """
        points = _true_points(shapes, like)
        points.flags.writeable = False
        if rotations is None:
            return cls(points)
        turned = np.asarray(rotations)
        if turned.ndim != 3 or len(turned) != like[0]:
            raise InvalidInput(
                "wrong_shape", field="ground_truth.rotations", expected=f"({like[0]}, 2, 3) or ({like[0]}, 3, 3)",
                got=str(turned.shape), hint="Give one rotation a frame.",
            )  # fmt: skip
        return cls(points, KnownCamera.from_arrays(turned).rotations)


def _true_points(shapes: ArrayLike, like: tuple[int, int]) -> NDArray[np.float64]:
    """Check true points against `(F, P)` of the tracks; return a copy in double precision."""
    given = np.asarray(shapes)
    expected = f"({like[0]}, {like[1]}, 3)"
    if given.dtype.kind not in "fiu":
        raise InvalidInput(
            "wrong_type", field="ground_truth.shapes", expected="real numbers", got=f"dtype {given.dtype}",
            hint="Convert the array to float.",
        )  # fmt: skip
    if given.shape != (*like, 3):
        raise InvalidInput(
            "wrong_shape", field="ground_truth.shapes", expected=expected, got=str(given.shape),
            hint="Ground truth is (frames, points, 3), with frames and points in the order of the tracks.",
        )  # fmt: skip
    points = np.array(given, dtype=np.float64, order="C")
    if not np.isfinite(points).all():
        raise InvalidInput(
            "not_finite", field="ground_truth.shapes",
            expected="finite coordinates", got=f"{int((~np.isfinite(points)).sum())} that are not",
            hint="Give truth for every point and frame, or omit it.",
        )  # fmt: skip
    if np.abs(points).max() > MAX_COORDINATE:
        raise InvalidInput(
            "out_of_range", field="ground_truth.shapes",
            expected=f"coordinates within ±{MAX_COORDINATE:g}", got=f"{np.abs(points).max():.3g}",
            hint="Check the file, or choose a larger unit.",
        )  # fmt: skip
    if not (np.ptp(points, axis=1) > 0).any(axis=1).all():
        raise InvalidInput(
            "no_extent", field="ground_truth.shapes",
            expected="points that differ in every frame", got="a frame whose points all coincide",
            hint="Omit the ground truth if it is not known.",
        )  # fmt: skip
    return points


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The selected frames and points of the files, in the order of the files."""

    frames: NDArray[np.intp]
    """Increasing indices, shape `(F,)`."""

    points: NDArray[np.intp]
    """Increasing indices, shape `(P,)`: vertex i of the result is point `points[i]` of the files."""

    whole: tuple[int, int]
    """Frames and points of the files."""

    @property
    def narrows(self) -> bool:
        """Whether any frame or point is excluded."""
        return (len(self.frames), len(self.points)) != self.whole


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The validated inputs of a job; vertex i of the mesh and of the truth is point i of the tracks."""

    tracks: Tracks
    mesh: Mesh | None
    ground_truth: GroundTruth | None
    cameras: KnownCamera | None
    interpretation: Interpretation

    selection: Selection | None = None
    """The selected frames and points of the files; None: all."""

    texture: Texture | None = None
    """The texture, with coordinates for each of the P points, or None."""

    point_names: tuple[str, ...] | None = None
    """Names of the P points, where the file has them."""

    frame_times: NDArray[np.float64] | None = None
    """Seconds of every frame of a film, shape `(F,)`, increasing; None for other tracks."""

    warnings: tuple[str, ...] = ()
    """The tracker's warnings about the film."""
