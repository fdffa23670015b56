"""Given focal length and principal point, checked against the tracks."""

from __future__ import annotations

import numpy as np
from pliant.solver.agreement import check_focal, check_principal_point, is_near
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.records import KnownCamera
from pliant.solver.settings import Settings
from pliant.solver.tracks.normalization import Normalized


def given_lens(normalized: Normalized, settings: Settings, cameras: KnownCamera | None = None) -> Perspective | None:
    """Return the given perspective parameters, or None if perspective is not considered.

    Without `image_size` and `principal_point` the principal point is the mean of the frames' centroids. Camera `auto` does not consider
    perspective for an object so small that the picture's centre is more than `MAX_CENTRE_RADII` from it.

    Raises
    ------
    InvalidInput
        The principal point is too far from the tracks, or the focal length far below their size.
    """
    given = settings.focal_length
    centre = settings.centre
    field = (
        "tracks"
        if centre is None
        else f"options.{'image_size' if settings.principal_point is None else 'principal_point'}"
    )
    if cameras is not None and cameras.focal is not None:
        given = cameras.focal
    if cameras is not None and cameras.principal_point is not None:
        centre, field = cameras.principal_point, "cameras.principal_point"
    if settings.is_orthographic:
        return None
    if settings.camera == "auto" and given is None and not settings.gaussian:
        return None
    point = normalized.centroid.mean(axis=0) if centre is None else np.array(centre, dtype=np.float64)
    small = field == "tracks" or (
        field == "options.image_size" and normalized.unit >= 1
    )  # else no pixels, which is an error
    if (
        small
        and settings.camera == "auto"
        and given is None
        and not is_near(normalized.centroid, normalized.unit, point)
    ):
        return None
    offsets = (normalized.centroid - point) / normalized.unit
    check_principal_point(normalized.centroid, normalized.unit, point, field=field)
    check_focal(normalized.unit, settings, None if cameras is None else cameras.focal)
    first = -1 if settings.y_up else 1
    return Perspective(
        offsets,
        point,
        given=None if given is None else normalized.unit / given,
        signs=(first, -first) if cameras is None else (first,),
        required=settings.camera == "perspective",
    )
