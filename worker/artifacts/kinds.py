"""The kinds of result files: name, description, option that requests them, and writer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options, Output
from pliant.solver import InvalidInput
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts import matlab, preview
from pliant.worker.artifacts.animation import animate
from pliant.worker.artifacts.colours import linear
from pliant.worker.artifacts.frames_zip import OnProgress, write_obj_zip, write_ply_zip
from pliant.worker.artifacts.geometry import Floats, viewer_scale
from pliant.worker.artifacts.glb import write_glb
from pliant.worker.artifacts.names import object_name
from pliant.worker.artifacts.result import Result
from pliant.worker.artifacts.scenes import alembic, usd
from pliant.worker.artifacts.scenes.mdd import write_mdd
from pliant.worker.artifacts.tables import write_frames_csv, write_points_csv
from pliant.worker.artifacts.view import view_of


@dataclass(frozen=True, slots=True)
class Kind:
    """One result file."""

    name: str
    output: Output | None
    """Value of the option `outputs` that requests it; None if it is always written."""

    media_type: str
    description: str
    share: float
    """Relative time of writing."""

    write: Callable[[Result, IO[bytes], OnProgress], dict[str, Any]]
    """Writes the file; returns its entry for the report."""

    textured: bool | None = None
    """Whether it is written only with, or only without, a texture; None: in both cases."""


def kinds_for(options: Options, *, size: tuple[int, int] = (0, 0), textured: bool = False) -> list[Kind]:
    """Return the kinds that a job's options request, in the order of writing; `size` is frames and points, if known.

    Raises
    ------
    InvalidInput
        A requested file cannot be written in this installation or at this size.
    """
    for output, there, package, extra in (
        ("usd", usd.available, "usd-core", "usd"),
        ("abc", alembic.available, "alembic3d", "alembic"),
    ):
        if output in options.outputs and not there():
            raise InvalidInput(
                "output_unavailable", field="options.outputs", expected="outputs that this installation can write",
                got=f"{output}, which needs the package {package}", hint=f"Install the extra {extra} beside the worker and the "
                f"service (pip install '.[{extra}]' in Pliant's source folder), or leave {output} out.",
            )  # fmt: skip
    if "mat" in options.outputs and not matlab.fits(*size):
        raise InvalidInput(
            "output_unavailable", field="options.outputs", expected="less than 2 GiB of shapes for mat",
            got=f"{size[0]} frames of {size[1]} points", hint="Leave mat out; shapes.npz holds the same arrays.",
        )  # fmt: skip
    wanted = [kind for kind in KINDS if kind.output is None or kind.output in options.outputs]
    return [kind for kind in wanted if kind.textured in (None, textured)]


def _npz(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
    np.savez(file, allow_pickle=False, **result.arrays())
    on_progress(1.0)
    return {}


def _glb(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
    options, shapes, painted = result.options, result.solution.shapes, result.painting
    animation = animate(shapes, y_axis=result.y_axis, motion=options.glb_motion)
    colours = None
    if painted is not None:
        animation.extras.update(painted.legend())
        colours = _rgba(painted.mean())
    elif result.texture is None and result.picture_colours is not None:
        colours = _rgba(result.picture_colours)
    scale = viewer_scale(shapes)
    view = view_of(
        result.solution.camera, shapes, y_axis=result.y_axis, scale=scale, image_size=result.options.picture_size
    )
    on_progress(0.4)
    write_glb(
        file, animation, triangles_of(result.faces), times=result.times, node={"scale": [scale] * 3}, name=object_name(result.name),
        normals=options.normals, quantized=options.glb_quantized, colours=colours,
        texture=result.texture, view=view, on_progress=lambda part: on_progress(0.4 + 0.6 * part),
    )  # fmt: skip
    return animation.extras


def _rgba(colours: Floats) -> NDArray[np.uint16]:
    """Return colours `(P, 3)`, sRGB, as glTF stores them: linear light and opaque, 65535 for 1."""
    shares = np.hstack([linear(colours), np.ones((len(colours), 1))])
    return np.asarray(np.rint(shares * 65535).astype(np.uint16))


def _plain(write: Callable[[Result, IO[bytes], OnProgress], None]) -> Callable[..., dict[str, Any]]:
    def written(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
        write(result, file, on_progress)
        return {}

    return written


def _painted(write: Callable[[Result, IO[bytes], OnProgress], None]) -> Callable[..., dict[str, Any]]:
    def written(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
        write(result, file, on_progress)
        return {} if result.painting is None else result.painting.legend()

    return written


def _at_once(write: Callable[[Result, IO[bytes]], None]) -> Callable[..., dict[str, Any]]:
    def written(result: Result, file: IO[bytes], on_progress: OnProgress) -> dict[str, Any]:
        write(result, file)
        on_progress(1.0)
        return {}

    return written


KINDS = (
    Kind("shapes.npz", None, "application/zip", "All arrays: shapes (F, P, 3), deviations, cameras, faces, residuals, weights.", 1, _npz),
    Kind("shapes.glb", "glb", "model/gltf-binary", "The moving mesh and its camera as animated glTF, y up.", 4, _glb),
    Kind("shapes_ply.zip", "ply", "application/zip", "One binary PLY for each frame.", 5, _painted(write_ply_zip)),
    Kind("shapes_obj.zip", "obj", "application/zip", "One OBJ for each frame.", 13, _painted(write_obj_zip)),
    Kind("shapes.usdc", "usd", "application/octet-stream", "The moving mesh as USD, y up.", 8, _painted(usd.write_usd), textured=False),
    Kind("shapes.usdz", "usd", "model/vnd.usdz+zip", "USD, y up, with its picture.", 8, _painted(usd.write_usdz), textured=True),
    Kind("shapes.abc", "abc", "application/octet-stream", "The moving mesh as Alembic, y up.", 8, _plain(alembic.write_alembic)),
    Kind("shapes.mat", "mat", "application/x-matlab-data", "The same arrays for MATLAB; faces from 1.", 2, _at_once(matlab.write_mat)),
    Kind("shapes.mdd", "mdd", "application/octet-stream", "Point cache for Blender, Maya and Houdini, y up.", 2, _plain(write_mdd)),
    Kind("metrics_frames.csv", "csv", "text/csv", "Metrics of every frame.", 2, _at_once(write_frames_csv)),
    Kind("metrics_points.csv", "csv", "text/csv", "Metrics of every point.", 1, _at_once(write_points_csv)),
    Kind(preview.NAME, None, preview.MEDIA_TYPE, preview.DESCRIPTION, 4, _at_once(preview.write_preview)),
)  # fmt: skip
