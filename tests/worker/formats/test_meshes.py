"""Meshes: vertex order kept, indices checked, the default mesh sensible."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
import pytest
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, Mesh, Tracks
from pliant.worker.formats import Inputs, Limits, read_inputs
from pliant.worker.formats.meshes.triangulation import triangulate

pytestmark = pytest.mark.usefixtures("forked_readers")

ROWS, COLUMNS, F = 5, 6, 4
P = ROWS * COLUMNS
FACES = Mesh.from_grid(np.arange(P).reshape(ROWS, COLUMNS)).faces
TRIANGLES = np.concatenate([FACES[:, [0, 1, 2]], FACES[:, [0, 2, 3]]])


def sheet() -> np.ndarray:
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    return np.stack([np.stack([x + 10 + f * 0.1, y * (1 - 0.02 * f) + 10], axis=-1).reshape(P, 2) for f in range(F)])


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    np.savez(tmp_path / "tracks.npz", tracks=sheet())
    return tmp_path / "tracks.npz"


def obj(faces: np.ndarray, vertices: int = P) -> str:
    lines = [f"v {i}.5 0 {-i}" for i in range(vertices)] + [f"vn 0 0 1\nvt {i} 0" for i in range(3)]
    return "\n".join(lines + ["f " + " ".join(f"{i + 1}/1/1" for i in face) for face in faces]) + "\n"


def write_ply(path: Path, faces: np.ndarray, *, text: bool, order: str) -> Path:
    vertex = np.zeros(P, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")])
    rows = np.zeros(len(faces), dtype=[("vertex_indices", "i4", (faces.shape[1],))])
    rows["vertex_indices"] = faces
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(rows, "face")]
    plyfile.PlyData(elements, text=text, byte_order=order).write(str(path))
    return path


def code_of(tracks: Path, mesh: Path | str, **limits: int) -> str:
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tracks, mesh=mesh, options=Options(), limits=Limits(**limits))
    assert caught.value.field.startswith("mesh")
    return caught.value.code


def read(tracks: Path, mesh: Path | str | None) -> Inputs:
    return read_inputs(tracks=tracks, mesh=mesh, options=Options())


@pytest.mark.parametrize("faces", [FACES, TRIANGLES], ids=["quads", "triangles"])
def test_faces_are_read_unchanged_from_every_format(tmp_path: Path, tracks: Path, faces: np.ndarray) -> None:
    (tmp_path / "m.obj").write_text(obj(faces))
    np.savez(tmp_path / "m.npz", faces=faces, vertices=np.zeros((P, 3)))
    np.save(tmp_path / "m.npy", faces)
    files = [tmp_path / "m.obj", tmp_path / "m.npz", tmp_path / "m.npy"]
    files += [
        write_ply(tmp_path / f"{text}{order}.ply", faces, text=text, order=order)
        for text, order in ((True, "="), (False, "<"), (False, ">"))
    ]
    for file in files:
        got = read(tracks, file)
        assert got.mesh is not None
        np.testing.assert_array_equal(got.mesh.faces, faces)
        assert got.interpretation.mesh_source == "given"
        assert got.interpretation.num_faces == len(faces)


def test_negative_obj_indices_count_from_the_end(tmp_path: Path, tracks: Path) -> None:
    (tmp_path / "m.obj").write_text(obj(np.zeros((0, 3), dtype=int)) + "f -3 -2 -1\nf 1 2 3\n")
    got = read(tracks, tmp_path / "m.obj")
    assert got.mesh is not None
    np.testing.assert_array_equal(got.mesh.faces, [[P - 3, P - 2, P - 1], [0, 1, 2]])


def test_obj_files_may_have_a_byte_order_mark_comments_and_continued_lines(tmp_path: Path, tracks: Path) -> None:
    text = obj(np.zeros((0, 3), dtype=int)) + "# C:\\meshes\\\nf 1 2 \\\n  3 # a comment\n# f 9 9 9\n"
    (tmp_path / "m.obj").write_text(text, encoding="utf-8-sig")
    got = read(tracks, tmp_path / "m.obj")
    assert got.mesh is not None
    np.testing.assert_array_equal(got.mesh.faces, [[0, 1, 2]])


def test_mixed_polygons_become_triangles(tmp_path: Path, tracks: Path) -> None:
    (tmp_path / "m.obj").write_text(obj(np.zeros((0, 3), dtype=int)) + "f 1 2 3\nf 1 2 3 4 5\n")
    got = read(tracks, tmp_path / "m.obj")
    assert got.mesh is not None
    np.testing.assert_array_equal(got.mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]])


def test_a_grid_size_or_mask_makes_quads(tmp_path: Path, tracks: Path) -> None:
    got = read(tracks, f"{ROWS}x{COLUMNS}")
    assert got.mesh is not None
    np.testing.assert_array_equal(got.mesh.faces, FACES)
    assert got.interpretation.mesh_source == "grid"
    mask = np.zeros((ROWS + 1, COLUMNS + 1), dtype=bool)
    mask[:ROWS, 1:] = True
    np.savez(tmp_path / "mask.npz", mask=mask)
    masked = read(tracks, tmp_path / "mask.npz")
    assert masked.mesh is not None
    np.testing.assert_array_equal(masked.mesh.faces, FACES)


def test_no_mesh_is_generated_for_none(tracks: Path) -> None:
    got = read(tracks, "none")
    assert got.mesh is None
    assert got.interpretation.mesh_source == "none"


def test_a_mesh_with_another_number_of_points_is_refused(tmp_path: Path, tracks: Path) -> None:
    (tmp_path / "m.obj").write_text(obj(FACES, vertices=P + 1))
    np.savez(tmp_path / "grid.npz", grid=np.arange(P - 6).reshape(ROWS - 1, COLUMNS))
    assert code_of(tracks, tmp_path / "m.obj") == "vertex_count_mismatch"
    assert code_of(tracks, tmp_path / "grid.npz") == "vertex_count_mismatch"
    assert code_of(tracks, "5x7") == "vertex_count_mismatch"


def test_a_grid_with_rows_and_columns_exchanged_is_refused(tracks: Path) -> None:
    with pytest.raises(InvalidInput, match=f"6x5.*{ROWS}x{COLUMNS}") as caught:
        read_inputs(tracks=tracks, mesh=f"{COLUMNS}x{ROWS}", options=Options(), limits=Limits())
    assert caught.value.code == "transposed_grid"
    assert caught.value.hint == f"Give mesh {ROWS}x{COLUMNS}."
    assert read(tracks, f"{ROWS}x{COLUMNS}").interpretation.mesh_grid == (ROWS, COLUMNS)


def test_a_grid_of_points_in_random_order_or_hidden_is_accepted(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "random.npz", tracks=sheet()[:, rng.permutation(P)])
    np.savez(tmp_path / "hidden.npz", tracks=sheet(), visibility=np.tile(np.arange(P) % 7 == 0, (F, 1)))
    for name in ("random.npz", "hidden.npz"):
        assert read(tmp_path / name, f"{COLUMNS}x{ROWS}").interpretation.mesh_grid == (COLUMNS, ROWS)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("f 1 2 31\n", "index_out_of_range"),
        ("f 0 1 2\n", "index_out_of_range"),
        ("f -1 -2 -99\n", "index_out_of_range"),
        ("f 1 2\n", "wrong_shape"),
        ("f 1 2 2\n", "degenerate_face"),
        ("f a b c\n", "damaged_file"),
        ("v 1 2\n", "damaged_file"),
        ("f 1 2 \\", "damaged_file"),
        ("f " + "1 " * 5000 + "\n", "damaged_file"),
    ],
)
def test_bad_obj_lines_are_refused(here: None, tmp_path: Path, tracks: Path, text: str, code: str) -> None:
    (tmp_path / "m.obj").write_text(obj(FACES) + text)
    assert code_of(tracks, tmp_path / "m.obj") == code


def test_files_that_are_not_meshes_are_rejected(tmp_path: Path, tracks: Path) -> None:
    (tmp_path / "m.obj").write_text("hello\n")
    (tmp_path / "m.bin").write_bytes(bytes(range(256)))
    (tmp_path / "m.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n")
    np.savez(tmp_path / "m.npz", vertices=np.zeros((P, 3)))
    assert code_of(tracks, tmp_path / "m.obj") == "unknown_format"
    assert code_of(tracks, tmp_path / "m.bin") == "unknown_format"
    assert code_of(tracks, tmp_path / "m.ply") == "damaged_file"
    assert code_of(tracks, tmp_path / "m.npz") == "missing_array"
    assert code_of(tracks, "several") == "unknown_format"


def test_too_many_faces_are_refused(tmp_path: Path, tracks: Path) -> None:
    (tmp_path / "m.obj").write_text(obj(FACES))
    np.savez(tmp_path / "m.npz", faces=FACES)
    ply = write_ply(tmp_path / "m.ply", FACES, text=True, order="=")
    for file in (tmp_path / "m.obj", tmp_path / "m.npz", ply):
        assert code_of(tracks, file, max_faces=len(FACES) - 1) == "too_large"


def test_the_generated_mesh_covers_the_sheet_and_faces_the_camera() -> None:
    for y_axis, sign in (("down", -1), ("up", 1)):
        mesh, notes = triangulate(Tracks.from_arrays(sheet()), y_axis=y_axis)
        assert mesh is not None
        a, b, c = (sheet()[0][mesh.faces[:, i]] for i in range(3))
        areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
        assert (np.sign(areas) == sign).all()
        assert abs(areas).sum() == pytest.approx((ROWS - 1) * (COLUMNS - 1))
        assert "frame 0" in notes[0]


def test_the_generated_mesh_does_not_bridge_a_gap() -> None:
    apart = sheet()
    apart[:, P // 2 :, 0] += 500
    mesh, notes = triangulate(Tracks.from_arrays(apart), y_axis="down")
    assert mesh is not None
    sides = (mesh.faces >= P // 2).sum(axis=1)
    assert set(sides.tolist()) == {0, 3}
    assert " 0 of" not in notes[0]


def test_the_generated_mesh_uses_the_frame_with_most_visible_points() -> None:
    visible = np.ones((F, P))
    visible[:2, :10] = 0
    visible[2, 3] = 0
    visible[3, 5:7] = 0
    mesh, notes = triangulate(Tracks.from_arrays(sheet(), visible), y_axis="down")
    assert mesh is not None
    assert "frame 2" in notes[0]
    assert 3 not in mesh.faces
    assert "1 point belongs to no face" in notes[1]


def test_points_on_a_line_get_no_mesh(tmp_path: Path) -> None:
    line = np.zeros((F, P, 2))
    line[..., 0] = np.arange(P)
    mesh, notes = triangulate(Tracks.from_arrays(line), y_axis="down")
    assert mesh is None
    assert "too few distinct points" in notes[0]


def test_vertices_that_are_a_scalar_are_refused(tmp_path: Path, tracks: Path) -> None:
    np.savez(tmp_path / "m.npz", vertices=np.float64(3), faces=FACES)
    assert code_of(tracks, tmp_path / "m.npz") == "vertex_count_mismatch"


def test_indices_beyond_64_bits_are_refused(here: None, tmp_path: Path, tracks: Path) -> None:
    (tmp_path / "m.obj").write_text(obj(FACES) + f"f 1 2 3 {10**30}\n")
    assert code_of(tracks, tmp_path / "m.obj") == "damaged_file"
