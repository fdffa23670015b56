"""Names of points: read from every export that has them, then selected and stored with the points."""

from __future__ import annotations

import json
import pickle
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats import Inputs, load_inputs, read_inputs, save_inputs
from pliant.worker.formats.point_names import FACE, HAND, IRISES, MAX_POINT_NAME, POSE, pack, unpack
from pliant.worker.formats.reading.pose_hdf5 import strings_of
from pliant.worker.formats.records import Arrays
from pliant.worker.formats.tracks.interpretation import understand

F, P = 5, 6
POINTS = np.round(np.random.default_rng(2).uniform(20, 500, (1, P, 2)) + np.arange(F)[:, None, None] * [1.5, 0.25], 2)
PARTS = ("Nose", "left_Ear", "right ear", "Kinn Ü", "brow", "tip")
AXES = ("x", "y", "likelihood")
TABLE = np.concatenate([POINTS, np.full((F, P, 1), 0.9)], axis=2).reshape(F, 3 * P)


def read(path: Path, **options: Any) -> Inputs:
    return read_inputs(tracks=path, mesh="none", options=Options(**options))


def csv_of(path: Path, heads: list[list[str]], values: np.ndarray = TABLE) -> Path:
    rows = [*heads, *([str(index), *(f"{value:g}" for value in row)] for index, row in enumerate(values))]
    path.write_text("\n".join(",".join(row) for row in rows), encoding="utf-8")
    return path


def deeplabcut(path: Path, *, individuals: bool = False) -> Path:
    animals = [["mouse1"] * 9 + ["mouse2"] * 9] if individuals else []
    parts = [*PARTS[:3], *PARTS[:3]] if individuals else list(PARTS)
    heads = [["DLC"] * 18, *animals, [part for part in parts for _ in AXES], list(AXES) * P]
    levels = ["scorer", *(["individuals"] if individuals else []), "bodyparts", "coords"]
    return csv_of(path, [[level, *row] for level, row in zip(levels, heads, strict=True)])


def deeplabcut_h5(path: Path, columns: list[tuple[str, ...]], *, kind: str) -> Path:
    """What pandas and PyTables write: names pickled in an attribute (table), or as levels and labels (fixed)."""
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        if kind == "fixed":
            group["block0_values"] = TABLE
            for level, words in enumerate(zip(*columns, strict=True)):
                known, places = np.unique(words, return_inverse=True)
                group[f"axis0_level{level}"] = np.array([word.encode() for word in known])
                group[f"axis0_label{level}"] = places.astype(np.int8)
        else:
            rows = np.zeros(F, dtype=[("index", "<i8"), ("values_block_0", "<f8", (3 * P,))])
            rows["index"], rows["values_block_0"] = np.arange(F), TABLE
            group.create_dataset("table", data=rows, chunks=(F,))
            group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], 0))
    return path


def test_named_columns_keep_their_spelling(here: None, tmp_path: Path) -> None:
    path = csv_of(tmp_path / "t.csv", [["Frame", *(f"{part}_{axis}" for part, axis in product(PARTS, AXES))]])
    got = read(path)
    assert got.point_names == PARTS
    assert "The file names its 6 points: Nose, left_Ear, right ear, Kinn Ü, …." in got.interpretation.notes
    path = csv_of(tmp_path / "t.csv", [["Frame", *(f"İ{index}_{axis}" for index, axis in product(range(P), AXES))]])
    assert read(path).point_names == tuple(f"i̇{index}" for index in range(P))  # lower-case it has two code points


def test_numbered_columns_have_no_names(here: None, tmp_path: Path) -> None:
    path = csv_of(tmp_path / "t.csv", [["frame", *(f"{axis}{index}" for index, axis in product(range(P), AXES))]])
    got = read(path)
    assert got.point_names is None
    assert not any("names" in note for note in got.interpretation.notes[1:])


@pytest.mark.parametrize(
    ("numbers", "names"),
    [
        ((0, 1, 2, 3, 4, 5), None),
        ((1, 2, 3, 4, 5, 6), tuple("123456")),
        ((0, 1, 40, 3, 4, 7), ("0", "1", "3", "4", "7", "40")),
    ],
)
def test_points_of_observations_keep_numbers_that_are_not_their_index(
    numbers: tuple[int, ...], names: tuple[str, ...] | None, here: None, tmp_path: Path
) -> None:
    path = tmp_path / "t.csv"
    rows = [
        f"{frame},{numbers[point]},{x},{y}"
        for (frame, point), (x, y) in zip(np.ndindex(F, P), POINTS.reshape(-1, 2), strict=True)
    ]
    path.write_text("\n".join(["frame,point,x,y", *rows]))
    got = read(path)
    assert got.point_names == names
    np.testing.assert_array_equal(got.tracks.points, POINTS[:, np.argsort(numbers)])


def test_deeplabcut_csv_names_are_read(here: None, tmp_path: Path) -> None:
    assert read(deeplabcut(tmp_path / "t.csv")).point_names == PARTS
    both = tuple(f"{animal}/{part}" for animal in ("mouse1", "mouse2") for part in PARTS[:3])
    assert read(deeplabcut(tmp_path / "t.csv", individuals=True)).point_names == both


@pytest.mark.parametrize("kind", ["table", "fixed"])
def test_deeplabcut_hdf5_names_are_read(here: None, kind: str, tmp_path: Path) -> None:
    columns = [("DLC", part, axis) for part, axis in product(PARTS, AXES)]
    assert read(deeplabcut_h5(tmp_path / "t.h5", columns, kind=kind)).point_names == PARTS
    columns = [("DLC", animal, part, axis) for animal, part, axis in product(("a", "b"), PARTS[:3], AXES)]
    both = tuple(f"{animal}/{part}" for animal in "ab" for part in PARTS[:3])
    assert read(deeplabcut_h5(tmp_path / "t.h5", columns, kind=kind)).point_names == both
    columns = [("DLC", part, axis) for axis, part in product(AXES, PARTS)]  # not the order of DeepLabCut
    assert read(deeplabcut_h5(tmp_path / "t.h5", columns, kind=kind)).point_names is None


def test_deeplabcut_hdf5_with_invalid_column_names_has_no_names(here: None, tmp_path: Path) -> None:
    columns = [("DLC", part, axis) for part, axis in product(PARTS, AXES)]
    path = deeplabcut_h5(tmp_path / "t.h5", columns, kind="fixed")
    with h5py.File(path, "r+") as file:
        file["df_with_missing/axis0_label1"][0] = 99
    assert read(path).point_names is None
    path = deeplabcut_h5(tmp_path / "t.h5", columns[:-3], kind="table")
    assert read(path).point_names is None


def test_the_pickled_names_are_read_in_the_sandbox(tmp_path: Path) -> None:
    columns = [("DLC", part, axis) for part, axis in product(PARTS, AXES)]
    assert read(deeplabcut_h5(tmp_path / "t.h5", columns, kind="table")).point_names == PARTS


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickled_strings_are_listed_without_running_code(protocol: int, tmp_path: Path) -> None:
    words = [("a", "b ü"), ("a", "c"), ("d", "b ü")]
    assert strings_of(pickle.dumps(words, protocol)) == ["a", "b ü", "a", "c", "d", "b ü"]

    class Attack:
        def __reduce__(self) -> tuple[Any, ...]:
            return (tmp_path.joinpath("touched").touch, ())

    strings_of(pickle.dumps([Attack()], max(protocol, 2)))
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize("cut", range(6))
def test_a_truncated_pickle_has_no_strings(cut: int) -> None:
    assert strings_of(pickle.dumps(["abc"], 2)[: 2 + cut]) == []


@pytest.mark.parametrize("texts", ["fixed", "variable"])
def test_sleap_node_names_are_read(here: None, texts: str, tmp_path: Path) -> None:
    nodes = [part.encode() for part in PARTS[:3]]
    kind = h5py.string_dtype() if texts == "variable" else f"S{max(map(len, nodes))}"
    given = np.stack([POINTS[:, :3], POINTS[:, 3:]], axis=1).transpose(1, 3, 2, 0)
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["tracks"] = given
        file.create_dataset("node_names", data=np.array(nodes), dtype=kind)
        file.create_dataset("track_names", data=np.array([b"one", b"two"]), dtype=kind)
    both = tuple(f"{animal}/{part}" for animal in ("one", "two") for part in PARTS[:3])
    assert read(tmp_path / "s.h5").point_names == both
    with h5py.File(tmp_path / "s.h5", "r+") as file:
        del file["track_names"]
    assert read(tmp_path / "s.h5").point_names == tuple(f"{index}/{part}" for index in "01" for part in PARTS[:3])
    with h5py.File(tmp_path / "s.h5", "r+") as file:
        del file["tracks"], file["node_names"]
        file["tracks"] = POINTS.transpose(2, 1, 0)[None]
        file.create_dataset("node_names", data=np.array([part.encode() for part in PARTS]))
    assert read(tmp_path / "s.h5").point_names == PARTS


def landmarks(count: int, **more: str) -> list[list[dict[str, Any]]]:
    places = np.random.default_rng(1).uniform(0.2, 0.8, (1, count, 2)) + np.arange(F)[:, None, None] * 0.01
    return [[{"x": x, "y": y, "visibility": 0.9, **more} for x, y in frame.tolist()] for frame in places]


@pytest.mark.parametrize(
    ("count", "names"), [(33, POSE), (21, HAND), (468, FACE), (478, IRISES), (543, None), (7, None)]
)
def test_mediapipe_names_are_chosen_by_the_number_of_landmarks(
    here: None, count: int, names: tuple[str, ...] | None, tmp_path: Path
) -> None:
    assert len(set(POSE)) == 33
    assert len(set(HAND)) == 21
    assert (FACE[0], FACE[-1], IRISES[-1]) == ("face_0", "face_467", "face_477")
    (tmp_path / "t.json").write_text(json.dumps([None, *landmarks(count)]))
    assert read(tmp_path / "t.json", image_size="640x480").point_names == names
    heads = [["frame", *(f"{axis}{index}" for index in range(count) for axis in "xyz")]]
    values = np.random.default_rng(1).uniform(0.2, 0.8, (1, 3 * count)) + np.arange(F)[:, None] * 0.01
    assert read(csv_of(tmp_path / "t.csv", heads, values), image_size="640x480").point_names == names


def test_named_landmarks_keep_their_names(here: None, tmp_path: Path) -> None:
    frames = landmarks(33)
    for number, landmark in enumerate(frames[0]):
        landmark["name"] = f"part {number}"
    (tmp_path / "t.json").write_text(json.dumps(frames))
    assert read(tmp_path / "t.json", image_size="640x480").point_names == tuple(f"part {n}" for n in range(33))
    del frames[0][5]["name"]
    (tmp_path / "t.json").write_text(json.dumps(frames))
    assert read(tmp_path / "t.json", image_size="640x480").point_names == POSE


@pytest.mark.parametrize("order", ["frames", "points"])
def test_an_npz_may_name_its_points(order: str, tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    tracks = POINTS if order == "frames" else POINTS.transpose(1, 0, 2)
    layout = "frames_points" if order == "frames" else "points_frames"
    odd = np.array(["a\tb", " c ", "x" * 300, "é", "🙂", ""])
    np.savez(path, tracks=tracks, point_names=odd)
    got = read(path, layout=layout)
    assert got.point_names == ("a b", "c", "x" * MAX_POINT_NAME, "é", "🙂", "")
    assert "The file names its 6 points: a b, c, " in " ".join(got.interpretation.notes)
    np.savez(path, tracks=tracks, point_names=np.array([part.encode() for part in PARTS]))
    assert read(path, layout=layout).point_names == PARTS
    got = read(path, layout=layout, max_points=4)
    assert got.selection is not None
    assert got.point_names == tuple(PARTS[point] for point in got.selection.points)
    np.savez(path, tracks=tracks)
    assert read(path, layout=layout).point_names is None


def test_a_file_of_pliant_track_may_name_its_points() -> None:
    seen = {"visibility": np.ones((F, P)), "frame_indices": np.arange(F)}
    named: Arrays = {"tracks": POINTS, "point_names": np.array(PARTS), **seen}
    assert understand(named, Options()).point_names == PARTS
    named["point_names"] = np.array(PARTS[:5])
    with pytest.raises(InvalidInput, match="one name for each point"):
        understand(named, Options())


@pytest.mark.parametrize(
    ("names", "code", "expected", "got"),
    [
        (np.array(PARTS[:5]), "wrong_shape", "(6,), one name for each point", "(5,)"),
        (np.array([PARTS]), "wrong_shape", "(6,), one name for each point", "(1, 6)"),
        (np.arange(6), "wrong_type", "an array of texts", "dtype int64"),
        (np.array(PARTS, dtype=object), "object_array", "an array of texts", "an array of Python objects"),
        (np.full(6, 0x110000, dtype="<u4").view("<U1"), "damaged_file", None, "texts that are not Unicode"),
    ],
    ids=["too few", "two axes", "numbers", "objects", "not Unicode"],
)
def test_invalid_point_names_are_refused(
    names: np.ndarray, code: str, expected: str | None, got: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "t.npz", tracks=POINTS, point_names=names)
    with pytest.raises(InvalidInput) as refused:
        read(tmp_path / "t.npz", layout="frames_points")
    assert (refused.value.code, refused.value.field, refused.value.got) == (code, "tracks.point_names", got)
    assert expected is None or refused.value.expected == expected
    assert refused.value.hint


def test_names_follow_the_selected_points_and_survive_storage(here: None, tmp_path: Path) -> None:
    path = deeplabcut(tmp_path / "t.csv")
    assert read(path, layout="frames_points").point_names == PARTS
    got = read(path, max_points=4)
    assert got.selection is not None
    assert len(got.selection.points) == 4
    assert got.point_names == tuple(PARTS[point] for point in got.selection.points)
    save_inputs(got, tmp_path / "inputs.npz")
    assert load_inputs(tmp_path / "inputs.npz").point_names == got.point_names


def test_names_are_normalised_to_printable_lines(here: None, tmp_path: Path) -> None:
    odd = ["a\tb", " c  d ", "\ud800", "x" * 300, "e\u0301", "🙂"]
    frames = landmarks(P)
    for frame in frames:
        for landmark, name in zip(frame, odd, strict=True):
            landmark["name"] = name
    (tmp_path / "t.json").write_text(json.dumps(frames))
    clean = ("a b", "c d", "?", "x" * MAX_POINT_NAME, "é", "🙂")
    got = read(tmp_path / "t.json", image_size="640x480")
    assert got.point_names == clean
    assert unpack(pack(clean), P) == clean
    assert unpack(pack(clean), P + 1) is None
    assert unpack(np.zeros(3), 1) is None
