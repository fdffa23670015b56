"""Crafted NumPy files: each is rejected with its code before its content is inflated."""

from __future__ import annotations

import ast
import errno
import io
import math
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from crafting import archive as archive_of
from crafting import described, header, npy
from hypothesis import given, settings
from hypothesis import strategies as st
from pliant.solver import InvalidInput
from pliant.worker.formats.reading.arrays import read_npy, read_npz
from pliant.worker.formats.records import Limits

SMALL = Limits(max_bytes=1 << 20, max_members=4)


GOOD = npy(np.zeros((3, 4, 2)))
HEADERS = {
    "object": ("object_array", header(described("(2,)", "'|O'"), b"\x80\x04K\x01.")),
    "structured": ("wrong_type", header(described("(1,)", "[('a', '<f8')]"), bytes(8))),
    "text": ("wrong_type", header(described("(1,)", "'<U4'"), bytes(16))),
    "complex": ("wrong_type", header(described("(1,)", "'<c16'"), bytes(16))),
    "nothing known": ("damaged_file", header(described("(1,)", "'<f3'"), bytes(3))),
    "more than there is": ("damaged_file", header(described("(9,)"), bytes(8))),
    "less than there is": ("damaged_file", header(described("(1,)"), bytes(16))),
    "a terabyte": ("too_large", header(described("(1000000, 131072)"))),
    "negative": ("damaged_file", header(described("(-1,)"))),
    "not a tuple": ("damaged_file", header(described("'x'"))),
    "a number": ("damaged_file", header(described("(2)"), bytes(16))),
    "a number with zeros": ("damaged_file", header(described("(02,)"), bytes(16))),
    "a fraction": ("damaged_file", header(described("(2.0,)"), bytes(16))),
    "no encoding": ("damaged_file", header("{}").replace(b"{}", b"\xff\xff")),
    "many dimensions": ("damaged_file", header(described("(" + "1," * 40 + ")", "'|u1'"), b"\0")),
    "code": ("damaged_file", header("__import__('os').system('true')")),
    "nested": ("damaged_file", header("(" * 3000)),
    "other entries": ("damaged_file", header("{'descr': '<f8'}")),
    "version": ("damaged_file", header(described("(1,)"), bytes(8)).replace(b"\1\0", b"\x09\0", 1)),
    "cut off": ("damaged_file", GOOD[:20]),
    "no header": ("damaged_file", b"nonsense and more"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_inconsistent_headers_are_rejected(name: str) -> None:
    code, content = HEADERS[name]
    with pytest.raises(InvalidInput) as caught:
        read_npy(io.BytesIO(content), len(content), field="tracks", limits=SMALL)
    assert caught.value.code == code


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3), (1, 2, 3, 1)])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "|u1", "|b1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_headers_of_numpy_are_read(shape: tuple[int, ...], dtype: str, order: str) -> None:
    written = np.arange(math.prod(shape)).reshape(shape).astype(dtype, order=order)
    content = npy(written)
    found = read_npy(io.BytesIO(content), len(content), field="tracks", limits=SMALL)
    np.testing.assert_array_equal(found, written)
    assert found.shape == shape


def test_literals_are_parsed_in_one_thread_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise Python 3.11 now and then raises SystemError, which ended a request with 500."""
    literal_eval, busy, alone = ast.literal_eval, threading.Lock(), list[bool]()

    def slow(text: str) -> object:
        mine = busy.acquire(blocking=False)
        alone.append(mine)
        time.sleep(0.002)
        if mine:
            busy.release()
        return literal_eval(text)

    monkeypatch.setattr(ast, "literal_eval", slow)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: read_npy(io.BytesIO(GOOD), len(GOOD), field="tracks", limits=SMALL), range(24)))
    assert len(found) == len(alone) == 24
    assert all(alone)


def archive(path: Path, members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> Path:
    path.write_bytes(archive_of(*members, method=method))
    return path


ARCHIVES = {
    "duplicate_member": [("tracks.npy", GOOD), ("tracks.npy", GOOD)],
    "member_name": [("../tracks.npy", GOOD)],
    "pickle_refused": [("archive/data.pkl", b"\x80\x02.")],
    "too_large": [("tracks.npy", npy(np.zeros(1 << 18)))],
}


@pytest.mark.parametrize("code", ARCHIVES)
def test_crafted_archives_are_rejected(tmp_path: Path, code: str) -> None:
    path = archive(tmp_path / "x.npz", ARCHIVES[code])
    with pytest.raises(InvalidInput) as caught:
        read_npz(path, field="tracks", limits=SMALL)
    assert caught.value.code == code


def test_too_many_members_and_unknown_compression_are_rejected(tmp_path: Path) -> None:
    many = archive(tmp_path / "many.npz", [(f"a{index}.npy", GOOD) for index in range(5)])
    packed = archive(tmp_path / "lzma.npz", [("tracks.npy", GOOD)], zipfile.ZIP_LZMA)
    for path, code in ((many, "too_large"), (packed, "unsupported_feature")):
        with pytest.raises(InvalidInput) as caught:
            read_npz(path, field="tracks", limits=SMALL)
        assert caught.value.code == code


def test_a_member_with_a_wrong_checksum_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "x.npz", [("tracks.npy", GOOD)], zipfile.ZIP_STORED)
    content = bytearray(path.read_bytes())
    content[200] ^= 1
    path.write_bytes(content)
    with pytest.raises(InvalidInput) as caught:
        read_npz(path, field="tracks", limits=SMALL)
    assert caught.value.code == "damaged_file"


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300), st.integers(0, len(GOOD)))
def test_arbitrary_bytes_only_raise_input_errors(junk: bytes, at: int) -> None:
    content = GOOD[:at] + junk + GOOD[at + len(junk) :]
    try:
        read_npy(io.BytesIO(content), len(content), field="tracks", limits=SMALL)
    except InvalidInput as error:
        assert error.code in ("damaged_file", "wrong_type", "too_large", "object_array")  # noqa: PT017


def test_a_zip_directory_pointing_before_the_file_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "x.npz", [("tracks.npy", GOOD)])
    path.write_bytes(path.read_bytes()[1:])
    with pytest.raises(InvalidInput) as caught:
        read_npz(path, field="tracks", limits=SMALL)
    assert caught.value.code == "damaged_file"


def test_a_disk_failure_is_not_an_input_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = archive(tmp_path / "x.npz", [("tracks.npy", GOOD)])

    def fails(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(zipfile.ZipFile, "open", fails)
    with pytest.raises(OSError, match="Input/output error"):
        read_npz(path, field="tracks", limits=SMALL)
