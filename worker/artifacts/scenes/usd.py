"""The moving mesh as USD with time samples (`usd-core`, the extra `usd`)."""

from __future__ import annotations

import importlib.util
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts.colours import linear
from pliant.worker.artifacts.geometry import Floats, vertex_normals, viewer_scale
from pliant.worker.artifacts.names import identifier, object_name
from pliant.worker.artifacts.result import Result
from pliant.worker.artifacts.scenes.by_path import path_beside
from pliant.worker.formats import Texture

PICTURE = "texture.jpg"
"""Name of the texture in the package."""

PACKED_AT = 315_619_200
"""Time stamp of the package's files, seconds since 1970 (2 January 1980, which ZIP can represent); makes equal results equal files."""


def available() -> bool:
    """Whether `usd-core` is installed."""
    return importlib.util.find_spec("pxr") is not None


def write_usd(result: Result, file: IO[bytes], on_progress: Callable[[float], None]) -> None:
    """Write `/NAME` with one time sample per frame; y up, right-handed, as in the glTF file.

    The library requires a path with its own suffix, so a temporary file beside the target is used.
    """
    with path_beside(file, ".usdc") as path:
        _build(path, result, on_progress)


def write_usdz(result: Result, file: IO[bytes], on_progress: Callable[[float], None]) -> None:
    """Write the content of `write_usd` in a package together with the texture."""
    from pxr import UsdUtils

    with tempfile.TemporaryDirectory(dir=Path(file.name).parent, prefix=".usdz-") as folder:
        stage, package = Path(folder) / "shapes.usdc", Path(folder) / "shapes.usdz"
        assert result.texture is not None
        (Path(folder) / PICTURE).write_bytes(result.texture.jpeg)
        _build(stage, result, on_progress)
        for path in Path(folder).iterdir():
            os.utime(path, (PACKED_AT, PACKED_AT))
        if not UsdUtils.CreateNewUsdzPackage(str(stage), str(package)):
            raise OSError(f"USD could not write the package {package}.")
        with package.open("rb") as made:
            shutil.copyfileobj(made, file)


def _build(path: Path, result: Result, on_progress: Callable[[float], None]) -> None:
    from pxr import Usd, Vt

    stage = Usd.Stage.CreateNew(str(path))
    _describe_stage(stage, result)
    shape = _define(stage, result)
    stage.SetDefaultPrim(shape.GetPrim())
    points, extent = shape.CreatePointsAttr(), shape.CreateExtentAttr()
    painted = result.painting
    frames = len(result.solution.shapes)
    for frame, code in enumerate(result.time_codes.tolist()):
        standing = result.standing(frame)
        points.Set(Vt.Vec3fArray.FromNumpy(standing.astype(np.float32)), code)
        corners = np.stack([standing.min(axis=0), standing.max(axis=0)]).astype(np.float32)
        extent.Set(Vt.Vec3fArray.FromNumpy(corners), code)
        if result.moving_normals:
            normals = vertex_normals(standing, triangles_of(result.faces))
            shape.CreateNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(normals), code)
        if painted is not None:
            _paint(shape, painted.frame(frame), code)
        on_progress((frame + 1) / frames)
    stage.GetRootLayer().Save()


def _describe_stage(stage: Any, result: Result) -> None:
    from pxr import UsdGeom

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    # The real size is unknown; the object is scaled to a few units, interpreted as metres as in glTF.
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(result.options.fps)
    stage.SetFramesPerSecond(result.options.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(float(result.time_codes[-1]))


def _define(stage: Any, result: Result) -> Any:
    """Return the static prim: a mesh with faces, or points, scaled to a suitable size for viewers."""
    from pxr import Gf, Usd, UsdGeom, Vt

    scale = viewer_scale(result.solution.shapes)
    faces = result.faces
    shape = (UsdGeom.Mesh if len(faces) else UsdGeom.Points).Define(stage, f"/{identifier(result.name)}")
    if (shown := object_name(result.name)) != identifier(result.name):
        shape.GetPrim().SetDisplayName(shown)
    shape.AddScaleOp().Set(Gf.Vec3f(scale))
    if len(faces) == 0:
        low, high = result.solution.shapes[0].min(axis=0), result.solution.shapes[0].max(axis=0)
        width = float(np.linalg.norm(high - low) / np.sqrt(result.solution.shapes.shape[1])) / 4
        shape.CreateWidthsAttr(Vt.FloatArray([width]))
        shape.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        if result.picture_colours is not None:
            _paint(shape, result.picture_colours, Usd.TimeCode.Default())
        return shape
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1))))
    # Subdivision would move the surface off the points.
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    if result.texture is not None:
        _put_picture(stage, shape, result.texture)
    return shape


def _paint(shape: Any, colours: Floats, code: Any) -> None:
    """Colour the points by `(P, 3)`, sRGB, at a time code."""
    from pxr import Sdf, UsdGeom, Vt

    primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    primvar.Set(Vt.Vec3fArray.FromNumpy(linear(colours).astype(np.float32)), code)


def _put_picture(stage: Any, shape: Any, texture: Texture) -> None:
    """Bind a material with the texture: a UsdPreviewSurface with texture coordinates `st`, whose t points up."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    kinds = Sdf.ValueTypeNames
    coordinates = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", kinds.TexCoord2fArray, UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(texture.uv_up))
    path = shape.GetPath().AppendChild("film")
    material = UsdShade.Material.Define(stage, path)
    surface, picture, reader = (
        UsdShade.Shader.Define(stage, path.AppendChild(name)) for name in ("surface", "picture", "coordinates")
    )
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", kinds.Asset).Set(f"./{PICTURE}")
    picture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    for name in ("wrapS", "wrapT"):
        picture.CreateInput(name, kinds.Token).Set("clamp")
    found = reader.CreateOutput("result", kinds.Float2)
    picture.CreateInput("st", kinds.Float2).ConnectToSource(found)
    surface.CreateIdAttr("UsdPreviewSurface")
    colour = picture.CreateOutput("rgb", kinds.Float3)
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(colour)
    surface.CreateInput("roughness", kinds.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
