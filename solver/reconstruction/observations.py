"""What all stages of a reconstruction start from: checked tracks in normalized units, the lens, and how to monitor a stage."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.lens import given_lens
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.descent import Descent
from pliant.solver.errors import InvalidInput, InvalidSettings
from pliant.solver.limits import frame_chunks
from pliant.solver.mesh import Mesh
from pliant.solver.monitor import Monitor
from pliant.solver.records import KnownCamera, Step, Tracks
from pliant.solver.settings import Settings
from pliant.solver.stages import iteration_seconds, planned, unseen_frames
from pliant.solver.tracks.normalization import Normalized, normalize, relative

OnStep = Callable[[Step], None]
ShouldStop = Callable[[], bool]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Tracks and what is given about their cameras."""

    tracks: Tracks
    """As given."""

    normalized: Normalized
    """The tracks in normalized units."""

    settings: Settings
    """With `order` `film` or `any`."""

    lens: Perspective | None
    """What is given about perspective; None for orthographic camera models."""

    known: KnownCamera | None
    """Given cameras; None where they are estimated."""

    @property
    def turning(self) -> bool:
        """Whether rotations are estimated and refined."""
        return self.known is None and self.settings.refine_rotations

    def without(self, outliers: NDArray[np.bool_]) -> Observations:
        """Return the same observations with those where `outliers`, shape `(F, P)`, hidden: they have no part in unit and centroids."""
        kept = normalize(Tracks.from_arrays(self.tracks.points, np.where(outliers, 0.0, self.tracks.visible)))
        return replace(self, normalized=kept, lens=given_lens(self.tracks, kept, self.settings, self.known))

    def with_all(self) -> Observations:
        """Return the observations with those that were hidden, in the same unit and about the same centroids."""
        return replace(self, normalized=in_units_of(self.normalized, self.tracks))

    def without_points(self) -> Observations:
        """Return what the same tracks, or others of their frames, are normalized with, without the points themselves."""
        frames = self.tracks.num_frames
        return replace(
            self, normalized=replace(self.normalized, points=np.zeros((frames, 0, 2)), visible=np.zeros((frames, 0)))
        )

    def at(self, used: NDArray[np.intp]) -> Observations:
        """Return some of the frames, in the unit of all."""
        tracks = Tracks.from_arrays(self.tracks.points[used], self.tracks.visible[used])
        whole = self.normalized
        normalized = replace(
            whole, points=whole.points[used], visible=whole.visible[used], centroid=whole.centroid[used]
        )
        lens = None if self.lens is None else replace(self.lens, offsets=self.lens.offsets[used])
        known = self.known
        if known is not None:
            scales = None if known.scales is None else known.scales[used]
            known = replace(known, rotations=known.rotations[used], scales=scales)
        return Observations(tracks, normalized, self.settings, lens, known)

    def of(self, tracks: Tracks) -> Observations:
        """Return other tracks of the same frames, in the unit and about the centroids of these.

        Raises
        ------
        InvalidInput
            The number of frames differs.
        """
        if tracks is self.tracks:
            return self
        if tracks.num_frames != self.tracks.num_frames:
            raise InvalidInput(
                "camera_mismatch", field="cameras", expected=f"cameras of {tracks.num_frames} frames, as the tracks",
                got=f"{self.tracks.num_frames}", hint="Estimate the cameras from tracks of the same frames.",
            )  # fmt: skip
        return replace(self, tracks=tracks, normalized=in_units_of(self.normalized, tracks))


def in_units_of(normalized: Normalized, tracks: Tracks) -> Normalized:
    """Return tracks in the unit and about the centroids of others."""
    points = np.zeros(tracks.points.shape)
    for some in frame_chunks(tracks.num_frames, tracks.num_points):
        placed = (tracks.points[some] - normalized.centroid[some, None]) / normalized.unit
        points[some] = np.where(tracks.visible[some, :, None] > 0, placed, 0.0)
    return replace(normalized, points=points, visible=relative(tracks.visible, normalized.full_confidence))


def observe(tracks: Tracks, known: KnownCamera | None, settings: Settings) -> Observations:
    """Return the tracks in normalized units, with their lens; `settings.order` is `film` or `any`.

    Raises
    ------
    InvalidInput
        The tracks show nothing, or contradict the lens.
    """
    normalized = normalize(tracks)
    return Observations(tracks, normalized, settings, given_lens(tracks, normalized, settings, known), known)


def check_fit(tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera | None, settings: Settings) -> None:
    """Check that mesh and given cameras fit the tracks, and the settings the mesh.

    Raises
    ------
    InvalidInput
        Codes mesh_mismatch and camera_mismatch.
    InvalidSettings
        `laplacian="grid8"` with faces only.
    """
    if mesh is not None and mesh.num_points != tracks.num_points:
        raise InvalidInput(
            "mesh_mismatch", field="mesh", expected=f"{tracks.num_points} vertices, one for each point of the tracks",
            got=f"{mesh.num_points}", hint="Vertex i of the mesh must be point i of the tracks.",
        )  # fmt: skip
    if mesh is not None and settings.laplacian == "grid8" and mesh.grid is None and len(mesh.faces) > 0:
        raise InvalidSettings(
            "invalid_option", field="options.laplacian", expected="a mesh that is a pixel grid", got="faces only",
            hint="Use laplacian auto, uniform or cotangent, or give the points as a grid.",
        )  # fmt: skip
    if cameras is not None and len(cameras.rotations) != tracks.num_frames:
        raise InvalidInput(
            "camera_mismatch", field="rotations", expected=f"{tracks.num_frames} rotations, one for each frame of the tracks",
            got=f"{len(cameras.rotations)}", hint="Give one camera a frame, in the order of the frames.",
        )  # fmt: skip


def monitored(
    tracks: Tracks,
    known: KnownCamera | None,
    settings: Settings,
    on_step: OnStep | None,
    should_stop: ShouldStop | None,
    *,
    sheet: bool = False,
    only: Collection[str] = (),
) -> Monitor:
    """Return the monitor of a solve, or of the stages named by `only`."""
    unseen = 0.0 if tracks.all_visible else unseen_frames(tracks.visible)
    plan = planned(
        tracks.num_frames, tracks.num_points, gaussian=settings.gaussian, known_cameras=known is not None,
        known_scales=known is not None and known.scales is not None,
        sheet=sheet, unseen=unseen,
    )  # fmt: skip
    return Monitor(
        on_step, should_stop, plan=[stage for stage in plan if not only or stage.name in only],
        descent=Descent(unseen, settings.tolerance, settings.max_reweightings),
        seconds_per_iteration=iteration_seconds(tracks.num_frames, tracks.num_points, gaussian=settings.gaussian),
    )  # fmt: skip
