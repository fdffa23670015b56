"""Solver inputs from a tracked film."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import Tracks
from pliant.worker.films.tracker import Tracked, notes_on_rate
from pliant.worker.formats.cost import estimated
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.reading.arrays import read_file
from pliant.worker.formats.records import Inputs, Limits, Selection
from pliant.worker.formats.tracks.decimation import thin
from pliant.worker.formats.tracks.film_tracks import read_film_tracks
from pliant.worker.formats.tracks.selection import LEFT_OUT_LISTED, hide_sparsely_observed
from pliant.worker.formats.unused_options import notes_on_options


def read_tracked(file: Path, tracked: Tracked, options: Options) -> Inputs:
    """Read the `tracks.npz` of a film as solver inputs: points in the film's pixels, y down, and their grid as mesh.

    The file is validated like an uploaded one.

    Raises
    ------
    InvalidInput
        The arrays do not fit together, or `stride`, `max_points` or `min_seen` leave too few points.
    """
    limits = Limits()
    tracks = read_file(file, field="film", limits=limits, wanted=("tracks",)).get("tracks")
    if tracks is None or tracks.ndim != 3:
        raise damaged("film", "a film without tracks (F, P, 2)")
    film = read_film_tracks(file, field="film", shape=tracks.shape[:2], limits=limits)
    if film.times is None:
        raise damaged("film", "tracks of a film without times")
    given = tracks.shape[1]
    kept, mesh, how = thin(tracks, film.visible, film.mesh, options)
    points, visible = tracks[:, kept].astype(np.float64), film.visible[:, kept]
    confidence, left_out, sparse = hide_sparsely_observed(points, visible, mesh, options)
    checked = Tracks.from_arrays(points, confidence)
    hidden = float((checked.visible == 0).mean())
    notes = [
        f"{given:,} points of the film were tracked; {hidden:.1%} of the observations are hidden and carry no weight."
    ]
    stated = Interpretation(
        num_frames=checked.num_frames, num_points=checked.num_points, num_faces=0 if mesh is None else len(mesh.faces),
        hidden_fraction=hidden, mesh_source="film", has_ground_truth=False, has_rotations=False, layout="tracks (F, P, 2)",
        format=f"film ({tracked.container})", image_size=options.image_size, fps=tracked.fps, given_points=given,
        num_left_out=len(left_out), left_out_points=left_out[:LEFT_OUT_LISTED].tolist(),
        estimate=estimated(checked.num_frames, checked.num_points, options),
        notes=[*notes_on_options(options, film=True), *notes_on_rate(tracked.container), *notes, *how, *sparse, *tracked.warnings],
    )  # fmt: skip
    frames = np.arange(checked.num_frames)
    selection = Selection(frames, kept, (len(frames), given))
    return Inputs(
        checked,
        mesh,
        None,
        None,
        stated,
        selection if selection.narrows else None,
        texture=None if film.texture is None else film.texture.at_points(kept),
        frame_times=film.times,
        warnings=tracked.warnings,
    )
