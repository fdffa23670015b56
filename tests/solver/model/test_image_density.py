"""The density of a point's images: both forms against the definition, their gradients against each other and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.model.image_density import (
    ImageModel,
    dense_terms,
    factor_of,
    inverted,
    negative_log_likelihoods,
    terms,
    woodbury_terms,
)
from pliant.solver.model.random_walk import WalkPosterior, random_walk
from pliant.solver.model.so3 import exponential

GRADIENTS = ("by_columns", "by_walk", "by_noise_variance", "by_walk_variance")


def drawn(
    frames: int, modes: int, *, points: int = 30, noise: float = 0.05, drift: float = 0.02
) -> tuple[ImageModel, np.ndarray]:
    """A model, and tracks that it nearly explains."""
    random = np.random.default_rng(frames)
    projections = exponential(np.cumsum(random.normal(0, 0.1, (frames, 3)), axis=0))[:, :2] * random.uniform(
        0.8, 1.2, (frames, 1, 1)
    )
    along = np.cumsum(random.normal(0, 1 / frames**0.5, (frames, modes)), axis=0)
    columns = np.concatenate([projections, *(projections * each[:, None, None] for each in along.T)], axis=2).reshape(
        2 * frames, -1
    )
    walk = projections @ np.linalg.cholesky(np.diag([1.4, 1.0, 0.6]))
    model = ImageModel(columns, walk, noise**2, drift)
    tracks = columns @ random.normal(size=(columns.shape[1], points)) + noise * random.normal(size=(2 * frames, points))
    return model, tracks / points**0.5


@pytest.mark.parametrize("frames", [3, 8, 9, 31])
@pytest.mark.parametrize("modes", [0, 4])
@pytest.mark.parametrize("drift", [1e-10, 0.02])
def test_both_forms_agree(frames: int, modes: int, drift: float) -> None:
    model, factor = drawn(frames, modes, drift=drift)
    dense, low_rank = dense_terms(model, factor), woodbury_terms(model, factor)
    assert low_rank.value == pytest.approx(dense.value, rel=1e-10)
    for name in GRADIENTS:
        expected = getattr(dense, name)
        np.testing.assert_allclose(getattr(low_rank, name), expected, atol=1e-8 * np.abs(expected).max())


def test_the_value_matches_the_definition() -> None:
    model, factor = drawn(9, 2)
    image = model.covariance()
    expected = (np.linalg.slogdet(image)[1] + np.trace(np.linalg.solve(image, factor @ factor.T))) / len(image)
    assert woodbury_terms(model, factor).value == pytest.approx(expected, rel=1e-12)


def test_the_gradient_matches_finite_differences_of_the_value() -> None:
    model, factor = drawn(9, 2)
    found, step = woodbury_terms(model, factor), 1e-6
    random = np.random.default_rng(0)
    columns, walk = random.normal(size=model.columns.shape), random.normal(size=model.walk.shape)

    def moved(size: float) -> float:
        other = ImageModel(
            model.columns + size * columns, model.walk + size * walk,
            model.noise_variance * (1 + size), model.walk_variance * (1 + 2 * size),
        )  # fmt: skip
        return woodbury_terms(other, factor).value

    slope = (moved(step) - moved(-step)) / (2 * step)
    expected = (found.by_columns * columns).sum() + (found.by_walk * walk).sum()
    expected += found.by_noise_variance * model.noise_variance + 2 * found.by_walk_variance * model.walk_variance
    assert slope == pytest.approx(expected, rel=1e-6)


def test_very_low_noise_does_not_lose_precision() -> None:
    model, factor = drawn(20, 3, noise=1e-4, drift=1e-6)
    image = model.covariance().astype(np.longdouble)
    rough = np.linalg.solve(image.astype(float), factor)
    exact = rough + np.linalg.solve(image.astype(float), (factor - image @ rough).astype(float))  # refined once
    expected = (np.linalg.slogdet(image.astype(float))[1] + (factor * exact).sum()) / len(image)
    assert woodbury_terms(model, factor).value == pytest.approx(expected, rel=1e-10)


def test_terms_use_woodbury_for_long_and_dense_for_short_sequences() -> None:
    model, factor = drawn(100, 3)
    np.testing.assert_allclose(terms(model, factor).by_columns, woodbury_terms(model, factor).by_columns, atol=1e-12)
    model, factor = drawn(20, 3)
    np.testing.assert_array_equal(terms(model, factor).by_columns, dense_terms(model, factor).by_columns)


def test_a_gram_factor_has_about_one_column_per_point() -> None:
    _, factor = drawn(40, 3, points=11)
    found = factor_of(factor @ factor.T)
    assert 11 <= found.shape[1] <= 13
    np.testing.assert_allclose(found @ found.T, factor @ factor.T, atol=1e-13)


def test_the_walk_posterior_matches_its_dense_precision() -> None:
    frames = 19
    model, _ = drawn(frames, 0)
    images = np.zeros((2 * frames, 3 * frames))
    for index, block in enumerate(model.walk):
        images[2 * index : 2 * index + 2, 3 * index : 3 * index + 3] = block
    precision = np.linalg.inv(np.kron(0.02 * random_walk(frames, ordered=True), np.eye(3))) + images.T @ images / 0.0025
    walk = WalkPosterior.of(model.walk, noise_variance=0.0025, walk_variance=0.02, ordered=True)
    columns = np.random.default_rng(0).normal(size=(frames, 3, 4))
    expected = np.linalg.solve(precision, columns.reshape(3 * frames, 4)).reshape(columns.shape)
    np.testing.assert_allclose(walk.solve(columns), expected, atol=1e-12)
    blocks = np.linalg.inv(precision).reshape(frames, 3, frames, 3)
    np.testing.assert_allclose(walk.variances, np.einsum("fcfd->fcd", blocks), atol=1e-12)


@pytest.mark.parametrize("form", [terms, woodbury_terms])
def test_non_finite_or_indefinite_input_raises(form: object) -> None:
    model, factor = drawn(6, 1)
    with pytest.raises(np.linalg.LinAlgError), np.errstate(all="ignore"):
        form(replace(model, walk=np.full_like(model.walk, np.inf)), factor)  # type: ignore[operator]
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        inverted(-np.eye(3))
    with pytest.raises(np.linalg.LinAlgError, match="finite"), np.errstate(all="ignore"):
        terms(model, np.full_like(factor, np.inf))


@pytest.mark.parametrize("frames", [9, 100])
def test_the_nll_of_each_point_matches_the_definition(frames: int) -> None:
    model, factor = drawn(frames, 2)
    image = model.covariance()
    expected = np.linalg.slogdet(image)[1] + (factor * np.linalg.solve(image, factor)).sum(axis=0)
    np.testing.assert_allclose(negative_log_likelihoods(model, factor), expected / (2 * frames), rtol=1e-9)
