"""Report sentences about the choice between orthography and perspective, which `refinement.focal_length` makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.model.marginal_likelihood import UNLIKELY
from pliant.solver.records import Choices, FocalCandidate, KnownCamera
from pliant.solver.refinement.focal_length import MIN_PERSPECTIVE_GAIN, more_probable
from pliant.solver.settings import Settings

DIVERGED = "the depths of the points diverge with it"
"""Instead of a gain in likelihood, where a focal length has none."""


def with_camera_choice(
    choices: Choices, view: Perspective | None, settings: Settings, *, unit: float, known: KnownCamera | None
) -> Choices:
    """Return the choices with camera model, its reason, the focal lengths compared, and whether the sign of depth is known.

    Parameters
    ----------
    choices : Choices
        All other choices.
    view : Perspective, optional
        Estimated perspective; None if perspective was not considered.
    settings : Settings
        Settings of the solve.
    unit : float
        One normalized unit in the tracks' unit.
    known : KnownCamera, optional
        Given cameras, which determine the sign of depth; None if they were estimated.
    """
    given = known is not None
    plain = settings.camera if settings.camera == "orthographic" else "scaled_orthographic"
    if view is None:
        return replace(choices, camera=plain, depth_sign="settled" if given else "ambiguous")
    chosen = view.signs[0] if not view.is_perspective else float(np.sign(view.flipped * view.inverse_focal))
    candidates = tuple(
        FocalCandidate(
            unit / abs(each.inverse_focal) if each.inverse_focal else None,
            bool(each.inverse_focal * chosen < 0),
            each.nll,
        )
        for each in view.candidates
    )
    warnings = improbable(view, unit), unknown_centre_warning(view, settings, known)
    return replace(
        choices,
        camera="perspective" if view.is_perspective else plain,
        depth_sign="settled" if given or (view.is_perspective and view.sign_known) else "ambiguous",
        focal_candidates=candidates,
        reasons={**choices.reasons, "camera_model": described(view, unit)},
        warnings=(*choices.warnings, *(each for each in warnings if each is not None)),
    )


def described(view: Perspective, unit: float) -> str:
    """Return a sentence about the choice between orthography and perspective."""
    nll = {each.inverse_focal: each.nll for each in view.candidates}
    if not view.is_perspective:
        best = min((each for each in nll if each != 0), key=lambda each: nll[each], default=None)
        if best is None:
            return "Orthography: perspective was not compared."
        if nll[best] >= UNLIKELY:
            return (
                f"Orthography: perspective with focal length {unit / abs(best):.4g} is impossible, because {DIVERGED}."
            )
        return (
            f"Orthography: the best perspective compared, focal length {unit / abs(best):.4g}, changes the log likelihood per point "
            f"and frame by {nll[0.0] - nll[best]:+.3f}; more than {MIN_PERSPECTIVE_GAIN} is required, and a clear sign of depth."
        )
    compared = [each for each in nll if each != 0 and (view.given is None or abs(each) == view.given)]
    own = min((nll[each] for each in compared), default=nll[0.0])
    std = view.focal_std(unit)
    how = "as given" if view.given is not None else "" if std is None else f"± {float(f'{std:.2g}'):g} from noise alone"
    gains = f"gains {nll[0.0] - own:.3f} in the log likelihood per point and frame over orthography"
    length = f"{unit / abs(view.inverse_focal):.4g} {how}".strip()
    if own >= UNLIKELY:
        return f"Perspective with focal length {length}, although {DIVERGED} from the first cameras."
    if view.given is not None:
        return f"Perspective with focal length {length}: {gains}."
    return f"Perspective {gains}. The focal length, estimated together with cameras and covariance, is {length}."


def improbable(view: Perspective, unit: float) -> str | None:
    """Return a warning if the given focal length is less probable than another one or orthography, else None."""
    found = more_probable(view)
    if found is None or view.given is None:
        return None
    best, gain = found
    other = "orthography" if best == 0 else f"a focal length of {unit / abs(best):.4g}"
    instead = "" if view.is_perspective else ", so the cameras are orthographic"
    gains = (
        f"{other} gains {gain:.3f} in the log likelihood per point and frame"
        if np.isfinite(gain)
        else f"{DIVERGED}{instead}"
    )
    return f"The given focal length, {unit / view.given:.4g}, is improbable: {gains}."


def unknown_centre_warning(view: Perspective, settings: Settings, known: KnownCamera | None) -> str | None:
    """Return a sentence if the principal point of a perspective camera is a guess; None otherwise."""
    given = settings.centre is not None or (known is not None and known.principal_point is not None)
    if given or not view.is_perspective:
        return None
    return (
        "The camera has perspective, but the picture's size is unknown, so the middle of the tracks is taken as its centre. "
        "Give image_size."
    )
