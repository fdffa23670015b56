"""The shape covariance (`model.shape_covariance`), learned by expectation maximisation from tracks and their cameras.

This is probabilistic PCA with missing data, as in Torresani, Hertzmann, Bregler (2008), "Nonrigid structure-from-motion:
estimating shape and motion with hierarchical priors". Here the variables are frames instead of points, so that all
statistics are in the 2F×2F Gram matrix W Wᵀ / P and the cost does not depend on P.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.model.image_density import Explained, factor_of, inverted
from pliant.solver.model.marginal_likelihood import root_matrix
from pliant.solver.model.random_walk import WalkPosterior, coloured, walk_bands, whitened, whitener
from pliant.solver.model.shape_covariance import AXIS_VARIANCE_FLOOR, NOISE_VARIANCE_FLOOR, ShapeCovariance
from pliant.solver.model.so3 import IDENTITY
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from pliant.solver.tracks.noise import roughness
from scipy.linalg import lapack

MAX_ITERATIONS, MIN_ITERATIONS, ITERATION_FRAMES = 150, 60, 18_000
"""EM rounds from scratch: min(MAX_ITERATIONS, max(MIN_ITERATIONS, ITERATION_FRAMES // F)), since a dense round costs F³.
Horse of 48 frames, known cameras: error .020 after 60 rounds, .013 after 150, no lower after 400."""

MAX_MODES = 64
"""Maximum number of columns of L."""

START_SMOOTHNESS = 1e-3
"""Weight of HᵀH against the data in the starting shapes, normalized units."""

MODE_VARIANCE_RATIO = 2.0
"""Minimum ratio of a mode's variance to the variance of the random walk along it; weaker modes are dropped."""

WALK_VARIANCE_FLOOR = 1e-6
"""Floor of τ, variance per point in normalized units."""

ANNEALING_START = 1e-2
"""Floor of τ in the first annealed round, variance in normalized units; it falls to `WALK_VARIANCE_FLOOR`. A mode
dropped early recovers only slowly, so early rounds keep a high floor: horse, known cameras, error .069 without,
.024 with."""

MEAN_MODE_STD = 0.3
"""Standard deviation, normalized units, of the mode that `freed` adds for the mean positions."""

START_NOISE_VARIANCE = 1e-5
"""σ² at the start, normalized units squared: below that of any tracker."""


MAX_DENSE_FRAMES = 160
"""Maximum number of frames for which an EM round works on dense 2F×2F matrices, which is then the faster form."""

GUARD_VECTORS = 8
"""Eigenvectors beyond the modes that are carried from round to round, from which new modes emerge."""


@dataclass(frozen=True, slots=True)
class ModelOrder:
    """Limits with which the covariance is learned."""

    max_modes: int = MAX_MODES
    """Maximum number of modes, the columns of L."""

    noisy_start: bool = False
    """Whether EM starts with the roughness of the tracks as its noise, instead of a low noise."""

    ordered: bool = True
    """True for a film, False for photographs in no order."""


def learned(
    gram: Floats,
    projections: Floats,
    model_order: ModelOrder,
    *,
    iterations: int = MAX_ITERATIONS,
    should_stop: ShouldStop = never,
) -> ShapeCovariance:
    """Return the more probable of two covariances learned by EM from scratch.

    The first run is annealed, then continued without annealing with the mean position added as a mode, which undoes a
    rotation that annealing mistook for deformation. The second run is never annealed. Neither is better on all data, so
    the likelihood decides.

    Parameters
    ----------
    gram : array, shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks, normalized units.
    projections : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    model_order : ModelOrder
        Maximum number of modes, and the starting noise.
    iterations : int
        Maximum number of EM rounds of a run.
    should_stop : callable, optional
        Called after every round; once it returns True, the best so far is returned.
    """
    count = min(iterations, max(MIN_ITERATIONS, ITERATION_FRAMES // len(projections)))
    max_modes = model_order.max_modes
    warm = freed(annealed(gram, projections, model_order, iterations=count, should_stop=should_stop))
    cold = scratch(gram, projections, model_order)
    runs = (
        improve(warm, gram, projections, iterations=count // 2, max_modes=max_modes, should_stop=should_stop),
        improve(cold, gram, projections, iterations=count, max_modes=max_modes, should_stop=should_stop),
    )
    return min(runs, key=lambda run: run.nll)


def annealed(
    gram: Floats,
    projections: Floats,
    model_order: ModelOrder,
    *,
    iterations: int,
    should_stop: ShouldStop = never,
) -> ShapeCovariance:
    """Return the covariance after `iterations` annealed rounds from scratch."""
    return improve(
        scratch(gram, projections, model_order), gram, projections, iterations=iterations, warm=ANNEALING_START,
        max_modes=model_order.max_modes, should_stop=should_stop,
    )  # fmt: skip


def freed(covariance: ShapeCovariance) -> ShapeCovariance:
    """Return the covariance with the mean position added as a mode, for EM to reassign."""
    constant = np.full((len(covariance.modes), 1), MEAN_MODE_STD)
    return replace(covariance, modes=np.hstack([covariance.modes, constant]))


def scratch(gram: Floats, projections: Floats, model_order: ModelOrder) -> ShapeCovariance:
    """Return the starting covariance of least-squares shapes with least change between frames; if unordered, with least deformation.

    Parameters
    ----------
    gram : array, shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks, normalized units.
    projections : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    model_order : ModelOrder
        Maximum number of modes, and the starting noise.
    """
    frames, factor, ordered = len(projections), factor_of(gram), model_order.ordered
    if ordered:
        seen = projections.transpose(0, 2, 1) @ factor.reshape(frames, 2, -1)
        walk_variance = walk_bands(frames, ordered)[1] / START_SMOOTHNESS
        walk = WalkPosterior.of(projections, noise_variance=1.0, walk_variance=walk_variance, ordered=ordered)
        shapes = walk.solve(seen)
    else:
        rigid = np.linalg.pinv(projections.reshape(-1, 3)) @ factor
        shapes = rigid + np.linalg.pinv(projections) @ (factor.reshape(frames, 2, -1) - projections @ rigid)
    mean = shapes.mean(axis=0)
    mean_covariance = mean @ mean.T + 1e-6 * np.eye(3)
    flat = shapes.reshape(frames, -1)
    whole = flat @ flat.T / 3
    middle = whole.mean(axis=0)
    deformed = whole - middle - middle[:, None] + middle.mean()
    modes, walk_variance = _split(deformed, ANNEALING_START, model_order.max_modes, ordered=ordered)
    noise_variance = max(roughness(gram), START_NOISE_VARIANCE) if model_order.noisy_start else START_NOISE_VARIANCE
    return ShapeCovariance(mean_covariance, np.eye(3), modes, walk_variance, noise_variance, np.inf, ordered)


def improve(
    covariance: ShapeCovariance,
    gram: Floats,
    projections: Floats,
    *,
    iterations: int,
    warm: float = WALK_VARIANCE_FLOOR,
    max_modes: int = MAX_MODES,
    should_stop: ShouldStop = never,
) -> ShapeCovariance:
    """Return the covariance after rounds of EM with a floor of τ that falls from `warm` to `WALK_VARIANCE_FLOOR`.

    At a constant floor the likelihood never decreases.
    """
    floors = np.geomspace(warm, WALK_VARIANCE_FLOOR, iterations)
    for better in rounds(covariance, gram, projections, floors=floors, max_modes=max_modes):
        covariance = better
        if should_stop():
            break
    return covariance


def rounds(
    covariance: ShapeCovariance, gram: Floats, projections: Floats, *, floors: Floats, max_modes: int
) -> Iterator[ShapeCovariance]:
    """Yield the covariance after every round of EM, each with its floor of τ.

    With V = ΠΣΠᵀ + σ²I and K = V⁻¹(G − V)V⁻¹, every second moment of the posterior is a contraction of K: for a
    component with covariance D and image ΠD, E[xxᵀ] = D + (ΠD)ᵀ K (ΠD). Modes and walk variance are the probabilistic
    principal components (Tipping, Bishop 1999) of C relative to the random walk. `MAX_DENSE_FRAMES` selects the dense
    or the factored form of K.
    """
    factor, subspace = factor_of(gram), None
    for number, floor in enumerate(floors):
        if len(projections) <= MAX_DENSE_FRAMES:
            covariance = _round(covariance, factor, projections, floor, max_modes)
        else:
            covariance, subspace = _linear_round(covariance, factor, projections, floor, max_modes, subspace)
            subspace = np.hstack([subspace, _cosines(len(projections), GUARD_VECTORS, first=number * GUARD_VECTORS)])
        yield covariance


def _round(
    covariance: ShapeCovariance, factor: Floats, projections: Floats, floor: float, max_modes: int
) -> ShapeCovariance:
    """Return the covariance after one round with dense K."""
    frames = len(projections)
    rows = projections.reshape(2 * frames, 3)
    over_frames = covariance.over_frames()
    wide = over_frames.repeat(2, axis=0).repeat(2, axis=1)
    by_mean, by_axes = rows @ covariance.mean_covariance, rows @ covariance.axis_covariance
    deform = by_axes @ rows.T
    image = deform * wide
    image += by_mean @ rows.T
    image.ravel()[:: 2 * frames + 1] += covariance.noise_variance
    inverse, log_det = inverted(image)
    explained = inverse @ factor
    surplus = explained @ explained.T
    surplus -= inverse
    wide *= surplus
    deform *= surplus
    paired = deform[0::2] + deform[1::2]
    moved = paired[:, 0::2] + paired[:, 1::2]
    modes, walk_variance = _split(
        over_frames + over_frames @ moved @ over_frames / 3, floor, max_modes, ordered=covariance.ordered
    )
    return _improved(
        covariance, modes, walk_variance,
        mean_covariance=covariance.mean_covariance + by_mean.T @ surplus @ by_mean,
        axis_covariance=covariance.axis_covariance + by_axes.T @ wide @ by_axes / frames,
        surplus=float(surplus.trace()) / (2 * frames),
        nll=0.5 * (log_det + float(np.vdot(explained, factor))) / frames,
    )  # fmt: skip


def _linear_round(
    covariance: ShapeCovariance,
    factor: Floats,
    projections: Floats,
    floor: float,
    max_modes: int,
    subspace: Floats | None,
) -> tuple[ShapeCovariance, Floats]:
    """Return the covariance after one round in time linear in the frames, and the subspace for the next round.

    All contractions except those for the modes are derivatives of `image_density`. With root rootᵀ = T⁻¹ and C̃ =
    rootᵀ C root, the modes are the leading eigenvectors of C̃ + C̃ m C̃/3, of which only products and the trace are
    needed: one Nyström step per round, from the eigenvectors of the previous round and `GUARD_VECTORS` more.
    """
    frames, count = covariance.modes.shape
    root0, root1 = root_matrix(covariance.mean_covariance), root_matrix(covariance.axis_covariance)
    model = covariance.image_model(projections)
    walk, columns = model.walk, model.columns.reshape(frames, 2, count + 1, 3)
    seen = Explained.of(model, factor)
    found = seen.terms()
    by_columns = -frames * found.by_columns.reshape(columns.shape)
    by_walk = -frames * found.by_walk  # [K B (τT ⊗ I)]_ff
    mean_moments = np.einsum("fic,fid->cd", columns[:, :, 0], by_columns[:, :, 0])
    own, by_own = (each[:, :, 1:].transpose(2, 0, 1, 3).reshape(count, 6 * frames) for each in (columns, by_columns))
    axis_moments = own.reshape(-1, 3).T @ by_own.reshape(-1, 3) + np.einsum("fic,fid->cd", walk, by_walk)
    along, ordered = whitened(covariance.modes, ordered=covariance.ordered), covariance.ordered
    inner = own @ by_own.T
    square = along.T @ along + 2 * covariance.walk_variance * np.eye(count)
    total = float((along**2).sum()) + frames * covariance.walk_variance
    total += (float((square * inner).sum()) + covariance.walk_variance * float((walk * by_walk).sum())) / 3
    begun = np.hstack([along, _cosines(frames, max_modes)]) if subspace is None else subspace
    if begun.shape[1] == 0:  # no modes exist and none are allowed: only the walk is improved
        begun = _cosines(frames, 1)
    values, vectors = _nystrom(_mode_operator(covariance, along, walk, seen), begun)
    modes, walk_variance = _kept(values, vectors, total, floor, min(max_modes, frames - 1))
    better = _improved(
        covariance, coloured(modes, ordered=ordered), walk_variance,
        mean_covariance=root0 @ (np.eye(3) + mean_moments) @ root0.T,
        axis_covariance=root1 @ (np.eye(3) + axis_moments / frames) @ root1.T,
        surplus=-found.by_noise_variance,
        nll=found.value,
    )  # fmt: skip
    return better, vectors[:, : modes.shape[1] + GUARD_VECTORS]


def _mode_operator(
    covariance: ShapeCovariance, along: Floats, walk: Floats, seen: Explained
) -> Callable[[Floats], Floats]:
    """Return a function that applies C̃ + C̃ m C̃/3 to columns; `along` are the whitened modes, `walk` the images of the random walk."""
    frames, ordered = len(along), covariance.ordered

    def spread(vectors: Floats) -> Floats:  # C̃ times vectors
        result: Floats = along @ (along.T @ vectors) + covariance.walk_variance * vectors
        return result

    def product(vectors: Floats) -> Floats:
        wide = spread(vectors)
        images = walk[:, :, :, None] * coloured(wide, ordered=ordered)[:, None, None]
        moved = seen.surplus(images.reshape(2 * frames, -1)).reshape(frames, 6, -1)
        return wide + spread(coloured((walk.reshape(frames, 1, 6) @ moved)[:, 0], ordered=ordered, transposed=True)) / 3

    return product


def _cosines(frames: int, count: int, *, first: int = 0) -> Floats:
    """Return `count` cosines of rising frequency, orthonormal except for the constant, shape `(F, count)`; frequencies wrap around."""
    frequencies = (first + np.arange(min(count, frames))) % frames
    return np.asarray(np.cos(np.pi * np.outer(np.arange(frames) + 0.5, frequencies) / frames) * (2 / frames) ** 0.5)


def _nystrom(product: Callable[[Floats], Floats], begun: Floats) -> tuple[Floats, Floats]:
    """Return leading eigenvalues, descending, and eigenvectors of a positive semidefinite matrix, given its product with a basis.

    Williams and Seeger (2001), "Using the Nyström method to speed up kernel machines", for an arbitrary basis.
    """
    basis, _ = np.linalg.qr(begun)
    image = product(basis)
    held, turn = np.linalg.eigh(_symmetric(basis.T @ image))
    usable = held > 1e-12 * held[-1]
    root = (image @ turn[:, usable]) / np.sqrt(held[usable])
    values, turn = np.linalg.eigh(root.T @ root)
    values, vectors = values[::-1], (root @ turn)[:, ::-1]
    return values, vectors / np.linalg.norm(vectors, axis=0)


def _kept(values: Floats, vectors: Floats, total: float, floor: float, max_modes: int) -> tuple[Floats, float]:
    """Return L in white coordinates and τ as `_split` does, from leading eigenvalues, eigenvectors, and the trace."""
    frames, max_modes = len(vectors), min(max_modes, len(values))
    walk_variance = max((total - float(values[:max_modes].sum())) / (frames - max_modes), floor)
    count = min(max_modes, int((values > MODE_VARIANCE_RATIO * walk_variance).sum()))
    walk_variance = max((total - float(values[:count].sum())) / (frames - count), floor)
    return vectors[:, :count] * np.sqrt(np.maximum(values[:count] - walk_variance, 0.0)), walk_variance


def _improved(
    covariance: ShapeCovariance,
    modes: Floats,
    walk_variance: float,
    *,
    mean_covariance: Floats,
    axis_covariance: Floats,
    surplus: float,
    nll: float,
) -> ShapeCovariance:
    """Return the covariance with new moments; `surplus` is the mean of K's diagonal, `nll` that of the previous covariance."""
    return ShapeCovariance(
        mean_covariance=_symmetric(mean_covariance),
        axis_covariance=_symmetric(axis_covariance * (3 / axis_covariance.trace()) + AXIS_VARIANCE_FLOOR * IDENTITY)
        / (1 + AXIS_VARIANCE_FLOOR),
        modes=modes,
        walk_variance=walk_variance,
        noise_variance=max(covariance.noise_variance * (1 + covariance.noise_variance * surplus), NOISE_VARIANCE_FLOOR),
        nll=nll,
        ordered=covariance.ordered,
    )


def _split(over_frames: Floats, floor: float, max_modes: int, *, ordered: bool) -> tuple[Floats, float]:
    """Return L and τ with C ≈ L Lᵀ + τ T: principal components in coordinates in which the random walk is white."""
    frames = len(over_frames)
    root = whitener(frames, ordered)
    # This runs thousands of times: for short films, `dsyevd` takes a third of the time of `eigh`, and `sum` of `mean`.
    values, vectors, failed = lapack.dsyevd(root.T @ over_frames @ root, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the eigenvalues of the covariance over frames did not converge")
    values, vectors = values[::-1], vectors[:, ::-1]
    max_modes = min(max_modes, frames - 1)
    walk_variance = max(float(values[max_modes:].sum()) / (frames - max_modes), floor)
    count = min(max_modes, int(np.count_nonzero(values > MODE_VARIANCE_RATIO * walk_variance)))
    walk_variance = max(float(values[count:].sum()) / (frames - count), floor)
    scaled = vectors[:, :count] * np.sqrt(np.maximum(values[:count] - walk_variance, 0.0))
    modes = lapack.dtrtrs(root.T, scaled)[0] if count else scaled  # LAPACK refuses an array without columns
    return np.asarray(modes), walk_variance


def _symmetric(matrix: Floats) -> Floats:
    return np.asarray((matrix + matrix.T) / 2)
