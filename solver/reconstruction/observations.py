"""Common input of all stages: validated tracks in normalized units, the lens, and the monitor of a stage."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.lens import given_lens
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.errors import InvalidInput
from pliant.solver.limits import frame_chunks
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import ShouldStop
from pliant.solver.records import Floats, KnownCamera, Step, Tracks, mean_scale
from pliant.solver.settings import Settings
from pliant.solver.stages import planned, unseen_frames
from pliant.solver.tracks.normalization import Normalized, normalize, relative

OnStep = Callable[[Step], None]


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
    """Given cameras, their scales divided by `world_scale`; None if they are estimated."""

    world_scale: float = 1.0
    """Geometric mean of the given scales: units of the tracks per unit of the world. Inside the solver it is 1, so that the constants in
    normalized units do not depend on the unit of the given cameras."""

    @property
    def turning(self) -> bool:
        """Whether rotations are estimated and refined."""
        return self.known is None and self.settings.refine_rotations

    @property
    def known_scales(self) -> Floats | None:
        """The given scales; None if they are estimated."""
        return None if self.known is None else self.known.scales

    def without(self, outliers: NDArray[np.bool_]) -> Observations:
        """Return the observations with `outliers`, shape `(F, P)`, hidden, so that they do not affect unit and centroids."""
        kept = normalize(Tracks.from_arrays(self.tracks.points, np.where(outliers, 0.0, self.tracks.visible)))
        return replace(self, normalized=kept, lens=given_lens(kept, self.settings, self.known))

    def with_all(self) -> Observations:
        """Return all observations, including those hidden by `without`, in the same unit and about the same centroids."""
        # The most confident one may have been an outlier.
        seen = np.minimum(self.tracks.visible, self.normalized.full_confidence)
        return replace(self, normalized=in_units_of(self.normalized, Tracks(self.tracks.points, seen)))

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
        return replace(self, tracks=tracks, normalized=normalized, lens=lens, known=known)

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
    full = max(normalized.full_confidence, float(tracks.visible.max()))
    return replace(normalized, points=points, visible=relative(tracks.visible, full), full_confidence=full)


def observe(tracks: Tracks, known: KnownCamera | None, settings: Settings) -> Observations:
    """Return the tracks in normalized units, with their lens; `settings.order` must be `film` or `any`.

    Raises
    ------
    InvalidInput
        No observation is visible, or the tracks contradict the lens.
    """
    normalized = normalize(tracks)
    lens, world_scale = given_lens(normalized, settings, known), 1.0
    if known is not None and known.scales is not None:
        world_scale = mean_scale(known.scales)
        known = replace(known, scales=known.scales / world_scale)
    return Observations(tracks, normalized, settings, lens, known, world_scale)


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
        ordered=settings.order == "film", sheet=sheet, unseen=unseen, tolerance=settings.tolerance,
    )  # fmt: skip
    return Monitor(on_step, should_stop, plan=[stage for stage in plan if not only or stage.name in only])
