"""Crafted files, generated here, and the error codes they must get. None is working malware, and none is kept on disk.

An attack is a form: the crafted part, an honest track file if the crafted part is another one, and texts. Only the error codes in
`codes` count as a defence; which of several is returned depends on the library that meets the file first.
"""

# ruff: noqa: E501
from __future__ import annotations

import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import h5py
import numpy as np
from crafting import (
    BINARY,
    HONEST,
    MAT_HEADER,
    OBJ_POINTS,
    PLY_FACE,
    PLY_VERTEX,
    SECRET,
    Runs,
    accessors,
    archive,
    declared_smaller,
    deflated,
    described,
    encrypted,
    glb,
    gltf,
    hdf5,
    hdf5_bomb,
    hdf5_cells,
    hdf5_circle,
    hdf5_deep,
    hdf5_external,
    hdf5_virtual,
    header,
    many_members,
    mat,
    mat_many_bombs,
    mat_matrix,
    mat_nested,
    mat_packed_bomb,
    npy,
    observations,
    overlapping,
    patched,
    ply,
    png,
    zeros,
)
from pliant.worker.formats.records import Limits


@dataclass(frozen=True)
class Attack:
    name: str
    what: str
    make: Callable[[], bytes]
    codes: tuple[str, ...]
    part: str = "tracks"
    texts: Mapping[str, str] = field(default_factory=dict)
    statuses: tuple[int, ...] = (422,)
    limits: Limits = field(default_factory=Limits)
    """The limits that the file exceeds. One that exceeds the usual ones as well can be sent to a service."""

    def __str__(self) -> str:
        return self.name


ZIPS = (
    Attack("zip bomb", "1 MB that inflates to 1,074 MB", lambda: zeros(1025, "(1025, 65536, 2)"), ("too_large",)),
    Attack("zip bomb below the limit", "40 kB that inflate to 40 MB", lambda: zeros(40, "(40, 65536, 2)"), ("too_large",),
           limits=Limits(max_observations=2_000_000)),
    Attack("member larger than declared", "4 MB behind a directory entry of 1 kB", declared_smaller, ("damaged_file",)),
    Attack("overlapping members", "60 directory entries share one member", overlapping,
           ("damaged_file", "duplicate_member", "missing_array")),
    Attack("duplicate members", "two members named tracks.npy", lambda: archive(("tracks.npy", HONEST), ("tracks.npy", HONEST)),
           ("duplicate_member",)),
    Attack("many members", "a directory of 1,000 entries", many_members, ("too_large",)),
    Attack("huge directory", "a directory that claims 4 GB", lambda: patched(archive(("tracks.npy", HONEST)),
           archive(("tracks.npy", HONEST))[-10:-6], b"\xff\xff\xff\xff"), ("too_large", "damaged_file")),
    Attack("64-bit directory", "a zip64 locator", lambda: patched(archive(("tracks.npy", HONEST)), b"PK\x05\x06",
           b"PK\x06\x07" + bytes(16) + b"PK\x05\x06"), ("too_large", "damaged_file")),
    Attack("path as name", "a member ../../../../tmp/x.npy", lambda: archive(("../../../../tmp/x.npy", HONEST)), ("member_name",)),
    Attack("absolute name", "a member /etc/passwd.npy", lambda: archive(("/etc/passwd.npy", HONEST)), ("member_name",)),
    Attack("odd name", "a name with a line break and a bell", lambda: archive(("tra\r\n\acks.npy", HONEST)), ("member_name",)),
    Attack("encrypted member", "the encryption flag set", encrypted, ("unsupported_feature", "damaged_file")),
    Attack("LZMA member", "another compression than deflate", lambda: archive(("tracks.npy", HONEST), method=zipfile.ZIP_LZMA),
           ("unsupported_feature",)),
    Attack("broken deflate", "a compressed stream of noise", lambda: patched(archive(("tracks.npy", HONEST)),
           archive(("tracks.npy", HONEST))[60:90], bytes(range(30)), count=1), ("damaged_file",)),
    Attack("cut off", "half a file", lambda: archive(("tracks.npy", HONEST))[:400], ("damaged_file",)),
)  # fmt: skip

HEADERS = (
    Attack("object array", "a pickle inside .npy that opens a file", lambda: npy(np.array([Runs()], dtype=object)), ("object_array",)),
    Attack("object array in npz", "the same as a member", lambda: archive(("tracks.npy", npy(np.array([Runs()], dtype=object)))),
           ("object_array",)),
    Attack("pickle", "a bare pickle that opens a file", lambda: pickle.dumps(Runs()), ("pickle_refused",)),
    Attack("torch file", "a zip with data.pkl", lambda: archive(("archive/data.pkl", pickle.dumps(Runs()))), ("pickle_refused",)),
    Attack("header of code", "a header that is a call", lambda: header("__import__('os').system('true')"), ("damaged_file",)),
    Attack("header of brackets", "4,000 nested brackets", lambda: header("(" * 4000), ("damaged_file",)),
    Attack("long header", "a header of 64 kB", lambda: header(described("(1,)") + " " * 60_000), ("damaged_file",)),
    Attack("terabyte header", "a shape of 8 TB over 0 bytes", lambda: header(described("(1000000, 1000000)")), ("too_large",)),
    Attack("overflowing shape", "a shape beyond 64 bits", lambda: header(described("(4294967296, 4294967296, 2)")), ("too_large",)),
    Attack("negative shape", "a shape of −1", lambda: header(described("(-1, 20, 2)"), bytes(320)), ("damaged_file",)),
    Attack("40 dimensions", "a shape of 40 axes", lambda: header(described("(" + "1," * 40 + ")"), bytes(8)), ("damaged_file",)),
    Attack("structured type", "a dtype with fields", lambda: header(described("(1,)", "[('a', '<f8')]"), bytes(8)), ("wrong_type",)),
    Attack("endless text type", "strings of 9,999 characters", lambda: header(described("(1,)", "'<U9999'"), bytes(40)), ("wrong_type",)),
    Attack("less than announced", "a header of 64 MB over 64 bytes", lambda: header(described("(64, 65536, 2)"), bytes(64)),
           ("damaged_file",)),
)  # fmt: skip

NUMBERS = (
    Attack("all NaN", "no finite coordinate", lambda: npy(np.full((6, 20, 2), np.nan)), ("nothing_visible",)),
    Attack("all infinite", "infinity everywhere", lambda: npy(np.full((6, 20, 2), np.inf)), ("nothing_visible",)),
    Attack("2 million frames", "F = 2,000,000, one byte a number", lambda: archive(("tracks.npy", npy(np.zeros((2 * 10**6, 4, 2), "u1")))),
           ("too_large",)),
    Attack("2 million points", "P = 2,000,000", lambda: archive(("tracks.npy", npy(np.zeros((3, 2 * 10**6, 2), "u1")))), ("too_large",)),
    Attack("no points", "P = 0", lambda: npy(np.zeros((6, 0, 2))), ("too_few_points", "wrong_shape")),
    Attack("huge grid in words", "mesh = 999999x999999", lambda: HONEST, ("vertex_count_mismatch",), texts={"mesh": "999999x999999"}),
    Attack("huge numbers in options", "frames, stride, max_points beyond all bounds", lambda: HONEST, ("invalid_option",),
           texts={"options": '{"stride": 1e300, "max_points": 99999999999999999999}'}),
    Attack("frames of nothing", "frames = 5:5", lambda: HONEST, ("no_frames_left",), texts={"options": '{"frames": "5:5"}'}),
    Attack("nested options", "100,000 nested brackets as options", lambda: HONEST, ("invalid_option", "text_too_large", "text_too_long"),
           texts={"options": "[" * 100_000}, statuses=(413, 422)),
    Attack("truth of NaN", "ground truth without a number", lambda: npy(np.full((6, 20, 3), np.nan)), ("not_finite",), part="ground_truth"),
    Attack("cameras of noise", "rotations that are none", lambda: npy(np.ones((6, 3, 3)) * 1e308), ("not_a_rotation",), part="rotations"),
    Attack("faces beyond the points", "an index of 2³¹ − 1", lambda: npy(np.array([[0, 1, 2**31 - 1]])), ("index_out_of_range",), part="mesh"),
    Attack("grid that repeats", "a grid of one index", lambda: archive(("grid.npy", npy(np.zeros((4, 5), np.int32)))),
           ("index_out_of_range",), part="mesh"),
)  # fmt: skip

HDF5 = (
    Attack("HDF5 external storage", f"a data set that is {SECRET}", lambda: hdf5(hdf5_external), ("unsupported_feature",)),
    Attack("HDF5 external link", "a link into another file", lambda: hdf5(lambda f: f.__setitem__("W", h5py.ExternalLink(SECRET, "W"))),
           ("unsupported_feature",)),
    Attack("HDF5 soft link", "a link by path", lambda: hdf5(lambda f: f.__setitem__("W", h5py.SoftLink("/x"))), ("unsupported_feature",)),
    Attack("HDF5 virtual data set", "a data set made of another file's", lambda: hdf5(hdf5_virtual), ("unsupported_feature",)),
    Attack("HDF5 declared size", "1 kB that claims 8.6 GB", lambda: hdf5(lambda f: f.create_dataset("W", (1 << 15, 1 << 15), "f8",
           chunks=(16, 16))), ("too_large",)),
    Attack("HDF5 bomb", "1.4 kB that is 800 MB of zeros", lambda: hdf5(hdf5_bomb), ("too_large",)),
    Attack("HDF5 circle", "a group that holds itself", lambda: hdf5(hdf5_circle), ("too_large",)),
    Attack("HDF5 depth", "200 nested groups", lambda: hdf5(hdf5_deep), ("too_large",)),
    Attack("HDF5 width", "1,000 variables", lambda: hdf5(lambda f: [f.create_group(f"g{index}") for index in range(1000)]), ("too_large",)),
    Attack("HDF5 cells", "25,000 cells of one matrix", lambda: hdf5(hdf5_cells), ("too_large",)),
    Attack("HDF5 cut off", "half a file", lambda: hdf5(hdf5_cells)[:5000], ("damaged_file",)),
    Attack("HDF5 noise", "a signature and noise", lambda: b"\x89HDF\r\n\x1a\n" + np.random.default_rng(0).bytes(4000), ("damaged_file",)),
)  # fmt: skip

MAT5 = (
    Attack("MAT packed bomb", "0.3 MB that inflates to 268 MB", mat_packed_bomb, ("too_large", "damaged_file", "too_slow")),
    Attack("MAT small bomb", "8 kB that inflate to 7.7 MB, 10 times over", mat_many_bombs, ("too_large",), limits=Limits(max_bytes=64 << 20)),
    Attack("MAT dimensions", "a size of 2³¹ − 1 by 2³¹ − 1", lambda: mat_matrix((2**31 - 1, 2**31 - 1)), ("too_large",)),
    Attack("MAT negative dimensions", "a size of −4 by −4", lambda: mat_matrix((-4, -4)), ("damaged_file", "missing_array", "too_large")),
    Attack("MAT lying size", "an element that claims 4 GB", lambda: mat_matrix((2, 4), size=0xFFFFFFF0), ("damaged_file", "too_large")),
    Attack("MAT without data", "64 bytes that claim 20 × 20 numbers", lambda: mat_matrix((20, 20)), ("damaged_file",)),
    Attack("MAT 40 dimensions", "40 axes", lambda: mat_matrix((2,) * 40), ("damaged_file", "too_large")),
    Attack("MAT no dimensions", "no axes at all", lambda: mat_matrix(()), ("damaged_file", "wrong_shape", "missing_array")),
    Attack("MAT nested cells", "3,000 cells, each in the next", lambda: mat_nested(3000), ("damaged_file", "missing_array", "too_large")),
    Attack("MAT unknown class", "a class that there is not", lambda: mat_matrix((2, 4), flags=99), ("damaged_file", "missing_array")),
    Attack("MAT cut off", "half a file", lambda: mat(W=np.ones((12, 20)))[:300], ("damaged_file", "missing_array")),
    Attack("MAT noise", "a header and noise", lambda: MAT_HEADER + np.random.default_rng(1).bytes(4000),
           ("damaged_file", "too_large", "missing_array")),
)  # fmt: skip

TEXT = (
    Attack("CSV of far frames", "frame 999,999,999", lambda: observations("0,0,1,2", "999999999,0,1,2"), ("too_large",)),
    Attack("CSV of far points", "point 10³⁰⁸", lambda: observations("0,0,1,2", "0,1e308,1,2"), ("damaged_file",)),
    Attack("CSV of repeats", "one observation twice", lambda: observations("0,0,1,2", "0,0,1,2"), ("duplicate_observation",)),
    Attack("CSV of one line", "1 MB without a line break", lambda: b"frame,point,x,y\n" + b"1," * (1 << 19), ("unreadable_table",)),
    Attack("CSV of columns", "100,000 columns", lambda: b"frame,point,x,y" + b",a" * 100_000 + b"\n", ("damaged_file", "unknown_format")),
    Attack("CSV not text", "bytes that are no UTF-8", lambda: b"frame,point,x,y\n0,0,\xff\xfe,1\n", ("unreadable_table",)),
    Attack("CSV of infinity", "frame inf", lambda: observations("inf,0,1,2"), ("damaged_file",)),
    Attack("page as tracks", "HTML with a script", lambda: b"<html><script>alert(1)</script></html>", ("unknown_format",)),
)  # fmt: skip

MESHES = (
    Attack("OBJ of indices", "a face of 1,000,000 corners", lambda: (OBJ_POINTS + "f" + " 1" * 10**6).encode(), ("damaged_file",), part="mesh"),
    Attack("OBJ beyond its points", "a face of vertex 10¹⁸", lambda: (OBJ_POINTS + f"f 1 2 {10**18}\n").encode(),
           ("index_out_of_range",), part="mesh"),
    Attack("OBJ beyond 64 bits", "a face of vertex 10³⁰", lambda: (OBJ_POINTS + f"f 1 2 {10**30}\n").encode(),
           ("damaged_file", "index_out_of_range"), part="mesh"),
    Attack("OBJ of long numbers", "a number of 4,000 digits", lambda: (OBJ_POINTS + "f 1 2 " + "9" * 4000 + "\n").encode(),
           ("damaged_file", "index_out_of_range"), part="mesh"),
    Attack("OBJ of many points", "100,000 vertices where 50,000 are allowed", lambda: b"v 0 0 0\n" * 100_000, ("too_large",), part="mesh",
           limits=Limits(max_points=50_000)),
    Attack("OBJ with another file", "mtllib ../../etc/passwd", lambda: (f"mtllib ../../..{SECRET}\n" + OBJ_POINTS + "f 1 2 99\n").encode(),
           ("index_out_of_range",), part="mesh"),
    Attack("PLY count", "10¹⁵ vertices", lambda: ply("element vertex 1000000000000000\nproperty float x\n"), ("too_large",), part="mesh"),
    Attack("PLY other count", "4,000,000,000 of an element of its own", lambda: ply(PLY_VERTEX + "element junk 4000000000\nproperty uchar a\n",
           bytes(240)), ("too_large",), part="mesh"),
    Attack("PLY negative count", "−5 vertices", lambda: ply("element vertex -5\nproperty float x\n"), ("too_large", "damaged_file"), part="mesh"),
    Attack("PLY list", "a face of 4,294,967,295 corners", lambda: ply(PLY_VERTEX + PLY_FACE, bytes(240) + b"\xff\xff\xff\xff"),
           ("damaged_file", "too_large"), part="mesh"),
    Attack("PLY properties", "10,000 properties", lambda: ply("element vertex 20\n" + "".join(f"property float p{i}\n" for i in range(10_000))),
           ("damaged_file", "too_large"), part="mesh"),
    Attack("PLY without an end", "a header that never ends", lambda: b"ply\nformat ascii 1.0\n" + b"comment x\n" * 20_000,
           ("damaged_file",), part="mesh"),
    Attack("PLY cut off", "half the vertices", lambda: ply(PLY_VERTEX + PLY_FACE, bytes(100)), ("damaged_file",), part="mesh"),
    Attack("glTF lying count", "an accessor of 4,000,000 over 240 bytes", lambda: glb(gltf(accessors=accessors(count=4_000_000)), BINARY),
           ("damaged_file", "too_large"), part="mesh"),
    Attack("glTF huge count", "an accessor of 10¹⁸", lambda: glb(gltf(accessors=accessors(count=10**18)), BINARY), ("too_large",), part="mesh"),
    Attack("glTF negative offset", "an accessor at −100,000", lambda: glb(gltf(accessors=accessors(byteOffset=-100_000)), BINARY),
           ("too_large", "damaged_file"), part="mesh"),
    Attack("glTF stride", "a stride of 10⁹", lambda: glb(gltf(bufferViews=[{"buffer": 0, "byteStride": 10**9}, {"buffer": 0}]), BINARY),
           ("too_large", "damaged_file"), part="mesh"),
    Attack("glTF other file", "a buffer at file:///etc/passwd", lambda: glb(gltf(buffers=[{"uri": f"file://{SECRET}", "byteLength": 9}])),
           ("unsupported_feature",), part="mesh"),
    Attack("glTF other server", "a buffer at http://169.254.169.254/", lambda: glb(gltf(buffers=[{"uri": "http://169.254.169.254/x"}])),
           ("unsupported_feature",), part="mesh"),
    Attack("glTF depth", "100,000 nested brackets", lambda: glb(b"[" * 100_000), ("damaged_file",), part="mesh"),
    Attack("glTF lying length", "a JSON part of 4 GB", lambda: glb(gltf(), BINARY, length=0xFFFFFFF0), ("damaged_file", "too_large"), part="mesh"),
    Attack("glTF of other numbers", "counts that are text", lambda: glb(gltf(accessors=accessors(count="20")), BINARY),
           ("damaged_file",), part="mesh"),
    Attack("PNG bomb", "a header of 60,000 × 60,000 pixels", lambda: png(60_000, 60_000, data=zlib.compress(bytes(1000))), ("too_large",),
           part="mesh"),
    Attack("PNG of 2³¹ pixels a side", "the largest size there is", lambda: png(2**31 - 1, 2**31 - 1), ("too_large", "damaged_file"), part="mesh"),
    Attack("PNG within the limit", "2,000 × 2,000 in 4 kB", lambda: png(2000, 2000, data=zlib.compress(bytes(2001 * 2000), 9)),
           ("vertex_count_mismatch", "index_out_of_range"), part="mesh"),
    Attack("PNG text bomb", "a comment that inflates to 100 MB", lambda: png(4, 5, (b"zTXt", b"a\0\0" + deflated(b"", 100))),
           ("damaged_file",), part="mesh"),
    Attack("PNG cut off", "no pixels", lambda: png(4, 5, data=b""), ("damaged_file",), part="mesh"),
    Attack("other picture", "a GIF as mask", lambda: b"GIF89a" + struct.pack("<HH", 60_000, 60_000) + bytes(20), ("unknown_format",), part="mesh"),
    Attack("drawing as mesh", "an SVG with an entity bomb", lambda: b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "aaaa">]><svg>&a;</svg>',
           ("unknown_format",), part="mesh"),
)  # fmt: skip


def mp4_box(kind: bytes, body: bytes = b"") -> bytes:
    return struct.pack(">I4s", 8 + len(body), kind) + body


FTYP = mp4_box(b"ftyp", b"isom\0\0\2\0isom")
DREF = mp4_box(b"dref", struct.pack(">II", 0, 1) + mp4_box(b"url ", b"\0\0\0\0http://169.254.169.254/x\0"))
LARGE_PICTURE = png(6000, 6000, data=zlib.compress(bytes(1000)))

FILMS = (
    Attack("film playlist", "an HLS playlist of /etc/passwd", lambda: b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", ("playlist",), part="film"),
    Attack("film list", "an ffconcat list of /etc/passwd", lambda: b"ffconcat version 1.0\nfile /etc/passwd\n", ("playlist",), part="film"),
    Attack("film elsewhere", "an MP4 whose samples lie at http://169.254.169.254/", lambda: FTYP + mp4_box(b"moov", mp4_box(b"trak",
           mp4_box(b"mdia", mp4_box(b"minf", mp4_box(b"dinf", DREF))))), ("external_reference",), part="film"),
    Attack("film of 1,000 streams", "an MP4 with 1,000 tracks", lambda: FTYP + mp4_box(b"moov", mp4_box(b"trak") * 1000),
           ("too_many_streams",), part="film"),
    Attack("film without index", "an MP4 cut off before its index", lambda: FTYP + mp4_box(b"mdat", bytes(1 << 20)), ("truncated_film",), part="film"),
    Attack("film of huge pictures", "a zip of pictures that state 6,000 × 6,000 pixels", lambda: archive(*((f"{n}.png", LARGE_PICTURE)
           for n in range(3))), ("too_many_pixels",), part="film"),
    Attack("film of no pictures", "a zip of a text as film", lambda: archive(("notes.txt", b"nothing to see")), ("no_picture",), part="film"),
    Attack("tracks as film", "a zip of tracks as film", lambda: archive(("tracks.npy", HONEST)), ("tracks_as_film",), part="film"),
    Attack("film of sound alone", "an MP4 whose only track is sound", lambda: FTYP + mp4_box(b"moov", mp4_box(b"trak", mp4_box(b"mdia",
           mp4_box(b"hdlr", bytes(8) + b"soun" + bytes(13))))) + mp4_box(b"mdat", bytes(1000)), ("no_picture",), part="film"),
    Attack("film of boxes", "an MP4 of 30,000 empty boxes", lambda: FTYP + mp4_box(b"free") * 30_000, ("unsupported_film",), part="film"),
    Attack("headless AVI", "an AVI that ends inside its header", lambda: b"RIFF\0\0\0\0AVI LIST", ("truncated_film",), part="film"),
    Attack("film zip bomb", "a zip of pictures that unpack to 8 MB of zeros each", lambda: archive(*((f"{n}.png", bytes(8 << 20)) for n in range(3))),
           ("too_many_bytes",), part="film", limits=Limits(max_bytes=16 << 20)),
    Attack("GIF of 60,000 × 60,000", "an animated GIF that states a huge size", lambda: b"GIF89a" + struct.pack("<HH", 60_000, 60_000) + bytes(20),
           ("too_many_pixels", "broken_picture"), part="film"),
)  # fmt: skip

ATTACKS = (*ZIPS, *HEADERS, *NUMBERS, *HDF5, *MAT5, *TEXT, *MESHES, *FILMS)

OVER_HTTP = (
    "zip bomb", "pickle", "HDF5 bomb", "MAT packed bomb", "OBJ of indices", "glTF lying length", "PNG bomb", "film of huge pictures",
    "huge numbers in options", "nested options",
)  # fmt: skip
"""One per format, and those that the service handles before any reader."""
