"""Given focal length and principal point, checked against the tracks."""

from __future__ import annotations

import numpy as np
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.errors import InvalidInput
from pliant.solver.records import KnownCamera, Tracks
from pliant.solver.settings import Settings
from pliant.solver.tracks.normalization import Normalized

MAX_CENTRE_RADII = 100.0
"""Maximum distance, along x and along y, of a principal point from the frames' centroids, RMS radii: a view of 1° or more."""


def given_lens(
    tracks: Tracks, normalized: Normalized, settings: Settings, cameras: KnownCamera | None = None
) -> Perspective | None:
    """Return the given perspective parameters, or None if perspective is not considered.

    Without `image_size` and `principal_point` the principal point is the mean of the frames' centroids.

    Raises
    ------
    InvalidInput
        Half or more of the observations lie outside the picture, the principal point is too far from the tracks, or the given
        cameras have a focal length while the settings have another one or an orthographic model.
    """
    check_picture(tracks, settings)
    given = settings.focal_length
    centre = settings.centre
    if cameras is not None and cameras.focal is not None:
        if settings.camera in ("orthographic", "scaled_orthographic") or given not in (None, cameras.focal):
            raise InvalidInput(
                "camera_mismatch", field="cameras.focal", expected=f"no focal length with camera {settings.camera} and focal {given}",
                got=f"{cameras.focal}", hint="Give the focal length once, with camera perspective or auto.",
            )  # fmt: skip
        given = cameras.focal
    if cameras is not None and cameras.principal_point is not None:
        centre = cameras.principal_point
    if settings.camera in ("orthographic", "scaled_orthographic"):
        return None
    if settings.camera == "auto" and given is None and not settings.gaussian:
        return None
    if centre is not None:
        point = np.array(centre, dtype=np.float64)
    else:
        point = normalized.centroid.mean(axis=0)
    offsets = (normalized.centroid - point) / normalized.unit
    if not np.abs(offsets).max() < MAX_CENTRE_RADII:
        raise InvalidInput(
            "principal_point_far", field="options.principal_point",
            expected=f"a point within {MAX_CENTRE_RADII:.0f} RMS radii of the tracks",
            got=f"({point[0]:.5g}, {point[1]:.5g})", hint="Give x, y in the unit and axes of the tracks.",
        )  # fmt: skip
    first = -1 if settings.y_up else 1
    return Perspective(
        offsets,
        point,
        given=None if given is None else normalized.unit / given,
        signs=(first, -first) if cameras is None else (first,),
        required=settings.camera == "perspective",
    )


def check_picture(tracks: Tracks, settings: Settings) -> None:
    """Check that most of the tracks lie inside the picture.

    Raises
    ------
    InvalidInput
        Half or more of the visible observations lie outside `image_size`.
    """
    if settings.image_size is None:
        return
    seen = tracks.points[tracks.visible > 0]
    inside = np.asarray(((seen >= -0.5) & (seen <= np.array(settings.image_size) - 0.5)).all(axis=1))
    if 2 * np.count_nonzero(inside) > len(inside):
        return
    low, high = seen.min(axis=0), seen.max(axis=0)
    raise InvalidInput(
        "outside_picture", field="options.image_size",
        expected=f"most positions within 0 … {settings.image_size[0] - 1:g} and 0 … {settings.image_size[1] - 1:g}",
        got=f"{np.count_nonzero(inside)} of {len(inside)}; x from {low[0]:.5g} to {high[0]:.5g}, y from {low[1]:.5g} to {high[1]:.5g}",
        hint="Correct image_size, or leave it out where tracks are not in pixels from the picture's corner.",
    )  # fmt: skip
