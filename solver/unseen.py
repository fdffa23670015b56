"""Points that no frame shows: drawn from their neighbours along the surface.

No observation holds such a point, and its prior only says that it is somewhere about the middle; the surface around it knows better. The
minimisation would get there, at the pace of diffusion. Here the surface is closed directly: among all positions of the unseen
points, those of least ‖A X‖², which is the thinnest plate through their seen neighbours.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.iteration import init
from pliant.solver.state import Problem, State
from scipy import sparse
from scipy.sparse import linalg

LOOSE = 1e-6
"""Ridge beside AᵀA, whose diagonal is about 150: points that hang on nothing stay in the middle."""


def close_surface(problem: Problem, state: State) -> State:
    """Return the state with points that are never seen moved to where their neighbours put them."""
    unseen = ~(problem.confidence > 0).any(axis=0)
    if problem.laplacian is None or not unseen.any() or unseen.all():
        return state
    matrix = sparse.csc_array(problem.laplacian.matrix, dtype=np.float64)
    there, elsewhere = matrix[:, np.flatnonzero(unseen)], matrix[:, np.flatnonzero(~unseen)]
    normal = there.T @ there + LOOSE * sparse.eye_array(there.shape[1])
    flat = state.shapes.reshape(-1, state.shapes.shape[2]).astype(np.float64)
    wanted = np.asarray(-(there.T @ (elsewhere @ flat[:, ~unseen].T)))
    filled = flat.copy()
    filled[:, unseen] = linalg.splu(sparse.csc_array(normal)).solve(wanted).T
    shapes = filled.reshape(state.shapes.shape).astype(state.shapes.dtype)
    moved = init(problem, shapes, state.translations)
    return State(
        moved.shapes, moved.translations, moved.omega, moved.rank, state.objective, moved.residual, state.reweighting,
        state.iterations,
    )  # fmt: skip
