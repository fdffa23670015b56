"""Dense non-rigid structure from motion: 2-D tracks in, a 3-D shape for every frame out.

Numerics only: no environment variables, logging set-up or network, and no files except temporary ones in a given folder. Names are
imported on first access, so importing a record or an error does not load the solver.
"""

if __name__ != "pliant.solver":
    raise ImportError(f"import this folder as pliant.solver, not as {__name__!r}: install it with pip install -e .")

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.solver.errors import InvalidInput, InvalidSettings, NotFinite, SolverError
    from pliant.solver.mesh import Mesh
    from pliant.solver.reconstruct import solve
    from pliant.solver.reconstruction.cameras import Cameras, estimate_cameras
    from pliant.solver.reconstruction.prior import Prior, learn_prior
    from pliant.solver.reconstruction.solve_shapes import solve_shapes
    from pliant.solver.reconstruction.start import find_outliers
    from pliant.solver.records import Camera, Choices, KnownCamera, Step, Tracks
    from pliant.solver.settings import Settings
    from pliant.solver.solution import Outcome, Solution, Trace
    from pliant.solver.threads import threads_limited

_HOMES = {
    "errors": (
        "InvalidInput",
        "InvalidSettings",
        "NotFinite",
        "SolverError",
    ),
    "threads": ("threads_limited",),
    "reconstruct": ("solve",),
    "reconstruction.cameras": ("Cameras", "estimate_cameras"),
    "reconstruction.prior": ("Prior", "learn_prior"),
    "reconstruction.solve_shapes": ("solve_shapes",),
    "reconstruction.start": ("find_outliers",),
    "mesh": ("Mesh",),
    "records": ("Camera", "Choices", "KnownCamera", "Step", "Tracks"),
    "solution": ("Outcome", "Solution", "Trace"),
    "settings": ("Settings",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Camera",
    "Cameras",
    "Choices",
    "InvalidInput",
    "InvalidSettings",
    "KnownCamera",
    "Mesh",
    "NotFinite",
    "Outcome",
    "Prior",
    "Settings",
    "Solution",
    "SolverError",
    "Step",
    "Trace",
    "Tracks",
    "estimate_cameras",
    "find_outliers",
    "learn_prior",
    "solve",
    "solve_shapes",
    "threads_limited",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'pliant.solver' has no attribute {name!r}")
    return getattr(import_module(f"pliant.solver.{_HOME_OF[name]}"), name)
