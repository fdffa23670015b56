"""The isolated reader: the same interpretation, stored bits and errors as in-process reading, without memory growth."""

from __future__ import annotations

import inspect
import os
import signal
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from peaks import forget_peak, peak_of
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats import AmbiguousInput, Limits, isolated_reader, read_inputs, save_inputs, store_inputs
from pliant.worker.formats.isolated_reader import declared_bytes
from pliant.worker.processes.contained import Ended
from results import moving_sheet

POINTS = moving_sheet(8, 6, 7)[..., :2] + 100


@pytest.fixture
def all_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_reader, "LARGE", 0)


def test_isolated_reading_gives_the_same_file_and_interpretation(all_apart: None, tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", tracks=POINTS)
    np.savez(tmp_path / "g.npz", shapes=moving_sheet(8, 6, 7))
    options = Options(stride=2)
    inputs = read_inputs(tracks=tmp_path / "t.npz", mesh="6x7", ground_truth=tmp_path / "g.npz", options=options)
    save_inputs(inputs, tmp_path / "here.npz")
    interpretation = store_inputs(
        tracks=tmp_path / "t.npz",
        mesh="6x7",
        ground_truth=tmp_path / "g.npz",
        options=options,
        target=tmp_path / "there.npz",
    )
    assert interpretation == inputs.interpretation
    assert (tmp_path / "here.npz").read_bytes() == (tmp_path / "there.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["g.npz", "here.npz", "t.npz", "there.npz"]


def test_both_readers_accept_the_same_parameters() -> None:
    here, apart_too = (dict(inspect.signature(door).parameters) for door in (read_inputs, store_inputs))
    assert apart_too.pop("target").default is inspect.Parameter.empty
    assert here == apart_too


def test_errors_are_transferred_completely(all_apart: None, tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", tracks=POINTS[:2])
    with pytest.raises(InvalidInput) as caught:
        store_inputs(tracks=tmp_path / "t.npz", options=Options(), target=tmp_path / "c.npz")
    assert (caught.value.code, caught.value.field, caught.value.got) == ("too_few_frames", "tracks", "2")
    np.savez(tmp_path / "t.npz", tracks=POINTS.swapaxes(0, 1))
    with pytest.raises(AmbiguousInput) as asked:
        store_inputs(tracks=tmp_path / "t.npz", options=Options(), target=tmp_path / "c.npz")
    assert asked.value.code == "ambiguous_layout"
    assert {"layout": "points_frames"} in [choice["options"] for choice in asked.value.choices]


@pytest.mark.slow
def test_exceeding_memory_or_time_is_an_input_error(all_apart: None, tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    np.savez_compressed(path, tracks=np.zeros((1000, 20_000, 2), dtype=np.float32))
    with pytest.raises(InvalidInput, match="within 419,430,400 bytes") as caught:
        store_inputs(tracks=path, options=Options(), limits=Limits(read_memory=400 << 20), target=tmp_path / "c.npz")
    assert caught.value.code == "too_large"
    with pytest.raises(InvalidInput, match=r"within 0\.01 s") as late:
        store_inputs(tracks=path, options=Options(), limits=Limits(read_seconds=0.01), target=tmp_path / "c.npz")
    assert late.value.code == "too_large"


def test_a_small_file_that_expands_is_read_in_a_separate_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(isolated_reader, "LARGE", 64 << 10)
    path = tmp_path / "t.csv"
    corners = [(0, 0), (90, 0), (0, 90), (90, 90), (40, 50)]
    lines = [
        f"{frame},{point},{x + frame / 100},{y}"
        for frame in (0, 400, 800, 1200)
        for point, (x, y) in enumerate(corners)
    ]
    path.write_text("\n".join(["frame,point,x,y", *lines]))
    assert declared_bytes(path, field="tracks") < isolated_reader.LARGE < 1201 * 5 * 16
    here, read_here = [], isolated_reader.read_inputs
    monkeypatch.setattr(isolated_reader, "read_inputs", lambda **parts: here.append(read_here(**parts)))
    options = Options(layout="frames_points")
    interpretation = store_inputs(tracks=path, mesh="none", options=options, target=tmp_path / "c.npz")
    assert (interpretation.num_frames, interpretation.num_points) == (1201, 5)
    assert not here


def test_a_killed_reader_leaves_no_files(all_apart: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(module: str, request: object, *, environment: dict[str, str], **more: object) -> Ended:
        (Path(environment["TMPDIR"]) / "output").write_bytes(b"unfinished")
        return Ended(-signal.SIGKILL, b"", "", overdue=True)

    np.savez(tmp_path / "t.npz", tracks=POINTS)
    monkeypatch.setattr(isolated_reader, "run_contained", killed)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(InvalidInput, match="are read within"):
        store_inputs(tracks=tmp_path / "t.npz", options=Options(), target=tmp_path / "c.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["t.npz"]


def test_an_internal_error_is_not_an_input_error(all_apart: None, tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", tracks=POINTS)
    with pytest.raises(RuntimeError, match="No such file or directory"):
        store_inputs(tracks=tmp_path / "t.npz", options=Options(), target=tmp_path / "nowhere" / "x.npz")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_isolated_reading_keeps_no_memory_in_the_parent(tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    np.savez(path, tracks=np.linspace(0, 900, 20 * 220_000 * 2).reshape(220_000, 20, 2).swapaxes(0, 1))
    assert declared_bytes(path, field="tracks") > isolated_reader.LARGE
    before = peak_now()
    interpretation = store_inputs(tracks=path, mesh="none", options=Options(), target=tmp_path / "c.npz")
    assert (interpretation.num_frames, interpretation.num_points) == (20, 220_000)
    assert peak_of(os.getpid()) - before < 40 << 20  # the arrays are 70 MB


def peak_now() -> int:
    """Resident bytes now, read as the peak right after a reset."""
    forget_peak(os.getpid())
    return peak_of(os.getpid())


def test_declared_sizes_are_computed(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "z.npz", tracks=np.zeros((100, 100, 2)))
    np.save(tmp_path / "p.npy", np.zeros((100, 100, 2)))
    scipy.io.savemat(tmp_path / "m.mat", {"W": np.zeros((20, 30))})
    (tmp_path / "t.csv").write_text("frame,point,x,y\n0,0,1,2\n")
    size = {path.suffix: path.stat().st_size for path in tmp_path.iterdir()}
    assert size[".npz"] < 10_000
    assert declared_bytes(tmp_path / "z.npz", field="tracks") == 160_000 + 128  # with the header
    assert declared_bytes(tmp_path / "p.npy", field="tracks") == size[".npy"]
    np.save(tmp_path / "b.npy", np.zeros((100, 100, 2), dtype=bool))
    assert declared_bytes(tmp_path / "b.npy", field="tracks") == 160_000
    assert declared_bytes(tmp_path / "m.mat", field="tracks") == 1032 * size[".mat"]
    assert declared_bytes(tmp_path / "t.csv", field="tracks") == 8 * size[".csv"]
    (tmp_path / "n.npz").write_bytes(b"PK\x03\x04" + bytes(400))
    with pytest.raises(InvalidInput, match="without its directory"):
        declared_bytes(tmp_path / "n.npz", field="tracks")
    np.savez(tmp_path / "o.npz", tracks=np.array([{}], dtype=object))
    assert 0 < declared_bytes(tmp_path / "o.npz", field="tracks") < 1000
    with h5py.File(tmp_path / "h.mat", "w", userblock_size=512) as file:
        file["W"] = np.zeros(4)
    assert declared_bytes(tmp_path / "h.mat", field="tracks") > isolated_reader.LARGE
