"""Input of the writers: inputs and solution of a job, with shared quantities computed once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isclose
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options
from pliant.solver import Solution
from pliant.solver.evaluation.alignment import align
from pliant.solver.evaluation.trust import size_of
from pliant.worker.artifacts.animation import MAX_FRAME_TARGETS
from pliant.worker.artifacts.colours import Painting
from pliant.worker.artifacts.geometry import Floats, Ints, upright
from pliant.worker.formats import Inputs, Texture
from pliant.worker.formats.tracks.frame_times import mean_rate, uneven


@dataclass(frozen=True, eq=False)
class Result:
    """Inputs, solution and options of a job."""

    inputs: Inputs
    solution: Solution
    options: Options
    name: str = ""
    """Name of the job, from which the names of the objects in the files derive; see `names`."""

    @property
    def y_axis(self) -> str:
        """Direction of the tracks' y axis: `down` or `up`."""
        return self.inputs.interpretation.y_axis

    @cached_property
    def uneven_times(self) -> Floats | None:
        """Seconds of every frame of a film from the first, `(F,)`; None if its frames follow each other at the option `fps`.

        That is also the case if the job sets another rate than the film's.
        """
        own = self.inputs.frame_times
        if own is None or not isclose(self.options.fps, mean_rate(own)) or not uneven(own):
            return None
        return np.asarray(own - own[0])

    @property
    def time_codes(self) -> Floats:
        """Time of every frame from the first, in units of 1 / `fps` seconds, `(F,)`."""
        if self.uneven_times is None:
            return np.arange(len(self.solution.shapes), dtype=np.float64)
        return self.uneven_times * self.options.fps

    @property
    def times(self) -> Floats:
        """Time of every frame from the first, seconds, `(F,)`."""
        return self.time_codes / self.options.fps

    @cached_property
    def faces(self) -> Ints:
        """Faces of the mesh, `(0, 3)` without one."""
        return np.zeros((0, 3), dtype=np.int32) if self.inputs.mesh is None else self.inputs.mesh.faces

    @cached_property
    def distances(self) -> Floats | None:
        """Distance of every point from the truth, `(F, P)`, as `e3d_frame_scaled` aligns the two, the truth's unit; None without truth."""
        truth = self.inputs.ground_truth
        return None if truth is None else align(self.solution.shapes, truth.shapes, kind="frame_scaled").distances

    @cached_property
    def painting(self) -> Painting | None:
        """Colours, if the options request them: the distance from the truth (the residual without truth), or the expected error.

        Also None for the expected error with a prior that has no posterior.
        """
        if self.options.colours == "none":
            return None
        seen = self.inputs.tracks.visible > 0
        if self.options.colours == "expected_error":
            if self.solution.shapes_std is None:
                return None
            share = 100 * self.solution.shapes_std / size_of(self.solution.shapes)
            return Painting.of("expected error", share, seen, unit="percent of the object's size")
        if self.distances is not None:
            return Painting.of("distance from the truth", self.distances, unit="the ground truth's unit")
        return Painting.of("reprojection residual", self.solution.residuals, seen)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of `shapes.npz` by name; docs/reference/artifacts.md describes them."""
        solution, camera, trace = self.solution, self.solution.camera, self.solution.trace
        names, chosen = self.inputs.point_names, self.inputs.selection
        posterior = {"shapes_std": solution.shapes_std, "inlier_probability": solution.inlier_probability}
        return {
            "shapes": solution.shapes,
            "rotations": camera.rotations,
            "scales": camera.scales,
            "translations": camera.translations,
            "focal": np.array(np.inf if camera.focal is None else camera.focal),
            "focal_std": np.array(np.nan if camera.focal_std is None else camera.focal_std),
            "principal_point": camera.principal_point,
            "faces": self.faces,
            "residuals": solution.residuals.astype(np.float32),
            "weights": solution.weights.astype(np.float32),
            **{name: array.astype(np.float32) for name, array in posterior.items() if array is not None},
            "trace_objective": trace.objective,
            "trace_residual": trace.residual,
            "trace_iterations": trace.iterations,
            **({} if chosen is None else {"source_frames": chosen.frames, "source_points": chosen.points}),
            **({} if names is None else {"point_names": np.array(names)}),
        }

    @property
    def texture(self) -> Texture | None:
        """The texture; None without one, without faces, and if colours show a metric."""
        return self.inputs.texture if self.painting is None and len(self.faces) else None

    @cached_property
    def picture_colours(self) -> Floats | None:
        """Colours `(P, 3)` of the points in the texture, sRGB in [0, 1]; None without one or if colours show a metric."""
        return None if self.inputs.texture is None or self.painting is not None else self.inputs.texture.colours()

    @property
    def moving_normals(self) -> bool:
        """Whether every frame has normals of its own: if the options request them and there is a mesh."""
        return self.options.normals == "animated" and len(self.faces) > 0

    def standing(self, frame: int) -> Floats:
        """Return the points `(P, 3)` of a frame, y up, right-handed."""
        return upright(self.solution.shapes[frame], self.y_axis)


def file_warnings(options: Options, solution: Solution) -> tuple[str, ...]:
    """Return a sentence for each option that has no effect on the files of this solution."""
    sentences = []
    if options.colours == "expected_error" and solution.shapes_std is None:
        sentences.append("colours=expected_error has no effect, because the solution has no expected error.")
    if options.glb_motion == "frames" and "glb" in options.outputs and len(solution.shapes) > MAX_FRAME_TARGETS:
        sentences.append("glb_motion=frames has no effect, because the result has too many frames.")
    return tuple(sentences)
