"""The arrays of a solution as a MATLAB 5 file, which MATLAB, Octave and SciPy read."""

from __future__ import annotations

from typing import IO

from pliant.worker.artifacts.result import Result

HEADER = b"MATLAB 5.0 MAT-file, written by Pliant"
TEXT_BYTES = 116
"""Length of the text at the start of a file; version and byte order follow."""

INDICES = frozenset({"faces", "source_frames", "source_points"})
"""Arrays that count frames or points, from 0 in Python and from 1 in MATLAB."""

MOST_BYTES = 2**31
"""Upper bound of the size of one variable in this format, bytes."""


def fits(num_frames: int, num_points: int) -> bool:
    """Return whether the shapes fit into one variable."""
    return 24 * num_frames * num_points < MOST_BYTES


def write_mat(result: Result, file: IO[bytes]) -> None:
    """Write the arrays of `shapes.npz` under the same names; indices (`faces`, `source_…`) count from 1, `point_names` is a cell array."""
    import scipy.io  # imported here, because the API process writes no files

    arrays = result.arrays()
    for name in arrays.keys() & INDICES:
        arrays[name] = arrays[name] + 1
    if "point_names" in arrays:
        arrays["point_names"] = arrays["point_names"].astype(object)
    scipy.io.savemat(file, arrays, oned_as="column")  # type: ignore[arg-type]  # documented: "str or file-like object"
    # SciPy writes the time of day there; a fixed text makes equal results equal files.
    end = file.tell()
    file.seek(0)
    file.write(HEADER.ljust(TEXT_BYTES))
    file.seek(end)
