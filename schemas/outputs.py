"""The wire contract of requests for further files of a stored result."""

from __future__ import annotations

from typing import Annotated

from pliant.schemas.options import Axes, Chosen, Colours, GlbMotion, Normals, Options, Outputs
from pydantic import Field


class OutputRequest(Chosen):
    """Files to write from a stored result. Options that are null keep the job's values."""

    outputs: Annotated[Outputs, Field(min_length=1)] = Field(
        description="Files to write; see the option `outputs` of a job."
    )
    fps: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] | None = Field(
        default=None, description="Frames per second of the written animation; null: as in the job."
    )
    normals: Normals | None = Field(default=None, description="As in the options of a job.")
    colours: Colours | None = Field(default=None, description="As in the options of a job.")
    axes: Axes | None = Field(default=None, description="As in the options of a job.")
    glb_quantized: bool | None = Field(default=None, description="As in the options of a job.")
    glb_motion: GlbMotion | None = Field(default=None, description="As in the options of a job.")

    def applied_to(self, options: Options) -> Options:
        """Return the options of a job with the outputs and the overridden options of this request."""
        return options.model_copy(update={name: value for name, value in self if value is not None})
