"""All result files of a job. Each is written under another name and renamed when whole, so a reader never sees half of one."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from pliant.client.options import Options
from pliant.client.schemas import Artifact
from pliant.solver import Solution
from pliant.worker import preview
from pliant.worker.artifacts.animation import animate
from pliant.worker.artifacts.frames_zip import write_ply_zip
from pliant.worker.artifacts.geometry import Ints, triangles_of, upright, viewer_scale
from pliant.worker.artifacts.glb import write_glb
from pliant.worker.formats import Inputs

OnProgress = Callable[[float], None]


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a writer works from."""

    inputs: Inputs
    solution: Solution
    options: Options

    @property
    def faces(self) -> Ints:
        """Faces of the mesh, `(0, 3)` without one."""
        return np.zeros((0, 3), dtype=np.int32) if self.inputs.mesh is None else self.inputs.mesh.faces


@dataclass(frozen=True, slots=True)
class Kind:
    """One result file."""

    name: str
    media_type: str
    description: str
    share: float
    """Estimated share of the time that exporting takes."""

    write: Callable[[Result, IO[bytes], OnProgress], dict[str, Any]]
    """Writes the file; returns what the report should say of it."""


def write_artifacts(
    inputs: Inputs, solution: Solution, options: Options, report: dict[str, Any], directory: Path, *, on_progress: OnProgress | None = None
) -> list[Artifact]:  # fmt: skip
    """Write every result file of a job into a directory that exists.

    Parameters
    ----------
    inputs, solution, options
        Of the job.
    report : dict
        From `build_report`; what was written is added to it under `artifacts`, and `seconds.exporting`.
    directory : Path
        Where the files go; files of the same names are replaced.
    on_progress : callable, optional
        Told the share that is done, in [0, 1].

    Returns
    -------
    list of Artifact
        In the order written; `report.json` is the last.
    """
    began = time.perf_counter()
    result = Result(inputs, solution, options)
    tell: OnProgress = on_progress or (lambda _: None)
    written: list[Artifact] = []
    told: dict[str, Any] = {}
    done, total = 0.0, sum(kind.share for kind in KINDS)
    for kind in KINDS:
        start, share = done / total, kind.share / total
        said: dict[str, Any] = {}

        def put(
            file: IO[bytes], kind: Kind = kind, start: float = start, share: float = share, said: dict[str, Any] = said
        ) -> None:
            said.update(kind.write(result, file, lambda part: tell(start + share * part)))

        artifact = _written(directory, kind.name, kind.media_type, kind.description, put)
        written.append(artifact)
        told[kind.name] = {"bytes": artifact.bytes, "sha256": artifact.sha256, **said}
        done += kind.share
    seconds = {**report.get("seconds", {}), "exporting": time.perf_counter() - began}
    text = json.dumps({**report, "seconds": seconds, "artifacts": told}, indent=2, allow_nan=False).encode()
    written.append(_written(directory, "report.json", "application/json", REPORT, lambda file: file.write(text)))
    tell(1.0)
    return written


def _written(
    directory: Path, name: str, media_type: str, description: str, put: Callable[[IO[bytes]], object]
) -> Artifact:
    aside = directory / f".{name}.part"
    try:
        with aside.open("wb") as file:
            put(file)
            file.flush()
            os.fsync(file.fileno())
        with aside.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = aside.stat().st_size
        aside.replace(directory / name)
    finally:
        aside.unlink(missing_ok=True)
    return Artifact(name=name, media_type=media_type, bytes=size, sha256=digest, description=description)


def _write_npz(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
    solution, camera = result.solution, result.solution.camera
    np.savez(
        file,
        allow_pickle=False,
        shapes=solution.shapes,
        rotations=camera.rotations,
        scales=camera.scales,
        translations=camera.translations,
        faces=result.faces,
        residuals=solution.residuals.astype(np.float32),
        weights=solution.weights.astype(np.float32),
        trace_objective=solution.trace.objective,
        trace_residual=solution.trace.residual,
        trace_iterations=solution.trace.iterations,
    )
    on_progress(1.0)
    return {}


def _write_glb(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
    standing = upright(result.solution.shapes, result.inputs.interpretation.y_axis)
    animation = animate(standing)
    on_progress(0.4)
    write_glb(
        file, animation, triangles_of(result.faces), fps=result.options.fps, node={"scale": [viewer_scale(standing)] * 3},
        on_progress=lambda part: on_progress(0.4 + 0.6 * part),
    )  # fmt: skip
    return animation.extras


def _write_ply(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
    y_axis = result.inputs.interpretation.y_axis
    write_ply_zip(file, result.solution.shapes, result.faces, y_axis=y_axis, on_progress=on_progress)
    return {}


def _write_preview(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
    inputs = result.inputs
    preview.write_preview(
        file,
        tracks=inputs.tracks,
        mesh=inputs.mesh,
        solution=result.solution,
        truth=None if inputs.ground_truth is None else inputs.ground_truth.shapes,
        y_axis=inputs.interpretation.y_axis,
        fps=result.options.fps,
    )
    on_progress(1.0)
    return {}


REPORT = "How the result came to be: options, choices with reasons, metrics, trace, timings, versions."
KINDS = (
    Kind("shapes.npz", "application/zip", "All arrays: shapes (F, P, 3), cameras, faces, residuals, weights, trace.", 2, _write_npz),
    Kind("shapes.glb", "model/gltf-binary", "The moving mesh as animated glTF, y up.", 2, _write_glb),
    Kind("shapes_ply.zip", "application/zip", "One binary PLY for each frame.", 6, _write_ply),
    Kind(preview.NAME, preview.MEDIA_TYPE, preview.DESCRIPTION, 1, _write_preview),
)  # fmt: skip
