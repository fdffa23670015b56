"""The arrays of a solution as a MATLAB 5 file, which MATLAB, Octave and SciPy read."""

from __future__ import annotations

from typing import IO

import numpy as np
from pliant.worker.artifacts.result import Result

HEADER = b"MATLAB 5.0 MAT-file, written by Pliant"
TEXT_BYTES = 116
"""Length of the text at the start of a file; version and byte order follow."""

MOST_BYTES = 2**31
"""Upper bound of the size of one variable in this format, bytes."""


def fits(num_frames: int, num_points: int) -> bool:
    """Return whether the shapes fit into one variable."""
    return 24 * num_frames * num_points < MOST_BYTES


def write_mat(result: Result, file: IO[bytes]) -> None:
    """Write the arrays of `shapes.npz` under the same names; indices (`faces`, `source_…`) count from 1, `point_names` is a cell array."""
    import scipy.io  # imported here, because the API process writes no files

    solution, camera = result.solution, result.solution.camera
    names, chosen = result.inputs.point_names, result.inputs.selection
    sources = {} if chosen is None else {"source_frames": chosen.frames + 1, "source_points": chosen.points + 1}
    posterior = {"shapes_std": solution.shapes_std, "inlier_probability": solution.inlier_probability}
    scipy.io.savemat(
        file,  # type: ignore[arg-type]  # documented: "str or file-like object"
        {
            **({} if names is None else {"point_names": np.array(names, dtype=object)}),
            "shapes": solution.shapes,
            "rotations": camera.rotations,
            "scales": camera.scales,
            "translations": camera.translations,
            "focal": np.inf if camera.focal is None else camera.focal,
            "focal_std": np.nan if camera.focal_std is None else camera.focal_std,
            "principal_point": camera.principal_point,
            "faces": result.faces + 1,
            "residuals": solution.residuals.astype(np.float32),
            "weights": solution.weights.astype(np.float32),
            **{name: array.astype(np.float32) for name, array in posterior.items() if array is not None},
            "trace_objective": solution.trace.objective,
            "trace_residual": solution.trace.residual,
            "trace_iterations": solution.trace.iterations,
            **sources,
        },
        oned_as="column",
    )
    # SciPy writes the time of day there; a fixed text makes equal results equal files.
    end = file.tell()
    file.seek(0)
    file.write(HEADER.ljust(TEXT_BYTES))
    file.seek(end)
