"""Honest files of every format, mutated by Hypothesis: the parsers must return arrays or a refusal, nothing else.

As a program (`python fuzzing.py PARSER:EXAMPLES … SEED`) it fuzzes parsers in its own process, which a crash of a native library may
end, and prints the number of each outcome per parser.
"""

from __future__ import annotations

import io
import json
import os
import resource
import struct
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))

from attack_files import HDF5, HEADERS, MAT5, MESHES, TEXT, ZIPS
from crafting import BINARY, GFACES, HONEST, OBJ_POINTS, archive, glb, gltf, mat, ply, png
from pliant.solver import InvalidInput
from pliant.worker.formats.reading.arrays import read_npy, read_npz
from pliant.worker.formats.reading.parsers import PARSERS, parse
from pliant.worker.formats.records import Arrays, Limits

SMALL = Limits(max_bytes=4 << 20, max_points=5000, max_faces=20_000, max_members=16)
MEMORY = 3 << 30
NATIVE = ("matlab5", "matlab73")
"""Parsers whose library is native and known to crash; each example gets a process."""

CRASHED = "crashed, contained"
LARGEST_SEED = 6000
"""Bytes; larger honest files gain nothing."""


def from_npy(content: bytes) -> Arrays:
    return {"array": read_npy(io.BytesIO(content), len(content), field="tracks", limits=SMALL)}


def from_npz(content: bytes) -> Arrays:
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        return read_npz(Path(file.name), field="tracks", limits=SMALL)[0]


def from_parser(name: str) -> Callable[[bytes], Arrays]:
    return lambda content: parse(PARSERS[name], io.BytesIO(content), field="mesh", limits=SMALL)


READERS: dict[str, Callable[[bytes], Arrays]] = {
    "npy": from_npy, "npz": from_npz, **{name: from_parser(name) for name in PARSERS},
}  # fmt: skip


def honest(parser: str) -> list[bytes]:
    """Return files to start from: valid ones, and the smaller attacks on the same format."""
    import h5py

    with io.BytesIO() as buffer:
        with h5py.File(buffer, "w") as file:
            file["data/W"] = np.ones((20, 12))
            file.create_dataset("c", (2, 1), dtype=h5py.ref_dtype)[...] = file["data/W"].ref
        matlab73 = buffer.getvalue()
    quad = struct.pack("<BIIII", 4, 0, 1, 2, 3)
    vertices = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    ascii_body = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
    good = {
        "npy": [HONEST],
        "npz": [archive(("tracks.npy", HONEST), ("visibility.npy", HONEST))],
        "matlab5": [
            mat(W=np.ones((12, 20)), s={"a": np.ones((3, 4)), "c": np.zeros((1, 2), object)}, packed=packed)
            for packed in (False, True)
        ],
        "matlab73": [matlab73],
        "csv": [
            b"frame,point,x,y,visible\n" + b"".join(b"%d,%d,1.5,-2e1,1\n" % (f, p) for f in range(4) for p in range(5))
        ],
        "json": [json.dumps([{"pose_landmarks": [[{"x": 0.5, "y": 0.25, "visibility": 1.0}] * 3]}] * 4).encode()],
        "obj": [(OBJ_POINTS + "vt 0 0\nf 1/1 2/1 3/1\nf -1 -2 -3 -4\n").encode()],
        "ply": [
            ply(vertices + faces, np.zeros((4, 3), "<f4").tobytes() + quad),
            ply(vertices + faces, ascii_body.encode(), kind="ascii"),
        ],
        "glb": [glb(gltf(), BINARY)],
        "gltf": [json.dumps(gltf(buffers=[{"uri": "data:application/octet-stream;base64," + GFACES}])).encode()],
        "png": [png(4, 5, data=__import__("zlib").compress(bytes(25)))],
    }[parser]
    starts = {
        "npy": (b"\x93NUMPY",), "npz": (b"PK",), "matlab5": (b"MATLAB",), "matlab73": (b"\x89HDF",), "csv": (b"frame",),
        "json": (b"[",), "obj": (b"v ",), "ply": (b"ply",), "glb": (b"glTF",), "gltf": (b"{",), "png": (b"\x89PNG",),
    }[parser]  # fmt: skip
    bad = [content for content in small_attacks() if content.startswith(starts)]
    return [*good * (3 * len(bad) // len(good) + 1), *bad]


@cache
def small_attacks() -> list[bytes]:
    """Attacks of every kind that are small and quickly made."""
    slow = ("bomb", "small bomb", "many", "million", "count")
    attacks = [
        one for one in (*ZIPS, *HEADERS, *HDF5, *MAT5, *TEXT, *MESHES) if not any(word in one.name for word in slow)
    ]
    made = [one.make() for one in attacks if one.make.__name__ == "<lambda>"]
    return [content for content in made if len(content) < LARGEST_SEED]


NUMBERS = st.sampled_from([0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFF8, 0xFFFFFFFF])
PLACES = st.integers(0, 9999)
"""Ten-thousandths of the file."""

EDITS = st.lists(
    st.one_of(
        st.tuples(st.just("set"), PLACES, st.binary(min_size=1, max_size=4)),
        st.tuples(st.just("insert"), PLACES, st.binary(min_size=1, max_size=12)),
        st.tuples(st.just("cut"), PLACES, st.integers(1, 64)),
        st.tuples(st.just("again"), PLACES, st.integers(1, 64)),
        st.tuples(st.just("number"), PLACES, NUMBERS),
    ),
    min_size=1,
    max_size=3,
)


def bent(content: bytes, edits: list[tuple[str, int, object]]) -> bytes:
    for kind, where, what in edits:
        at = where * len(content) // 10_000
        if kind == "set":
            content = content[:at] + what + content[at + len(what) :]  # type: ignore[operator, arg-type]
        elif kind == "insert":
            content = content[:at] + what + content[at:]  # type: ignore[operator]
        elif kind == "cut":
            content = content[:at] + content[at + what :]  # type: ignore[operator]
        elif kind == "again":
            content = content[: at + what] + content[at:]  # type: ignore[operator]
        else:
            content = content[:at] + struct.pack("<L", what) + content[at + 4 :]
    return content


def fuzz(parser: str, examples: int, number: int) -> Counter[str]:
    """Mutate and read; anything but arrays or a refusal raises."""
    seeds, answers = honest(parser), Counter[str]()
    read = READERS[parser]
    read(seeds[0])  # loads what it needs, before any fork

    @settings(max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @seed(number)
    @given(st.sampled_from(range(len(seeds))), EDITS)
    def once(which: int, edits: list[tuple[str, int, object]]) -> None:
        content = bent(seeds[which], edits)
        answers[in_a_fork(lambda: answer(read, content)) if parser in NATIVE else answer(read, content)] += 1

    once()
    return answers


def answer(read: Callable[[bytes], Arrays], content: bytes) -> str:
    try:
        arrays = read(content)
    except InvalidInput as error:
        return error.code if error.hint else "a refusal without a hint"
    assert all(isinstance(array, np.ndarray) and array.dtype.kind in "fiub" for array in arrays.values())
    return "read"


def in_a_fork(act: Callable[[], str]) -> str:
    """Return the result of `act`, or CRASHED if a signal ended it, as may happen in the sandbox that reads uploads."""
    out, into = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.write(into, act().encode())
            os._exit(0)
        except BaseException:  # noqa: BLE001  the traceback is printed, and the parent sees the exit code
            traceback.print_exc()
            os._exit(1)
    os.close(into)
    with os.fdopen(out, "rb") as stream:
        text = stream.read().decode()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert code <= 0, "not a refusal; the exception is printed above"
    return text if code == 0 else CRASHED


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    warnings.simplefilter("ignore")
    *given_parsers, number = sys.argv[1:]
    counts = dict(each.split(":") for each in given_parsers)
    print(json.dumps({name: fuzz(name, int(examples), int(number)) for name, examples in counts.items()}))
