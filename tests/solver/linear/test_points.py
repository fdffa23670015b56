"""The per-point inverse with a Gaussian prior, whose modes bend as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver import gallery
from pliant.solver.linear import points
from pliant.solver.linear.block_tridiagonal import stiffness_of_neighbours
from pliant.solver.linear.conjugate_gradient import conjugate_gradient
from pliant.solver.linear.preconditioner import bends, build_preconditioner
from pliant.solver.model.random_walk import walk_bands
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.mesh_laplacian import build_laplacian
from pliant.solver.operators.normal_equations import Operator

FRAMES, POINTS = 16, 400


def operator() -> Operator:
    """A face with a learned prior of few, loose modes, seen exactly."""
    made = gallery.face(FRAMES, POINTS, mesh="triangles")
    time = np.linspace(0, 1, FRAMES)
    modes = np.stack([np.ones(FRAMES), np.sin(5 * time), np.cos(7 * time)], axis=1)
    bands, norm = walk_bands(FRAMES, ordered=True)
    prior = PathPrior.of(bands * norm / 1e-5, (0.3 * modes,) * 3).scaled(3e-5)
    weights = np.full((FRAMES, 2, made.tracks.num_points), 500.0)
    projections = np.asarray(made.rotations)[:, :2]
    return Operator(projections, weights, np.zeros((2, FRAMES)), build_laplacian(made.mesh, "auto"), 1e-3, None, prior)


def test_the_inverse_is_exact_for_a_diagonal_stiffness() -> None:
    given = replace(operator(), laplacian=None)
    stiffness = np.full(given.weights.shape[2], 0.2)
    shapes = np.random.default_rng(0).standard_normal((FRAMES, 3, len(stiffness)))
    found = points.build(given, stiffness)(given.apply(shapes) + 0.2 * shapes)
    np.testing.assert_allclose(found, shapes, atol=1e-6)


def test_bending_modes_need_few_iterations() -> None:
    given = operator()
    assert bends(given)
    assert stiffness_of_neighbours(given).mean() > 0.01
    b = given.right_hand_side(np.random.default_rng(1).standard_normal((FRAMES, 2, given.weights.shape[2])))
    found = conjugate_gradient(
        given.apply, b, precondition=build_preconditioner(given), reduction=1e-3, max_iterations=200
    )
    assert found.iterations < 30
