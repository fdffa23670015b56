"""Leading eigenvectors of the Gram matrices of long films."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import Settings
from pliant.solver.cameras import factorization
from pliant.solver.cameras.factorization import leading_eigenpairs, upgrade, upgrades
from pliant.solver.cameras.planar_ambiguity import is_planar
from pliant.solver.cameras.scale import rigid_evidence
from pliant.solver.gallery import face
from pliant.solver.pulse import pulses_to
from pliant.solver.records import Floats
from pliant.solver.tracks.matrix import columns


@pytest.fixture(scope="module")
def gram() -> Floats:
    points = face(120, 100).tracks.points
    flat = columns(points - points.mean(axis=1, keepdims=True))
    flat = flat / np.sqrt((flat**2).mean()) + np.random.default_rng(0).normal(0, 1e-3, flat.shape)
    return flat @ flat.T / 100


def test_orthogonal_iteration_finds_the_leading_eigenpairs(gram: Floats, monkeypatch: pytest.MonkeyPatch) -> None:
    values, vectors = leading_eigenpairs(gram, 9)
    assert (np.diff(values) <= 0).all()
    np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, gram, atol=1e-4 * values[0])
    monkeypatch.setattr(factorization, "DENSE_ROWS", 100)
    found, basis = leading_eigenpairs(gram, 9)
    np.testing.assert_allclose(found, values, rtol=1e-3)
    np.testing.assert_allclose(found[:6], values[:6], rtol=1e-10)
    np.testing.assert_allclose(np.abs((basis * vectors).sum(axis=0))[:6], 1, atol=1e-8)
    np.testing.assert_array_equal(basis, leading_eigenpairs(gram, 9)[1])


def test_cameras_of_long_films_are_those_of_the_whole_decomposition(
    gram: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = upgrade(gram, 1).rotations, rigid_evidence(gram, Settings()), is_planar(gram)
    monkeypatch.setattr(factorization, "DENSE_ROWS", 100)
    monkeypatch.setattr(np.linalg, "eigvalsh", None)  # cubic in the frames
    whole = np.linalg.eigh
    monkeypatch.setattr(np.linalg, "eigh", lambda matrix: None if len(matrix) == len(gram) else whole(matrix))
    after = upgrade(gram, 1).rotations, rigid_evidence(gram, Settings()), is_planar(gram)
    mirror = np.diag([1.0, 1.0, np.sign((after[0][:, 0, 2] * before[0][:, 0, 2]).sum())])  # the sign of depth is free
    np.testing.assert_allclose(after[0], mirror @ before[0] @ mirror, atol=1e-6)
    np.testing.assert_allclose(after[1][0], before[1][0], atol=1e-8)
    assert (after[1][1], after[2]) == (before[1][1], before[2])


def test_the_factorization_of_long_films_reports_progress(gram: Floats, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factorization, "DENSE_ROWS", 100)
    pulses: list[None] = []
    with pulses_to(lambda: pulses.append(None)):
        leading_eigenpairs(gram, 9)
    assert len(pulses) == factorization.ITERATIONS


def test_too_few_points_for_any_factorization_give_none(gram: Floats) -> None:
    assert list(upgrades(gram, [])) == []
