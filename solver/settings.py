"""Settings of a solve, each explained by its formula.

The energy, in normalized units (the points minus each frame's centroid, divided by their RMS radius, so λ is dimensionless)::

    E(S) = Σ_fp v_fp ρ(w_fp − s_f R_f S_fp)  +  λ1 ‖H S‖_F²  +  λ2 ‖A vec(S)‖²  (+ λ3 Σ_i log-det-like rank penalty)

The energy is eq. 7 of Dai, Deng, He (2017), extended by the scale s_f, the weight v_fp and the rank term. With the Gaussian prior,
λ1 Σ_p x_pᵀ Σ⁻¹ x_p replaces λ1 ‖H S‖², where Σ is the learned covariance of a point's positions x_p; λ2 then acts in the axes in which
the deformation is isotropic, and H and λ3 are not used.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from math import radians, tan
from numbers import Integral, Real
from typing import Literal

import numpy as np
from pliant.solver.errors import InvalidSettings

Method = Literal["pseudo_inverse", "temporal", "spatio_temporal", "robust"]
CameraModel = Literal["auto", "perspective", "scaled_orthographic", "orthographic"]
Preset = Literal["auto", "paper"]
Loss = Literal["l1", "l2", "huber"]
Prior = Literal["gaussian", "smooth+low_rank", "smooth"]
Surface = Literal["auto", "isometric", "free"]
Order = Literal["auto", "film", "any"]
Laplacian = Literal["auto", "grid8", "uniform", "cotangent"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of a solve. The defaults suit most sequences."""

    method: Method = "robust"
    """`pseudo_inverse`: R†W; `temporal`: closed form, eq. 5; `spatio_temporal`: eq. 7 with L2; `robust`: eq. 7 with `loss`."""

    camera: CameraModel = "auto"
    """`perspective`: a pinhole camera, u = c + (s_f R_f x + t_f) / (1 + z/φ); `scaled_orthographic`: φ = ∞, s_f per frame (gauge: mean of
    log s_f = 0); `orthographic`: also s_f = 1; `auto`: `perspective` where the tracks are clearly more probable with it, else
    `scaled_orthographic`. Without the Gaussian prior `auto` means `scaled_orthographic`, unless a focal length is given."""

    focal: float | None = None
    """φ, focal length in the tracks' unit (pixels); None estimates it. Not allowed with the orthographic models."""

    field_of_view: float | None = None
    """Horizontal angle of view in degrees, instead of `focal`: φ = width / (2 tan(angle/2)). Needs `image_size`."""

    principal_point: tuple[float, float] | None = None
    """c as (x, y) in the tracks' unit; None: the image centre, or the centre of the tracks if `image_size` is not given."""

    image_size: tuple[float, float] | None = None
    """(width, height) of the image in pixels. Pixel centres have integer coordinates, the first (0, 0): the image extends from −½ to
    width − ½, and its centre is ((width − 1)/2, (height − 1)/2)."""

    y_up: bool = False
    """Whether y of the tracks points up. The third axis of the camera then points to the viewer instead of away."""

    surface: Surface = "auto"
    """`isometric`: a sheet that bends without stretching, seen in perspective; `free`: any surface; `auto`: isometric if the tracks show
    a sheet and its edge lengths determine a focal length. `auto` tests this only if `image_size` or the focal length is given, with
    estimated cameras, camera `auto` or `perspective`, and the default method, preset and prior."""

    order: Order = "auto"
    """`film`: neighbouring frames are alike; `any`: unordered photographs, solved without comparing neighbours (Gaussian prior only);
    `auto`: `film` where the tracks are more probable as a random walk from frame to frame than as independent frames."""

    basis_size: int | None = None
    """K of the rank-3K factorization; None selects it from the data and reports the reason."""

    refine_rotations: bool = True
    """Refine the cameras by variable projection on the likelihood of the tracks; with the Gaussian prior, jointly with it."""

    preset: Preset = "auto"
    """`paper`: λ1 = 1e-3, λ2 = 1, L1 with ε = 1e-3, first order; `auto`: weights from the noise and motion measured in the data."""

    temporal_weight: float | None = None
    """λ1, dimensionless; None takes the preset's value. With 0, only the starting point determines depth."""

    spatial_weight: float | None = None
    """λ2, dimensionless; None takes the preset's value. Unused without a mesh."""

    robust_scale: float | None = None
    """ε of the smoothed L1 (r ↦ √(r² + ε²)) or δ of Huber, in normalized units; None takes the preset's value. Automatic λ1 and λ2 follow
    a given one, so that it decides only from which residual on the loss grows linearly."""

    temporal_order: Literal[1, 2] | None = None
    """Order of the difference operator H; None takes the preset's value. Has no effect with the Gaussian prior, which is reported."""

    loss: Loss = "l1"
    """ρ of the data term when `method` is `robust`."""

    laplacian: Laplacian = "auto"
    """`grid8`: the paper's 8-direction stencil (needs a grid); `uniform` or `cotangent` on a mesh; `auto`: grid8 on a grid,
    else uniform."""

    prior: Prior = "gaussian"
    """Prior of method `robust` with preset `auto`. `gaussian`: a Gaussian over all frames for the positions of each point, with a
    covariance learned from the tracks (modes and a random walk, by expectation maximisation) and weight λ1; estimated cameras are
    refined with it. `smooth`: the paper's method; `smooth+low_rank` adds a reweighted nuclear norm of the F×3P shape matrix (with
    preset `paper` only if `low_rank_weight` is given). With other methods or preset `paper`, `gaussian` means `smooth`."""

    low_rank_weight: float | None = None
    """λ3, dimensionless, weight of the low-rank prior; None derives it from the data. Has no effect unless `prior` is
    `smooth+low_rank`, which is reported."""

    max_reweightings: int = 60
    """Maximum number of reweightings, the outer IRLS iterations."""

    tolerance: float = 1e-4
    """Relative change of the objective over one reweighting below which the solve has converged."""

    precision: Literal["float64", "float32"] = "float64"
    """Precision of the large arrays. The Gaussian prior always uses float64, because its equations span ten orders of magnitude."""

    seed: int = 0
    """Seed of all random choices (samples, held-out entries, folds). The same seed and thread count give bit-identical results."""

    @property
    def focal_length(self) -> float | None:
        """φ from `focal` or from `field_of_view`; None if neither is given."""
        if self.field_of_view is None or self.image_size is None:
            return self.focal
        return self.image_size[0] / (2 * tan(radians(self.field_of_view) / 2))

    @property
    def centre(self) -> tuple[float, float] | None:
        """The principal point if it is given, else the image centre; None if neither is known."""
        if self.principal_point is None and self.image_size is not None:
            return ((self.image_size[0] - 1) / 2, (self.image_size[1] - 1) / 2)
        return self.principal_point

    @property
    def gaussian(self) -> bool:
        """Whether the solve uses the Gaussian prior."""
        return self.prior == "gaussian" and self.method == "robust" and self.preset == "auto"

    @property
    def is_orthographic(self) -> bool:
        """Whether the camera model has no perspective."""
        return self.camera in ("orthographic", "scaled_orthographic")

    @property
    def gives_weights(self) -> bool:
        """Whether λ1 or λ2 is given."""
        return self.temporal_weight is not None or self.spatial_weight is not None

    @property
    def estimates_scales(self) -> bool:
        """Whether every frame may have its own scale."""
        return self.camera != "orthographic"

    def __post_init__(self) -> None:
        for name in ("image_size", "principal_point"):
            value = getattr(self, name)
            plain = value.tolist() if isinstance(value, np.ndarray) else value  # an array has no truth value
            object.__setattr__(self, name, tuple(plain) if isinstance(plain, list) else plain)
        self._check_types()
        check_pinhole(self)
        _check_choice("method", self.method, Method)
        _check_choice("camera", self.camera, CameraModel)
        _check_choice("surface", self.surface, Surface)
        _check_choice("order", self.order, Order)
        _check_choice("preset", self.preset, Preset)
        _check_choice("loss", self.loss, Loss)
        _check_choice("laplacian", self.laplacian, Laplacian)
        _check_choice("prior", self.prior, Prior)
        _check_choice("precision", self.precision, Literal["float64", "float32"])
        if self.temporal_order not in (None, 1, 2):
            raise _out_of_range("temporal_order", "1, 2 or None", self.temporal_order)
        if self.basis_size is not None and not 1 <= self.basis_size <= 100:
            raise _out_of_range("basis_size", "a whole number from 1 to 100, or None", self.basis_size)
        for name in ("temporal_weight", "spatial_weight", "low_rank_weight"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1e6:
                raise _out_of_range(name, "a number from 0 to 1e6, or None", value)
        if self.robust_scale is not None and not 1e-9 <= self.robust_scale <= 1e3:
            raise _out_of_range("robust_scale", "a number from 1e-9 to 1e3, or None", self.robust_scale)
        if not 1 <= self.max_reweightings <= 1000:
            raise _out_of_range("max_reweightings", "a whole number from 1 to 1000", self.max_reweightings)
        if not 0 < self.tolerance < 1:
            raise _out_of_range("tolerance", "a number between 0 and 1", self.tolerance)
        if self.order == "any" and not self.gaussian:
            raise _contradiction(
                "order", "prior gaussian with method robust and preset auto beside order any",
                f"prior {self.prior}, method {self.method}, preset {self.preset}", "The other priors compare neighbouring frames.",
            )  # fmt: skip
        if self.surface == "isometric" and self.is_orthographic:
            raise _contradiction(
                "surface", f"auto or free beside camera {self.camera}", "'isometric'",
                "An isometric surface is found from its perspective. Leave out one of the two.",
            )  # fmt: skip
        if not 0 <= self.seed < 2**32:
            raise _out_of_range("seed", "a whole number from 0 to 4294967295", self.seed)

    def _check_types(self) -> None:
        for name in ("basis_size", "temporal_order", "max_reweightings", "seed"):
            value = getattr(self, name)
            whole = isinstance(value, Integral) and not isinstance(value, bool)
            if not (whole or (value is None and name in ("basis_size", "temporal_order"))):
                raise _out_of_range(name, "a whole number", value)
        for name in (
            "temporal_weight",
            "spatial_weight",
            "low_rank_weight",
            "robust_scale",
            "tolerance",
            "focal",
            "field_of_view",
        ):
            value = getattr(self, name)
            if not (isinstance(value, Real) or (value is None and name != "tolerance")):
                raise _out_of_range(name, "a number", value)
        for name in ("image_size", "principal_point"):
            value = getattr(self, name)
            if value is not None and not (
                isinstance(value, Collection) and all(isinstance(each, Real) for each in value)
            ):
                raise _out_of_range(name, "two numbers, or None", value)
        for name in ("refine_rotations", "y_up"):
            if not isinstance(getattr(self, name), (bool, np.bool_)):
                raise _out_of_range(name, "True or False", getattr(self, name))


MAX_CENTRE_DISTANCE = 10.0
"""Maximum distance of the principal point from the image, in image sizes: a crop may keep a tenth of the original."""


MAX_FIELD_OF_VIEW = 150.0
"""Horizontal angle of view, degrees, above which a given focal length is refused: the widest lenses without distortion have 127°, and
a focal length in millimetres, taken for pixels, gives 150° or more for all but long lenses."""


def check_pinhole(settings: Settings) -> None:
    """Validate the settings of a pinhole camera.

    Raises
    ------
    InvalidSettings
        A focal length or size that is not positive and finite; a focal length with which the image is wider than `MAX_FIELD_OF_VIEW`; both
        `focal` and `field_of_view`; an angle without `image_size` or outside 0 to 180 degrees; a focal length or angle with an
        orthographic camera; a principal point that is not finite or too far outside the image.
    """
    focal, angle, centre, size = settings.focal, settings.field_of_view, settings.principal_point, settings.image_size
    if focal is not None and not (math.isfinite(focal) and focal > 0):
        raise _out_of_range("focal", "a positive, finite length in pixels, or None", focal)
    if angle is not None and not 0 < angle < 180:
        raise _out_of_range("field_of_view", "an angle between 0 and 180 degrees, or None", angle)
    if size is not None and not (len(size) == 2 and all(math.isfinite(each) and each > 0 for each in size)):
        raise _out_of_range("image_size", "two positive numbers, width and height, or None", size)
    if focal is not None and size is not None and focal < (least := size[0] / 2 / tan(radians(MAX_FIELD_OF_VIEW / 2))):
        raise _contradiction(
            "focal", f"at least {least:.4g} pixels for a picture {size[0]:g} pixels wide", f"{focal:g}",
            "Give the focal length in pixels, not in millimetres: divide millimetres by the sensor's width, and multiply by the "
            "picture's width in pixels.",
        )  # fmt: skip
    if focal is not None and angle is not None:
        raise _contradiction(
            "field_of_view", "either focal or field_of_view", f"both: {focal} and {angle}", "Leave one out."
        )
    if angle is not None and size is None:
        raise _contradiction(
            "field_of_view", "image_size beside field_of_view", "no image_size", "Give the picture's width and height."
        )
    if (focal is not None or angle is not None) and settings.is_orthographic:
        given = "focal" if focal is not None else "field_of_view"
        raise _contradiction(
            given, f"no focal length with camera {settings.camera}", f"{given} = {focal or angle}",
            "Choose camera perspective or auto, or leave the focal length out.",
        )  # fmt: skip
    if centre is None:
        return
    if not (len(centre) == 2 and all(math.isfinite(each) for each in centre)):
        raise _out_of_range("principal_point", "two finite numbers x, y in pixels, or None", centre)
    if size is not None and any(
        not -MAX_CENTRE_DISTANCE * side <= each <= (1 + MAX_CENTRE_DISTANCE) * side
        for each, side in zip(centre, size, strict=True)
    ):
        raise _contradiction(
            "principal_point", f"a point within {MAX_CENTRE_DISTANCE:.0f} pictures of size {size[0]:g}x{size[1]:g}", f"{centre}",
            "Give x, y in pixels from the picture's upper left corner.",
        )  # fmt: skip


def _contradiction(name: str, expected: str, got: str, hint: str) -> InvalidSettings:
    return InvalidSettings("invalid_option", field=f"options.{name}", expected=expected, got=got, hint=hint)


def _check_choice(name: str, value: str, choices: object) -> None:
    allowed: tuple[str, ...] = choices.__args__  # type: ignore[attr-defined]
    if value not in allowed:
        raise _out_of_range(name, "one of " + ", ".join(allowed), value)


def _out_of_range(name: str, expected: str, got: object) -> InvalidSettings:
    return InvalidSettings(
        "invalid_option",
        field=f"options.{name}",
        expected=expected,
        got=repr(got),
        hint="Correct the value or leave it out.",
    )
