"""The Gaussian shape prior: how the positions of a point covary over frames and axes, learned from the tracks themselves.

A point's world positions over all frames, x ∈ R^{3F}, are taken as draws from one zero-mean Gaussian with covariance

    Σ = 1 1ᵀ ⊗ A₀  +  C ⊗ A₁,    C = L Lᵀ + τ T,

a mean position with extents A₀ (3×3), deformation whose frames covary by C (F×F: modes L, and a random walk T for what they
leave) and whose axes covary by A₁ (3×3, trace 3). The tracks show two of three coordinates a frame, W = Π X + noise σ² with
Π = blockdiag(s_f R_f); the unseen third is integrated out, not guessed, so that depth is not counted as flat where it is merely
unknown. That is the difference to a penalty on the shapes found (`pliant.solver.energy.low_rank`), which shrinks depth. Expectation
maximisation, as for probabilistic principal components with missing data: Torresani, Hertzmann, Bregler (2008), "Nonrigid
structure-from-motion: estimating shape and motion with hierarchical priors", with frames instead of points as the variables, which
makes everything a matter of the 2F×2F Gram matrix W Wᵀ / P and independent of P.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.model.image_density import Explained, ImageModel, factor_of, inverted
from pliant.solver.model.marginal_likelihood import root_matrix
from pliant.solver.model.random_walk import (
    WalkPosterior,
    coloured,
    random_walk,
    walk_bands,
    whitened,
    whitener,
)
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.records import Floats
from pliant.solver.tracks.noise import roughness
from scipy import linalg

ITERATIONS, FEWEST, FRAMES = 150, 60, 18_000
"""Rounds of expectation maximisation from scratch: so many, fewer where their product with the frames is above the last number, for a
round costs F³. The likelihood still creeps up. Measured with 60, known cameras, horse of 48 frames: .020 instead of .013; 400 gain
no more."""

MOST_MODES = 64
"""Columns of L at most."""

BEGUN_WEIGHT = 1e-3
"""Weight of HᵀH against the data in the shapes to start from, normalised units."""

ABOVE = 2.0
"""A mode counts if its variance is this many times what the random walk explains of it."""

DRIFT_FLOOR = 1e-6
"""Smallest τ, variance per point in normalised units."""

WARM = 1e-2
"""The floor of τ at the first round from scratch, whence it falls to `DRIFT_FLOOR`: annealing. A mode that was given up too early
comes back only slowly. Measured: known cameras, horse .069 → .024, talking face .074 → .022, speaking head .017 → .0002."""

FREED = 0.3
"""Standard deviation, normalised units, that mean positions get as a mode."""

FLATTEST = 1e-3
"""Least variance of deformation along an axis, beside a mean of 1: keeps A₁ invertible."""

NOISE_FLOOR = 1e-8
"""Smallest σ²."""

QUIET = 1e-5
"""σ² to start from: less than any tracker's."""


DENSE_FRAMES = 160
"""Frames up to which a round of expectation maximisation works on 2F×2F matrices, which is then faster."""

GUARD = 8
"""Eigenvectors beyond the modes that are followed from round to round, in which new modes appear."""


@dataclass(frozen=True, slots=True, eq=False)
class ShapeCovariance:
    """Σ and the noise, normalised units."""

    extent: Floats
    """A₀, shape `(3, 3)`."""

    play: Floats
    """A₁, shape `(3, 3)`, trace 3."""

    modes: Floats
    """L, shape `(F, k)`."""

    drift: float
    """τ."""

    noise: float
    """σ², variance of an image coordinate."""

    likelihood: float
    """Negative logarithm, per point and frame, of the covariance this one was improved from; ∞ for the start."""

    def over_frames(self) -> Floats:
        """Return C, shape `(F, F)`."""
        covariance: Floats = self.modes @ self.modes.T + self.drift * random_walk(len(self.modes))
        return covariance

    def of_image(self, pairs: Floats) -> Floats:
        """Return V = ΠΣΠᵀ + σ²I, shape `(2F, 2F)`, for `pairs` (F, 2, 3) of s_f times the first two rows of R_f."""
        rows = pairs.reshape(-1, 3)
        wide = np.repeat(np.repeat(self.over_frames(), 2, axis=0), 2, axis=1)
        image: Floats = rows @ self.extent @ rows.T + (rows @ self.play @ rows.T) * wide
        image[np.diag_indices(len(rows))] += self.noise
        return image

    def image_model(self, pairs: Floats) -> ImageModel:
        """Return the same by its parts."""
        frames, walk = len(pairs), pairs @ root_matrix(self.play)
        middle = (pairs @ root_matrix(self.extent))[:, :, None]
        columns = np.concatenate([middle, self.modes[:, None, :, None] * walk[:, :, None]], axis=2)
        return ImageModel(columns.reshape(2 * frames, -1), walk, self.noise, self.drift)

    def axes(self) -> tuple[Floats, Floats]:
        """Return B (3×3) and a (3,) with A₁ = B Bᵀ and A₀ = B diag(a) Bᵀ: in axes x = B y the coordinates are independent."""
        values, vectors = linalg.eigh(self.extent, self.play)
        return np.asarray(np.linalg.inv(vectors).T, dtype=np.float64), np.maximum(values, 0.0)

    def precisions(self) -> tuple[Floats, PathPrior]:
        """Return B (3×3) and the inverse covariance over frames of each coordinate of y = B⁻¹x."""
        basis, extents = self.axes()
        chain, norm = walk_bands(len(self.modes))
        first, second, third = (
            np.column_stack([self.modes, np.full(len(self.modes), extent**0.5)]) for extent in extents
        )
        return basis, PathPrior.of(chain * (norm / self.drift), (first, second, third))

    def stretched(self, used: NDArray[np.intp], num_frames: int) -> ShapeCovariance:
        """Return the covariance for all of `num_frames` frames when this one belongs to the frames `used`.

        Between two of them the modes run straight, which is what a random walk expects.
        """
        every = np.arange(num_frames)
        modes = [np.interp(every, used, mode) for mode in self.modes.T]
        return replace(self, modes=np.stack(modes, axis=1) if modes else np.zeros((num_frames, 0)))


def learned(
    gram: Floats,
    pairs: Floats,
    *,
    most: int = MOST_MODES,
    noisy: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> ShapeCovariance:
    """Return the most probable of the covariances that expectation maximisation finds from scratch in two ways.

    Annealed, and then once more without, from a start whose mean positions may also be a mode: annealing that has taken the turn
    of an object for deformation does not find back otherwise. Or never annealed. Neither is best for all: measured, known cameras,
    99 frames of faces seen in one sweep of 60°, error .192 annealed, .030 not; a horse of 48 frames .009 and .314. The likelihood tells.

    Parameters
    ----------
    gram, pairs
        As for `begin`.
    most : int
        Columns of L at most.
    noisy : bool
        Begin with all that is rough in the tracks as noise, not with hardly any.
    should_stop : callable, optional
        Asked after every round; once it returns True, the best so far is returned.
    """
    count = min(ITERATIONS, max(FEWEST, FRAMES // len(pairs)))
    warm = freed(annealed(gram, pairs, most=most, noisy=noisy, iterations=count, should_stop=should_stop))
    runs = (
        improve(warm, gram, pairs, iterations=count // 2, most=most, should_stop=should_stop),
        improve(
            scratch(gram, pairs, most, noisy=noisy), gram, pairs,
            iterations=count, most=most, should_stop=should_stop,
        ),
    )  # fmt: skip
    return min(runs, key=lambda run: run.likelihood)


def annealed(
    gram: Floats,
    pairs: Floats,
    *,
    most: int = MOST_MODES,
    noisy: bool = False,
    iterations: int,
    should_stop: Callable[[], bool] | None = None,
) -> ShapeCovariance:
    """Return the covariance that so many annealed rounds find from scratch."""
    start = scratch(gram, pairs, most, noisy=noisy)
    return improve(start, gram, pairs, iterations=iterations, warm=WARM, most=most, should_stop=should_stop)


def freed(covariance: ShapeCovariance) -> ShapeCovariance:
    """Return the same with one more mode, that of mean positions: how much of them is deformation is open anew."""
    constant = np.full((len(covariance.modes), 1), FREED)
    return replace(covariance, modes=np.hstack([covariance.modes, constant]))


def scratch(gram: Floats, pairs: Floats, most: int, *, noisy: bool) -> ShapeCovariance:
    """Return a covariance to start from (`begin`), with the noise that `learned` says."""
    return begin(gram, pairs, noise=max(roughness(gram), QUIET) if noisy else QUIET, most=most)


def begin(gram: Floats, pairs: Floats, *, noise: float = QUIET, most: int = MOST_MODES) -> ShapeCovariance:
    """Return a covariance to start from: that of the shapes of least acceleration in the least-squares sense.

    Parameters
    ----------
    gram : array, shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks, normalised units.
    pairs : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    noise : float
        σ² to start from.
    most : int
        Columns of L at most.
    """
    frames, factor = len(pairs), factor_of(gram)
    seen = pairs.transpose(0, 2, 1) @ factor.reshape(frames, 2, -1)
    walk = WalkPosterior.of(pairs, noise_variance=1.0, walk_variance=walk_bands(frames)[1] / BEGUN_WEIGHT)
    shapes = walk.solve(seen)
    mean = shapes.mean(axis=0)
    extent = mean @ mean.T + 1e-6 * np.eye(3)
    flat = shapes.reshape(frames, -1)
    whole = flat @ flat.T / 3
    middle = whole.mean(axis=0)
    deformed = whole - middle - middle[:, None] + middle.mean()
    modes, drift = _split(deformed, WARM, most)
    return ShapeCovariance(extent, np.eye(3), modes, drift, noise, np.inf)


def improve(
    covariance: ShapeCovariance,
    gram: Floats,
    pairs: Floats,
    *,
    iterations: int,
    warm: float = DRIFT_FLOOR,
    most: int = MOST_MODES,
    should_stop: Callable[[], bool] | None = None,
) -> ShapeCovariance:
    """Return the covariance after rounds of expectation maximisation, with a floor of τ that falls from `warm` to `DRIFT_FLOOR`.

    At a constant floor no round makes the tracks less probable.
    """
    floors = np.geomspace(warm, DRIFT_FLOOR, iterations)
    for better in rounds(covariance, gram, pairs, floors=floors, most=most):
        covariance = better
        if should_stop is not None and should_stop():
            break
    return covariance


def rounds(
    covariance: ShapeCovariance, gram: Floats, pairs: Floats, *, floors: Floats, most: int = MOST_MODES
) -> Iterator[ShapeCovariance]:
    """Yield the covariance after every round of expectation maximisation, each with its floor of τ.

    With V = ΠΣΠᵀ + σ²I and K = V⁻¹(G − V)V⁻¹ every second moment of the posterior is a contraction of K: for a component with
    covariance D and image ΠD, E[xxᵀ] = D + (ΠD)ᵀ K (ΠD). Modes and drift are then the probabilistic principal components
    (Tipping, Bishop 1999) of C seen relative to the random walk. `DENSE_FRAMES` says in which form K is.
    """
    factor, subspace = factor_of(gram), None
    for number, floor in enumerate(floors):
        if len(pairs) <= DENSE_FRAMES:
            covariance = _round(covariance, factor, pairs, floor, most)
        else:
            covariance, subspace = _linear_round(covariance, factor, pairs, floor, most, subspace)
            subspace = np.hstack([subspace, _cosines(len(pairs), GUARD, first=number * GUARD)])
        yield covariance


def _round(covariance: ShapeCovariance, factor: Floats, pairs: Floats, floor: float, most: int) -> ShapeCovariance:
    """Return the covariance after one round, K dense."""
    frames = len(pairs)
    rows = pairs.reshape(2 * frames, 3)
    over_frames = covariance.over_frames()
    wide = np.repeat(np.repeat(over_frames, 2, axis=0), 2, axis=1)
    by_extent, by_play = rows @ covariance.extent, rows @ covariance.play
    deform = by_play @ rows.T
    image = deform * wide
    image += by_extent @ rows.T
    image[np.diag_indices(2 * frames)] += covariance.noise
    inverse, log_det = inverted(image)
    explained = inverse @ factor
    surplus = explained @ explained.T
    surplus -= inverse
    wide *= surplus
    deform *= surplus
    moved = deform[0::2, 0::2] + deform[0::2, 1::2] + deform[1::2, 0::2] + deform[1::2, 1::2]
    modes, drift = _split(over_frames + over_frames @ moved @ over_frames / 3, floor, most)
    return _improved(
        covariance, modes, drift,
        extent=covariance.extent + by_extent.T @ surplus @ by_extent,
        play=covariance.play + by_play.T @ wide @ by_play / frames,
        surplus=float(np.trace(surplus)) / (2 * frames),
        nll=0.5 * (log_det + float((explained * factor).sum())) / frames,
    )  # fmt: skip


def _linear_round(
    covariance: ShapeCovariance, factor: Floats, pairs: Floats, floor: float, most: int, subspace: Floats | None
) -> tuple[ShapeCovariance, Floats]:
    """Return the covariance after one round in time linear in the frames, and the subspace to begin the next one with.

    All contractions but the modes are derivatives of `image_density` already. With root rootᵀ = T⁻¹ and C̃ = rootᵀ C root the modes are the
    leading eigenvectors of C̃ + C̃ m C̃/3, of which only products and the trace are needed: one step of Nyström's method a round, from the
    eigenvectors of the round before and `GUARD` more.
    """
    frames, count = covariance.modes.shape
    root0, root1 = root_matrix(covariance.extent), root_matrix(covariance.play)
    model = covariance.image_model(pairs)
    walk, columns = model.walk, model.columns.reshape(frames, 2, count + 1, 3)
    seen = Explained.of(model, factor)
    found = seen.terms()
    by_columns = -frames * found.by_columns.reshape(columns.shape)
    by_walk = -frames * found.by_walk  # [K B (τT ⊗ I)]_ff
    extents = np.einsum("fic,fid->cd", columns[:, :, 0], by_columns[:, :, 0])
    own, by_own = (each[:, :, 1:].transpose(2, 0, 1, 3).reshape(count, -1) for each in (columns, by_columns))
    plays = own.reshape(-1, 3).T @ by_own.reshape(-1, 3) + np.einsum("fic,fid->cd", walk, by_walk)
    along = whitened(covariance.modes)

    def spread(vectors: Floats) -> Floats:  # C̃ times them
        result: Floats = along @ (along.T @ vectors) + covariance.drift * vectors
        return result

    def product(vectors: Floats) -> Floats:
        wide = spread(vectors)
        images = walk[:, :, :, None] * coloured(wide)[:, None, None]
        moved = seen.surplus(images.reshape(2 * frames, -1)).reshape(frames, 6, -1)
        return wide + spread(coloured((walk.reshape(frames, 1, 6) @ moved)[:, 0], transposed=True)) / 3

    inner = own @ by_own.T
    square = along.T @ along + 2 * covariance.drift * np.eye(count)
    total = float((along**2).sum()) + frames * covariance.drift
    total += (float((square * inner).sum()) + covariance.drift * float((walk * by_walk).sum())) / 3
    values, vectors = _nystrom(product, np.hstack([along, _cosines(frames, most)]) if subspace is None else subspace)
    modes, drift = _kept(values, vectors, total, floor, min(most, frames - 1))
    better = _improved(
        covariance, coloured(modes), drift,
        extent=root0 @ (np.eye(3) + extents) @ root0.T,
        play=root1 @ (np.eye(3) + plays / frames) @ root1.T,
        surplus=-found.by_noise,
        nll=found.value,
    )  # fmt: skip
    return better, vectors[:, : modes.shape[1] + GUARD]


def _cosines(frames: int, count: int, *, first: int = 0) -> Floats:
    """Return `count` cosines of rising frequency, orthonormal but for the constant, shape `(F, count)`; after the last comes the first."""
    frequencies = (first + np.arange(min(count, frames))) % frames
    return np.asarray(np.cos(np.pi * np.outer(np.arange(frames) + 0.5, frequencies) / frames) * (2 / frames) ** 0.5)


def _nystrom(product: Callable[[Floats], Floats], begun: Floats) -> tuple[Floats, Floats]:
    """Return leading eigenvalues, falling, and eigenvectors of a positive semidefinite matrix, given its product with a basis.

    Williams and Seeger (2001), "Using the Nyström method to speed up kernel machines", for a basis of any columns.
    """
    basis, _ = np.linalg.qr(begun)
    image = product(basis)
    held, turn = np.linalg.eigh(_symmetric(basis.T @ image))
    usable = held > 1e-12 * held[-1]
    root = (image @ turn[:, usable]) / np.sqrt(held[usable])
    values, turn = np.linalg.eigh(root.T @ root)
    values, vectors = values[::-1], (root @ turn)[:, ::-1]
    return values, vectors / np.linalg.norm(vectors, axis=0)


def _kept(values: Floats, vectors: Floats, total: float, floor: float, most: int) -> tuple[Floats, float]:
    """Return L in white coordinates and τ as `_split` does, from leading eigenvalues, eigenvectors, and the sum of all."""
    frames, most = len(vectors), min(most, len(values))
    drift = max((total - float(values[:most].sum())) / (frames - most), floor)
    count = min(most, int((values > ABOVE * drift).sum()))
    drift = max((total - float(values[:count].sum())) / (frames - count), floor)
    return vectors[:, :count] * np.sqrt(np.maximum(values[:count] - drift, 0.0)), drift


def _improved(
    covariance: ShapeCovariance,
    modes: Floats,
    drift: float,
    *,
    extent: Floats,
    play: Floats,
    surplus: float,
    nll: float,
) -> ShapeCovariance:
    """Return the covariance with new moments; `surplus`: mean of K's diagonal, `nll`: of the covariance before."""
    return ShapeCovariance(
        extent=_symmetric(extent),
        play=_symmetric(play * (3 / np.trace(play)) + FLATTEST * np.eye(3)) / (1 + FLATTEST),
        modes=modes,
        drift=drift,
        noise=max(covariance.noise * (1 + covariance.noise * surplus), NOISE_FLOOR),
        likelihood=nll,
    )


def _split(over_frames: Floats, floor: float, most: int) -> tuple[Floats, float]:
    """Return L and τ with C ≈ L Lᵀ + τ T: principal components in coordinates in which the random walk is white."""
    frames = len(over_frames)
    root = whitener(frames)
    values, vectors = np.linalg.eigh(_symmetric(root.T @ over_frames @ root))
    values, vectors = values[::-1], vectors[:, ::-1]
    most = min(most, frames - 1)
    drift = max(float(values[most:].mean()), floor)
    count = min(most, int((values > ABOVE * drift).sum()))
    drift = max(float(values[count:].mean()), floor)
    scaled = vectors[:, :count] * np.sqrt(np.maximum(values[:count] - drift, 0.0))
    return linalg.solve_triangular(root, scaled, lower=True, trans="T"), drift


def _symmetric(matrix: Floats) -> Floats:
    return np.asarray((matrix + matrix.T) / 2)
