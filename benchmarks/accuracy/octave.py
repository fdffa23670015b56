"""Calls of other authors' Octave functions: tracks into a file, one generated script, shapes out of a file.

Nothing of theirs is in this project. `FMINUNC` and `CORRECTIVE` are this project's own text, put before Octave's and theirs on the path:

- Octave's `fminunc` takes neither a matrix to start from nor further arguments of the objective. MATLAB's takes both.
- BMM states its convex programme with YALMIP, which takes minutes to build it in Octave. `CORRECTIVE` gives the same programme to the same
  solver, SDPT3: the nuclear norm of a symmetric matrix Q = X₁ − X₂ is the least sum of the traces of two positive semidefinite ones. With
  K = 5, both end at .5461 for the face landmarks.
"""

from __future__ import annotations

import resource
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

FMINUNC = """
function [x, value] = fminunc (f, x0, options, varargin)
  here = fileparts (mfilename ("fullpath"));
  rmpath (here);  % so that the name means Octave's function
  unwind_protect
    [x, value] = fminunc (@(q) f (reshape (q, size (x0)), varargin{:}), x0(:), options);
    x = reshape (x, size (x0));
  unwind_protect_cleanup
    addpath (here);
  end_unwind_protect
end
"""

CORRECTIVE = """
function G = Estimate_G_k (factor, vectors, count, K)
  n = 3 * K;  free = 2 * K^2 - K;  upper = triu (true (n));
  place = zeros (n);  place(upper') = 1:count;  place = place';  % their order of a symmetric matrix's entries
  weight = (upper / sqrt (2) + (1 - 1 / sqrt (2)) * eye (n))(upper);  % SDPT3's order and scale of them
  A = weight .* [vectors(:, 1:count - free), sum(vectors(:, count - free + 1:end), 2)](place(upper), :);
  b = [zeros(count - free, 1); 1];
  [~, X] = sqlp ({"s", n; "s", n}, {A; -A}, {speye(n); speye(n)}, b, struct ("printlevel", 0));
  [U, D] = svd (X{1} - X{2});
  options = optimset ("MaxIter", 5000, "TolFun", 1e-10, "TolX", 1e-10);  % theirs
  G = fminunc (@evalQ_regularization, U(:, 1:3) * sqrt (D(1:3, 1:3)), options, factor);
end
"""

SCRIPT = """
warning ("off", "all");
pkg load signal
svd_driver ("gesdd");  # takes half the time of Octave's default
{paths}
load ("tracks.mat");
began = cputime;
{call}
seconds = cputime - began;
save ("-v7", "shapes.mat", "S", "seconds");
"""


class Failed(Exception):
    """A method gave no shapes; the text says why."""


def run(call: str, tracks: np.ndarray, *, paths: list[Path], seconds: int) -> tuple[np.ndarray, float]:
    """Evaluate Octave statements that make `S (3F, P)` of `W (2F, P)`; return shapes `(F, P, 3)` and the processor seconds of the call.

    The tracks `(F, P, 2)` are complete. Octave searches the last of the folders first, and is ended after so many processor
    seconds.

    Raises
    ------
    Failed
        Octave ended without shapes or took too long, or the shapes are not finite.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "ours").mkdir()
        (folder / "ours" / "fminunc.m").write_text(FMINUNC)
        (folder / "ours" / "Estimate_G_k.m").write_text(CORRECTIVE)
        added = "\n".join(f'addpath ("{path}");' for path in [*paths, folder / "ours"])
        (folder / "call.m").write_text(SCRIPT.format(paths=added, call=call))
        write_tracks(folder / "tracks.mat", tracks)
        before = _spent()
        limited = f"ulimit -t {seconds}; exec octave-cli --quiet call.m"
        ended = subprocess.run(["sh", "-c", limited], cwd=folder, capture_output=True, text=True, check=False)
        if not (folder / "shapes.mat").exists():
            if ended.returncode < 0 and _spent() - before >= 0.8 * seconds:  # a signal, and not for want of memory
                raise Failed(f"more than {seconds} s")
            lines = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
            raise Failed(lines[0].removeprefix("error: ") if lines else f"octave-cli ended with {ended.returncode}")
        return read_shapes(folder / "shapes.mat")


def write_tracks(path: Path, tracks: np.ndarray) -> None:
    """Write tracks `(F, P, 2)` as `W (2F, P)`: the rows x and y of the first frame, then of the second."""
    savemat(path, {"W": tracks.transpose(0, 2, 1).reshape(-1, tracks.shape[1])})


def read_shapes(path: Path) -> tuple[np.ndarray, float]:
    """Read `S (3F, P)` as shapes `(F, P, 3)`, and the processor seconds."""
    found = loadmat(path)
    stacked = found["S"]
    if not np.isfinite(stacked).all() or np.iscomplexobj(stacked):
        raise Failed("shapes that are not finite or not real")
    return stacked.reshape(len(stacked) // 3, 3, -1).transpose(0, 2, 1), float(found["seconds"].item())


def _spent() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
