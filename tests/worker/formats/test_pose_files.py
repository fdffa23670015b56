"""Spreadsheets, DeepLabCut, SLEAP and MediaPipe: what is read, and the exact message for what is refused."""

from __future__ import annotations

import codecs
import io
import json
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.worker.formats import InvalidInput, Limits, read_inputs
from pliant.worker.formats.reading.parsers import PARSERS

pytestmark = pytest.mark.usefixtures("here")

F, P = 5, 6
NAMES = ("nose", "left_ear", "right ear", "chin", "brow", "tip")
POINTS = np.round(np.random.default_rng(2).uniform(20, 500, (1, P, 2)) + np.arange(F)[:, None, None] * [1.5, 0.25], 2)
SURE = np.where(np.arange(F * P).reshape(F, P) == 8, 0.1, 0.9)
EXAMPLE = "Write it as in `frame,point,x,y` and then `0,0,312.5,200.1`, or one row a frame: `frame,nose_x,nose_y,chin_x,chin_y`."


def rows_of(*, separator: str = ",", decimal: str = ".", frame: bool = True, confidence: bool = True) -> list[str]:
    lines = []
    for index in range(F):
        cells = [str(index)] if frame else []
        for point in range(P):
            values = [*POINTS[index, point], *([SURE[index, point]] if confidence else [])]
            cells += [f"{value:g}".replace(".", decimal) for value in values]
        lines.append(separator.join(cells))
    return lines


def one_row_a_frame(separator: str, decimal: str) -> str:
    head = separator.join(["Frame", *(f"{name}_{axis}" for name in NAMES for axis in ("x", "y", "likelihood"))])
    return "\n".join([head, *rows_of(separator=separator, decimal=decimal)])


def deeplabcut(individuals: bool) -> str:
    def row(head: str, cells: list[str]) -> str:
        return ",".join([head, *(each for cell in cells for each in [cell] * (1 if head == "coords" else 3))])

    heads = [row("scorer", ["DLC_resnet50"] * P)]
    if individuals:
        heads.append(row("individuals", ["mouse1"] * 3 + ["mouse2"] * 3))
    parts = [*NAMES[:3], *NAMES[:3]] if individuals else list(NAMES)
    heads += [row("bodyparts", parts), "coords," + ",".join(["x", "y", "likelihood"] * P)]
    return "\n".join([*heads, *rows_of()])


def long_with_decimal_commas() -> str:
    lines = ["frame;point;x;y"]
    for (frame, point), _ in np.ndenumerate(SURE):
        x, y = (f"{value:g}".replace(".", ",") for value in POINTS[frame, point])
        lines.append(f"{frame};{point};{x};{y}")
    return "\n".join(lines)


TABLES = {
    "decimal commas": (long_with_decimal_commas(), "canonical", False),
    "one row a frame": (one_row_a_frame(",", "."), "one row a frame", True),
    "one row a frame, decimal commas": (one_row_a_frame(";", ","), "one row a frame", True),
    "one row a frame, tabs": (one_row_a_frame("\t", ","), "one row a frame", True),
    "numbered": ("x0,y0,x1,y1,x2,y2,x3,y3,x4,y4,x5,y5\n" + "\n".join(rows_of(frame=False, confidence=False)), "one row a frame", False),
    "DeepLabCut": (deeplabcut(individuals=False), "DeepLabCut", True),
    "DeepLabCut, two animals": (deeplabcut(individuals=True), "DeepLabCut", True),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLES)
def test_every_kind_of_table_is_read(case: str, tmp_path: Path) -> None:
    text, form, hides = TABLES[case]
    path = tmp_path / "tracks.csv"
    path.write_text(f"\ufeff{text}\r\n".replace("\n", "\r\n"), encoding="utf-8")
    read = read_inputs(tracks=path, mesh="none", options=Options())
    assert read.interpretation.format == form
    expected = np.where(SURE > 0.5, 0.9, 0.0) if hides else np.ones((F, P))
    np.testing.assert_allclose(read.tracks.visible, expected)
    seen = expected > 0
    np.testing.assert_allclose(read.tracks.points[seen], POINTS[seen])


def test_points_without_a_confidence_count_as_seen(tmp_path: Path) -> None:
    heads = [f"{name}_{axis}" for name in NAMES for axis in ("x", "y")]
    rows = [",".join(f"{value:g}" for value in [*POINTS[frame].ravel(), SURE[frame, 2]]) for frame in range(F)]
    (tmp_path / "tracks.csv").write_text("\n".join([",".join([*heads, f"{NAMES[2]}_likelihood"]), *rows]))
    visible = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options()).tracks.visible
    np.testing.assert_allclose(visible[:, 2], [0.9, 0, 0.9, 0.9, 0.9])
    np.testing.assert_array_equal(np.delete(visible, 2, axis=1), 1)


@pytest.mark.parametrize("name", ["visible", "likelihood", "Confidence"])
def test_a_table_of_observations_may_have_a_confidence_of_any_name(name: str, tmp_path: Path) -> None:
    places = [((f, p), x, y) for f in range(F) for p, (x, y) in enumerate(POINTS[f].tolist())]
    rows = [f"{f},{p},{x},{y},{SURE[f, p]}" for (f, p), x, y in places]
    (tmp_path / "tracks.csv").write_text("\n".join([f"frame,point,x,y,{name}", *rows]))
    read = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    np.testing.assert_allclose(read.tracks.visible, np.where(SURE > 0.5, SURE, 0))


@pytest.mark.parametrize("heads", ["Frame,ID,X,Y,Conf", "FRAME,Track_ID,x,y,conf", "frame,track_id,x,y,conf,id"])
def test_columns_may_be_in_upper_case_and_have_other_names(heads: str, tmp_path: Path) -> None:
    """A column named `id` beside `track_id` numbers something else."""
    more = ",7" if heads.endswith(",id") else ""
    rows = [f"{f},{p},{x},{y},{SURE[f, p]}{more}" for f in range(F) for p, (x, y) in enumerate(POINTS[f].tolist())]
    (tmp_path / "tracks.csv").write_text("\n".join([heads, *rows]))
    read = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    np.testing.assert_allclose(read.tracks.points, np.where(read.tracks.visible[..., None] > 0, POINTS, 0))
    np.testing.assert_allclose(read.tracks.visible, np.where(SURE > 0.5, SURE, 0))


@pytest.mark.parametrize(("mark", "encoding"), [(codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be")])
def test_unicode_text_of_a_spreadsheet_is_read(mark: bytes, encoding: str, tmp_path: Path) -> None:
    text = one_row_a_frame("\t", ",").replace("\n", "\r\n")
    (tmp_path / "tracks.txt").write_bytes(mark + text.encode(encoding))
    read = read_inputs(tracks=tmp_path / "tracks.txt", mesh="none", options=Options())
    assert read.interpretation.format == "one row a frame"
    assert "Recognised by the names in the file: one row a frame." in read.interpretation.notes
    np.testing.assert_allclose(read.tracks.points[SURE > 0.5], POINTS[SURE > 0.5])


@pytest.mark.parametrize("numbered", [True, False])
def test_rows_with_frame_numbers_may_come_in_any_order(numbered: bool, tmp_path: Path) -> None:
    head, *rows = one_row_a_frame(",", ".").split("\n")
    if not numbered:  # words in place of numbers say nothing about the order
        rows = [f"picture{row}" for row in rows]
    (tmp_path / "tracks.csv").write_text("\n".join([head, *rows[::-1]]))
    read = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    order = slice(None, None, 1 if numbered else -1)
    np.testing.assert_allclose(read.tracks.points[SURE[order] > 0.5], POINTS[order][SURE[order] > 0.5])


@pytest.mark.parametrize("step", [1, 5])
def test_a_frame_without_a_row_shows_no_point(step: int, tmp_path: Path) -> None:
    head, *rows = one_row_a_frame(",", ".").strip().split("\n")
    numbered = [f"{step * (frame + 7)},{row.partition(',')[2]}" for frame, row in enumerate(rows)]
    del numbered[2]
    (tmp_path / "tracks.csv").write_text("\n".join([head, *numbered]))
    read = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    assert read.tracks.num_frames == F
    there = np.setdiff1d(np.arange(F), [2])
    assert (read.tracks.visible[2] == 0).all()
    np.testing.assert_allclose(read.tracks.points[there][SURE[there] > 0.5], POINTS[there][SURE[there] > 0.5])


def test_frame_numbers_that_are_no_numbers_of_frames_are_refused_or_only_order_the_rows(tmp_path: Path) -> None:
    head, *rows = one_row_a_frame(",", ".").strip().split("\n")
    far = [f"{10**6 * frame + (frame == 1)},{row.partition(',')[2]}" for frame, row in enumerate(rows)]
    (tmp_path / "tracks.csv").write_text("\n".join([head, *far]))
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    assert caught.value.code == "too_large"
    seconds = [f"{0.04 * frame**2:.2f},{row.partition(',')[2]}" for frame, row in enumerate(rows)]
    (tmp_path / "tracks.csv").write_text("\n".join([head, *seconds[::-1]]))
    read = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    np.testing.assert_allclose(read.tracks.points[SURE > 0.5], POINTS[SURE > 0.5])


def test_mediapipe_landmarks_are_fractions_of_the_picture(tmp_path: Path) -> None:
    places = np.random.default_rng(0).uniform(0.2, 0.8, (1, 33, 4)) + np.arange(F)[:, None, None] * 0.01
    head = ",".join(f"{axis}{index}" for index in range(33) for axis in ("x", "y", "z", "v"))
    text = "\n".join([head, *(",".join(f"{value:.6f}" for value in frame.ravel()) for frame in places)])
    (tmp_path / "pose.csv").write_text(text)
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tmp_path / "pose.csv", mesh="none", options=Options())
    assert caught.value.code == "ambiguous_coordinates"
    assert str(caught.value) == (
        f"tracks: expected coordinates whose unit is certain, got values from {places[..., :2].min():.3g} to {places[..., :2].max():.3g}. "
        "Give the option image_size=WIDTHxHEIGHT if they are fractions of the picture, else coordinates=pixels."
    )
    read = read_inputs(tracks=tmp_path / "pose.csv", mesh="none", options=Options(image_size="641x481"))
    assert (read.interpretation.format, read.interpretation.coordinates) == ("MediaPipe", "unit")
    seen = read.tracks.visible > 0
    np.testing.assert_allclose(read.tracks.points[seen], (places[..., :2] * [640, 480])[seen], atol=1e-2)


LANDMARKS = np.round(np.random.default_rng(5).uniform(0.2, 0.8, (1, P, 2)) + np.arange(F)[:, None, None] * 0.01, 4)


def landmarks(frame: int) -> list[dict[str, float]]:
    return [
        {"x": x, "y": y, "z": 0.1, "visibility": float(SURE[frame, point])}
        for point, (x, y) in enumerate(LANDMARKS[frame].tolist())
    ]


MEDIAPIPE = {
    "lists": [landmarks(frame) for frame in range(F)],
    "message": [{"landmark": landmarks(frame)} for frame in range(F)],
    "tasks": [
        {"pose_world_landmarks": [[{"x": 9, "y": 9}]], "pose_landmarks": [landmarks(frame)]} for frame in range(F)
    ],
    "javascript": {"frames": [{"time": frame / 25, "faceLandmarks": [landmarks(frame)]} for frame in range(F)]},
    "named otherwise": {"video": "a.mp4", "results": [landmarks(frame) for frame in range(F)]},
}


@pytest.mark.parametrize("case", MEDIAPIPE)
def test_every_form_of_mediapipe_json_is_read(case: str, tmp_path: Path) -> None:
    (tmp_path / "pose.json").write_text("\ufeff" * (case == "lists") + json.dumps(MEDIAPIPE[case]), encoding="utf-8")
    read = read_inputs(tracks=tmp_path / "pose.json", mesh="none", options=Options(image_size="641x481"))
    assert (read.interpretation.format, read.interpretation.coordinates) == ("MediaPipe", "unit")
    np.testing.assert_allclose(read.tracks.visible, np.where(SURE > 0.5, 0.9, 0.0))
    seen = SURE > 0.5
    np.testing.assert_allclose(read.tracks.points[seen], (LANDMARKS * [640, 480])[seen])


NOTHING = [None, [], {"landmarks": []}, {"poseLandmarks": None}, {"landmarks": None, "world_landmarks": None}]


@pytest.mark.parametrize("nothing", NOTHING)
def test_a_mediapipe_frame_without_a_detection_is_hidden(nothing: object, tmp_path: Path) -> None:
    frames = [*MEDIAPIPE["lists"][:2], nothing, *MEDIAPIPE["lists"][3:]]
    (tmp_path / "pose.json").write_text(json.dumps(frames))
    read = read_inputs(tracks=tmp_path / "pose.json", mesh="none", options=Options(image_size="641x481"))
    assert (read.tracks.visible[2] == 0).all()
    assert (read.tracks.visible[3] > 0).any()


@pytest.mark.parametrize("kind", ["table", "fixed"])
def test_deeplabcut_hdf5_is_read(kind: str, tmp_path: Path) -> None:
    values = np.concatenate([POINTS, SURE[..., None]], axis=2).reshape(F, 3 * P)
    with h5py.File(tmp_path / "dlc.h5", "w") as file:
        group = file.create_group("df_with_missing")
        if kind == "fixed":
            group["block0_values"] = values
        else:
            rows = np.zeros(F, dtype=[("index", "<i8"), ("values_block_0", "<f8", (3 * P,))])
            rows["index"], rows["values_block_0"] = np.arange(F), values
            group.create_dataset("table", data=rows, chunks=(F,))
    read = read_inputs(tracks=tmp_path / "dlc.h5", mesh="none", options=Options())
    assert read.interpretation.format == "DeepLabCut"
    np.testing.assert_allclose(read.tracks.points[SURE > 0.5], POINTS[SURE > 0.5])
    assert (read.tracks.visible[SURE < 0.5] == 0).all()


def test_a_sleap_analysis_file_is_read(tmp_path: Path) -> None:
    given = np.stack([POINTS[:, :3], POINTS[:, 3:]], axis=1)  # frames, instances, nodes, 2
    given[2, 1] = np.nan
    with h5py.File(tmp_path / "sleap.h5", "w") as file:
        file["tracks"] = given.transpose(1, 3, 2, 0)
        file["track_occupancy"] = np.ones((F, 2))
        file["node_names"] = np.array([b"a", b"b", b"c"])
    read = read_inputs(tracks=tmp_path / "sleap.h5", mesh="none", options=Options())
    assert read.interpretation.format == "SLEAP"
    assert (read.tracks.visible[2, 3:] == 0).all()
    np.testing.assert_allclose(read.tracks.points[:, :3], POINTS[:, :3])
    np.testing.assert_allclose(read.tracks.points[3], POINTS[3])


FILM = (
    "Send it as the film instead (on the page: under Film; REST: -F film=@film.mp4; Python: submit(film=…)): its points are tracked "
    "for you."
)


def pictures() -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        archive.writestr("0001.png", b"\x89PNG\r\n\x1a\n")
        archive.writestr("0002.png", b"\x89PNG\r\n\x1a\n")
    return held.getvalue()


def spreadsheet(*members: str) -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        for name in members:
            archive.writestr(name, "<a/>")
    return held.getvalue()


def utf_16(text: str) -> bytes:
    return codecs.BOM_UTF16_LE + text.encode("utf-16-le")


FILES = "npz, npy, MATLAB .mat, CSV, or DeepLabCut, SLEAP and MediaPipe exports"
UNKNOWN = f"tracks: expected {FILES}, recognised by content, got"
AS_CSV = f"Save it as CSV in the spreadsheet program. {EXAMPLE}"
CONVERT = "Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible)."
TABLE = "tracks: expected a table with the columns frame, point, x and y, or with one row a frame, got line"
JSON = "tracks: expected MediaPipe landmarks: a list of frames, each with landmarks x, y and visibility, got"
JSON_EXAMPLE = (
    'Write it as [[{"x": 0.51, "y": 0.32, "z": -0.1, "visibility": 0.99}, …], …], a list of landmarks for each frame.'
)
REFUSED: dict[str, tuple[bytes, str, str]] = {
    "an mp4": (b"\0\0\0\x18ftypmp42" + bytes(600), "film_as_tracks", f"tracks: expected point tracks, got a film (mp4 or mov). {FILM}"),
    "a webm": (b"\x1aE\xdf\xa3" + bytes(600), "film_as_tracks", f"tracks: expected point tracks, got a film (webm or mkv). {FILM}"),
    "an avi": (b"RIFF\0\0\0\0AVI LIST" + bytes(600), "film_as_tracks", f"tracks: expected point tracks, got a film (avi). {FILM}"),
    "a gif": (b"GIF89a" + bytes(600), "film_as_tracks", f"tracks: expected point tracks, got a film (gif). {FILM}"),
    "a zip of pictures": (pictures(), "film_as_tracks", f"tracks: expected point tracks, got a zip of pictures. {FILM}"),
    "a picture": (
        b"\x89PNG\r\n\x1a\n" + bytes(600), "picture_as_tracks",
        "tracks: expected point tracks over several frames, got a single picture (png). "
        "Depth comes from motion: send a film, or a zip of all its pictures, as the film.",
    ),
    "a picture in another format": (
        b"RIFF\0\0\0\0WEBPVP8X" + bytes(600), "picture_as_tracks",
        "tracks: expected point tracks over several frames, got a single picture (webp). "
        "Depth comes from motion: send a film, or a zip of all its pictures, as the film.",
    ),
    "a spreadsheet": (
        spreadsheet("xl/workbook.xml", "xl/worksheets/sheet1.xml", "[Content_Types].xml"), "unknown_format",
        f"{UNKNOWN} a spreadsheet (xlsx). {AS_CSV}",
    ),
    "a spreadsheet of many sheets": (
        spreadsheet("[Content_Types].xml", *(f"xl/worksheets/sheet{index}.xml" for index in range(2000))), "unknown_format",
        f"{UNKNOWN} a spreadsheet (xlsx). {AS_CSV}",
    ),
    "an OpenDocument spreadsheet": (
        spreadsheet("mimetype", "content.xml"), "unknown_format", f"{UNKNOWN} an OpenDocument file (ods). {AS_CSV}",
    ),
    "an old spreadsheet": (
        b"\xd0\xcf\x11\xe0" + bytes(600), "unknown_format", f"{UNKNOWN} an Office document (xls, doc). {AS_CSV}",
    ),
    "a document": (
        spreadsheet("[Content_Types].xml", "word/document.xml"), "member_name",
        "tracks: expected members named like tracks.npy, got '[Content_Types].xml'. Write the file with numpy.savez and plain names.",
    ),
    "words in UTF-16": (
        utf_16("time\tname\twhere\r\n1\t2\t3\r\n"), "unreadable_table", f"{TABLE} 1: 'time\\tname\\twhere'. {EXAMPLE}",
    ),
    "other text in UTF-16": (utf_16("Hello world\r\n"), "unknown_format", f"{UNKNOWN} UTF-16 text that begins 'Hello world'. {CONVERT}"),
    "blank text in UTF-16": (utf_16(" \r\n"), "unknown_format", f"{UNKNOWN} blank UTF-16 text. {CONVERT}"),
    "bytes that begin as UTF-16": (
        b"\xff\xfe" + bytes([1, 0, 2, 0, 3, 0]), "unknown_format",
        f"{UNKNOWN} a file of an unknown kind, which begins with the bytes ff fe 01 00 02 00 03 00. {CONVERT}",
    ),
    "words in a table": (b"frame,point,x,y\n0,0,1,2\n0,1,left,2\n", "unreadable_table", f"{TABLE} 3: '0,1,left,2'. {EXAMPLE}"),
    "words below blank rows": (b",,,\n\nframe,point,x,y\n0,0,left,2\n", "unreadable_table", f"{TABLE} 4: '0,0,left,2'. {EXAMPLE}"),
    "other columns": (b"time,name,where,how\n1,2,3,4\n", "unreadable_table", f"{TABLE} 1: 'time,name,where,how'. {EXAMPLE}"),
    "decimal commas between commas": (b"frame,point,x,y\n0,0,1,5,2,5\n", "unreadable_table", f"{TABLE} 2: '0,0,1,5,2,5'. {EXAMPLE}"),
    "one row a frame without names": (
        b"0,1,2,3,4,5,6,7,8\n1,2,3,4,5,6,7,8,9\n", "unreadable_table", f"{TABLE} 1: '0,1,2,3,4,5,6,7,8'. {EXAMPLE}",
    ),
    "one frame twice": (
        b"frame,x0,y0,x1,y1\n0,1,2,3,4\n1,1,2,3,4\n1,1,2,3,4\n", "duplicate_observation",
        "tracks: expected one row for each frame, got frame 1 twice. Keep one row for each frame, with the columns of all points.",
    ),
    "a short row": (b"x0,y0,x1,y1\n1,2,3,4\n1,2,3\n", "unreadable_table", f"{TABLE} 3: '1,2,3'. {EXAMPLE}"),
    "half of DeepLabCut's head": (b"scorer,a,a,a\nbodyparts,b,b,b\n0,1,2,3\n", "unreadable_table", f"{TABLE} 1: 'scorer,a,a,a'. {EXAMPLE}"),
    "JSON that is cut off": (
        b'[[{"x": 0.5,\n', "damaged_file",
        "tracks: expected valid JSON, got a file in which line 2, column 1 is not: Expecting property name enclosed in double quotes. "
        "Write it with json.dump or JSON.stringify.",
    ),
    "JSON that is not UTF-8": (
        b'["\xff\xfe"]', "damaged_file",
        "tracks: expected valid JSON, got a file in which the text is not UTF-8. Write it with json.dump or JSON.stringify.",
    ),
    "JSON nested too deeply": (
        b"[" * 200_000, "damaged_file",
        "tracks: expected valid JSON, got a file in which lists are nested too deeply. Write it with json.dump or JSON.stringify.",
    ),
    "JSON of something else": (b'{"name": "a", "size": 3}', "unreadable_table", f"{JSON} JSON without one list of frames. {JSON_EXAMPLE}"),
    "frames without landmarks": (b'[{"time": 0}]', "unreadable_table", f"{JSON} no landmarks in frame 0. {JSON_EXAMPLE}"),
    "a frame that is a number": (b'[[], 5]', "unreadable_table", f"{JSON} no landmarks in frame 1. {JSON_EXAMPLE}"),
    "nothing detected": (b"[null, []]", "unreadable_table", f"{JSON} no landmark in any frame. {JSON_EXAMPLE}"),
    "numbers of landmarks that change": (
        b'[[{"x": 1, "y": 2}], [{"x": 1, "y": 2}, {"x": 3, "y": 4}]]', "unreadable_table",
        f"{JSON} frames with 1 and 2 landmarks. {JSON_EXAMPLE}",
    ),
    "a landmark without y": (b'[[{"x": 1}]]', "unreadable_table", f'{JSON} landmark 0 of frame 0: {{"x": 1}}. {JSON_EXAMPLE}'),
    "a landmark that is a list": (b'[["a"]]', "unreadable_table", f'{JSON} landmark 0 of frame 0: "a". {JSON_EXAMPLE}'),
    "a number beyond all bounds": (
        b'[[{"x": 1' + b"0" * 400 + b', "y": 2}]]', "unreadable_table",
        f'{JSON} landmark 0 of frame 0: {{"x": 1{"0" * 73}. {JSON_EXAMPLE}',
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_state_what_was_found_and_what_to_do(case: str, tmp_path: Path) -> None:
    content, code, sentence = REFUSED[case]
    (tmp_path / "tracks").write_bytes(content)
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tmp_path / "tracks", mesh=None, options=Options())
    assert caught.value.code == code
    assert str(caught.value) == sentence


@pytest.mark.parametrize(
    ("part", "kinds"),
    [("mesh", "npz, npy, OBJ, PLY, glTF, GLB or a PNG mask"), ("ground_truth", "npz, npy or MATLAB .mat")],
)
def test_a_spreadsheet_as_mesh_or_truth_is_refused(part: str, kinds: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=POINTS)
    (tmp_path / "table").write_bytes(spreadsheet("[Content_Types].xml", "xl/workbook.xml"))
    with pytest.raises(InvalidInput) as caught:
        read_inputs(**{"tracks": tmp_path / "tracks.npz", "mesh": "none", part: tmp_path / "table"}, options=Options())
    assert str(caught.value) == (
        f"{part}: expected {kinds}, recognised by content, got a spreadsheet (xlsx). Write the arrays with numpy.savez."
    )


@pytest.mark.parametrize("part", ["ground_truth", "rotations"])
@pytest.mark.parametrize("text", ["frame,point,x,y,z\n0,0,1,2,3\n", "frame,r11,r12\n0,1,0\n"])
def test_tables_of_true_shapes_and_rotations_are_refused_with_the_files_that_are_read(
    part: str, text: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=POINTS)
    (tmp_path / "table.csv").write_text(text)
    files = {"tracks": tmp_path / "tracks.npz", "mesh": "none", part: tmp_path / "table.csv"}
    with pytest.raises(InvalidInput) as caught:
        read_inputs(**files, options=Options())
    assert (caught.value.code, caught.value.field) == ("unknown_format", part)
    assert caught.value.expected == "npz, npy or MATLAB .mat, recognised by content"


def test_an_hdf5_table_without_deeplabcut_columns_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "dlc.h5", "w") as file:
        file.create_group("df")["block0_values"] = np.full((F, 7), 3.0)
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tmp_path / "dlc.h5", mesh=None, options=Options())
    assert str(caught.value) == (
        "tracks: expected a DeepLabCut table: x, y and likelihood from 0 to 1 for each body part, got a table of shape (5, 7). "
        "Export it as csv: deeplabcut.analyze_videos_converth5_to_csv(folder)."
    )


@pytest.mark.parametrize("kind", ["virtual", "external", "link", "claimed", "claimed table"])
def test_crafted_pose_files_are_refused(kind: str, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(np.arange(1000.0).tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["tracks"] = np.ones((1, 2, 6, F))
    with h5py.File(tmp_path / "bad.h5", "w") as file:
        file["node_names"] = np.array([b"a"])
        if kind == "virtual":
            layout = h5py.VirtualLayout((1, 2, 6, F), "<f8")
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "tracks", (1, 2, 6, F))
            file.create_virtual_dataset("tracks", layout)
        elif kind == "external":
            file.create_dataset("tracks", (1, 2, 6, F), "<f8", external=[(str(secret), 0, h5py.h5f.UNLIMITED)])
        elif kind == "link":
            file["tracks"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/tracks")
        elif kind == "claimed":
            file.create_dataset("tracks", (1, 2, 1 << 20, 1 << 12), "<f8", chunks=(1, 2, 1 << 10, 1))
        else:
            group = file.create_group("df_with_missing")
            group.create_dataset(
                "table", (1 << 24,), [("index", "<i8"), ("values_block_0", "<f8", (30,))], chunks=(64,)
            )
    with pytest.raises(InvalidInput) as caught:
        read_inputs(tracks=tmp_path / "bad.h5", mesh=None, options=Options())
    assert caught.value.code in ("unsupported_feature", "too_large")


def test_tables_beyond_the_limits_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv"
    path.write_text("x0,y0,x1,y1\n" + "1,2,3,4\n" * 200)
    with pytest.raises(InvalidInput, match="as a table"), path.open("rb") as stream:
        PARSERS["csv"](stream, field="tracks", limits=Limits(max_bytes=4096))
    path.write_text(json.dumps(MEDIAPIPE["lists"]))
    with pytest.raises(InvalidInput, match="of JSON"), path.open("rb") as stream:
        PARSERS["json"](stream, field="tracks", limits=Limits(max_bytes=512))
    path.write_text("[" + ",".join(['[{"x":1,"y":2}]'] * 100) + "]")  # 16 bytes each, 24 as arrays
    with pytest.raises(InvalidInput, match="as arrays"), path.open("rb") as stream:
        PARSERS["json"](stream, field="tracks", limits=Limits(max_bytes=2000))
    path.write_text("x0,y0,x1,y1\n" + "1" * ((1 << 20) + 5))
    with pytest.raises(InvalidInput, match="rows of at most 1,048,576 characters"), path.open("rb") as stream:
        PARSERS["csv"](stream, field="tracks", limits=Limits())
