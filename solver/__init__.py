"""Dense non-rigid structure from motion: tracks in, a shape for every frame out.

Numerics alone: no files, no environment, no logging set-up, no network.
"""

if __name__ != "pliant.solver":
    raise ImportError(f"import this folder as pliant.solver, not as {__name__!r}: install it with pip install -e .")

from pliant.solver.errors import InvalidInput, InvalidSettings, NotFinite, SolverError
from pliant.solver.parallel import threads_limited
from pliant.solver.reconstruct import solve
from pliant.solver.records import Camera, Choices, KnownCamera, Mesh, Outcome, Solution, Step, Trace, Tracks
from pliant.solver.settings import Settings

__all__ = [
    "Camera",
    "Choices",
    "InvalidInput",
    "InvalidSettings",
    "KnownCamera",
    "Mesh",
    "NotFinite",
    "Outcome",
    "Settings",
    "Solution",
    "SolverError",
    "Step",
    "Trace",
    "Tracks",
    "solve",
    "threads_limited",
]
