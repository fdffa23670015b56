"""The exact message of every refusal by the readers, as a user sees it.

Limits are small where a refusal is about one. Parsers run in this process; their sandbox has its own tests.
"""

# ruff: noqa: E501
from __future__ import annotations

import json
import pickle
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
from crafting import (
    HONEST,
    Runs,
    accessors,
    archive,
    described,
    encrypted,
    glb,
    gltf,
    hdf5,
    hdf5_virtual,
    header,
    mat,
    mat_matrix,
    npy,
    npz,
    ply,
    png,
)
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats import Limits, read_inputs
from pliant.worker.formats.reading import containers
from pliant.worker.formats.reading.parsers import PARSERS
from pliant.worker.formats.reading.parsers import parse as parsed
from pliant.worker.formats.records import Arrays

WALK = np.cumsum(np.random.default_rng(0).normal(size=(6, 20, 2)), axis=0) + 100
PLACES = "v 0 0 0\n" * 20


@dataclass(frozen=True, kw_only=True)
class Case:
    """Inputs that are refused, and the message."""

    tracks: Callable[[], bytes] = lambda: HONEST
    mesh: Callable[[], bytes] | str | None = None
    ground_truth: Callable[[], bytes] | None = None
    rotations: Callable[[], bytes] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    limits: Limits = Limits()  # noqa: RUF009 - frozen
    words: str


def hdf5_sparse(file: h5py.File) -> None:
    group = file.create_group("W")
    group.attrs["MATLAB_sparse"] = np.uint64(12)
    group["data"], group["ir"], group["jc"] = WALK.ravel(), np.tile(np.arange(12), 20), np.arange(21) * 12


def film(**changes: Any) -> bytes:
    """The file that `pliant track` writes, with changes; None leaves an array out."""
    arrays = {
        "tracks": WALK.astype(np.float32), "visibility": np.ones((6, 20), bool), "confidence": np.ones((6, 20), np.float32), "frame_indices": np.arange(6),
        "grid": np.arange(20).reshape(4, 5), "image_size": np.array([640, 480]), "fps": np.array(25.0), "template_frame": np.array(0),
    }  # fmt: skip
    return npz(**{name: value for name, value in {**arrays, **changes}.items() if value is not None})


def parse_here(parser: str, path: Path, *, field: str, limits: Limits) -> Arrays:
    with path.open("rb") as stream:
        return parsed(PARSERS[parser], stream, field=field, limits=limits)


def refused(case: Case, folder: Path) -> InvalidInput:
    """Read the inputs of a case as files of a folder, and return the error."""
    parts: dict[str, Any] = {}
    for name in ("tracks", "mesh", "ground_truth", "rotations"):
        value = getattr(case, name)
        parts[name] = value
        if callable(value):
            parts[name] = folder / name
            parts[name].write_bytes(value())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(containers, "parse_in_sandbox", parse_here)
        with pytest.raises(InvalidInput) as caught:
            read_inputs(**parts, options=Options.model_validate(case.options), limits=case.limits)
    return caught.value


CASES: dict[str, Case] = {
    "an empty file": Case(tracks=lambda: b"",
        words="tracks: expected a file with content, got 0 bytes. Send the file again."),
    "a file beyond the limit": Case(limits=Limits(max_bytes=500),
        words="tracks: expected a file of at most 500 bytes, got 2,048 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a matrix file beyond the limit": Case(tracks=lambda: mat(W=np.ones((12, 20))), limits=Limits(max_bytes=500),
        words="tracks: expected a file of at most 500 bytes, got 2,104 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more inflated than the limit": Case(tracks=lambda: archive(("tracks.npy", npy(np.zeros((6, 2000, 2))))), limits=Limits(max_bytes=5000),
        words="tracks: expected at most 5,000 bytes inflated, got 192,128 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more frames than the limit": Case(limits=Limits(max_frames=5),
        words="tracks: expected at most 5 frames, 1,000,000 points and 40,000,000 observations, got 6 frames × 20 points. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more points than the limit": Case(limits=Limits(max_points=19),
        words="tracks: expected at most 10,000 frames, 19 points and 40,000,000 observations, got 6 frames × 20 points. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more observations than the limit": Case(limits=Limits(max_observations=119),
        words="tracks: expected at most 10,000 frames, 1,000,000 points and 119 observations, got 6 frames × 20 points. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more faces than the limit": Case(mesh="4x5", limits=Limits(max_faces=11),
        words="mesh.faces: expected at most 11 faces, got 12. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more members than the limit": Case(tracks=lambda: archive(*((f"a{index}.npy", HONEST) for index in range(4))), limits=Limits(max_members=3),
        words="tracks: expected at most 3 members, got 4. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a table beyond the limit": Case(tracks=lambda: b"x0,y0,x1,y1\n" + b"1,2,3,4\n" * 100, limits=Limits(max_bytes=1024),
        words="tracks: expected at most 1,024 bytes as a table, got more. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "more observations than a table may have": Case(tracks=lambda: b"".join(b"%d,0,1,2\n" % frame for frame in range(200)), limits=Limits(max_bytes=5000),
        words="tracks: expected at most 78 observations, got more. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a row of more characters than allowed": Case(tracks=lambda: b"x0,y0,x1,y1\n" + b"1" * ((1 << 20) + 5),
        words="tracks: expected rows of at most 1,048,576 characters, got longer ones. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a table of far frames": Case(tracks=lambda: b"frame,point,x,y\n0,0,1,2\n999999999,0,1,2\n",
        words="tracks: expected at most 1,073,741,824 bytes as a full table, got 1,000,000,000 frames × 1 points. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "JSON whose arrays are beyond the limit": Case(tracks=lambda: ("[" + ",".join(['[{"x":1,"y":2}]'] * 100) + "]").encode(), limits=Limits(max_bytes=2000),
        words="tracks: expected at most 2,000 bytes as arrays, got more. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a header of more than the limit": Case(tracks=lambda: header(described("(1000000, 1000000)")),
        words="tracks: expected at most 1,073,741,824 bytes, got (1000000, 1000000) of float64: 8,000,000,000,000 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a matrix of more than the limit": Case(tracks=lambda: mat_matrix((2**31 - 1, 2**31 - 1)),
        words="tracks: expected at most 1,073,741,824 bytes, got 36,893,488,113,059,364,864 bytes declared. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a mask beyond the limit": Case(mesh=lambda: png(300, 300), limits=Limits(max_points=1000),
        words="mesh: expected at most 64,000 pixels, got 300 × 300. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a web page": Case(tracks=lambda: b"<html><script>alert(1)</script></html>",
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got a web page or XML. Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "blank text": Case(tracks=lambda: b"  \n \n",
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got blank text. Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "other text": Case(tracks=lambda: b"Hello world\n",
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got text that begins 'Hello world'. Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "bytes of an unknown kind": Case(tracks=lambda: bytes(range(200, 232)),
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got a file of an unknown kind, which begins with the bytes c8 c9 ca cb cc cd ce cf. Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "a PDF": Case(tracks=lambda: b"%PDF-1.7\n" + bytes(100),
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got a PDF document. Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "text as a mesh": Case(mesh=lambda: b"Hello world\n",
        words="mesh: expected a mesh file, got text without vertices. Give an OBJ, PLY, glTF or npz mesh, a grid size such as 48x64, or leave the mesh out."),
    "bytes as a mesh": Case(mesh=lambda: bytes(range(200, 232)),
        words="mesh: expected a mesh file, got text without vertices. Give an OBJ, PLY, glTF or npz mesh, a grid size such as 48x64, or leave the mesh out."),
    "a word as a mesh": Case(mesh="several",
        words="mesh: expected a mesh file, ROWSxCOLUMNS or none, got 'several'. Give a file, or a grid size such as 48x64."),
    "a pickle": Case(tracks=lambda: pickle.dumps(Runs()),
        words="tracks: expected arrays that can be read without running code, got a Python pickle. Convert it where it was made: numpy.savez('tracks.npz', tracks=..., visibility=...); for a torch tensor use .cpu().numpy()."),
    "a torch file": Case(tracks=lambda: archive(("archive/data.pkl", b"")),
        words="tracks: expected arrays that can be read without running code, got a Python pickle. Convert it where it was made: numpy.savez('tracks.npz', tracks=..., visibility=...); for a torch tensor use .cpu().numpy()."),
    "a zip without its directory": Case(tracks=lambda: archive(("tracks.npy", HONEST))[:400],
        words="tracks: expected a complete, consistent file, got a zip file without its directory, probably cut off. Write the file again."),
    "a zip whose checksum is wrong": Case(tracks=lambda: archive(("tracks.npy", HONEST), method=zipfile.ZIP_STORED).replace(HONEST[-8:], bytes(8), 1),
        words="tracks: expected a complete, consistent file, got a zip file that cannot be read (…). Write the file again."),
    "a zip with a 64-bit directory": Case(tracks=lambda: archive(("tracks.npy", HONEST)).replace(b"PK\x05\x06", b"PK\x06\x07" + bytes(16) + b"PK\x05\x06"),
        words="tracks: expected a zip directory below 1 MiB, got 56 bytes or a 64-bit directory. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a path as name": Case(tracks=lambda: archive(("../../../../tmp/x.npy", HONEST)),
        words="tracks: expected members named like tracks.npy, got '../../../../tmp/x.npy'. Write the file with numpy.savez and plain names."),
    "two members of one name": Case(tracks=lambda: archive(("tracks.npy", HONEST), ("tracks.npy", HONEST)),
        words="tracks: expected each member once, got 'tracks' twice. Write the file again with numpy.savez."),
    "an encrypted member": Case(tracks=encrypted,
        words="tracks: expected stored or deflated members, got 'tracks' encrypted or compressed with another method. Write the file with numpy.savez or numpy.savez_compressed."),
    "no NumPy header": Case(tracks=lambda: archive(("tracks.npy", b"none at all")),
        words="tracks.tracks: expected a complete, consistent file, got no NumPy header. Write the file again."),
    "a header of another version": Case(tracks=lambda: b"\x93NUMPY\x09\x00" + bytes(100),
        words="tracks: expected a complete, consistent file, got a NumPy header of version 9 and 0 bytes. Write the file again."),
    "a header that is cut off": Case(tracks=lambda: header(described("(6, 20, 2)"), length=400),
        words="tracks: expected a complete, consistent file, got a header that is cut off. Write the file again."),
    "a header of code": Case(tracks=lambda: header("__import__('os').system('true')"),
        words="tracks: expected a complete, consistent file, got a NumPy header that is not a Python dictionary. Write the file again."),
    "a header of other entries": Case(tracks=lambda: header("{'a': 1}"),
        words="tracks: expected a complete, consistent file, got a NumPy header with other entries than descr, fortran_order and shape. Write the file again."),
    "a negative shape": Case(tracks=lambda: header(described("(-1, 20, 2)"), bytes(320)),
        words="tracks: expected a complete, consistent file, got a NumPy header whose shape is not a tuple of whole numbers. Write the file again."),
    "too many dimensions": Case(tracks=lambda: header(described("(" + "1," * 40 + ")"), bytes(8)),
        words="tracks: expected a complete, consistent file, got a NumPy header of 40 dimensions, fortran_order False. Write the file again."),
    "a dtype with fields": Case(tracks=lambda: header(described("(1,)", "[('a', '<f8')]"), bytes(8)),
        words="tracks: expected an array of numbers or bool, got dtype [('a', '<f8')]. Give one plain array for each name."),
    "an unknown dtype": Case(tracks=lambda: header(described("(1,)", "'<f7'"), bytes(8)),
        words="tracks: expected a complete, consistent file, got an unknown dtype <f7. Write the file again."),
    "Python objects": Case(tracks=lambda: npy(np.array([Runs()], dtype=object)),
        words="tracks: expected an array of numbers, got an array of Python objects. Reading objects can run code, so they are refused: save plain arrays, e.g. numpy.asarray(x, dtype=float)."),
    "names that are Python objects": Case(tracks=lambda: npz(tracks=WALK, point_names=np.array(["a"] * 20, dtype=object)),
        words="tracks.point_names: expected an array of texts, got an array of Python objects. Reading objects can run code, so they are refused: save plain arrays, e.g. numpy.array(x, dtype=str)."),
    "names that are numbers": Case(tracks=lambda: npz(tracks=WALK, point_names=np.arange(20)),
        words="tracks.point_names: expected an array of texts, got dtype int64. Save numpy.array(names, dtype=str)."),
    "names of another number": Case(tracks=lambda: npz(tracks=WALK, point_names=np.array(["a", "b"])),
        words="tracks.point_names: expected (20,), one name for each point, got (2,). Give as many names as the tracks have points, or leave them out."),
    "names that are not Unicode": Case(tracks=lambda: npz(tracks=WALK, point_names=np.full(20, 0x7FFFFFFF, np.uint32).view("<U1")),
        words="tracks.point_names: expected a complete, consistent file, got texts that are not Unicode. Write the file again."),
    "texts as tracks": Case(tracks=lambda: npy(np.array(["a", "b"])),
        words="tracks: expected real numbers or bool of at most 64 bits, got dtype <U1. Convert the array to float64."),
    "complex numbers": Case(tracks=lambda: npy(WALK.astype(complex)),
        words="tracks: expected real numbers or bool of at most 64 bits, got dtype complex128. Convert the array to float64."),
    "fewer bytes than announced": Case(tracks=lambda: header(described("(6, 20, 2)"), bytes(64)),
        words="tracks: expected a complete, consistent file, got a header that declares 1,920 bytes before 64 bytes of data. Write the file again."),
    "fewer bytes in a member": Case(tracks=lambda: archive(("tracks.npy", header(described("(6, 20, 2)"), bytes(64)))),
        words="tracks.tracks: expected a complete, consistent file, got a header that declares 1,920 bytes before 64 bytes of data. Write the file again."),
    "a MATLAB file without a matrix": Case(tracks=lambda: mat(name="text"),
        words="tracks: expected a full matrix of real numbers, such as W, got char name (1,). Save the 2F × P matrix, a sparse one after W = full(W): save('tracks.mat', 'W', '-v7')."),
    "a MATLAB file that is cut off": Case(tracks=lambda: mat(W=np.ones((12, 20)))[:300],
        words="tracks: expected a complete, consistent file, got a .mat file that cannot be read (…). Write the file again."),
    "HDF5 without a matrix": Case(tracks=lambda: hdf5(lambda file: file.create_group("g")),
        words="tracks: expected a full matrix of real numbers, such as W, got g. Save the 2F × P matrix, a sparse one after W = full(W): save('tracks.mat', 'W', '-v7')."),
    "a sparse MATLAB matrix": Case(tracks=lambda: mat(W=scipy.sparse.csc_array(WALK.reshape(12, 20))),
        words="tracks: expected a full matrix of real numbers, such as W, got sparse W (12, 20). Save the 2F × P matrix, a sparse one after W = full(W): save('tracks.mat', 'W', '-v7')."),
    "a sparse MATLAB 7.3 matrix": Case(tracks=lambda: hdf5(hdf5_sparse),
        words="tracks: expected a full matrix of real numbers, such as W, got sparse W. Save the 2F × P matrix, a sparse one after W = full(W): save('tracks.mat', 'W', '-v7')."),
    "a MATLAB 4 file": Case(tracks=lambda: mat(format="4", W=WALK.reshape(12, 20)),
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got a MATLAB file of version 4. Save it in MATLAB's version 7, e.g. save('tracks.mat', 'W', '-v7')."),
    "a file of Octave": Case(tracks=lambda: b"# Created by Octave 8.4.0, Mon Jan 01 00:00:00 2024 UTC <a@b>\n# name: W\n",
        words="tracks: expected npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports, recognised by content, got a file in Octave's own format. Save it in MATLAB's version 7, e.g. save('tracks.mat', 'W', '-v7')."),
    "a MATLAB file as a mesh": Case(mesh=lambda: mat(faces=np.array([[1, 2, 3]])),
        words="mesh: expected npz, npy, OBJ, PLY, glTF, GLB or a PNG mask, recognised by content, got a MATLAB file. Convert it, e.g. numpy.savez('mesh.npz', faces=faces), with indices from 0."),
    "an HDF5 file as a mesh": Case(mesh=lambda: hdf5(lambda file: file.create_dataset("faces", data=np.array([[0, 1, 2]]))),
        words="mesh: expected npz, npy, OBJ, PLY, glTF, GLB or a PNG mask, recognised by content, got an HDF5 file. Convert it, e.g. numpy.savez('mesh.npz', faces=faces), with indices from 0."),
    "bytes as ground truth": Case(ground_truth=lambda: bytes(range(200, 232)),
        words="ground_truth: expected npz, npy or MATLAB .mat, recognised by content, got a file of an unknown kind, which begins with the bytes c8 c9 ca cb cc cd ce cf. Convert it, e.g. numpy.savez('truth.npz', shapes=shapes)."),
    "HDF5 noise": Case(tracks=lambda: b"\x89HDF\r\n\x1a\n" + bytes(4000),
        words="tracks: expected a complete, consistent file, got an HDF5 file that cannot be read (…). Write the file again."),
    "HDF5 with a link": Case(tracks=lambda: hdf5(lambda file: file.__setitem__("W", h5py.SoftLink("/x"))),
        words="tracks: expected data inside the file itself, got W, a soft or external link. Save the matrix itself: save('tracks.mat', 'W', '-v7')."),
    "HDF5 of another file": Case(tracks=lambda: hdf5(hdf5_virtual),
        words="tracks: expected data inside the file itself, got W, which lies in another file. Save the matrix itself: save('tracks.mat', 'W', '-v7')."),
    "HDF5 that declares too much": Case(tracks=lambda: hdf5(lambda file: file.create_dataset("W", (1 << 15, 1 << 15), "f8", chunks=(16, 16))),
        words="tracks: expected at most 1,073,741,824 bytes, got W, which declares 8,589,934,592. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "HDF5 that stores nothing": Case(tracks=lambda: hdf5(lambda file: file.create_dataset("W", (2000, 5000), "f8", chunks=(2000, 100))),
        words="tracks: expected at most 1,032 bytes of data for each stored byte, got W: 80,000,000 of 0 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "HDF5 chunks beyond the data": Case(tracks=lambda: hdf5(lambda file: file.create_dataset("W", (2, 2), "f8", chunks=(2000, 2000), maxshape=(None, None))),
        words="tracks: expected chunks no larger than their data set, got W in chunks of 32,000,000 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "HDF5 of too many variables": Case(tracks=lambda: hdf5(lambda file: [file.create_group(f"g{index}") for index in range(600)]),
        words="tracks: expected at most 512 variables, 4 levels deep, got more. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "HDF5 of too many cells": Case(tracks=lambda: hdf5(lambda file: file.create_dataset("W", (1, 25_000), dtype=h5py.ref_dtype)),
        words="tracks: expected at most 20,000 cells, got W of 25,000. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "frames that are no whole numbers": Case(tracks=lambda: b"frame,point,x,y\n0.5,0,1,2\n",
        words="tracks: expected whole numbers in the columns frame and point, got 0.5. Number frames and points, as in 0, 1, 2."),
    "one observation twice": Case(tracks=lambda: b"frame,point,x,y\n0,0,1,2\n0,0,1,2\n",
        words="tracks: expected each point once in a frame, got frame 0 with point 0 twice. Keep one line for each frame and point."),
    "other names": Case(tracks=lambda: npz(Rs_gt=WALK, vis_e=WALK),
        words="tracks: expected an array named tracks (F, P, 2), or W (2F, P), got Rs_gt (6, 20, 2), vis_e (6, 20, 2). Save as numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "truth-values as tracks": Case(tracks=lambda: npz(tracks=np.ones((6, 20, 2), bool)),
        words="tracks.tracks: expected real numbers, got dtype bool. Convert the array to float."),
    "four coordinates": Case(tracks=lambda: npz(tracks=np.ones((6, 20, 4))),
        words="tracks: expected (frames, points, 2) or a matrix of 2·frames rows, with 3 frames and 4 points or more, got tracks of shape (6, 20, 4). Transpose or reshape the array; check the options layout and rows."),
    "six axes": Case(tracks=lambda: npz(tracks=np.ones((1, 1, 6, 20, 3, 2))),
        words="tracks: expected (frames, points, 2), got tracks of shape (1, 1, 6, 20, 3, 2). Reshape the array to three axes."),
    "a batch of two": Case(tracks=lambda: npz(tracks=np.ones((2, 6, 20, 2))),
        words="tracks: expected one video, got a batch of 2. Submit each element of the batch as its own job."),
    "a matrix of three rows": Case(tracks=lambda: npz(W=np.ones((3, 21))),
        words="tracks: expected (frames, points, 2) or a matrix of 2·frames rows, with 3 frames and 4 points or more, got W of shape (3, 21). Transpose or reshape the array; check the options layout and rows."),
    "three rows per frame": Case(tracks=lambda: npz(W=np.concatenate([WALK, WALK[..., :1] + 500], axis=2).transpose(0, 2, 1).reshape(18, 20)),
        words="tracks: expected two rows per frame, x and y, got W of shape (18, 20), which fits three interleaved rows per frame. Save only the rows of x and y. If it has two rows per frame, set rows=interleaved or rows=stacked."),
    "a layout that is not certain": Case(tracks=lambda: npz(W=np.random.default_rng(0).normal(size=(20, 20)) * 100 + 300),
        words="tracks: expected tracks whose layout is certain, got W of shape (20, 20), which can be read as W (P, 2F), columns interleaved or W (P, 2F), columns stacked or W (2F, P), rows stacked or W (2F, P), rows interleaved. Set the options of the correct one: layout=points_frames, rows=interleaved or layout=points_frames, rows=stacked or layout=frames_points, rows=stacked or layout=frames_points, rows=interleaved."),
    "two matrices": Case(tracks=lambda: mat(one={"W": WALK.reshape(12, 20)}, two={"W": WALK.reshape(12, 20)}),
        words="tracks: expected one track array, got one.W and two.W. Save the intended one in a separate file."),
    "points in space": Case(tracks=lambda: npz(tracks=np.ones((6, 20, 3)) * 4),
        words="tracks: expected two image coordinates for each point, or a third number from 0 to 1 as visibility, got tracks of shape (6, 20, 3). Save x and y as tracks (F, P, 2); for points in space before a camera, add intrinsics=[fx, fy, cx, cy]."),
    "points in space without a camera": Case(tracks=lambda: npz(tracks_XYZ=np.ones((6, 20, 3)), visibility=np.ones((6, 20), bool)),
        words="tracks.intrinsics: expected fx, fy, cx, cy beside points in space, got none. Save intrinsics=[fx, fy, cx, cy], or the image points as tracks (F, P, 2)."),
    "a camera of three numbers": Case(tracks=lambda: npz(tracks_XYZ=np.ones((6, 20, 3)), intrinsics=np.ones(3)),
        words="tracks.intrinsics: expected four finite numbers fx, fy, cx, cy, or a 3 × 3 matrix, got float64 (3,). Save intrinsics=[fx, fy, cx, cy]."),
    "fractions without a picture's size": Case(tracks=lambda: npz(tracks=np.random.default_rng(0).random((6, 20, 2))),
        words="tracks: expected coordinates whose unit is certain, got values from 0.00274 to 0.997. Give the option image_size=WIDTHxHEIGHT if they are fractions of the picture, else coordinates=pixels."),
    "fractions by an option without a size": Case(tracks=lambda: npz(tracks=np.random.default_rng(0).random((6, 20, 2))), options={"coordinates": "unit"},
        words="options.image_size: expected the picture's WIDTHxHEIGHT, since coordinates are fractions of it, got none. Set it, e.g. image_size=640x480."),
    "visibility of another shape": Case(tracks=lambda: npz(tracks=WALK, visibility=np.ones((5, 20), bool)),
        words="tracks.visibility: expected (6, 20), one value for each observation, got (5, 20). Visibility is (frames, points), in the order of the tracks."),
    "more visibility than tracks": Case(tracks=lambda: npz(tracks=WALK, visibility=np.ones((60, 200), bool)),
        words="tracks.visibility: expected (6, 20), one value for each observation, got (60, 200). Visibility is (frames, points), in the order of the tracks."),
    "visibility with frames and points exchanged": Case(tracks=lambda: npz(tracks=WALK.transpose(1, 0, 2), visibility=np.ones((6, 20), bool)), options={"layout": "points_frames"},
        words="tracks.visibility: expected (20, 6), one value for each observation, got (6, 20). Visibility is (points, frames), in the order of the tracks."),
    "visibility of texts": Case(tracks=lambda: npz(tracks=WALK, visibility=np.ones((6, 20), complex)),
        words="tracks.visibility: expected real numbers or bool of at most 64 bits, got dtype complex128. Convert the array to float64."),
    "visibility that could be two things": Case(tracks=lambda: npz(tracks=WALK, visibility=np.linspace(0.5, 3, 120).reshape(6, 20)),
        words="tracks.visibility: expected bool, probabilities from 0 to 1, or logits of both signs, got values from 0.5 to 3. Set the option visibility, or convert the array to bool."),
    "visibility above 1": Case(tracks=lambda: npz(tracks=WALK, visibility=np.linspace(0.5, 3, 120).reshape(6, 20)), options={"visibility": "probability"},
        words="tracks.visibility: expected probabilities from 0 to 1, got values from 0.5 to 3. Set the option visibility to bool or logits."),
    "one frame": Case(tracks=lambda: npy(WALK[:1]),
        words="tracks: expected at least 3 frames, got 1. Track a longer clip."),
    "one frame of all pixels": Case(tracks=lambda: npz(tracks=WALK[:1].reshape(1, 1, 4, 5, 2)),
        words="tracks: expected at least 3 frames, got 1. Track a longer clip."),
    "two frames": Case(tracks=lambda: npy(WALK[:2]),
        words="tracks: expected at least 3 frames, got 2. Track a longer clip."),
    "two points as a matrix": Case(tracks=lambda: npy(np.random.default_rng(0).normal(size=(280, 2))),
        words="tracks: expected at least 4 points, got 2 in array of shape (280, 2), read as array (2F, P), rows interleaved. Track more points, or save the array as (frames, points, 2)."),
    "unknown names": Case(tracks=lambda: npz(foo=WALK, label=np.array(["a"])),
        words="tracks: expected an array named tracks (F, P, 2), or W (2F, P), got foo (6, 20, 2), label. Save as numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "many unknown names": Case(tracks=lambda: npz(**{f"{i:02}{'x' * 60}": np.ones(3) for i in range(12)}),
        words="tracks: expected an array named tracks (F, P, 2), or W (2F, P), got " + ", ".join(f"{i:02}{'x' * 38} (3,)" for i in range(10)) + " and 2 more. Save as numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "an empty archive": Case(tracks=lambda: npz(),
        words="tracks: expected an array named tracks (F, P, 2), or W (2F, P), got no array. Save as numpy.savez('tracks.npz', tracks=points, visibility=visible)."),
    "three points": Case(tracks=lambda: npz(tracks=WALK[:, :3]), options={"layout": "frames_points"},
        words="tracks: expected (frames, points, 2) or a matrix of 2·frames rows, with 3 frames and 4 points or more, got tracks of shape (6, 3, 2). Transpose or reshape the array; check the options layout and rows."),
    "nothing visible": Case(tracks=lambda: npz(tracks=np.full((6, 20, 2), np.nan)),
        words="tracks: expected at least one finite, visible observation, got none. Check for NaN everywhere, or a visibility array that is inverted."),
    "coordinates beyond all bounds": Case(tracks=lambda: npz(tracks=np.where(np.arange(20)[:, None] == 3, 1e30, WALK)),
        words="tracks: expected visible coordinates within ±1e+12, got 6 of them beyond. Mark them as hidden, or set them to NaN."),
    "one position for all points": Case(tracks=lambda: npz(tracks=np.full((6, 20, 2), 7.0)),
        words="tracks: expected points that differ from each other in a frame, got one position for all visible points of each frame. Check that the points' axis is the second one, that the tracks are not all zero, and that frames show several points."),
    "a selection of two frames": Case(options={"frames": "0:2"},
        words="options.frames: expected at least 3 of the 6 frames, got 2 by 0:2. Widen the range, or omit frames to use all of them."),
    "a stride that leaves one point": Case(mesh="4x5", options={"stride": 1000},
        words="options.stride: expected a value that leaves 4 points or more, got 1 of 20. Use a smaller stride."),
    "points that are seen too seldom": Case(options={"min_seen": 7},
        words="options.min_seen: expected points that are visible in 7 or more frames, got none of 20. Set min_seen lower."),
    "points that are visible once": Case(tracks=lambda: npz(tracks=WALK, visibility=np.arange(20) % 6 == np.arange(6)[:, None]), options={"layout": "frames_points"},
        words="visibility: expected at least 4 points that are visible in two or more frames, got 0. Check that the visibility is not inverted, and that a point has the same index in every frame."),
    "a mesh of other arrays": Case(mesh=lambda: npz(vertices=np.ones((20, 3))),
        words="mesh: expected faces, or grid, got vertices (20, 3). Save the faces as numpy.savez('mesh.npz', faces=faces)."),
    "a grid of another size": Case(mesh="3x5",
        words="mesh: expected 20 vertices, one for each point of the tracks, got 15. Vertex i of the mesh must be point i of the tracks, in the same order; omit the mesh to have one generated."),
    "a mesh of other vertices": Case(mesh=lambda: b"v 0 0 0\n" * 19 + b"f 1 2 3\n",
        words="mesh: expected 20 vertices, one for each point of the tracks, got 19. Vertex i of the mesh must be point i of the tracks, in the same order; omit the mesh to have one generated."),
    "a mask of other pixels": Case(mesh=lambda: npz(mask=np.ones((3, 5), bool)),
        words="mesh: expected 20 vertices, one for each point of the tracks, got 15. Vertex i of the mesh must be point i of the tracks, in the same order; omit the mesh to have one generated."),
    "a face beyond the points": Case(mesh=lambda: npz(faces=np.array([[0, 1, 99]])),
        words="mesh.faces: expected indices from 0 to 19 (the tracks have 20 points), got indices from 0 to 99. Vertex i of the mesh must be point i of the tracks; indices start at 0."),
    "a face that repeats a vertex": Case(mesh=lambda: npz(faces=np.array([[0, 1, 1]])),
        words="mesh.faces: expected distinct vertices in every face, got face 0 = [0, 1, 1]. Remove faces that repeat a vertex."),
    "faces that are no integers": Case(mesh=lambda: npz(faces=np.array([[0.5, 1, 2]])),
        words="mesh.faces: expected integers, got dtype float64. Convert the faces to int32."),
    "a grid of fractions": Case(mesh=lambda: npz(grid=np.ones((4, 5))),
        words="mesh.grid: expected an integer array (rows, columns), got float64 (4, 5). Give the point index of every cell, −1 for holes."),
    "a grid that repeats": Case(mesh=lambda: npz(grid=np.zeros((4, 5), int)),
        words="mesh.grid: expected each index from 0 to 19 exactly once, got missing or repeated indices. Number the grid's points without gaps; −1 marks a hole."),
    "an OBJ without vertices": Case(mesh=lambda: b"# nothing\n" * 3,
        words="mesh: expected a mesh file, got text without vertices. Give an OBJ, PLY, glTF or npz mesh, a grid size such as 48x64, or leave the mesh out."),
    "an OBJ line that is none": Case(mesh=lambda: (PLACES + "f a b c\n").encode(),
        words="mesh: expected a complete, consistent file, got line 21, which is not a vertex or face. Write the file again."),
    "an OBJ vertex of two numbers": Case(mesh=lambda: b"v 0 0\n" * 20 + b"f 1 2 3\n",
        words="mesh: expected a complete, consistent file, got a vertex without three coordinates. Write the file again."),
    "an OBJ of a long line": Case(mesh=lambda: (PLACES + "f" + " 1" * 100_000 + "\n").encode(),
        words="mesh: expected a complete, consistent file, got line 21, which is longer than 4,096 bytes or not text. Write the file again."),
    "an OBJ beyond the limit": Case(mesh=lambda: b"v 0 0 0\n" * 30, limits=Limits(max_points=25),
        words="mesh: expected at most 25 vertices and 4,000,000 faces, got more. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "an OBJ that counts from 0": Case(mesh=lambda: (PLACES + "f 0 1 2\n").encode(),
        words="mesh.faces: expected indices from 1 to 20, the vertices of the OBJ, got indices from 0 to 2. The first vertex of an OBJ has index 1."),
    "an OBJ face beyond its vertices": Case(mesh=lambda: (PLACES + "f 1 2 21\n").encode(),
        words="mesh.faces: expected indices from 1 to 20, the vertices of the OBJ, got indices from 1 to 21. The first vertex of an OBJ has index 1."),
    "an OBJ face that repeats a vertex": Case(mesh=lambda: (PLACES + "f 1 2 3\nf 4 5 5\n").encode(),
        words="mesh.faces: expected distinct vertices in every face, got f 4 5 5. Remove faces that repeat a vertex."),
    "an OBJ face beyond 64 bits": Case(mesh=lambda: (PLACES + f"f 1 2 {10**30}\n").encode(),
        words="mesh.faces: expected a complete, consistent file, got an index beyond 64 bits. Write the file again."),
    "a face of two vertices": Case(mesh=lambda: (PLACES + "f 1 2\n").encode(),
        words="mesh.faces: expected faces of three vertices or more, got a face of 2. Remove points and lines from the faces."),
    "a PLY that is none": Case(mesh=lambda: b"ply\nformat ascii 1.0\nend_header\n",
        words="mesh: expected a complete, consistent file, got a PLY file that cannot be read (no element 'vertex'). Write the file again."),
    "a PLY beyond the limit": Case(mesh=lambda: ply("element vertex 1000000000000000\nproperty float x\n"),
        words="mesh: expected at most 1,000,000 vertices and 4,000,000 faces, got 1000000000000000 of vertex. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a GLB that is cut off": Case(mesh=lambda: b"glTF\x02\0\0\0",
        words="mesh: expected a complete, consistent file, got a GLB that is cut off. Write the file again."),
    "a GLB of another version": Case(mesh=lambda: glb(gltf()).replace(b"glTF\x02", b"glTF\x01"),
        words="mesh: expected a complete, consistent file, got a GLB of version 1 whose first part is b'JSON' of 404 bytes. Write the file again."),
    "a glTF of two parts": Case(mesh=lambda: json.dumps(gltf(meshes=[{"primitives": [{}, {}]}])).encode(),
        words="mesh: expected one mesh of triangles with one material, got 2 parts. Join the parts, or export OBJ or PLY, keeping the vertex order."),
    "a glTF of compressed data": Case(mesh=lambda: glb(gltf(accessors=accessors(sparse={})), bytes(264)),
        words="mesh: expected plain accessors, got sparse or compressed data. Export without compression, or as OBJ or PLY."),
    "a glTF of nothing": Case(mesh=lambda: b'{"asset": {"version": "2.0"}}',
        words="mesh: expected a complete, consistent file, got a glTF that cannot be read (no entry 'meshes'). Write the file again."),
    "a glTF of compressed views": Case(mesh=lambda: glb(gltf(bufferViews=[{"buffer": 0, "byteLength": 240, "extensions": {"EXT_meshopt_compression": {}}}] * 2), bytes(264)),
        words="mesh: expected plain accessors, got sparse or compressed data. Export without compression, or as OBJ or PLY."),
    "a glTF of another file": Case(mesh=lambda: json.dumps(gltf(buffers=[{"byteLength": 264, "uri": "data.bin"}])).encode(),
        words="mesh: expected data inside the file itself, got a buffer in another file. Export a binary glTF (.glb), or one with embedded data."),
    "a glTF beyond its buffer": Case(mesh=lambda: glb(gltf(), bytes(100)),
        words="mesh: expected a complete, consistent file, got a glTF that cannot be read (an accessor beyond its buffer). Write the file again."),
    "a glTF of absurd counts": Case(mesh=lambda: glb(gltf(accessors=accessors(count=10**12)), bytes(264)),
        words="mesh: expected counts within the limits, got 1,000,000,000,000 rows of 12 bytes. Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."),
    "a glTF of a half count": Case(mesh=lambda: glb(gltf(accessors=accessors(count=2.5)), bytes(264)),
        words="mesh: expected a complete, consistent file, got a glTF that cannot be read ('2.5' is not a whole number). Write the file again."),
    "truth of other arrays": Case(ground_truth=lambda: npz(points=np.ones((6, 20, 3))),
        words="ground_truth: expected shapes (F, P, 3) or S (3F, P), got points (6, 20, 3). Save as numpy.savez('truth.npz', shapes=shapes)."),
    "truth of other points": Case(ground_truth=lambda: npz(shapes=np.ones((6, 21, 3))),
        words="ground_truth.shapes: expected (6, 20, 3), got (6, 21, 3). Ground truth is (frames, points, 3), with frames and points in the order of the tracks."),
    "truth of truth-values": Case(ground_truth=lambda: npz(shapes=np.ones((6, 20, 3), bool)),
        words="ground_truth.shapes: expected real numbers, got dtype bool. Convert the array to float."),
    "truth that is not finite": Case(ground_truth=lambda: npz(shapes=np.full((6, 20, 3), np.nan)),
        words="ground_truth.shapes: expected finite coordinates, got 360 that are not. Give truth for every point and frame, or omit it."),
    "truth beyond all bounds": Case(ground_truth=lambda: npz(shapes=np.arange(360.0).reshape(6, 20, 3) * 1e30),
        words="ground_truth.shapes: expected coordinates within ±1e+12, got 3.59e+32. Check the file, or choose a larger unit."),
    "truth of one point": Case(ground_truth=lambda: npz(shapes=np.ones((6, 20, 3))),
        words="ground_truth.shapes: expected points that differ in every frame, got a frame whose points all coincide. Omit the ground truth if it is not known."),
    "truth with too few cameras": Case(ground_truth=lambda: npz(shapes=np.arange(360.0).reshape(6, 20, 3), rotations=np.ones((5, 3, 3))),
        words="ground_truth.rotations: expected (6, 2, 3) or (6, 3, 3), got (5, 3, 3). Give one rotation a frame."),
    "cameras of other arrays": Case(rotations=lambda: npz(cameras=np.ones((6, 3, 3))),
        words="rotations: expected rotations (F, 3, 3), got cameras (6, 3, 3). Save as numpy.savez('rotations.npz', rotations=rotations)."),
    "too few cameras": Case(rotations=lambda: npz(rotations=np.ones((5, 3, 3))),
        words="rotations: expected (6, 2, 3) or (6, 3, 3), real, got float64 (5, 3, 3). Give one rotation for each of the 6 frames; if the tracks have another number, set the option layout."),
    "cameras that are no rotations": Case(rotations=lambda: npz(rotations=np.full((6, 3, 3), 2.0)),
        words="rotations: expected orthonormal rows, got a deviation of 12. Rows must have length 1 and be perpendicular; scales are given separately."),
    "tracks of a film without confidence": Case(tracks=lambda: film(confidence=None),
        words="tracks: expected all arrays that pliant track writes, because there is one named frame_indices, got a file without confidence. Write the file again, or rename frame_indices if another program wrote it."),
    "confidence of other frames": Case(tracks=lambda: film(confidence=np.ones((5, 20))),
        words="tracks: expected a complete, consistent file, got confidence of shape (5, 20) beside tracks of shape (6, 20, 2). Write the file again."),
    "confidence above 1": Case(tracks=lambda: film(confidence=np.full((6, 20), 2.0)),
        words="tracks: expected a complete, consistent file, got confidence outside 0 … 1. Write the file again."),
    "a grid of other points": Case(tracks=lambda: film(grid=np.arange(12).reshape(3, 4)),
        words="tracks: expected a complete, consistent file, got a grid of 12 points beside tracks of 20. Write the file again."),
    "a picture's size of one number": Case(tracks=lambda: film(image_size=np.array([640])),
        words="tracks: expected a complete, consistent file, got an image_size that is not two positive integers, width and height. Write the file again."),
    "no frames per second": Case(tracks=lambda: film(fps=np.array(0.0)),
        words="tracks: expected a complete, consistent file, got an fps that is not a number from 0 to 1000. Write the file again."),
    "tracks of a film as a matrix": Case(tracks=lambda: film(tracks=WALK.reshape(6, 40)),
        words="tracks.tracks: expected (frames, points, 2), as pliant track writes it, got (6, 40). Save the file of pliant track as it is, or leave frame_indices out."),
    "texture coordinates of other points": Case(tracks=lambda: film(uv=np.ones((3, 2)), template_image=np.zeros((4, 4, 3), np.uint8)),
        words="tracks: expected a complete, consistent file, got texture coordinates of shape (3, 2) for 20 points. Write the file again."),
    "a texture that is no picture": Case(tracks=lambda: film(uv=np.ones((20, 2)), template_image=np.zeros((4, 4), np.uint8)),
        words="tracks: expected a complete, consistent file, got a template_image that is no picture (uint8 (4, 4)). Write the file again."),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_message_of_each_refusal(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    words = str(refused(case, tmp_path))
    if "(…)" in case.words:  # a library's own message
        words = re.sub(r"cannot be read \(.+?\)\. ", "cannot be read (…). ", words)
    assert words == case.words


def test_the_message_for_json_beyond_the_limit(tmp_path: Path) -> None:
    """Reached only by calling the parser directly, since the same limit applies to the file before."""
    (tmp_path / "tracks").write_text(json.dumps([[{"x": 0.5, "y": 0.5}] * 8] * 8))
    with pytest.raises(InvalidInput) as caught:
        parse_here("json", tmp_path / "tracks", field="tracks", limits=Limits(max_bytes=512))
    assert str(caught.value) == (
        "tracks: expected at most 512 bytes of JSON, got more. "
        "Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit."
    )
