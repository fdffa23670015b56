"""The one record of settings; every field is explained by its formula.

The energy that these settings shape, in normalised units (per-frame centroid of the visible points removed, then
divided by the RMS of what is left; λ is therefore dimensionless)::

    E(S) = Σ_fp v_fp ρ(w_fp − s_f R_f S_fp)  +  λ1 ‖H S‖_F²  +  λ2 ‖A vec(S)‖²  (+ λ3 Σ_i log-det-like rank penalty)

Dai, Deng, He (2017), eq. 7; the scale s_f, the weight v_fp and the rank term are ours. With the Gaussian prior λ1 Σ_p x_pᵀ Σ⁻¹ x_p
stands where λ1 ‖H S‖² does, Σ the learned covariance of a point's positions x_p; λ2 then acts in the axes in which deformation varies
alike, and neither H nor λ3 has a part in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, radians, tan
from typing import Literal

from pliant.solver.errors import InvalidSettings

Method = Literal["pseudo_inverse", "temporal", "spatio_temporal", "robust"]
CameraModel = Literal["scaled_orthographic", "orthographic"]
Preset = Literal["auto", "paper"]
Loss = Literal["l1", "l2", "huber"]
Prior = Literal["gaussian", "smooth+low_rank", "smooth"]
Surface = Literal["auto", "isometric", "free"]
Laplacian = Literal["auto", "grid8", "uniform", "cotangent"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How to solve. The defaults are meant to need no change."""

    method: Method = "robust"
    """`pseudo_inverse` R†W; `temporal` closed form (eq. 5); `spatio_temporal` eq. 7 with L2; `robust` eq. 7 with `loss`."""

    camera: CameraModel = "scaled_orthographic"
    """Scaled orthography estimates s_f per frame (gauge: mean of log s_f = 0); orthography has s_f = 1."""

    surface: Surface = "auto"
    """`isometric`: a sheet that bends without stretching, seen in perspective; `free`: none of that; `auto`: isometric where the tracks
    are those of a sheet and its edge lengths single out a focal length; tried only where `image_size` or the focal length is given, with
    the default camera model, method and prior."""

    focal: float | None = None
    """Focal length in the tracks' unit; None estimates it where it matters."""

    field_of_view: float | None = None
    """Horizontal field of view, degrees, in place of `focal`; needs `image_size`."""

    principal_point: tuple[float, float] | None = None
    """x, y in the tracks' unit; None: the centre of the image, or of the tracks where `image_size` is not given."""

    image_size: tuple[int, int] | None = None
    """Width and height of the image, the tracks' unit."""

    basis_size: int | None = None
    """K of the rank-3K factorization; None chooses it from the data and reports why."""

    refine_rotations: bool = True
    """Refine the cameras by variable projection on the likelihood of the tracks; with the Gaussian prior, together with it."""

    preset: Preset = "auto"
    """`paper`: λ1 = 1e-3, λ2 = 1, L1 with ε = 1e-3, first order; `auto`: weights from the noise and motion measured in the data."""

    temporal_weight: float | None = None
    """λ1, dimensionless; None takes the preset's. 0 leaves depth to nothing but the start."""

    spatial_weight: float | None = None
    """λ2, dimensionless; None takes the preset's. Unused without a mesh."""

    robust_scale: float | None = None
    """ε of the smoothed L1 (r ↦ √(r² + ε²)) or δ of Huber, in normalised units; None takes the preset's."""

    temporal_order: Literal[1, 2] | None = None
    """Order of the difference operator H; None takes the preset's. Without effect, and said so, with the Gaussian prior."""

    loss: Loss = "l1"
    """ρ of the data term when `method` is `robust`."""

    laplacian: Laplacian = "auto"
    """`grid8`: the paper's 8-direction stencil (needs a grid); `uniform` or `cotangent` on a mesh; `auto`: grid8 on a grid,
    else uniform."""

    prior: Prior = "gaussian"
    """Of method `robust` with preset `auto`. `gaussian`: one Gaussian over all frames for the positions of a point, its covariance
    learned from the tracks (modes and a random walk, by expectation maximisation), estimated cameras refined with it; λ1 weighs
    it. `smooth`: the paper's method exactly; `smooth+low_rank` adds a reweighted nuclear norm on the F×3P shape matrix (with preset
    `paper` only if `low_rank_weight` is given). With other methods or preset `paper`, `gaussian` means `smooth`."""

    low_rank_weight: float | None = None
    """λ3, dimensionless, strength of the low-rank prior; None takes it from the data. Without effect, and said so, unless `prior` is
    `smooth+low_rank`."""

    max_reweightings: int = 60
    """Upper bound on the outer IRLS steps."""

    tolerance: float = 1e-4
    """Converged when the relative change of the objective over one reweighting falls below this."""

    precision: Literal["float64", "float32"] = "float64"
    """Arithmetic of the large arrays. With the Gaussian prior always double, for its equations span ten magnitudes."""

    seed: int = 0
    """Seed of every random choice (restarts, sampled points). The same seed and thread count give the same bits."""

    @property
    def focal_length(self) -> float | None:
        """φ from `focal` or from `field_of_view`; None if neither is given."""
        if self.field_of_view is None or self.image_size is None:
            return self.focal
        return self.image_size[0] / (2 * tan(radians(self.field_of_view) / 2))

    @property
    def gaussian(self) -> bool:
        """True if the shapes get the Gaussian prior."""
        return self.prior == "gaussian" and self.method == "robust" and self.preset == "auto"

    def __post_init__(self) -> None:
        _check_choice("method", self.method, Method)
        _check_choice("camera", self.camera, CameraModel)
        _check_choice("surface", self.surface, Surface)
        self._check_image()
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
        if not 0 <= self.seed < 2**32:
            raise _out_of_range("seed", "a whole number from 0 to 4294967295", self.seed)

    def _check_image(self) -> None:
        if self.focal is not None and not 0 < self.focal < 1e9:
            raise _out_of_range("focal", "a positive number of pixels, or None", self.focal)
        if self.field_of_view is not None and not 1 <= self.field_of_view <= 170:
            raise _out_of_range("field_of_view", "degrees from 1 to 170, or None", self.field_of_view)
        if self.field_of_view is not None and self.focal is not None:
            raise _out_of_range("field_of_view", "either focal or field_of_view, not both", self.field_of_view)
        if self.image_size is not None and not (
            len(self.image_size) == 2 and all(0 < n < 1e6 for n in self.image_size)
        ):
            raise _out_of_range("image_size", "width and height in pixels", self.image_size)
        if self.field_of_view is not None and self.image_size is None:
            raise _out_of_range("field_of_view", "image_size beside it, for its width in pixels", self.field_of_view)
        point = self.principal_point
        if point is not None and not (len(point) == 2 and all(isfinite(n) and abs(n) < 1e9 for n in point)):
            raise _out_of_range("principal_point", "two finite numbers x, y in pixels", point)


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
