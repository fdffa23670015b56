"""Common input of all stages: validated tracks in normalized units, the lens, and the monitor of a stage."""

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
    """Tracks, with the given information about their cameras."""

    tracks: Tracks
    """The tracks as given."""

    normalized: Normalized
    """The tracks in normalized units."""

    settings: Settings
    """Settings with `order` resolved to `film` or `any`."""

    lens: Perspective | None
    """Lens under perspective camera models; None under orthographic ones."""

    known: KnownCamera | None
    """Given cameras; None if they are estimated."""

    @property
    def turning(self) -> bool:
        """Whether rotations are estimated and refined."""
        return self.known is None and self.settings.refine_rotations

    def without(self, outliers: NDArray[np.bool_]) -> Observations:
        """Return the observations with `outliers`, shape `(F, P)`, hidden, so that they do not affect unit and centroids."""
        kept = normalize(Tracks.from_arrays(self.tracks.points, np.where(outliers, 0.0, self.tracks.visible)))
        return replace(self, normalized=kept, lens=given_lens(self.tracks, kept, self.settings, self.known))

    def with_all(self) -> Observations:
        """Return all observations, including those hidden by `without`, in the same unit and about the same centroids."""
        return replace(self, normalized=in_units_of(self.normalized, self.tracks))

    def without_points(self) -> Observations:
        """Return a copy without the normalized points, which still serves `of` for other tracks of the same frames."""
        frames = self.tracks.num_frames
        return replace(
            self, normalized=replace(self.normalized, points=np.zeros((frames, 0, 2)), visible=np.zeros((frames, 0)))
        )

    def at(self, used: NDArray[np.intp]) -> Observations:
        """Return the observations of the frames `used`, in the unit of all frames."""
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
        """Return observations of other tracks of the same frames, in this unit and about these centroids.

        Raises
        ------
        InvalidInput
            The number of frames differs.
        """
        if tracks is self.tracks:
            return self
        if tracks.num_frames != self.tracks.num_frames:
            raise InvalidInput(
                "camera_mismatch", field="cameras", expected=f"cameras of {tracks.num_frames} frames, as many as the tracks have",
                got=f"{self.tracks.num_frames}", hint="Estimate the cameras from tracks of the same frames.",
            )  # fmt: skip
        return replace(self, tracks=tracks, normalized=in_units_of(self.normalized, tracks))


def in_units_of(normalized: Normalized, tracks: Tracks) -> Normalized:
    """Return tracks in the unit and about the centroids of `normalized`."""
    points = np.zeros(tracks.points.shape)
    for some in frame_chunks(tracks.num_frames, tracks.num_points):
        placed = (tracks.points[some] - normalized.centroid[some, None]) / normalized.unit
        points[some] = np.where(tracks.visible[some, :, None] > 0, placed, 0.0)
    return replace(normalized, points=points, visible=relative(tracks.visible, normalized.full_confidence))


def observe(tracks: Tracks, known: KnownCamera | None, settings: Settings) -> Observations:
    """Return the tracks in normalized units, with their lens; `settings.order` must be `film` or `any`.

    Raises
    ------
    InvalidInput
        No observation is visible, or the tracks contradict the lens.
    """
    normalized = normalize(tracks)
    return Observations(tracks, normalized, settings, given_lens(tracks, normalized, settings, known), known)


def check_fit(tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera | None, settings: Settings) -> None:
    """Check that mesh and given cameras match the tracks, and the settings the mesh.

    Raises
    ------
    InvalidInput
        Number of vertices (code `mesh_mismatch`) or of cameras (`camera_mismatch`).
    InvalidSettings
        `laplacian="grid8"` with a mesh that is not a grid, or `camera="orthographic"` with given scales that are not 1.
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
            got=f"{len(cameras.rotations)}", hint="Pass one camera per frame, in the order of the frames.",
        )  # fmt: skip
    scales = None if cameras is None else cameras.scales
    if scales is not None and settings.camera == "orthographic" and not np.allclose(scales, 1):
        raise InvalidSettings(
            "invalid_option", field="options.camera", expected="auto, scaled_orthographic or perspective beside given scales",
            got="'orthographic'", hint="Orthographic cameras have scale 1. Choose another model, or leave the scales out.",
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
    """Return the monitor of a whole solve, or of the stages named in `only`."""
    unseen = 0.0 if tracks.all_visible else unseen_frames(tracks.visible)
    plan = planned(
        tracks.num_frames, tracks.num_points, gaussian=settings.gaussian, known_cameras=known is not None,
        known_scales=known is not None and known.scales is not None,
        ordered=settings.order == "film", sheet=sheet, unseen=unseen,
    )  # fmt: skip
    return Monitor(
        on_step, should_stop, plan=[stage for stage in plan if not only or stage.name in only],
        descent=Descent(unseen, settings.tolerance, settings.max_reweightings),
        seconds_per_iteration=iteration_seconds(tracks.num_frames, tracks.num_points, gaussian=settings.gaussian),
    )  # fmt: skip
