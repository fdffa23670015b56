"""Tracks, cameras, and the records in which a solve reports its steps and choices. Arrays are read-only."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.solver.errors import numeric, shape_text, wrong_input
from pliant.solver.limits import MAX_COORDINATE, frame_chunks
from pliant.solver.storage import allocated, let_go

MIN_FRAMES = 3
MIN_POINTS = 4

MAX_SCALE_RATIO = 1e4
"""Largest ratio of two given scales: with it, an object that fills a picture 10,000 pixels wide has the size of one pixel in another."""

Array = NDArray[np.floating]
"""Numbers of either precision."""
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


def read_only(array: NDArray[np.generic]) -> None:
    """Make the array read-only."""
    array.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Tracks:
    """Dense 2-D point tracks: the image positions of P points in F frames. Make them with `from_arrays`, which validates and converts.

    Both members are read-only arrays of float64 with the frames first and the points second: index p is the same point of the object in
    every frame. Positions are `(x, y)` in any unit, usually pixels: x right, y down unless the settings have `y_up`. `visible` is the
    confidence of each observation: 1 is certain, 0 hidden, and between them only the ratios count. They are the matrix W of Dai, Deng, He
    (2017), stored as points.
    """

    points: Floats
    """Image positions, shape `(F, P, 2)`, any unit, usually pixels; x right, y down unless the settings have `y_up`.
    Hidden entries are 0 and have weight 0; never NaN."""

    visible: Floats
    """Confidence in [0, 1] that the point is visible, shape `(F, P)`; 0 means hidden."""

    @classmethod
    def from_arrays(
        cls, points: ArrayLike, visible: ArrayLike | None = None, *, scratch: str | Path | None = None
    ) -> Tracks:
        """Validate and copy arrays.

        Parameters
        ----------
        points : array_like, shape (F, P, 2)
            NaN, infinity or the mask of a masked array in either coordinate marks the observation as hidden.
        visible : array_like, shape (F, P), optional
            Bool or confidence in [0, 1]; masked entries are hidden.
        scratch : path, optional
            Folder for temporary files that hold the copies; None holds them in memory. With it and memory-mapped input
            (`numpy.load(path, mmap_mode="r")`), tracks may be larger than the memory.

        Raises
        ------
        OSError
            The folder `scratch` is missing, cannot be written to, or has too little space.
        InvalidInput
            Wrong shape or type, F < 3, P < 4, confidence outside [0, 1], no visible observation, or one further than 1e12 from zero.
        """
        given = numeric(points, "tracks", "Convert the array to float.")
        if given.ndim != 3 or given.shape[2] != 2:
            raise wrong_input(
                "tracks", "wrong_shape", "(frames, points, 2)", shape_text(given), "Transpose or reshape the array."
            )
        frames, count, _ = given.shape
        if frames < MIN_FRAMES:
            raise wrong_input(
                "tracks", "too_few_frames", f"at least {MIN_FRAMES} frames", f"{frames}", "Track a longer clip."
            )
        if count < MIN_POINTS:
            raise wrong_input(
                "tracks", "too_few_points", f"at least {MIN_POINTS} points", f"{count}", "Track more points."
            )
        positions = allocated((frames, count, 2), scratch)  # in C order: results must not depend on the memory layout
        confidence = _confidence(visible, (frames, count), scratch)
        beyond = 0
        for some in frame_chunks(frames, count):
            positions[some] = given[some]
            confidence[some][~np.isfinite(positions[some]).all(axis=2)] = 0.0
            positions[some][confidence[some] == 0] = 0.0
            beyond += int((np.abs(positions[some]) > MAX_COORDINATE).any(axis=2).sum())
        if beyond > 0:
            raise wrong_input(
                "tracks", "out_of_range", f"visible coordinates within ±{MAX_COORDINATE:g}", f"{beyond:,} of them beyond",
                "Mark them as hidden, or set them to NaN.",
            )  # fmt: skip
        if not any(confidence[some].any() for some in frame_chunks(frames, count)):
            raise wrong_input(
                "tracks", "nothing_visible", "at least one finite, visible observation", "none",
                "Check for NaN everywhere, or a visibility array that is inverted.",
            )  # fmt: skip
        let_go(positions, confidence)
        read_only(positions)
        read_only(confidence)
        return cls(positions, confidence)

    def __repr__(self) -> str:
        return f"<Tracks of shape {np.shape(self.points)}>"

    @property
    def num_frames(self) -> int:
        """F."""
        return int(self.points.shape[0])

    @property
    def num_points(self) -> int:
        """P."""
        return int(self.points.shape[1])

    @property
    def all_visible(self) -> bool:
        """Whether every observation has confidence 1."""
        return bool((self.visible == 1).all())


def mean_scale(scales: Floats) -> float:
    """Return the geometric mean of positive scales `(F,)`."""
    return float(np.exp(np.log(scales).mean()))


def projections_of(rotations: Floats, scales: Floats) -> Floats:
    """Return s_f times the first two rows of R_f, shape `(F, 2, 3)`, of rotations `(F, 3, 3)` and scales `(F,)`."""
    return np.asarray(rotations[:, :2] * scales[:, None, None])


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Camera:
    """Cameras of all frames; `project` maps shapes to the image."""

    rotations: Floats
    """Camera from world, shape `(F, 3, 3)`; the third axis points away from the camera, or towards it if `y_up`."""

    scales: Floats
    """Image units per world unit at the shape's origin, shape `(F,)`; all 1 for plain orthography. The mean of the logarithm is 0 unless
    the scales are given or the camera is perspective. With a focal length φ, the origin has depth φ/s_f."""

    translations: Floats
    """Image position of each frame's shape origin, shape `(F, 2)`, the tracks' unit."""

    focal: float | None = None
    """φ, focal length, the tracks' unit; None: orthographic."""

    focal_std: float | None = None
    """Standard deviation of an estimated φ; 0 for a given one, None for orthographic cameras and where there is no estimate."""

    principal_point: Floats = field(default_factory=lambda: np.zeros(2))
    """c, shape `(2,)`, the tracks' unit; has no effect for orthographic cameras."""

    y_up: bool = False
    """Whether y of the tracks points up, so that depth is minus the third coordinate."""

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.rotations, self.scales, self.translations, self.principal_point):
            read_only(array)

    def __repr__(self) -> str:
        lens = "orthographic" if self.focal is None else f"focal length {self.focal:.4g}"
        return f"<Camera of {len(self.rotations)} frames, {lens}>"

    def depths(self, shapes: Floats) -> Floats:
        """Return z = ± s_f R_f[2] x, the depth behind each frame's origin in image units, shape `(F, P)`; minus if `y_up`."""
        sign = -1.0 if self.y_up else 1.0
        return np.asarray(sign * self.scales[:, None] * np.einsum("fpi,fi->fp", shapes, self.rotations[:, 2]))

    def project(self, shapes: Floats) -> Floats:
        """Return the image of shapes `(F, P, 3)`: c + (s_f R_f[:2] x + t_f − c) / (1 + z/φ), shape `(F, P, 2)`, the tracks' unit."""
        flat = self.scales[:, None, None] * (shapes @ self.rotations[:, :2].transpose(0, 2, 1))
        image = flat + self.translations[:, None]
        if self.focal is None:
            return np.asarray(image)
        nearer = 1 + self.depths(shapes) / self.focal
        return np.asarray(self.principal_point + (image - self.principal_point) / nearer[..., None])

    def centred_on(self, origins: Floats) -> Camera:
        """Return cameras that project `shapes - origins[:, None]` to where these cameras project shapes; origins `(F, 3)`, world units."""
        points = origins[:, None]
        nearer = 1.0 if self.focal is None else 1 + self.depths(points)[:, 0] / self.focal
        return replace(self, scales=self.scales / nearer, translations=self.project(points)[:, 0])

    def at(self, frames: slice) -> Camera:
        """Return the cameras of the given frames."""
        return replace(
            self, rotations=self.rotations[frames], scales=self.scales[frames], translations=self.translations[frames]
        )

    @property
    def positions(self) -> Floats | None:
        """T_f with camera coordinates R_f x + T_f, shape `(F, 3)`, world units; None for orthographic cameras."""
        if self.focal is None:
            return None
        away = (-1.0 if self.y_up else 1.0) * self.focal / self.scales
        return np.column_stack([(self.translations - self.principal_point) / self.scales[:, None], away])


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class KnownCamera:
    """Cameras given by the user instead of estimated ones."""

    rotations: Floats
    """Shape `(F, 3, 3)`, camera from world."""

    scales: Floats | None = None
    """Shape `(F,)`, the tracks' unit per unit of the shapes; None estimates them if the camera model has scales. For a perspective
    camera, φ divided by the depth of the shape's origin, which is the mean of its points, not the origin of your world: with another
    depth the shapes have another size."""

    focal: float | None = None
    """φ, the tracks' unit; None takes it from the settings."""

    principal_point: tuple[float, float] | None = None
    """(x, y), the tracks' unit; None takes it from the settings."""

    def __repr__(self) -> str:
        lens = "" if self.focal is None else f", focal length {self.focal:.4g}"
        return f"<KnownCamera of {len(self.rotations)} frames, scales {'estimated' if self.scales is None else 'given'}{lens}>"

    @classmethod
    def from_arrays(
        cls,
        rotations: ArrayLike,
        scales: ArrayLike | None = None,
        *,
        focal: float | None = None,
        principal_point: tuple[float, float] | None = None,
    ) -> KnownCamera:
        """Validate and copy cameras, shape `(F, 3, 3)`, or `(F, 2, 3)`, which the cross product of the rows completes.

        Raises
        ------
        InvalidInput
            Wrong type or shape, not finite, rows not orthonormal and right-handed to within 1e-3, a scale or focal length that is not
            positive, or scales that differ by more than a factor of 10,000.
        """
        if focal is not None:
            length = numeric(focal, "cameras.focal", "Give one length in the tracks' unit.").astype(np.float64)
            if length.shape != () or not (np.isfinite(length) and length > 0):
                raise wrong_input(
                    "cameras.focal",
                    "out_of_range",
                    "a positive, finite length",
                    str(focal) if length.shape == () else f"an array of shape {shape_text(length)}",
                    "Give one length for all frames, in the tracks' unit.",
                )
        if principal_point is not None:
            point = np.asarray(numeric(principal_point, "cameras.principal_point", "Give x and y."), dtype=np.float64)
            if point.shape != (2,) or not np.isfinite(point).all():
                raise wrong_input(
                    "cameras.principal_point", "not_finite", "two finite numbers", str(point.tolist()), "Give x and y."
                )
            principal_point = (float(point[0]), float(point[1]))
        complete = _orthonormal(rotations)
        factors = None if scales is None else _positive_scales(scales, len(complete))
        return cls(complete, factors, focal, principal_point)


@dataclass(frozen=True, slots=True)
class Step:
    """Progress of a solve: the argument of `on_step`."""

    stage: str
    """`cameras`, `initialise`, `reweight` or `finish`."""

    fraction: float
    """Completed share of the solve, estimated, in [0, 1]."""

    reweighting: int = 0
    """Number of finished reweightings."""

    max_reweightings: int = 0
    """Maximum number of reweightings."""

    objective: float | None = None
    """E after this step, normalized units; None before the first shapes."""

    residual: float | None = None
    """Median reprojection residual of visible observations, the tracks' unit; None before the first shapes."""

    seconds_left: float | None = None
    """Estimated seconds until the solve ends, from the plan and the pace so far."""


@dataclass(frozen=True, slots=True)
class FocalCandidate:
    """A focal length that the estimation of the cameras compared with others."""

    focal: float | None
    """Focal length, the tracks' unit; None: orthography."""

    mirrored: bool
    """Whether the depths had the opposite sign to the chosen one."""

    nll: float
    """Negative log likelihood of the tracks per point and frame."""


@dataclass(frozen=True, slots=True)
class Choices:
    """Values chosen automatically, with reasons for the report."""

    basis_size: int
    """K of the factorization."""
    temporal_weight: float
    """λ1, dimensionless."""
    spatial_weight: float
    """λ2, dimensionless."""
    robust_scale: float
    """ε of the smoothed L1 or δ of Huber, normalized units."""
    temporal_order: int
    """Order of the difference operator H."""
    low_rank_weight: float
    """λ3, dimensionless."""
    laplacian: str
    """Laplacian used: `grid8`, `uniform`, `cotangent` or `none`."""
    unit: float
    """RMS radius of the centred tracks, the tracks' unit: one normalized unit."""
    noise: float
    """Estimated standard deviation of the track noise, the tracks' unit."""
    camera: str = "scaled_orthographic"
    """Camera model used: `perspective`, `scaled_orthographic` or `orthographic`."""
    depth_sign: Literal["settled", "ambiguous"] = "ambiguous"
    """Whether given cameras or perspective determine the sign of depth; orthography does not."""
    focal_candidates: tuple[FocalCandidate, ...] = ()
    """Focal lengths that were compared; empty where perspective was not considered."""
    reasons: dict[str, str] = field(default_factory=dict)
    """One sentence per automatic choice, by name."""
    warnings: tuple[str, ...] = ()
    """Warnings for the user, e.g. that the camera hardly moved."""
    focal_lengths: tuple[tuple[float, float], ...] = ()
    """Focal lengths compared for an isometric surface, pixels, each with its isometric inconsistency I; empty if this was not tested."""


def _orthonormal(rotations: ArrayLike) -> Floats:
    """Return exact rotations `(F, 3, 3)`, read-only, for rows that are orthonormal to within 1e-3."""
    hint = "Give one rotation a frame."
    given = numeric(rotations, "rotations", hint).astype(np.float64)
    if given.ndim != 3 or given.shape[1:] not in ((2, 3), (3, 3)) or len(given) == 0:
        raise wrong_input("rotations", "wrong_shape", "(frames, 2, 3) or (frames, 3, 3)", shape_text(given), hint)
    rows = given[:, :2]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rows @ rows.transpose(0, 2, 1) - np.eye(2)).max()
    if not error <= 1e-3:  # also rejects NaN
        raise wrong_input(
            "rotations", "not_a_rotation", "orthonormal rows", f"a deviation of {error:.3g}",
            "Rows must have length 1 and be perpendicular; scales are given separately.",
        )  # fmt: skip
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    rows = left @ right
    third = np.cross(rows[:, 0], rows[:, 1])
    if given.shape[1] == 3 and not np.abs(given[:, 2] - third).max() <= 1e-3:
        mirrored = np.abs(given[:, 2] + third).max() <= 1e-3
        raise wrong_input(
            "rotations", "not_a_rotation", "a third row that is the cross product of the first two",
            "its negative: the determinants are -1" if mirrored else "another row",
            "Leave out the third row, shape (frames, 2, 3), if the axes are left-handed.",
        )  # fmt: skip
    complete = np.concatenate([rows, third[:, None]], axis=1)
    read_only(complete)
    return complete


def _positive_scales(scales: ArrayLike, frames: int) -> Floats:
    hint = "Give one scale a frame."
    factors = np.array(numeric(scales, "scales", hint), dtype=np.float64)
    if factors.shape != (frames,):
        raise wrong_input("scales", "wrong_shape", f"{frames} numbers", shape_text(factors), hint)
    # False for NaN. Files in single precision would overflow beyond.
    within = (factors >= 1 / MAX_COORDINATE) & (factors <= MAX_COORDINATE)
    if not within.all():
        expected = f"positive numbers from {1 / MAX_COORDINATE:g} to {MAX_COORDINATE:g}"
        raise wrong_input("scales", "out_of_range", expected, f"{factors[~within][0]:.3g}", hint)
    ratio = float(factors.max() / factors.min())
    if not ratio <= MAX_SCALE_RATIO:
        raise wrong_input(
            "scales", "out_of_range", f"scales that differ by at most a factor of {MAX_SCALE_RATIO:,.0f}", f"a factor of {ratio:.3g}",
            "Give the object's size in the picture, in pixels per unit of the shapes: focal length divided by depth.",
        )  # fmt: skip
    read_only(factors)
    return factors


def _confidence(visible: ArrayLike | None, shape: tuple[int, int], scratch: str | Path | None) -> Floats:
    confidence = allocated(shape, scratch)
    if visible is None:
        confidence[...] = 1.0
        return confidence
    shown = visible.filled(0) if isinstance(visible, np.ma.MaskedArray) else visible
    given = numeric(shown, "visibility", "Convert the array to bool.", kinds="bfiu")
    if given.shape != shape:
        raise wrong_input(
            "visibility",
            "wrong_shape",
            str(shape),
            shape_text(given),
            "Visibility is (frames, points), like the tracks.",
        )
    confidence[...] = given
    finite = bool(np.isfinite(confidence).all())
    if not finite or confidence.min() < 0 or confidence.max() > 1:
        got = (
            f"values from {confidence.min():.3g} to {confidence.max():.3g}" if finite else "values that are not finite"
        )
        raise wrong_input(
            "visibility", "out_of_range", "values from 0 to 1", got, "Convert a mask to bool, logits to probabilities, and NaN to 0."
        )  # fmt: skip
    return confidence
