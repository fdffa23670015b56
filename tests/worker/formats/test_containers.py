"""Files of other programs, parsed in the sandbox; an attack is rejected with a code and costs one process."""

from __future__ import annotations

import io
import json
import os
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from crafting import GFACES, accessors, gltf
from PIL import Image
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.artifacts.animation import animate
from pliant.worker.artifacts.glb import write_glb
from pliant.worker.formats import Inputs, Limits, read_inputs
from pliant.worker.formats.reading.csv import read_csv
from pliant.worker.formats.reading.gltf import read_gltf
from pliant.worker.formats.reading.pose_hdf5 import read_hdf5 as read_matlab73
from pliant.worker.formats.reading.sandbox import parse_in_sandbox
from results import moving_sheet

F, ROWS, COLUMNS = 6, 4, 5
P = ROWS * COLUMNS
POINTS = moving_sheet(F, ROWS, COLUMNS)[..., :2] + 100
MATRIX = POINTS.transpose(0, 2, 1).reshape(2 * F, P)

forked = pytest.mark.usefixtures("forked_readers")


def read(path: Path, **more: object) -> Inputs:
    return read_inputs(tracks=path, options=Options(), mesh="none", **more)  # type: ignore[arg-type]


def code_of(path: Path, **more: object) -> str:
    with pytest.raises(InvalidInput) as caught:
        read(path, **more)
    return caught.value.code


@forked
def test_matlab_structs_of_both_versions_give_the_same_tracks(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "five.mat", {"data": {"W": MATRIX}})
    with h5py.File(tmp_path / "seven.mat", "w", userblock_size=512) as file:
        file["data/W"] = MATRIX.T
        file["data/W"].attrs["MATLAB_class"] = np.bytes_("double")
    for name in ("five.mat", "seven.mat"):
        np.testing.assert_array_equal(read(tmp_path / name).tracks.points, POINTS)


@forked
def test_other_variables_of_a_file_may_have_any_name_and_number(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "five.mat", {"W": MATRIX, "file": np.ones(3), "allow_pickle": np.ones(3)})
    with h5py.File(tmp_path / "seven.mat", "w") as file:
        file["Größe (mm)/W"] = MATRIX.T
        file["Größe (mm)/W"].attrs["MATLAB_class"] = np.bytes_("double")
        for index in range(Limits().max_members):
            file[f"v{index}"] = np.ones(3)
    for name in ("five.mat", "seven.mat"):
        np.testing.assert_array_equal(read(tmp_path / name).tracks.points, POINTS)


@forked
def test_a_table_of_numpy_savetxt_is_read(tmp_path: Path) -> None:
    rows = [(f, p, x, y) for f in range(F) for p, (x, y) in enumerate(POINTS[f].tolist())]
    np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header="frame,point,x,y")
    np.testing.assert_array_equal(read(tmp_path / "t.csv").tracks.points, POINTS)


def test_points_of_a_csv_may_have_large_numbers() -> None:
    rows = [f"{frame},{10**10 * point},{frame},{point}" for frame in range(4) for point in range(3)]
    content = "\n".join(["frame,point,x,y", *rows]).encode()
    assert read_csv(io.BytesIO(content), field="tracks", limits=Limits())["tracks"].shape == (4, 3, 2)


@forked
def test_csv_lines_may_come_in_any_order_and_missing_ones_are_hidden(tmp_path: Path) -> None:
    lines = [f"{f},{p + 7},{x!r},{y!r}" for f in range(F) for p, (x, y) in enumerate(POINTS[f].tolist())]
    order = np.random.default_rng(0).permutation(len(lines))
    (tmp_path / "t.csv").write_text("frame,point,x,y\n" + "\n".join(lines[i] for i in order if i != 3) + "\n")
    got = read(tmp_path / "t.csv")
    assert got.tracks.visible[0, 3] == 0
    assert (got.tracks.visible == 0).sum() == 1
    np.testing.assert_array_equal(got.tracks.points[1:], POINTS[1:])
    (tmp_path / "t.csv").write_text("frame,point,x,y\n" + "\n".join(lines), encoding="utf-16")
    np.testing.assert_array_equal(read(tmp_path / "t.csv").tracks.points, POINTS)
    (tmp_path / "t.csv").write_text("frame,point,x,y\n0,0,1,2\n0,0,1,3\n")
    assert code_of(tmp_path / "t.csv") == "duplicate_observation"
    (tmp_path / "t.csv").write_text("frame,point,x,y\n0,0,1,2\n99999999,0,1,3\n")
    assert code_of(tmp_path / "t.csv") == "too_large"
    with pytest.raises(InvalidInput, match="got line 1: '1,2'"):
        read_csv(io.BytesIO(b"1,2\n3,4\n"), field="tracks", limits=Limits())
    (tmp_path / "t.csv").write_text("frame,point,x,y\n0,zero,1,2\n")
    assert code_of(tmp_path / "t.csv") == "unreadable_table"


def test_glb_and_mask_meshes_keep_the_order_of_vertices(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", tracks=POINTS)
    faces = np.array([[0, 1, 6], [0, 6, 5], [13, 14, 19]], dtype=np.int32)
    with (tmp_path / "m.glb").open("wb") as out:
        write_glb(out, animate(moving_sheet(F, ROWS, COLUMNS)), faces, times=np.arange(F) / 25, node={})
    got = read_inputs(tracks=tmp_path / "t.npz", mesh=tmp_path / "m.glb", options=Options())
    assert got.mesh is not None
    np.testing.assert_array_equal(got.mesh.faces, faces)
    mask = np.zeros((ROWS + 2, COLUMNS + 1), dtype=np.uint8)
    mask[1:-1, 1:] = 255
    Image.fromarray(mask).save(tmp_path / "m.png")
    got = read_inputs(tracks=tmp_path / "t.npz", mesh=tmp_path / "m.png", options=Options())
    assert got.mesh is not None
    assert len(got.mesh.faces) == (ROWS - 1) * (COLUMNS - 1)


@forked
def test_the_darkest_colours_of_a_mask_are_points(tmp_path: Path) -> None:
    colours = np.array([[[0, 0, 0, 255], [1, 0, 0, 255], [0, 1, 0, 255]], [[0, 0, 1, 255], [9, 9, 9, 0], [0, 0, 0, 0]]])
    expected = [[False, True, True], [True, False, False]]
    Image.fromarray(colours.astype(np.uint8)).save(tmp_path / "m.png")
    found = parse_in_sandbox("png", tmp_path / "m.png", field="mesh", limits=Limits())
    np.testing.assert_array_equal(found["mask"], expected)
    Image.fromarray(np.where(expected, 1, 0).astype(np.uint16)).save(tmp_path / "m.png")
    found = parse_in_sandbox("png", tmp_path / "m.png", field="mesh", limits=Limits())
    np.testing.assert_array_equal(found["mask"], expected)


def test_hdf5_with_external_data_or_huge_declared_size_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(bytes(8 * 100))
    with h5py.File(tmp_path / "external.mat", "w") as file:
        file.create_dataset("W", (10, 10), dtype="f8", external=[(str(tmp_path / "secret"), 0, 800)])
    with h5py.File(tmp_path / "link.mat", "w") as file:
        file["W"] = h5py.ExternalLink(str(tmp_path / "external.mat"), "W")
    with h5py.File(tmp_path / "virtual.mat", "w") as file:
        layout = h5py.VirtualLayout((10, 10), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "external.mat"), "W", shape=(10, 10))
        file.create_virtual_dataset("W", layout)
    with h5py.File(tmp_path / "huge.mat", "w") as file:
        file.create_dataset("W", (1 << 20, 1 << 20), dtype="f8", chunks=(16, 16))
    for name in ("external", "link", "virtual"):
        assert code_of(tmp_path / f"{name}.mat") == "unsupported_feature"
    assert code_of(tmp_path / "huge.mat") == "too_large"


@pytest.mark.slow
def test_a_file_that_exceeds_the_sandbox_time_or_memory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text("v 1 2 3\n" * 4_000_000)  # several seconds on any machine; the limit is one
    limits = Limits(parse_seconds=1, max_points=10**8)
    with pytest.raises(InvalidInput) as caught:
        parse_in_sandbox("obj", tmp_path / "m.obj", field="mesh", limits=limits)
    assert caught.value.code == "too_slow"
    scipy.io.savemat(tmp_path / "t.mat", {"W": np.zeros((2000, 9000))}, do_compression=True)
    assert code_of(tmp_path / "t.mat", limits=Limits(parse_memory=300 << 20)) == "too_large"
    scipy.io.savemat(tmp_path / "t.mat", {"W": MATRIX}, do_compression=True)
    assert read(tmp_path / "t.mat", limits=Limits(parse_memory=300 << 20)).tracks.num_points == P, (
        "it is not the library"
    )


@forked
def test_damaged_matlab_files_are_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "t.mat", {"W": MATRIX})
    whole = (tmp_path / "t.mat").read_bytes()
    for content in (whole[:200], whole[:128] + os.urandom(400)):
        (tmp_path / "t.mat").write_bytes(content)
        assert code_of(tmp_path / "t.mat") in ("damaged_file", "too_large", "missing_array")


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    (tmp_path / "t.pkl").write_bytes(b"\x80\x04cos\nsystem\n.")
    assert code_of(tmp_path / "t.pkl") == "pickle_refused"


def test_json_gltf_is_read_and_non_integer_counts_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", tracks=POINTS)
    document = gltf(buffers=[{"uri": "data:application/octet-stream;base64," + GFACES}])
    (tmp_path / "m.gltf").write_text(json.dumps(document))
    got = read_inputs(tracks=tmp_path / "t.npz", mesh=tmp_path / "m.gltf", options=Options())
    assert got.mesh is not None
    np.testing.assert_array_equal(got.mesh.faces, [[0, 1, 2], [3, 4, 5]])
    with pytest.raises(InvalidInput, match="not a whole number"):
        read_gltf(
            io.BytesIO(json.dumps({**document, "accessors": accessors(count="20")}).encode()),
            field="mesh",
            limits=Limits(),
        )


def test_implausibly_small_hdf5_is_rejected_before_decompression(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "fill.mat", "w", userblock_size=512) as file:
        file.create_dataset("W", (1 << 13, 1 << 13), dtype="f8", chunks=(256, 256), compression="gzip")
    with h5py.File(tmp_path / "chunk.mat", "w", userblock_size=512) as file:
        file.create_dataset("W", (8, 8), maxshape=(None, None), dtype="f8", chunks=(2048, 2048), compression="gzip")[
            ...
        ] = 1
    for name, got in (("fill", "of 0 bytes"), ("chunk", "in chunks of")):
        tracemalloc.start()
        with (tmp_path / f"{name}.mat").open("rb") as stream, pytest.raises(InvalidInput, match=got) as caught:
            read_matlab73(stream, field="tracks", limits=Limits())
        assert caught.value.code == "too_large"
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
        tracemalloc.stop()
