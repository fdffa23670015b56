"""Given focal length and principal point, checked against the tracks."""

from __future__ import annotations

import numpy as np
from pliant.solver.agreement import check_focal, check_principal_point
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.records import KnownCamera
from pliant.solver.settings import Settings
from pliant.solver.tracks.normalization import Normalized


def given_lens(normalized: Normalized, settings: Settings, cameras: KnownCamera | None = None) -> Perspective | None:
    """Return the given perspective parameters, or None if perspective is not considered.

    Without `image_size` and `principal_point` the principal point is the mean of the frames' centroids.

    Raises
    ------
    InvalidInput
        The principal point is too far from the tracks, or the focal length far below their size.
    """
    given = settings.focal_length
    centre, of_picture = settings.centre, settings.principal_point is None and settings.image_size is not None
    if cameras is not None and cameras.focal is not None:
        given = cameras.focal
    if cameras is not None and cameras.principal_point is not None:
        centre, of_picture = cameras.principal_point, False
    if settings.is_orthographic:
        return None
    if settings.camera == "auto" and given is None and not settings.gaussian:
        return None
    if centre is not None:
        point = np.array(centre, dtype=np.float64)
    else:
        point = normalized.centroid.mean(axis=0)
    offsets = (normalized.centroid - point) / normalized.unit
    check_principal_point(normalized.centroid, normalized.unit, point, of_picture=of_picture)
    check_focal(normalized.unit, settings, None if cameras is None else cameras.focal)
    first = -1 if settings.y_up else 1
    return Perspective(
        offsets,
        point,
        given=None if given is None else normalized.unit / given,
        signs=(first, -first) if cameras is None else (first,),
        required=settings.camera == "perspective",
    )
