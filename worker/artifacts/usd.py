"""The moving mesh as USD with time samples (`usd-core`, an extra: `pip install 'pliant[usd]'`)."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from pliant.worker.artifacts.colours import linear
from pliant.worker.artifacts.geometry import triangles_of, vertex_normals, viewer_scale
from pliant.worker.artifacts.result import Result


def available() -> bool:
    """Whether `usd-core` is installed."""
    return importlib.util.find_spec("pxr") is not None


def write_usd(result: Result, file: IO[bytes], on_progress: Callable[[float], None]) -> None:
    """Write `/shape` with a time sample a frame; y up, right-handed, as in the glTF file.

    The library wants a path with its own suffix, so it writes beside the file, into one that goes.
    """
    path = Path(f"{file.name}.usdc")
    path.unlink(missing_ok=True)
    try:
        _build(path, result, on_progress)
        with path.open("rb") as made:
            shutil.copyfileobj(made, file)
    finally:
        path.unlink(missing_ok=True)


def _build(path: Path, result: Result, on_progress: Callable[[float], None]) -> None:
    from pxr import Sdf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    _describe_stage(stage, result)
    shape = _define(stage, result)
    stage.SetDefaultPrim(shape.GetPrim())
    points, extent = shape.CreatePointsAttr(), shape.CreateExtentAttr()
    moving = result.options.normals == "animated" and len(result.faces) > 0
    painted, kind = result.painting, Sdf.ValueTypeNames.Color3fArray
    painting = UsdGeom.PrimvarsAPI(shape)
    frames = len(result.solution.shapes)
    for frame in range(frames):
        standing = result.standing(frame)
        points.Set(Vt.Vec3fArray.FromNumpy(standing.astype(np.float32)), frame)
        corners = np.stack([standing.min(axis=0), standing.max(axis=0)]).astype(np.float32)
        extent.Set(Vt.Vec3fArray.FromNumpy(corners), frame)
        if moving:
            normals = vertex_normals(standing, triangles_of(result.faces))
            shape.CreateNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(normals), frame)
        if painted is not None:
            colours = painting.CreatePrimvar("displayColor", kind, UsdGeom.Tokens.vertex)
            colours.Set(Vt.Vec3fArray.FromNumpy(linear(painted.frame(frame)).astype(np.float32)), frame)
        on_progress((frame + 1) / frames)
    stage.GetRootLayer().Save()


def _describe_stage(stage: Any, result: Result) -> None:
    from pxr import UsdGeom

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    # How large the thing is nobody knows; its scale brings it to a few units, which are taken for metres as in glTF.
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(result.options.fps)
    stage.SetFramesPerSecond(result.options.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(result.solution.shapes) - 1)


def _define(stage: Any, result: Result) -> Any:
    """Make the prim without what moves: a mesh with its faces, or points; scaled to a size that viewers like."""
    from pxr import Gf, UsdGeom, Vt

    scale = viewer_scale(result.solution.shapes)
    faces = result.faces
    shape = UsdGeom.Mesh.Define(stage, "/shape") if len(faces) else UsdGeom.Points.Define(stage, "/shape")
    shape.AddScaleOp().Set(Gf.Vec3f(scale))
    if len(faces) == 0:
        low, high = result.solution.shapes[0].min(axis=0), result.solution.shapes[0].max(axis=0)
        width = float(np.linalg.norm(high - low) / np.sqrt(result.solution.shapes.shape[1])) / 4
        shape.CreateWidthsAttr(Vt.FloatArray([width]))
        shape.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        return shape
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1))))
    # Subdivision would move the surface away from the points.
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    return shape
