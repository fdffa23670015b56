"""Call other authors' Octave functions: write the tracks to a file, run a generated script, read the shapes back.

This project contains none of their code. `FMINUNC` and `CORRECTIVE` are its own and precede Octave's and the authors' functions on the
path:

- Octave's `fminunc` accepts neither a matrix as starting point nor extra arguments for the objective; MATLAB's accepts both.
- BMM formulates its convex program in YALMIP, which takes minutes to build it in Octave. `CORRECTIVE` passes the same program directly
  to the same solver, SDPT3: the nuclear norm of a symmetric matrix Q = X₁ − X₂ is the minimum of tr X₁ + tr X₂ over positive
  semidefinite X₁ and X₂. With K = 5 on the face landmarks, both reach .5461.
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
    """A method returned no shapes; the message gives the reason."""


def run(call: str, tracks: np.ndarray, *, paths: list[Path], seconds: int) -> tuple[np.ndarray, float]:
    """Evaluate Octave statements that compute `S (3F, P)` from `W (2F, P)`; return shapes `(F, P, 3)` and processor seconds.

    The tracks `(F, P, 2)` must be complete. Octave searches the last of `paths` first and is killed after `seconds` of processor time.

    Raises
    ------
    Failed
        Octave ended without shapes or exceeded the time, or the shapes are not finite and real.
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
            if ended.returncode < 0 and _spent() - before >= 0.8 * seconds:  # killed for its time, not for its memory
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
