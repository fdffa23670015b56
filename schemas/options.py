"""The options of a job: one flat record, each field with its meaning, unit, bounds and default.

The fields for the solver mirror `pliant.solver.Settings`; a test compares the two.
"""

from __future__ import annotations

import re
from functools import partial
from numbers import Real
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    field_validator,
)

SOLVER_FIELDS = (
    "method", "camera", "surface", "order", "basis_size", "refine_rotations", "preset", "temporal_weight", "spatial_weight", "robust_scale",
    "temporal_order", "loss", "laplacian", "prior", "low_rank_weight", "max_reweightings", "tolerance", "precision", "seed",
    "focal", "field_of_view", "principal_point", "image_size",
)  # fmt: skip
"""The fields for the solver; the others determine how inputs are read and results written."""

POINT = r"^-?\d{1,7}(\.\d{1,9})?,-?\d{1,7}(\.\d{1,9})?$"
"""Two numbers separated by a comma."""
SIZE = r"^[1-9]\d{0,5}x[1-9]\d{0,5}$"
SLICE = r"^(-?\d{1,7})?:(-?\d{1,7})?(:([1-9]\d{0,6})?)?$"

Weight = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]

Output = Literal["glb", "ply", "obj", "usd", "abc", "mdd", "mat", "csv"]
"""A result file written on request; `shapes.npz`, `report.json` and `preview.bin` are always written."""

Normals = Literal["static", "animated", "none"]
Colours = Literal["none", "error", "expected_error"]
Axes = Literal["tracks", "viewer"]
GlbMotion = Literal["auto", "frames"]


def _listed(given: object) -> object:
    """Accept `"glb,mat"` for `["glb", "mat"]`, as sent by command lines and forms."""
    return [word.strip() for word in given.split(",") if word.strip()] if isinstance(given, str) else given


def _in_order(given: tuple[Output, ...]) -> tuple[Output, ...]:
    """Remove duplicates and sort, so that equal requests have equal records."""
    return tuple(name for name in get_args(Output) if name in given)


def _joined(given: Any, *, sign: str) -> object:
    """Accept a pair of numbers, as Python programs have it, for a text such as `"320x240"`. JSON has no pairs, only lists."""
    pair = tuple(given) if getattr(given, "shape", None) == (2,) else given  # an array; NumPy is not imported here
    if isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(number, Real) for number in pair):
        return sign.join(str(int(number) if number == number // 1 else number) for number in pair)
    return given


def _matching(given: object, *, pattern: str, words: str) -> object:
    """Return the text if it matches; else raise ValueError with `words`, which are clearer than the pattern."""
    if not isinstance(given, str) or re.fullmatch(pattern, given) is None:
        raise ValueError(words)
    return given


PointText = Annotated[
    str,
    BeforeValidator(partial(_matching, pattern=POINT, words="x,y in pixels, such as 319.5,239.5")),
    BeforeValidator(partial(_joined, sign=",")),
    WithJsonSchema({"type": "string", "pattern": POINT}),
]
SizeText = Annotated[
    str,
    BeforeValidator(partial(_matching, pattern=SIZE, words="width and height in pixels, such as 1920x1080")),
    BeforeValidator(partial(_joined, sign="x")),
    WithJsonSchema({"type": "string", "pattern": SIZE}),
]
SliceText = Annotated[
    str,
    BeforeValidator(partial(_matching, pattern=SLICE, words="start:stop:step, such as 10:200:2")),
    WithJsonSchema({"type": "string", "pattern": SLICE}),
]
Pixel = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]

Outputs = Annotated[tuple[Output, ...], Field(max_length=64), BeforeValidator(_listed), AfterValidator(_in_order)]


class Chosen(BaseModel):
    """Base of the options that a request sets: unknown names are rejected, and so are `true` and `false` for numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*", mode="wrap")
    @classmethod
    def _refuse_booleans_for_numbers(cls, given: object, read: ValidatorFunctionWrapHandler) -> object:
        value = read(given)
        if isinstance(given, bool) and not isinstance(value, bool):
            raise ValueError("a number")
        return value


class Options(Chosen):
    """Options of a reconstruction. Every option has a default; unknown names are rejected."""

    method: Literal["pseudo_inverse", "temporal", "spatio_temporal", "robust"] = Field(
        default="robust",
        description="pseudo_inverse: the shapes of smallest norm that fit the tracks. temporal: closed form with smoothness in time. "
        "spatio_temporal: smoothness in time and space, least squares. robust: in time and space, with a loss that resists outliers.",
    )
    camera: Literal["auto", "perspective", "scaled_orthographic", "orthographic"] = Field(
        default="auto",
        description="perspective: a pinhole camera. scaled_orthographic: no perspective, one scale per frame. orthographic: no scales. "
        "auto: perspective if the tracks are clearly more probable with it, else scaled_orthographic.",
    )
    focal: Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)] | None = Field(
        default=None, description="Focal length in pixels of the tracks; null: estimated for a perspective camera."
    )
    field_of_view: Annotated[float, Field(gt=0, lt=180, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Horizontal angle of view in degrees, instead of focal: focal = width / (2 tan(angle / 2)). Needs image_size.",
    )
    principal_point: PointText | None = Field(
        default=None,
        description="Principal point X,Y in pixels, e.g. 319.5,239.5; null: the centre of image_size, "
        "((width - 1) / 2, (height - 1) / 2), or that of the tracks without it.",
    )
    surface: Literal["auto", "isometric", "free"] = Field(
        default="auto",
        description="isometric: a sheet that bends without stretching, such as paper or cloth, seen in perspective. free: no such "
        "assumption. auto: isometric if the tracks are those of a sheet and its edge lengths determine a focal length; "
        "needs image_size or focal.",
    )
    order: Literal["auto", "film", "any"] = Field(
        default="auto",
        description="film: neighbouring frames are alike. any: photographs in no order; results do not depend on it. "
        "Needs prior gaussian and at most 360 frames. auto: any if neighbouring frames are no more alike than others.",
    )
    basis_size: Annotated[int, Field(ge=1, le=100)] | None = Field(
        default=None,
        description="Number K of basis shapes in the factorization for the rotations; null: selected from the data.",
    )
    refine_rotations: bool = Field(
        default=True, description="Refine the cameras by maximising the likelihood of the tracks."
    )
    preset: Literal["auto", "paper"] = Field(
        default="auto",
        description="Source of weights that are not given. auto: measured from noise and motion. paper: the published setting.",
    )
    temporal_weight: Weight | None = Field(
        default=None, description="λ1, weight of smoothness in time, dimensionless; null: the preset's."
    )
    spatial_weight: Weight | None = Field(
        default=None, description="λ2, weight of smoothness along the surface, dimensionless; null: the preset's."
    )
    robust_scale: Annotated[float, Field(ge=1e-9, le=1e3, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Residual at which the loss changes from quadratic to linear, in RMS radii of the tracks; null: the preset's.",
    )
    temporal_order: Literal[1, 2] | None = Field(
        default=None,
        description="1 penalises velocity, 2 acceleration; null: the preset's. No effect with prior gaussian.",
    )
    loss: Literal["l1", "l2", "huber"] = Field(default="l1", description="Loss of the data term when method is robust.")
    laplacian: Literal["auto", "grid8", "uniform", "cotangent"] = Field(
        default="auto",
        description="Spatial smoothness: 8-direction stencil on a pixel grid, or mesh Laplacian; auto: by the mesh given.",
    )
    prior: Literal["gaussian", "smooth+low_rank", "smooth"] = Field(
        default="gaussian",
        description="gaussian: a Gaussian over the frames for the positions of each point, learned from the tracks (method robust with "
        "preset auto; else smooth); smooth: the published method; smooth+low_rank also favours shapes that few basis shapes "
        "explain (with preset paper only if low_rank_weight is given).",
    )
    low_rank_weight: Weight | None = Field(
        default=None,
        description="λ3, weight of the low-rank prior, dimensionless; null: from the data. No effect unless prior is "
        "smooth+low_rank.",
    )
    max_reweightings: int = Field(
        default=60, ge=1, le=1000, description="Maximum number of reweightings of the robust loss."
    )
    tolerance: float = Field(
        default=1e-4,
        gt=0,
        lt=1,
        description="Relative change of the objective over one reweighting below which the solve has converged.",
    )
    precision: Literal["float64", "float32"] = Field(
        default="float64", description="Precision of the large arrays; prior gaussian needs float64."
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Seed of all random choices.")

    time_limit: Annotated[float, Field(gt=0, le=604_800, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Time limit of the job in seconds, after which it fails with timed_out; null: only the service's own limit.",
    )
    fps: float = Field(
        default=25.0,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Frames per second of the written animation. For a film, the default is its own rate.",
    )
    outputs: Outputs = Field(
        default=("glb", "ply", "csv"),
        description="Files to write besides shapes.npz, report.json and preview.bin. glb: animated glTF. ply, obj: a mesh per frame, in a "
        "zip. usd: USD with time samples. abc: Alembic. mdd: point cache for Blender, Maya and Houdini. mat: MATLAB. "
        "csv: metrics of every frame and of every point.",
    )
    normals: Normals = Field(
        default="animated",
        description="animated: they move with the shape, in shapes.glb and in every frame of PLY, OBJ and USD. static: those of the "
        "first shape, in shapes.glb only. none: viewers compute their own.",
    )
    colours: Colours = Field(
        default="none",
        description="none: no colours. error: points are coloured by their distance from the ground truth, or by their reprojection "
        "residual where there is none. expected_error: by the error that the solver expects, in percent of the object's size, "
        "with prior gaussian and for isometric surfaces. PLY, OBJ and USD are coloured in every frame, shapes.glb by the mean over frames.",
    )
    axes: Axes = Field(
        default="viewer",
        description="Axes of PLY and OBJ. viewer: y up, as in shapes.glb. tracks: those of the tracks, as in shapes.npz.",
    )
    glb_quantized: bool = Field(
        default=False,
        description="Write shapes.glb with 16-bit positions and 8-bit normals (KHR_mesh_quantization): about half the size, and rounded "
        "to a 65,000th of the largest extent and half a degree.",
    )
    glb_motion: GlbMotion = Field(
        default="auto",
        description="How shapes.glb stores the motion. auto: as few modes of motion as keep every point within a thousandth "
        "of the bounding box's diagonal. frames: one morph target per frame, exact in single precision, for up to 200 frames.",
    )

    layout: Literal["auto", "frames_points", "points_frames"] = Field(
        default="auto",
        description="Order of the track array's axes. auto: by the names in the file and by smoothness in time; an error if several fit.",
    )
    rows: Literal["auto", "interleaved", "stacked"] = Field(
        default="auto",
        description="Rows of a 2F × P matrix: interleaved x1, y1, x2, y2 … or stacked all x, then all y; auto: from the data.",
    )
    y_axis: Literal["auto", "down", "up"] = Field(
        default="auto",
        description="Direction of y. auto: down (pixels), or up if coordinates are centred on zero. With the wrong one, the result is "
        "upside down and mirrored.",
    )
    coordinates: Literal["auto", "pixels", "unit", "signed"] = Field(
        default="auto",
        description="Unit of x and y. pixels: used unchanged, whatever their unit. unit: from 0 to 1, divided by (width − 1, "
        "height − 1). signed: from −1 to 1 likewise. auto: by the values; values within 0 … 1 without image_size are an error.",
    )
    image_size: SizeText | None = Field(
        default=None,
        description="WIDTHxHEIGHT of the picture in pixels, e.g. 640x480; needed if coordinates are fractions of it. "
        "Pixel centres lie at whole numbers from 0. The picture's centre is the principal point of a perspective camera.",
    )
    coordinate_order: Literal["auto", "xy", "yx"] = Field(
        default="auto",
        description="Order of a point's two coordinates. auto: x, y, unless only y, x lies inside image_size.",
    )
    visibility: Literal["auto", "bool", "probability", "logits"] = Field(
        default="auto",
        description="Type of the visibility array. bool: not 0 is true. probability: from 0 to 1. logits: any number, 0 is undecided. "
        "auto: by the values. The name of the array determines whether it marks visible or hidden points.",
    )
    frames: SliceText | None = Field(
        default=None, description="Frames to use, start:stop:step as in Python, e.g. 10:200:2; null: all."
    )
    stride: int = Field(
        default=1,
        ge=1,
        le=1000,
        description="Use every n-th point: every n-th row and column of a pixel grid, else every n-th of the list; with a given mesh, "
        "one in n, spread evenly.",
    )
    max_points: Annotated[int, Field(ge=4, le=10_000_000)] | None = Field(
        default=None,
        description="Use at most this many points, spread evenly, and decimate the mesh accordingly; null: all. A pixel grid "
        "is decimated by the smallest stride that suffices.",
    )
    min_seen: int = Field(
        default=2,
        ge=1,
        le=1000,
        description="A point visible in fewer frames than this is excluded from the solve. It keeps its index in the result and "
        "follows its neighbours on the mesh.",
    )

    template_frame: Annotated[int, Field(ge=0, le=10_000_000)] | None = Field(
        default=None,
        description="For a film: the frame whose points are tracked in both directions, counted in the complete film from 0; null: the "
        "region's frame if it lies in the middle third of the film, otherwise the sharpest frame of that third, or a frame on the way "
        "there if most of the region is lost.",
    )
    grid_step: Annotated[float, Field(ge=1, le=100, allow_inf_nan=False)] | None = Field(
        default=None,
        description="For a film: distance of neighbouring points in the film's pixels; null: 4 to 8 in the tracked frames, chosen for "
        "about 4,000 points.",
    )
    longest_side: int = Field(
        default=960,
        ge=64,
        le=4096,
        description="For a film: maximum size of the longer side of tracked frames, pixels; larger films are scaled down. Tracks remain in "
        "the film's own pixels.",
    )
    region_frame: int = Field(
        default=0,
        ge=0,
        le=10_000_000,
        description="For a film: the frame on which the region was drawn, counted in the complete film from 0.",
    )
    region_polygon: Annotated[tuple[tuple[Pixel, Pixel], ...], Field(min_length=3, max_length=1000)] | None = Field(
        default=None,
        description="For a film: corners [x, y] of the region to track, in the film's pixels, y down, instead of a mask picture; "
        "null: the mask, or the entire picture.",
    )

    @property
    def picture_size(self) -> tuple[int, int] | None:
        """Width and height in `image_size`, pixels; None without it."""
        if self.image_size is None:
            return None
        width, height = self.image_size.split("x")
        return int(width), int(height)

    @property
    def principal_point_xy(self) -> tuple[float, float] | None:
        """Coordinates in `principal_point`, pixels; None without it."""
        if self.principal_point is None:
            return None
        x, y = self.principal_point.split(",")
        return float(x), float(y)
