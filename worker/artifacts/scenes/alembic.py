"""The moving mesh as Alembic (`alembic3d`, the extra `alembic`), for Blender, Maya, Houdini and others."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pliant.worker.artifacts.geometry import viewer_scale
from pliant.worker.artifacts.names import identifier
from pliant.worker.artifacts.result import Result
from pliant.worker.artifacts.scenes.by_path import path_beside


def available() -> bool:
    """Whether `alembic3d` is installed."""
    return importlib.util.find_spec("alembic3d") is not None


def write_alembic(result: Result, file: IO[bytes], on_progress: Callable[[float], None]) -> None:
    """Write `/NAME/mesh` (`/NAME/points` without faces) with a time sample per frame; y up, right-handed, as in the glTF file.

    The library requires a path, so a temporary file beside the target is used. The archive has no date: equal results give
    equal files.
    """
    with path_beside(file, ".abc") as path:
        _build(path, result, on_progress)


def _build(path: Path, result: Result, on_progress: Callable[[float], None]) -> None:
    from alembic3d import Abc, AbcGeom

    # The archive is written to disk when the last of its objects is released, at the end of this function.
    archive = Abc.OArchive(str(path), True)  # True: the Ogawa format, which all current readers support
    # Referred to by index, because the binding does not keep a TimeSampling alive.
    sampling = archive.addTimeSampling(_sampling(result))
    stand = AbcGeom.OXform(archive.getTop(), identifier(result.name))
    scale, placed = AbcGeom.XformOp(AbcGeom.XformOperationType.kScaleOperation, 0), AbcGeom.XformSample()
    placed.addOp(scale, _vector(viewer_scale(result.solution.shapes)))
    stand.getSchema().set(placed)
    write = _mesh_writer(stand, sampling, result) if len(result.faces) else _points_writer(stand, sampling, result)
    frames = len(result.solution.shapes)
    for frame in range(frames):
        write(_points(result.standing(frame)))
        on_progress((frame + 1) / frames)


def _sampling(result: Result) -> Any:
    """Return the times of the samples: evenly spaced, or one by one for a film of variable frame rate."""
    from alembic3d import AbcCoreAbstract

    if result.uneven_times is None:
        return AbcCoreAbstract.TimeSampling(1 / result.options.fps, 0.0)
    times = AbcCoreAbstract.TimeVector()
    times.extend(result.uneven_times.tolist())
    acyclic = AbcCoreAbstract.TimeSamplingType(AbcCoreAbstract.AcyclicFlag.kAcyclic)
    return AbcCoreAbstract.TimeSampling(acyclic, times)


def _mesh_writer(parent: Any, sampling: int, result: Result) -> Callable[[Any], None]:
    """Return a function that writes the points of a frame; faces and texture coordinates are written once, with the first frame."""
    import imath
    from alembic3d import AbcGeom

    schema = AbcGeom.OPolyMesh(parent, "mesh", sampling).getSchema()
    faces = np.ascontiguousarray(result.faces[:, ::-1], dtype=np.int32)  # Alembic's outside is clockwise
    indices, counts = _integers(faces.reshape(-1)), _integers(np.full(len(faces), faces.shape[1], dtype=np.int32))
    first = True

    def write(points: Any) -> None:
        nonlocal first
        if not first:
            schema.set(AbcGeom.OPolyMeshSchemaSample(points))
            return
        first = False
        sample = AbcGeom.OPolyMeshSchemaSample(points, indices, counts)
        if result.texture is not None:
            array = imath.V2fArrayFromBuffer(result.texture.uv_up)
            # One indexed value for each corner of a face: the form that every reader supports.
            corners = imath.UnsignedIntArray(faces.size)
            for number, index in enumerate(faces.reshape(-1).tolist()):
                corners[number] = index
            sample.setUVs(AbcGeom.OV2fGeomParamSample(array, corners, AbcGeom.GeometryScope.kFacevaryingScope))
        schema.set(sample)

    return write


def _points_writer(parent: Any, sampling: int, result: Result) -> Callable[[Any], None]:
    import imath
    from alembic3d import AbcGeom

    schema = AbcGeom.OPoints(parent, "points", sampling).getSchema()
    count = result.solution.shapes.shape[1]
    numbers = imath.IntArray(count)
    for number in range(count):
        numbers[number] = number
    return lambda points: schema.set(AbcGeom.OPointsSchemaSample(points, numbers))


def _vector(scale: float) -> Any:
    import imath

    return imath.V3d(scale, scale, scale)


def _points(standing: NDArray[np.float64]) -> Any:
    import imath

    return imath.V3fArrayFromBuffer(np.ascontiguousarray(standing, dtype=np.float32))


def _integers(values: NDArray[np.int32]) -> Any:
    import imath

    return imath.IntArrayFromBuffer(values)
