"""Cameras from tracks: rotation, scale and translation of every frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from pliant.solver.completion import Completed, complete
from pliant.solver.metric_upgrade import Upgrade, upgrade
from pliant.solver.normalise import Normalised
from pliant.solver.records import Floats, Step, read_only
from pliant.solver.settings import Settings

SHARE = 0.3
"""Share of the whole solve that progress gives to the cameras."""

EXPLAINED = 0.999
"""Without a K in the settings: the fewest basis shapes that explain this share of the tracks' variance."""

LARGEST_BASIS = 8
"""Largest K tried."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate:
    """The cameras, and how they were found."""

    rotations: Floats
    """Camera from world, shape `(F, 3, 3)`; the first is the identity."""

    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0."""

    translations: Floats
    """Correction to the centroid, normalised units, shape `(F, 2)`."""

    basis_size: int
    """K of the factorization; 0 for given cameras."""

    reasons: dict[str, str] = field(default_factory=dict)
    """One sentence for each choice."""

    warnings: tuple[str, ...] = ()
    """What the user should know before trusting the result."""


def estimate_cameras(
    normalised: Normalised,
    settings: Settings,
    *,
    on_step: Callable[[Step], None] | None = None,
    should_stop: Callable[[], bool] | None = None,  # noqa: ARG001
) -> CameraEstimate:
    """Return the cameras of the tracks, without anything known about the shapes.

    Parameters
    ----------
    normalised : Normalised
        Centred tracks; hidden entries and gross outliers are filled first.
    settings : Settings
        `camera`, `basis_size`, `seed`.
    on_step : callable, optional
        Told after completion and after every factorization; fractions run from 0 to `SHARE`.
    should_stop : callable, optional
        Asked between units of work; once it says True, the best cameras so far are returned.
    """
    tell = on_step if on_step is not None else _silent
    completed = complete(normalised, seed=settings.seed)
    tell(Step("cameras", 0.5 * SHARE))
    size, reason = _basis_size(completed, settings)
    found = upgrade(completed.gram, size)
    scales = _scales(completed, found, settings)
    read_only(scales)
    tell(Step("cameras", SHARE))
    return CameraEstimate(found.rotations, scales, completed.translations, size, {"basis_size": reason})


def estimate_scales(normalised: Normalised, rotations: Floats) -> Floats:
    """Return the scale of every frame for given rotations, shape `(F,)`, mean of the logarithm 0.

    The scales are those with which one rigid shape explains the tracks best: Σ_f ‖W_f − s_f R_f S‖². Shrinking them all
    gains nothing, for S grows in return.
    """
    return _rigid_scales(complete(normalised).gram, rotations)


def _basis_size(completed: Completed, settings: Settings) -> tuple[int, str]:
    limit = max(1, min(LARGEST_BASIS, len(completed.gram) // 3, completed.sample.shape[1] // 3))
    if settings.basis_size is not None:
        size = min(settings.basis_size, len(completed.gram) // 3)
        return size, f"K = {size} as set."
    values = np.linalg.eigvalsh(completed.gram)[::-1]
    explained = np.cumsum(values)[2::3] / values.sum()
    size = min(limit, 1 + int((explained < EXPLAINED).sum()))
    return size, f"K = {size} basis shapes explain {explained[size - 1]:.4%} of the tracks' variance."


def _scales(completed: Completed, found: Upgrade, settings: Settings) -> Floats:
    if settings.camera == "orthographic":
        return np.ones(len(found.rotations))
    return _rigid_scales(completed.gram, found.rotations)


def _rigid_scales(gram: Floats, rotations: Floats, *, rounds: int = 30) -> Floats:
    frames = len(rotations)
    scales = np.ones(frames)
    for _ in range(rounds):
        rows = (rotations[:, :2] * scales[:, None, None]).reshape(2 * frames, 3)
        pseudo = np.linalg.pinv(rows)
        shape_gram, cross = pseudo @ gram @ pseudo.T, (gram @ pseudo.T).reshape(frames, 2, 3)
        pair = rotations[:, :2]
        hit = np.einsum("fij,fij->f", pair, cross)
        size = np.einsum("fij,jk,fik->f", pair, shape_gram, pair)
        scales = np.maximum(hit, 1e-3 * size) / np.maximum(size, np.finfo(float).tiny)
        scales = np.asarray(scales / np.exp(np.log(scales).mean()))
    return scales


def _silent(_: Step) -> None:
    pass
