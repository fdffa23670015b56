"""Arrays in temporary files."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from pliant.solver import Tracks
from pliant.solver.storage import allocated, let_go

POINTS = np.random.default_rng(0).normal(size=(5, 6, 2)).astype(np.float32)


def test_mapped_arrays_start_at_zero_and_keep_written_values(tmp_path: Path) -> None:
    array = allocated((3, 4), tmp_path)
    assert type(array) is np.ndarray
    assert (array == 0).all()
    array[1] = 7.0
    let_go(array, None, np.zeros(3))
    assert array.sum() == 28
    assert list(tmp_path.iterdir()) == []


def test_mapped_tracks_equal_those_in_memory(tmp_path: Path) -> None:
    points, visible = POINTS.copy(), np.linspace(0, 1, 30).reshape(5, 6)
    points[1, 2] = np.nan
    plain, mapped = Tracks.from_arrays(points, visible), Tracks.from_arrays(points, visible, scratch=tmp_path)
    assert np.array_equal(plain.points, mapped.points)
    assert np.array_equal(plain.visible, mapped.visible)
    assert isinstance(mapped.points.base, np.memmap)
    assert not mapped.points.flags.writeable
    assert (Tracks.from_arrays(POINTS, scratch=tmp_path).visible == 1).all()


def test_a_missing_folder_or_a_full_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match="missing"):
        allocated((3, 4), tmp_path / "missing")

    def full(descriptor: int, start: int, size: int) -> None:
        raise OSError(errno.ENOSPC, f"no space for {size - start} bytes in {descriptor}")

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(OSError, match="no space for 96 bytes"):
        allocated((3, 4), tmp_path)


def test_mapped_arrays_have_the_given_type_and_are_let_go_by_their_views(tmp_path: Path) -> None:
    resident = Path("/proc/self/statm")
    if not resident.exists():
        pytest.skip("needs the resident memory of this process")

    def pages() -> int:
        return int(resident.read_text().split()[1])

    array = allocated((2048, 4096), tmp_path, np.float32)
    assert array.dtype == np.float32
    array[:] = 1.0
    before = pages()
    let_go(array[1:, :7][:, 2:])
    assert pages() < before - array.nbytes // 8192
    assert float(array[:, ::512].sum()) == 2048 * 8
