"""The canonical form of a job's inputs: an npz file, written at submission and read back bit for bit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.job import Interpretation
from pliant.solver import KnownCamera, Mesh, Tracks
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.point_names import ARRAY as NAMES
from pliant.worker.formats.point_names import pack, unpack
from pliant.worker.formats.reading.arrays import read_file
from pliant.worker.formats.records import Arrays, GroundTruth, Inputs, Limits, Selection
from pliant.worker.formats.texture import Texture
from pliant.worker.formats.tracker_warnings import ARRAY as WARNINGS
from pliant.worker.formats.tracker_warnings import read_warnings
from pliant.worker.formats.tracks.frame_times import ARRAY as TIMES
from pliant.worker.formats.tracks.frame_times import read_frame_times

VERSION = 1
OWN_FILES = Limits(max_bytes=1 << 36)
"""Limits for files that this package wrote; their content was checked before writing."""


def save_inputs(inputs: Inputs, path: Path) -> None:
    """Write the canonical npz; values that a byte or single precision holds exactly are stored that way, to halve the file."""
    arrays: Arrays = {
        "version": np.array(VERSION),
        "points": _narrow(inputs.tracks.points),
        "visible": _narrow(inputs.tracks.visible),
        "interpretation": np.frombuffer(inputs.interpretation.model_dump_json().encode(), dtype=np.uint8),
    }
    if inputs.mesh is not None:
        arrays["faces"] = inputs.mesh.faces
        if inputs.mesh.grid is not None:
            arrays["grid"] = inputs.mesh.grid
    if inputs.cameras is not None:
        arrays["rotations"] = inputs.cameras.rotations
        if inputs.cameras.scales is not None:
            arrays["scales"] = inputs.cameras.scales
    if inputs.ground_truth is not None:
        arrays["true_shapes"] = _narrow(inputs.ground_truth.shapes)
        if inputs.ground_truth.rotations is not None:
            arrays["true_rotations"] = inputs.ground_truth.rotations
    if inputs.selection is not None:
        arrays["source_frames"], arrays["source_points"] = inputs.selection.frames, inputs.selection.points
        arrays["source_whole"] = np.array(inputs.selection.whole)
    if inputs.texture is not None:
        arrays["texture"] = np.frombuffer(inputs.texture.jpeg, dtype=np.uint8)
        arrays["texture_size"] = np.array([inputs.texture.width, inputs.texture.height])
        arrays["uv"] = inputs.texture.uv
    if inputs.point_names is not None:
        arrays[NAMES] = pack(inputs.point_names)
    if inputs.frame_times is not None:
        arrays[TIMES] = inputs.frame_times
    if inputs.warnings:
        arrays[WARNINGS] = np.array(inputs.warnings)
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_inputs(path: Path) -> Inputs:
    """Read what `save_inputs` wrote.

    Raises
    ------
    InvalidInput
        Code damaged_file: `save_inputs` did not write this file, or it was damaged.
    """
    arrays = read_file(path, field="inputs", limits=OWN_FILES, texts=(WARNINGS,))
    missing = {"version", "points", "visible", "interpretation"} - set(arrays)
    if missing or int(arrays["version"]) != VERSION:
        raise damaged(
            "inputs", f"not a canonical input of version {VERSION} (missing: {', '.join(sorted(missing)) or 'nothing'})"
        )
    points = _wide(arrays["points"])
    mesh = None
    if "faces" in arrays:
        grid = arrays.get("grid")
        mesh = Mesh(points.shape[1], _kept(arrays["faces"]), None if grid is None else _kept(grid))
    cameras = None
    if "rotations" in arrays:
        cameras = KnownCamera(_wide(arrays["rotations"]), _wide(arrays["scales"]) if "scales" in arrays else None)
    truth = None
    if "true_shapes" in arrays:
        turned = _wide(arrays["true_rotations"]) if "true_rotations" in arrays else None
        truth = GroundTruth(_wide(arrays["true_shapes"]), turned)
    selection = None
    if "source_frames" in arrays:
        frames, kept = (arrays[name].astype(np.intp) for name in ("source_frames", "source_points"))
        selection = Selection(frames, kept, (int(arrays["source_whole"][0]), int(arrays["source_whole"][1])))
    interpretation = Interpretation.model_validate(json.loads(arrays["interpretation"].tobytes()))
    return Inputs(
        Tracks(points, _wide(arrays["visible"])), mesh, truth, cameras, interpretation, selection, _texture(arrays),
        unpack(arrays.get(NAMES), points.shape[1]), read_frame_times(arrays, len(points), field="inputs"),
        read_warnings(arrays, field="inputs"),
    )  # fmt: skip


def _texture(arrays: Arrays) -> Texture | None:
    if "texture" not in arrays:
        return None
    width, height = arrays["texture_size"].tolist()
    uv = np.ascontiguousarray(arrays["uv"], dtype=np.float32)
    uv.flags.writeable = False
    return Texture(arrays["texture"].tobytes(), width, height, uv)


def _narrow(values: NDArray[np.float64]) -> NDArray[np.generic]:
    """Choose the smallest type that restores the same bits."""
    with np.errstate(invalid="ignore", over="ignore"):
        if not (np.signbit(values) & (values == 0)).any() and np.array_equal(values.astype(np.uint8), values):
            return values.astype(np.uint8)
        single = values.astype(np.float32)
    return single if single.astype(np.float64).tobytes() == values.tobytes() else values


def _wide(values: NDArray[np.generic]) -> NDArray[np.float64]:
    wide = np.ascontiguousarray(values, dtype=np.float64)
    wide.flags.writeable = False
    return wide


def _kept(values: NDArray[np.generic]) -> NDArray[np.int32]:
    whole = np.ascontiguousarray(values, dtype=np.int32)
    whole.flags.writeable = False
    return whole
