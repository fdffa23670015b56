"""Warnings about settings that have no effect in combination with others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

from pliant.solver.settings import Settings

OF_WEIGHTS = ("laplacian", "temporal_weight", "spatial_weight", "low_rank_weight", "robust_scale", "temporal_order")
OF_ENERGY = ("preset", "prior", "loss", *OF_WEIGHTS, "max_reweightings", "tolerance")
OF_ESTIMATED_CAMERAS = ("basis_size", "refine_rotations")


def without_effect(
    settings: Settings, *, with_mesh: bool = True, known_cameras: bool = False, isometric: bool = False
) -> tuple[str, ...]:
    """Return a sentence for each setting that was changed from its default, but has no effect on the solution.

    Parameters
    ----------
    settings : Settings
        Settings of the solve.
    with_mesh : bool
        Whether a mesh was given.
    known_cameras : bool
        Whether rotations were given.
    isometric : bool
        Whether the solution is an isometric surface.
    """
    default = Settings()
    changed = {each.name for each in fields(Settings) if getattr(settings, each.name) != getattr(default, each.name)}
    reasons: dict[str, str] = {}
    for reason, names in combinations(settings, with_mesh=with_mesh, known_cameras=known_cameras, isometric=isometric):
        for name in names:
            reasons.setdefault(name, reason)
    return tuple(f"{name} has no effect {reasons[name]}." for name in reasons if name in changed)


def combinations(
    settings: Settings, *, with_mesh: bool, known_cameras: bool, isometric: bool
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield what the settings are combined with, and the settings that have no effect then."""
    if isometric:
        yield "with an isometric surface", ("method", *OF_ENERGY, "precision", *OF_ESTIMATED_CAMERAS)
        return
    linear = settings.prior != "smooth+low_rank"
    if settings.method == "pseudo_inverse":
        yield "with method pseudo_inverse", OF_ENERGY
    elif settings.method != "robust":
        yield f"with method {settings.method}", ("loss", "robust_scale")
    if settings.method == "temporal":
        yield "with method temporal", ("laplacian", "spatial_weight")
        if linear:
            yield "with method temporal", ("max_reweightings", "tolerance")
    if settings.gaussian:
        yield "with prior gaussian", ("temporal_order", "precision")
    if linear:
        yield f"with prior {settings.prior}", ("low_rank_weight",)
    elif settings.preset == "paper" and settings.low_rank_weight is None:
        yield "with preset paper without low_rank_weight", ("prior",)
    if settings.loss == "l2":
        yield "with loss l2", ("robust_scale",)
    if settings.is_orthographic:
        yield f"with camera {settings.camera}", ("principal_point",)
    elif settings.camera == "auto" and settings.focal_length is None and not (settings.gaussian or known_cameras):
        yield "with camera auto, which finds perspective only with prior gaussian", ("principal_point",)
    if not with_mesh:
        yield "without a mesh", ("laplacian", "spatial_weight")
    if known_cameras:
        yield "with given rotations", OF_ESTIMATED_CAMERAS
