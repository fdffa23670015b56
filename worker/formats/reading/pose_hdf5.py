"""HDF5 files: DeepLabCut's tables and SLEAP's analysis files; all others as MATLAB 7.3 writes them.

DeepLabCut's tables are written by pandas, which keeps the names of the columns pickled; those are never read. The order of the columns
is x, y, likelihood for each body part, and it is checked by the values.
"""

from __future__ import annotations

from typing import IO

import h5py
import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.reading.hdf5 import UNREADABLE, check_before_reading, read_arrays, read_values
from pliant.worker.formats.records import Arrays, Limits

VALUES = "values_block_0"
FIXED = "block0_values"
_SLEAP = ("node_names", "track_names", "track_occupancy", "edge_names")


def read_hdf5(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read a pose tracker's file, or every numeric data set of a MATLAB file.

    Raises
    ------
    InvalidInput
        Codes damaged_file, missing_array, too_large, unsupported_feature, wrong_shape.
    """
    try:
        with h5py.File(stream, "r") as file:
            found = _sleap(file, field, limits) or _deeplabcut(file, field, limits)
            return found if found is not None else read_arrays(file, field=field, limits=limits)
    except UNREADABLE as error:
        raise damaged(field, f"an HDF5 file that cannot be read ({str(error)[:120]})") from error


def _sleap(file: h5py.File, field: str, limits: Limits) -> Arrays | None:
    """Read `tracks (instances, 2, nodes, frames)`; the nodes of all instances are points, NaN where they were not found."""
    item = _own(file, "tracks")
    if not isinstance(item, h5py.Dataset) or item.ndim != 4 or item.shape[1] != 2 or item.dtype.kind != "f":
        return None
    if not any(name in file for name in _SLEAP):
        return None
    values = read_values(item, "tracks", 0, field, limits)  # axes reversed: frames, nodes, 2, instances
    frames, nodes, _, instances = values.shape
    return {"sleap": values.transpose(0, 3, 1, 2).reshape(frames, instances * nodes, 2)}


def _deeplabcut(file: h5py.File, field: str, limits: Limits) -> Arrays | None:
    for name in list(file)[:8]:
        group = _own(file, name)
        if not isinstance(group, h5py.Group):
            continue
        table, fixed = _own(group, "table"), _own(group, FIXED)
        if (
            isinstance(table, h5py.Dataset)
            and table.dtype.names == ("index", VALUES)
            and table.dtype[VALUES].base.kind == "f"
        ):
            check_before_reading(table, name, 0, field, limits)
            return _columns(np.asarray(table[()][VALUES], dtype=np.float64), field)
        if isinstance(fixed, h5py.Dataset) and fixed.ndim == 2 and fixed.dtype.kind == "f":
            return _columns(np.asarray(read_values(fixed, name, 0, field, limits).T, dtype=np.float64), field)
    return None


def _columns(values: NDArray[np.float64], field: str) -> Arrays:
    """Take a table of x, y, likelihood for each body part apart."""
    likelihood = values[:, 2::3] if values.ndim == 2 else values
    if (
        values.ndim != 2
        or values.shape[1] % 3
        or not ((likelihood >= 0) & (likelihood <= 1) | np.isnan(likelihood)).all()
    ):
        raise InvalidInput(
            "wrong_shape", field=field, expected="a DeepLabCut table: x, y and likelihood from 0 to 1 for each body part",
            got=f"a table of shape {values.shape}", hint="Export it as csv: deeplabcut.analyze_videos_converth5_to_csv(folder).",
        )  # fmt: skip
    return {"deeplabcut": np.stack([values[:, 0::3], values[:, 1::3]], axis=2), "likelihood": likelihood}


def _own(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """Return a member that is stored in the file itself, None where there is no such member."""
    if name not in group or not isinstance(group.get(name, getlink=True), h5py.HardLink):
        return None
    found = group[name]
    return found if isinstance(found, h5py.Group | h5py.Dataset) else None
