"""Read a job's files from any supported program into validated records, with notes on their interpretation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, KnownCamera, Mesh, Tracks
from pliant.solver.agreement import (
    check_agreement,
    check_focal,
    check_principal_point,
    check_seen,
    separate_points_warnings,
    shared_position_warnings,
)
from pliant.solver.limits import MAX_COORDINATE
from pliant.solver.tracks.normalization import normalize
from pliant.worker.formats.cost import estimated
from pliant.worker.formats.errors import MAX_NAMES, too_large
from pliant.worker.formats.ground_truth import read_rotations, read_truth
from pliant.worker.formats.meshes.surface import Surface, check_order, read_surface, whole_grid
from pliant.worker.formats.meshes.triangulation import triangulate
from pliant.worker.formats.reading.containers import read_arrays, shapes_in
from pliant.worker.formats.records import GroundTruth, Inputs, Limits, Selection
from pliant.worker.formats.solver_settings import solver_settings
from pliant.worker.formats.tracks.decimation import thin
from pliant.worker.formats.tracks.film_tracks import FilmTracks, read_film_tracks, tracks_options
from pliant.worker.formats.tracks.interpretation import Understood, understand
from pliant.worker.formats.tracks.selection import LEFT_OUT_LISTED, chosen_frames, hide_sparsely_observed, selected
from pliant.worker.formats.tracks.tracker_formats import KNOWN, OWN, TRACKS, TRUE_ROTATIONS
from pliant.worker.formats.unused_options import notes_on_options


def read_inputs(
    *,
    tracks: Path,
    mesh: Path | str | None = None,
    ground_truth: Path | None = None,
    rotations: Path | None = None,
    options: Options,
    limits: Limits = Limits(),  # noqa: B008 - frozen
) -> Inputs:
    """Read, check and interpret the files of one job; files are recognised by content, not by name.

    `mesh` is a file whose vertex i is point i, a grid size `"ROWSxCOLUMNS"` or `"none"`; by default a mesh is generated. Ground
    truth (for metrics only) and rotations (instead of estimated cameras) cover all frames and points of the tracks: `frames`,
    `stride` and `max_points` select from them as well. Options such as `layout` take precedence over detection.

    Raises
    ------
    InvalidInput
        With a stable code, the field, expected and actual value, and a hint; also where the options do not agree with the files.
    AmbiguousInput
        Several interpretations fit; the error lists them.
    """
    understood = understand(read_arrays(tracks, field="tracks", limits=limits, wanted=KNOWN), options, file=tracks)
    film: FilmTracks | None = None
    if understood.format == OWN:
        film = read_film_tracks(tracks, field="tracks", shape=understood.points.shape[:2], limits=limits)
        understood = replace(understood, visible=film.visible)
    chosen = _choose(understood, mesh, options, limits, film)
    truth, truth_notes = _read_truth(ground_truth, understood, chosen.selection, limits)
    cameras = None
    if rotations is not None:
        frames = chosen.selection.frames
        cameras = read_rotations(rotations, num_frames=len(understood.points), frames=frames, limits=limits)
    notes = [
        *notes_on_options(options, film=False), *understood.notes,
        *unused_arrays(tracks, understood, has_mesh=mesh is not None, has_truth=truth is not None),
        *chosen.notes, *truth_notes, *shared_position_warnings(chosen.tracks),
        *separate_points_warnings(chosen.tracks),
    ]  # fmt: skip
    interpretation = _interpretation(
        understood, chosen, film, notes, has_truth=truth is not None, has_rotations=cameras is not None
    )
    checked, known = chosen.tracks, tracks_options(options, interpretation)
    check_seen(checked.visible)
    check_options(checked, chosen.mesh, cameras, known, y_axis=understood.y_axis)
    estimate = estimated(checked.num_frames, checked.num_points, known, has_rotations=cameras is not None)
    interpretation = interpretation.model_copy(update={"estimate": estimate})
    texture = None if film is None or film.texture is None else film.texture.at_points(chosen.selection.points)
    selection = chosen.selection if chosen.selection.narrows else None
    names = understood.point_names
    if names is not None:
        names = tuple(names[point] for point in chosen.selection.points.tolist())
    times = None if film is None or film.times is None else film.times[chosen.selection.frames]
    return Inputs(
        checked,
        chosen.mesh,
        truth,
        cameras,
        interpretation,
        selection,
        texture=texture,
        point_names=names,
        frame_times=times,
        warnings=() if film is None else film.warnings,
    )


def check_options(
    tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera | None, options: Options, *, y_axis: str
) -> None:
    """Check that options agree with tracks, mesh and cameras, and with each other.

    Raises
    ------
    InvalidInput
        What the solver would refuse, too.
    """
    settings = solver_settings(options, y_up=y_axis == "up")
    check_agreement(tracks, mesh, cameras, settings)
    if settings.principal_point is None and settings.focal_length is None:
        return
    normalized = normalize(tracks)
    check_focal(normalized.unit, settings)
    if settings.principal_point is not None:
        check_principal_point(normalized.centroid, normalized.unit, np.array(settings.principal_point))


def unused_arrays(path: Path, understood: Understood, *, has_mesh: bool, has_truth: bool) -> list[str]:
    """Return a note that lists the arrays of an npz that are not used; none if `pliant track` wrote the file.

    `has_mesh` if the job has a mesh of its own, `has_truth` if it has true shapes, which true rotations belong to.
    """
    if understood.format == OWN:
        return []
    used = {name for name in understood.arrays if name == understood.name or name not in TRACKS}
    if not has_truth:
        used -= set(TRUE_ROTATIONS)
    every: dict[str, tuple[int, ...] | None] = {name: array.shape for name, array in understood.arrays.items()}
    unknown = [(name, shape) for name, shape in (every | shapes_in(path, {})).items() if name not in used]
    if not unknown:
        return []
    listed = ", ".join(f"{name} {shape}" if shape is not None else name for name, shape in unknown[:MAX_NAMES])
    more = f" and {len(unknown) - MAX_NAMES} more" if len(unknown) > MAX_NAMES else ""
    mesh = not has_mesh and any(name in ("faces", "grid") for name, _ in unknown)
    cameras = any(name in TRUE_ROTATIONS for name, _ in unknown)
    return [
        f"Not used: {listed}{more}."
        + (" Send this file as the mesh, too, to use its mesh." if mesh else "")
        + (" Send given cameras as the part rotations." if cameras else "")
    ]


def _interpretation(
    understood: Understood,
    chosen: _Chosen,
    film: FilmTracks | None,
    notes: list[str],
    *,
    has_truth: bool,
    has_rotations: bool,
) -> Interpretation:
    """Return how the files were understood, without the estimated cost."""
    tracks, (frames, points) = chosen.tracks, understood.points.shape[:2]
    return Interpretation(
        num_frames=tracks.num_frames, num_points=tracks.num_points,
        num_faces=0 if chosen.mesh is None else len(chosen.mesh.faces),
        hidden_fraction=float((tracks.visible == 0).mean()),
        mesh_source=chosen.source, mesh_grid=chosen.grid, has_ground_truth=has_truth, has_rotations=has_rotations,
        layout=understood.layout, format=understood.format, coordinates=understood.coordinates, y_axis=understood.y_axis,
        given_frames=frames, given_points=points,
        num_left_out=len(chosen.left_out), left_out_points=chosen.left_out[:LEFT_OUT_LISTED].tolist(), notes=notes,
        **({} if film is None else _stated(film, chosen.selection)),
    )  # fmt: skip


def _stated(film: FilmTracks, selection: Selection) -> dict[str, Any]:
    """Return the picture size, and the frame rate of the selected frames, for the interpretation."""
    return {"image_size": f"{film.image_size[0]}x{film.image_size[1]}", "fps": film.rate(selection.frames)}


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """The selected frames and points, validated."""

    tracks: Tracks
    mesh: Mesh | None
    source: str
    grid: tuple[int, int] | None
    """Rows and columns of the grid that all points of the files fill row by row."""
    selection: Selection
    left_out: NDArray[np.intp]
    notes: list[str]


def _choose(
    understood: Understood, mesh: Path | str | None, options: Options, limits: Limits, film: FilmTracks | None
) -> _Chosen:
    whole = understood.points.shape[:2]
    frames, notes = chosen_frames(
        options.frames, whole[0], timed=film is not None and "fps" not in options.model_fields_set
    )
    if film is not None and mesh is None:
        surface = Surface(film.mesh, "film", ["The mesh is the grid of the film's tracker."])
    else:
        surface = read_surface(mesh, num_points=whole[1], picture=understood.grid, limits=limits)
    points, visible = understood.points, understood.visible
    picked = np.arange(whole[1]) if surface.points is None else surface.points
    if len(frames) < whole[0]:
        points, visible = selected(points, visible, np.s_[frames])
    if len(picked) < whole[1]:
        points, visible = selected(points, visible, np.s_[:, picked])
    _check_range(points, visible)
    check_order(surface, points, visible)
    kept, made, how = thin(points, visible, surface.mesh, options)
    if len(kept) < len(picked):
        points, visible = selected(points, visible, np.s_[:, kept])
    _check_size(points, limits)
    source = surface.source
    more: list[str] = []
    if source == "delaunay":
        made, more = triangulate(Tracks.from_arrays(points, visible), y_axis=understood.y_axis)
        source = "none" if made is None else source
    confidence, left_out, sparse = hide_sparsely_observed(points, visible, made, options)
    checked = Tracks.from_arrays(points, confidence)
    _check_extent(checked)
    selection = Selection(frames, picked[kept], whole)
    notes += [*surface.notes, *how, *_hidden_notes(checked), *sparse, *more]
    return _Chosen(checked, made, source, whole_grid(surface), selection, left_out, notes)


def _check_size(points: NDArray[np.generic], limits: Limits) -> None:
    frames, count = points.shape[:2]
    if frames > limits.max_frames or count > limits.max_points or frames * count > limits.max_observations:
        raise too_large(
            "tracks",
            expected=f"at most {limits.max_frames:,} frames, {limits.max_points:,} points and {limits.max_observations:,} observations",
            got=f"{frames:,} frames × {count:,} points",
        )


def _check_range(points: NDArray[np.generic], visible: NDArray[np.float64] | None) -> None:
    if points.dtype.itemsize <= 2:
        return  # 16-bit numbers are within the limit
    far = ((points > MAX_COORDINATE) | (points < -MAX_COORDINATE)).any(axis=2) & np.isfinite(points).all(axis=2)  # type: ignore[operator]
    if visible is not None:
        far &= visible > 0
    if far.any():
        raise InvalidInput(
            "out_of_range", field="tracks", expected=f"visible coordinates within ±{MAX_COORDINATE:g}",
            got=f"{int(far.sum()):,} of them beyond", hint="Mark them as hidden, or set them to NaN.",
        )  # fmt: skip


def _check_extent(tracks: Tracks) -> None:
    """Reject tracks that the solver would reject: in every frame, all visible points at one position."""
    seen = (tracks.visible > 0)[..., None]
    low = np.where(seen, tracks.points, np.inf).min(axis=1)
    high = np.where(seen, tracks.points, -np.inf).max(axis=1)
    if not (high > low).any():
        raise InvalidInput(
            "no_extent", field="tracks", expected="points that differ from each other in a frame",
            got="one position for all visible points of each frame",
            hint="Check that the points' axis is the second one, that the tracks are not all zero, and that frames show several points.",
        )  # fmt: skip


def _read_truth(
    given: Path | None, understood: Understood, selection: Selection, limits: Limits
) -> tuple[GroundTruth | None, list[str]]:
    """Return the truth of the selected frames and points; invalid truth in the tracks' file is skipped with a note."""
    raw = read_truth(given, understood, limits=limits)
    if raw is None:
        return None, []
    shapes, turned, like = raw.shapes, raw.rotations, selection.whole
    if shapes.shape == (*like, 3):
        like = (len(selection.frames), len(selection.points))
        if selection.narrows:
            shapes = shapes[np.ix_(selection.frames, selection.points)]
    if turned is not None and turned.ndim == 3 and len(turned) == selection.whole[0]:
        turned = turned[selection.frames]
    try:
        truth = GroundTruth.from_arrays(shapes, turned, like=like)
    except InvalidInput as error:
        if given is not None:
            raise
        return None, [
            f"The tracks file contains true shapes that cannot be used: expected {error.expected}, got {error.got}."
        ]
    if given is not None:
        return truth, raw.notes
    return truth, ["The tracks file also contains true shapes; they are used for metrics only.", *raw.notes]


def _hidden_notes(tracks: Tracks) -> list[str]:
    hidden = float((tracks.visible == 0).mean())
    notes = [f"{hidden:.1%} of the observations are hidden and carry no weight."] if hidden else []
    unseen = np.flatnonzero((tracks.visible > 0).sum(axis=1) == 0)
    if len(unseen):
        some = f"1 frame has no visible points: frame {unseen[0]}."
        notes.append(
            some if len(unseen) == 1 else f"{len(unseen)} frames have no visible points (first: frame {unseen[0]})."
        )
    return notes
