"""Parsers called directly, without their sandbox: every refusal has its code."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from crafting import BINARY, HONEST, OBJ_POINTS, PLY_FACE, PLY_VERTEX, accessors, glb, gltf, observations, ply
from crafting import hdf5 as hdf5_file
from crafting import hdf5_deep as deep
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats import Limits, read_inputs
from pliant.worker.formats.meshes.surface import read_surface
from pliant.worker.formats.reading import arrays, sandbox
from pliant.worker.formats.reading.csv import read_csv
from pliant.worker.formats.reading.gltf import read_glb
from pliant.worker.formats.reading.meshes import read_obj, read_ply
from pliant.worker.formats.reading.parsers import parse
from pliant.worker.formats.reading.pose_hdf5 import read_hdf5
from pliant.worker.formats.records import Arrays
from pliant.worker.processes.contained import DONE, Ended

FEW = Limits(max_points=2, max_faces=2, max_bytes=1000)
BRIEF = Limits(max_bytes=64)


def code(read: Callable[[], object]) -> str:
    with pytest.raises(InvalidInput) as caught:
        read()
    return caught.value.code


def hdf5(*, groups: str = "") -> bytes:
    return hdf5_file(deep if groups == "deep" else lambda file: file.create_group("nothing"))


LIST = PLY_FACE.replace("vertex_indices", "others")


@pytest.mark.parametrize(
    ("reader", "content", "limits", "expected"),
    [
        (read_csv, observations("0.5,0,1,2"), Limits(), "damaged_file"),
        (read_csv, observations(), Limits(), "damaged_file"),
        (read_csv, b"frame,point,x,y,x\n0,0,1,2,3\n", Limits(), "unreadable_table"),
        (read_csv, observations("0,0,1,2", "100000,0,1,2"), Limits(), "too_large"),
        (read_csv, observations("0,0,1,2", "0,0,1,2"), Limits(), "duplicate_observation"),
        (read_csv, observations("0,0,1,2", "0,1,1,2"), BRIEF, "too_large"),
        (read_glb, b"glTF", Limits(), "damaged_file"),
        (read_glb, glb(gltf(), BINARY, length=0xFFFFFFF0), Limits(), "damaged_file"),
        (read_glb, glb(gltf(meshes=[{"primitives": [{}, {}]}])), Limits(), "unsupported_feature"),
        (read_glb, glb(gltf(), BINARY), FEW, "too_large"),
        (read_glb, glb(gltf(), BINARY), Limits(max_points=19), "too_large"),
        (read_glb, glb(gltf(accessors=accessors(sparse={})), BINARY), Limits(), "unsupported_feature"),
        (read_glb, glb(gltf(accessors=accessors(count=10**18)), BINARY), Limits(), "too_large"),
        (read_glb, glb(gltf(), BINARY[:100]), Limits(), "damaged_file"),
        (read_glb, glb(gltf(buffers=[{"uri": "mesh.bin"}])), Limits(), "unsupported_feature"),
        (read_obj, OBJ_POINTS.encode(), FEW, "too_large"),
        (read_obj, b"# a comment\n", Limits(), "unknown_format"),
        (read_ply, ply(PLY_VERTEX, bytes(240)), FEW, "too_large"),
        (read_ply, ply(PLY_VERTEX, bytes(100)), Limits(), "damaged_file"),
        (read_ply, ply(PLY_VERTEX + LIST, bytes(244)), Limits(), "damaged_file"),
        (read_hdf5, hdf5(), Limits(), "missing_array"),
        (read_hdf5, hdf5(groups="deep"), Limits(), "too_large"),
        (read_hdf5, hdf5()[:600], Limits(), "damaged_file"),
    ],
)
def test_files_refused_by_a_parser_have_the_expected_code(
    reader: Callable[..., Arrays], content: bytes, limits: Limits, expected: str
) -> None:
    assert code(lambda: reader(io.BytesIO(content), field="mesh", limits=limits)) == expected


def test_a_parser_out_of_memory_refuses_the_file() -> None:
    def hungry(stream: object, **given: object) -> Arrays:
        raise MemoryError

    assert code(lambda: parse(hungry, io.BytesIO(), field="tracks", limits=Limits())) == "too_large"


def test_arrays_above_the_limit_are_too_large_for_every_parser(tmp_path: Path) -> None:
    lines = [f"{100 * row},0,1,2,1" for row in range(2001)]
    (tmp_path / "t.csv").write_text("\n".join(["frame,point,x,y,visible", *lines]))
    limits = Limits(max_bytes=200_001 * 16)  # enough for the positions, not for the visibility
    read = lambda: sandbox.parse_in_sandbox("csv", tmp_path / "t.csv", field="tracks", limits=limits)  # noqa: E731
    assert code(read) == "too_large"


@pytest.mark.parametrize("answer", [b"{", b"3", b"[]", b'["a", "b"]', b"[" * 100_000])
def test_a_sandbox_that_answers_other_names_than_it_wrote_is_refused(answer: bytes, tmp_path: Path) -> None:
    np.savez(tmp_path / "output.npz", np.zeros(3))
    ended = Ended(DONE, answer, "")
    read = lambda: sandbox._received(ended, tmp_path / "output.npz", field="tracks", limits=Limits())  # noqa: E731
    assert code(read) in ("damaged_file", "too_large")


def test_sandboxed_formats_are_refused_without_a_sandbox(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sandbox, "find_spec", lambda name: None)
    read = lambda: sandbox.parse_in_sandbox("obj", tmp_path / "m.obj", field="mesh", limits=Limits())  # noqa: E731
    assert code(read) == "unsupported_feature"


def test_an_array_that_ends_early_is_damaged() -> None:
    read = lambda: arrays.read_npy(io.BytesIO(HONEST[:-8]), len(HONEST), field="tracks", limits=Limits())  # noqa: E731
    assert code(read) == "damaged_file"


def test_a_file_larger_than_the_limit_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "t.npy").write_bytes(HONEST)
    assert code(lambda: arrays.read_file(tmp_path / "t.npy", field="tracks", limits=BRIEF)) == "too_large"


def test_a_zip_with_a_64_bit_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.npz").write_bytes(arrays.ZIP64_LOCATOR + bytes(16) + arrays.END_OF_DIRECTORY + bytes(18))
    assert code(lambda: arrays.check_directory(tmp_path / "t.npz", field="tracks")) == "too_large"


def test_complex_visibility_is_refused(tmp_path: Path) -> None:
    tracks = np.cumsum(np.random.default_rng(0).normal(size=(6, 20, 2)), axis=0)
    np.savez(tmp_path / "t.npz", tracks=tracks, visibility=np.ones((6, 20), dtype=complex))
    assert code(lambda: read_inputs(tracks=tmp_path / "t.npz", options=Options())) == "wrong_type"


def test_a_mask_with_another_number_of_points_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "m.npz", mask=np.ones((3, 3), dtype=bool))
    read = lambda: read_surface(tmp_path / "m.npz", num_points=8, picture=None, limits=Limits())  # noqa: E731
    assert code(read) == "vertex_count_mismatch"
