"""Whether tracks, mesh, cameras and settings agree: every contradiction that can be seen without solving.

Nothing here needs SciPy, so a reader can refuse a job before it is queued.
"""

from __future__ import annotations

from math import radians, tan

import numpy as np
from pliant.solver.errors import InvalidInput, InvalidSettings, shape_text, wrong_input
from pliant.solver.limits import MAX_COORDINATE, MAX_UNORDERED_FRAMES, frame_chunks
from pliant.solver.mesh import Mesh
from pliant.solver.records import MIN_FRAMES, MIN_POINTS, Floats, KnownCamera, Tracks
from pliant.solver.settings import MAX_FIELD_OF_VIEW, Settings

MAKE_TRACKS = "Use Tracks.from_arrays(points, visible), which validates and converts."
MAKE_MESH = "Use Mesh.from_faces(faces, num_points)."
MAKE_SETTINGS = "Use Settings(…)."
MAKE_CAMERAS = "Use KnownCamera.from_arrays(rotations, scales), which validates and converts."

MAX_CENTRE_RADII = 100.0
"""Maximum distance, along x and along y, of a principal point from the frames' centroids, RMS radii: a view of 1° or more."""

SMALL = "Choose camera scaled_orthographic: so small an object shows no perspective."

SHARED_SHARE, SHARED_POINTS, SHARED_SAMPLE = 0.01, 3, (300, 1000)
"""Share of the visible positions that are the same one, and number of points with it, above which it probably marks hidden points; and the
numbers of frames and of points in which it is looked for. Tracked points hardly ever meet exactly."""


def check_agreement(tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera | None, settings: Settings) -> None:
    """Check that mesh and given cameras match the tracks, and the settings all of them.

    `check_principal_point` and `check_focal` are separate, because they need normalized tracks.

    Raises
    ------
    InvalidInput
        Number of vertices (code `mesh_mismatch`) or of cameras (`camera_mismatch`); cameras with a focal length while the settings have
        another one or an orthographic model (`camera_mismatch`); half or more of the observations outside `image_size`
        (`outside_picture`); an argument of another type (`wrong_type`); tracks or cameras that were not made with `from_arrays` and that it
        would refuse or convert.
    InvalidSettings
        `laplacian="grid8"` with a mesh that is not a grid, `surface="isometric"` with given cameras, `camera="orthographic"` with given
        scales that are not 1, or `order="any"` with more than `MAX_UNORDERED_FRAMES` frames.
    """
    check_tracks(tracks)
    for field, value, kind, make in (
        ("mesh", mesh, Mesh, MAKE_MESH),
        ("cameras", cameras, KnownCamera, MAKE_CAMERAS),
        ("settings", settings, Settings, MAKE_SETTINGS),
    ):
        if value is not None:
            check_type(field, value, kind, make)
    check_mesh(tracks, mesh, settings)
    if cameras is not None:
        _check_known(cameras)
        _check_cameras(tracks, cameras, settings)
    if settings.order == "any" and tracks.num_frames > MAX_UNORDERED_FRAMES:
        raise InvalidSettings(
            "invalid_option", field="options.order", expected=f"film or auto with more than {MAX_UNORDERED_FRAMES} frames",
            got=f"'any' with {tracks.num_frames}", hint="Select some of the photographs with the option frames.",
        )  # fmt: skip
    if settings.image_size is not None:
        _check_picture(tracks, settings.image_size)


def check_type(field: str, value: object, kind: type, hint: str) -> None:
    """Check that an argument is a record of the expected class; `hint` says how to make one.

    Raises
    ------
    InvalidInput
        Code `wrong_type`.
    """
    if not isinstance(value, kind):
        raise wrong_input(field, "wrong_type", f"a {kind.__name__}", f"a value of type {type(value).__name__}", hint)


def check_tracks(tracks: Tracks) -> None:
    """Check that tracks are as `Tracks.from_arrays` makes them, because the class can also be called directly.

    Raises
    ------
    InvalidInput
        Not a `Tracks`, arrays of another type or shape, coordinates that are not finite or beyond ±1e12, or confidence outside [0, 1].
    """
    check_type("tracks", tracks, Tracks, MAKE_TRACKS)
    points, visible = tracks.points, tracks.visible
    _check_array("tracks", points, MAKE_TRACKS)
    _check_array("visibility", visible, MAKE_TRACKS)
    if points.ndim != 3 or points.shape[2] != 2 or len(points) < MIN_FRAMES or points.shape[1] < MIN_POINTS:
        expected = f"(frames, points, 2) with at least {MIN_FRAMES} frames and {MIN_POINTS} points"
        raise wrong_input("tracks", "wrong_shape", expected, shape_text(points), MAKE_TRACKS)
    if visible.shape != points.shape[:2]:
        raise wrong_input("visibility", "wrong_shape", str(points.shape[:2]), shape_text(visible), MAKE_TRACKS)
    for some in frame_chunks(*visible.shape):
        if not (np.abs(points[some]) <= MAX_COORDINATE).all():  # also rejects NaN
            expected = f"finite coordinates within ±{MAX_COORDINATE:g}"
            raise wrong_input("tracks", "out_of_range", expected, "others", MAKE_TRACKS)
        if not ((visible[some] >= 0) & (visible[some] <= 1)).all():
            raise wrong_input("visibility", "out_of_range", "values from 0 to 1", "others", MAKE_TRACKS)


def _check_array(field: str, array: object, hint: str) -> None:
    """Check that a member of a record is an array of float64."""
    if not isinstance(array, np.ndarray) or array.dtype != np.float64:
        got = f"dtype {array.dtype}" if isinstance(array, np.ndarray) else f"a value of type {type(array).__name__}"
        raise wrong_input(field, "wrong_type", "an array of float64", got, hint)


def _check_known(cameras: KnownCamera) -> None:
    """Check that cameras are as `KnownCamera.from_arrays` makes them, because the class can also be called directly."""
    valid = KnownCamera.from_arrays(
        cameras.rotations, cameras.scales, focal=cameras.focal, principal_point=cameras.principal_point
    )
    _check_array("rotations", cameras.rotations, MAKE_CAMERAS)
    if cameras.scales is not None:
        _check_array("scales", cameras.scales, MAKE_CAMERAS)
    if cameras.rotations.shape != valid.rotations.shape:
        expected, got = shape_text(valid.rotations), shape_text(cameras.rotations)
        raise wrong_input("rotations", "wrong_shape", expected, got, MAKE_CAMERAS)


def check_mesh(tracks: Tracks, mesh: Mesh | None, settings: Settings) -> None:
    """Check that a mesh matches the tracks, all of them or a block of points, and the settings the mesh.

    Raises
    ------
    InvalidInput
        Number of vertices (code `mesh_mismatch`).
    InvalidSettings
        `laplacian="grid8"` with a mesh that is not a grid.
    """
    if mesh is None:
        return
    if mesh.num_points != tracks.num_points:
        raise InvalidInput(
            "mesh_mismatch", field="mesh", expected=f"{tracks.num_points} vertices, one for each point of the tracks",
            got=f"{mesh.num_points}", hint="Vertex i of the mesh must be point i of the tracks.",
        )  # fmt: skip
    if settings.laplacian == "grid8" and mesh.grid is None and len(mesh.faces) > 0:
        raise InvalidSettings(
            "invalid_option", field="options.laplacian", expected="a mesh that is a pixel grid", got="faces only",
            hint="Use laplacian auto, uniform or cotangent, or give the points as a grid.",
        )  # fmt: skip


def check_seen(visible: Floats) -> None:
    """Check that enough points are visible in two or more frames.

    Raises
    ------
    InvalidInput
        Fewer than `MIN_POINTS`.
    """
    again = seen_again(visible)
    if again < MIN_POINTS:
        raise InvalidInput(
            "too_little_seen", field="visibility", expected=f"at least {MIN_POINTS} points that are visible in two or more frames",
            got=f"{again}", hint="Check that the visibility is not inverted, and that a point has the same index in every frame.",
        )  # fmt: skip


def seen_again(visible: Floats) -> int:
    """Return the number of points that are visible in two or more frames."""
    return int(((visible > 0).sum(axis=0) >= 2).sum())


def shared_position_warnings(tracks: Tracks) -> tuple[str, ...]:
    """Return a warning if several points are at exactly the same position in many frames, which marks hidden points in some files."""
    frames, points = (max(1, -(-size // most)) for size, most in zip(tracks.visible.shape, SHARED_SAMPLE, strict=True))
    seen = tracks.visible[::frames, ::points] > 0
    which = np.nonzero(seen)[1]
    places, place_of, counts = np.unique(
        tracks.points[::frames, ::points][seen], axis=0, return_inverse=True, return_counts=True
    )
    if len(places) == 0:
        return ()
    most = int(np.argmax(counts))
    if counts[most] < SHARED_SHARE * len(which) or len(np.unique(which[place_of.ravel() == most])) < SHARED_POINTS:
        return ()
    x, y = places[most]
    return (
        f"{counts[most] / len(which):.0%} of the visible positions are exactly ({x:g}, {y:g}), for several points. "
        "If this marks hidden points, set their visibility to 0, or the position to NaN.",
    )


def separate_points_warnings(tracks: Tracks) -> tuple[str, ...]:
    """Return a warning if no chain of frames that share points connects all points that are visible in two or more frames."""
    seen = tracks.visible > 0
    often = seen.sum(axis=0) >= 2
    reached = seen[np.argmax(seen.sum(axis=1))]
    before = -1
    while before < (before := int(reached.sum())):
        for shown in (*seen, *seen[::-1]):
            if (shown & reached).any():
                reached = reached | shown
    apart = int((often & ~reached).sum())
    if apart < MIN_POINTS:
        return ()
    return (
        f"No frame connects {apart} of the points to the others, as in tracks across a cut: their position relative to these is a guess. "
        "Solve each part of the film on its own.",
    )


def is_near(centroids: Floats, unit: float, point: Floats) -> bool:
    """Whether a point `(2,)` is within `MAX_CENTRE_RADII` of the centroids `(F, 2)` of all frames; `unit` is the RMS radius."""
    return bool(np.abs(centroids - point).max() < MAX_CENTRE_RADII * unit)


def check_principal_point(
    centroids: Floats, unit: float, point: Floats, *, field: str = "options.principal_point"
) -> None:
    """Check that a principal point is near the tracks.

    Parameters
    ----------
    centroids : array, shape (F, 2)
        Centroid of every frame.
    unit : float
        RMS radius of the tracks.
    point : array, shape (2,)
        Principal point, in the unit of the centroids.
    field : str
        What it was taken from, for the error: `options.principal_point`, `options.image_size`, `cameras.principal_point`, or `tracks`,
        whose mean it is.

    Raises
    ------
    InvalidInput
        More than `MAX_CENTRE_RADII` from the centroid of a frame.
    """
    if is_near(centroids, unit, point):
        return
    middle = centroids.mean(axis=0)
    if field == "tracks":
        expected = f"centroids of the frames within {MAX_CENTRE_RADII:.0f} RMS radii of their mean, which is the principal point"
        got = f"one {np.abs(centroids - point).max() / unit:.4g} radii from it"
        hint = f"{SMALL} Hide frames that show only outliers."
    else:
        expected = (
            f"a {'centre' if field == 'options.image_size' else 'point'} within {MAX_CENTRE_RADII:.0f} RMS radii of the tracks, "
            f"which lie around ({middle[0]:.5g}, {middle[1]:.5g})"
        )
        got = f"({point[0]:.5g}, {point[1]:.5g})"
        hint = (
            "Give x, y in the unit and axes of the tracks."
            if field != "options.image_size"
            else "Multiply tracks that are fractions of the picture by its size in pixels."
            if unit < 1
            else SMALL
        )
    raise InvalidInput("principal_point_far", field=field, expected=expected, got=got, hint=hint)


def check_focal(unit: float, settings: Settings, known: float | None = None) -> None:
    """Check that a given focal length, if there is one, is not far below the size of the tracks, as one in millimetres is.

    Parameters
    ----------
    unit : float
        RMS radius of the tracks.
    settings : Settings
        With `focal` or `field_of_view`.
    known : float, optional
        Focal length of given cameras, which counts before that of the settings.

    Raises
    ------
    InvalidSettings
        The RMS radius is seen at more than half of `MAX_FIELD_OF_VIEW` from the optical axis.
    """
    focal, field = known, "cameras.focal"
    if focal is None:
        focal, field = (
            settings.focal_length,
            "options.focal" if settings.field_of_view is None else "options.field_of_view",
        )
    least = unit / tan(radians(MAX_FIELD_OF_VIEW / 2))
    if focal is not None and focal < least:
        raise InvalidSettings(
            "invalid_option", field=field,
            expected=f"a focal length of at least {least:.4g} pixels for tracks with an RMS radius of {unit:.4g}", got=f"{focal:.4g}",
            hint="Give it in pixels of the tracks, not in millimetres: divide millimetres by the sensor's width, and multiply by the "
            "picture's width in pixels.",
        )  # fmt: skip


def _check_cameras(tracks: Tracks, cameras: KnownCamera, settings: Settings) -> None:
    if len(cameras.rotations) != tracks.num_frames:
        raise InvalidInput(
            "camera_mismatch", field="rotations", expected=f"{tracks.num_frames} rotations, one for each frame of the tracks",
            got=f"{len(cameras.rotations)}", hint="Pass one camera per frame, in the order of the frames.",
        )  # fmt: skip
    if settings.surface == "isometric":
        raise InvalidSettings(
            "invalid_option", field="options.surface", expected="auto or free where rotations are given", got="'isometric'",
            hint="Omit the rotations: an isometric surface determines its own cameras.",
        )  # fmt: skip
    if settings.camera == "orthographic" and cameras.scales is not None and not np.allclose(cameras.scales, 1):
        raise InvalidSettings(
            "invalid_option", field="options.camera", expected="auto, scaled_orthographic or perspective beside given scales",
            got="'orthographic'", hint="Orthographic cameras have scale 1. Choose another model, or leave the scales out.",
        )  # fmt: skip
    given = settings.focal_length
    if cameras.focal is not None and (settings.is_orthographic or given not in (None, cameras.focal)):
        raise InvalidInput(
            "camera_mismatch", field="cameras.focal", expected=f"no focal length with camera {settings.camera} and focal {given}",
            got=f"{cameras.focal}", hint="Give the focal length once, with camera perspective or auto.",
        )  # fmt: skip


def _check_picture(tracks: Tracks, size: tuple[float, float]) -> None:
    """Check that most visible positions lie inside the picture."""
    within = total = 0
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for chunk in frame_chunks(tracks.num_frames, tracks.num_points):
        seen = tracks.points[chunk][tracks.visible[chunk] > 0]
        within += int(np.count_nonzero(((seen >= -0.5) & (seen <= np.array(size) - 0.5)).all(axis=1)))
        total += len(seen)
        low = np.minimum(low, seen.min(axis=0, initial=np.inf))
        high = np.maximum(high, seen.max(axis=0, initial=-np.inf))
    if 2 * within > total:
        return
    raise InvalidInput(
        "outside_picture", field="options.image_size",
        expected=f"most positions within 0 … {size[0] - 1:g} and 0 … {size[1] - 1:g}",
        got=f"{within} of {total}; x from {low[0]:.5g} to {high[0]:.5g}, y from {low[1]:.5g} to {high[1]:.5g}",
        hint="Correct image_size, or leave it out where tracks are not in pixels from the picture's corner.",
    )  # fmt: skip
