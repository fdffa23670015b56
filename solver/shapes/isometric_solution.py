"""A Solution from an isometric surface: surfaces in camera axes become shapes in world axes and moving cameras.

The surface is known in each frame's camera axes. A rigid motion per frame aligns it with the mean shape (generalised Procrustes analysis;
Gower 1975): the rotation becomes the camera's, and the remaining differences between frames are deformation. Shapes are in image units at
the mean depth, as under scaled orthography.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.evaluation.trust import assess_isometric
from pliant.solver.isometry.surface import IsometricSurface, IsometricVerdict
from pliant.solver.model.so3 import rotations_of
from pliant.solver.records import Camera, Choices, Floats, Tracks, mean_scale
from pliant.solver.settings import Settings
from pliant.solver.solution import Outcome, Solution, Trace


def isometric_solution(
    tracks: Tracks,
    verdict: IsometricVerdict,
    settings: Settings,
    *,
    unit: float,
    seconds: dict[str, float],
    stopped: bool,
) -> Solution:
    """Return the solution for an accepted verdict.

    Parameters
    ----------
    tracks : Tracks
        The tracks that the surface was computed from.
    verdict : IsometricVerdict
        Contains a surface, computed from tracks with y down.
    settings : Settings
        `y_up` of the tracks, and whether the focal length was given.
    unit : float
        RMS radius of the centred tracks, reported in the choices.
    seconds : dict
        Wall time per stage.
    stopped : bool
        Whether the refinement of the surface was stopped early.
    """
    surface = verdict.surface
    assert surface is not None
    shapes, camera, shapes_std = in_world_axes(surface)
    estimated = None if verdict.warnings else surface.focal_std
    camera = replace(camera, focal_std=0.0 if settings.focal_length is not None else estimated)
    if settings.y_up:
        camera = upwards(camera)
    seen = tracks.visible > 0
    residual = np.where(seen, np.linalg.norm(camera.project(shapes) - tracks.points, axis=2), 0.0)
    weights = (seen & ~surface.outliers & surface.placed).astype(np.float64)
    median = float(np.median(residual[seen]))
    trace = Trace(np.array([surface.inconsistency]), np.array([median]), np.zeros(1, dtype=np.int32))
    choices = _choices(verdict, surface, unit, float(surface.outliers.sum() / seen.sum()))
    outcome = Outcome.STOPPED if stopped else Outcome.CONVERGED
    solution = Solution(shapes, camera, residual, weights, trace, outcome, choices, seconds, shapes_std)
    trust = assess_isometric(solution, ordered=settings.order == "film", doubted=bool(verdict.warnings))
    return replace(solution, trust=trust)


def in_world_axes(surface: IsometricSurface) -> tuple[Floats, Camera, Floats | None]:
    """Return centred shapes `(F, P, 3)` in world axes, cameras that reproduce the images of the surface, and standard deviations `(F, P)`.

    The latter are None if the surface has none.

    A frame that copies the shape of another one may differ from it by the deformation of the surface, which is added to its variance.
    """
    origin = surface.points.mean(axis=1)
    centred = surface.points - origin[:, None]
    rotations = rotations_of(centred[:, surface.placed])
    scales = surface.focal / origin[:, 2]
    unit = mean_scale(scales)
    shapes = unit * (centred @ rotations)
    point = np.array(surface.principal_point)
    translations = point + scales[:, None] * origin[:, :2]
    camera = Camera(rotations, scales / unit, translations, surface.focal, principal_point=point)
    if surface.deviations is None:
        return shapes, camera, None
    deformation = np.square(shapes - shapes.mean(axis=0)).sum(axis=2).mean(axis=0)
    variance = np.square(unit * surface.deviations) + np.where(surface.shown[:, None], 0.0, deformation)
    return shapes, camera, np.sqrt(variance)


def downwards(tracks: Tracks) -> Tracks:
    """Return the tracks with y reversed."""
    return Tracks.from_arrays(tracks.points * (1.0, -1.0), tracks.visible)


def centre_downwards(settings: Settings) -> tuple[float, float] | None:
    """Return the given principal point or the image centre, with y down; None if neither is known."""
    point = settings.centre
    return point if point is None or not settings.y_up else (point[0], -point[1])


def upwards(camera: Camera) -> Camera:
    """Return the camera for the tracks with y reversed: rotated by half a turn about x."""
    half_turn = np.diag([1.0, -1.0, -1.0])
    rotations, translations = half_turn @ camera.rotations, camera.translations * (1.0, -1.0)
    return replace(
        camera,
        rotations=rotations,
        translations=translations,
        principal_point=camera.principal_point * (1.0, -1.0),
        y_up=True,
    )


def _choices(verdict: IsometricVerdict, surface: IsometricSurface, unit: float, outliers: float) -> Choices:
    reasons = {
        "surface": verdict.reason,
        "outliers": f"{outliers:.1%} of the visible observations contradict the surface and were not used.",
    }
    warnings = list(verdict.warnings)
    if not surface.shown.all():
        count = int((~surface.shown).sum())
        few = f"{count} of {len(surface.shown)} frames show too little of the surface"
        warnings.append(f"{few}; they have the shapes and cameras of the nearest other frames.")
    if not surface.placed.all():
        share = 1 - float(surface.placed.mean())
        warnings.append(
            f"{share:.1%} of the points could not be located on the surface; they are placed at its centre."
        )
    return Choices(
        basis_size=0, temporal_weight=0.0, spatial_weight=0.0, robust_scale=0.0, temporal_order=1, low_rank_weight=0.0,
        laplacian="none", unit=unit, noise=surface.noise_std, reasons=reasons, warnings=tuple(warnings),
        camera="perspective", depth_sign="settled", focal_lengths=verdict.focal_lengths,
    )  # fmt: skip
