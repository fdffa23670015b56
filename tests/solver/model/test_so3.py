"""The exponential map and its Jacobian are exact to rounding at every angle, also where the closed forms are 0/0."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver.model.so3 import exponential, exponential_and_jacobian, hat, vee
from scipy.linalg import expm


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-12, 1e-8, 1e-4, 1e-2, 1.0, np.pi])
def test_exponential_and_jacobian_are_those_of_the_matrix_exponential(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3
    rotation, jacobian = exponential_and_jacobian(angle * axis)
    # exp of [[K, I], [0, 0]] has exp(K) and the integral of exp(tK) over t from 0 to 1, which is J
    whole = expm(np.block([[hat(angle * axis), np.eye(3)], [np.zeros((3, 6))]]))
    np.testing.assert_allclose(rotation, whole[:3, :3], rtol=0, atol=2e-15)
    np.testing.assert_allclose(jacobian, whole[:3, 3:], rtol=0, atol=2e-15)
    np.testing.assert_allclose(rotation - rotation.T, 2 * np.sin(angle) * hat(axis), rtol=0, atol=2e-15 * angle)


def test_vee_is_the_transpose_of_hat_for_stacks_of_any_shape() -> None:
    random = np.random.default_rng(1)
    matrices, vectors = random.normal(size=(2, 5, 3, 3)), random.normal(size=(2, 5, 3))
    np.testing.assert_allclose((matrices * hat(vectors)).sum(axis=(-2, -1)), (vee(matrices) * vectors).sum(axis=-1))
    np.testing.assert_allclose(hat(vectors) @ vectors[..., None], np.zeros((2, 5, 3, 1)), atol=1e-15)
    assert exponential(np.zeros((0, 3))).shape == (0, 3, 3)
