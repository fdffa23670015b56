"""The wire contract of further files: what to write of a stored result."""

from __future__ import annotations

from typing import Annotated, Literal

from pliant.schemas.options import Options, Outputs
from pydantic import BaseModel, ConfigDict, Field

RESTATED = ("fps", "normals", "colours", "axes", "glb_quantized", "glb_motion")
"""Options of a job that a request for further files may state anew."""


class OutputRequest(BaseModel):
    """Files to write of a stored result. Each option that is null stays as the job has it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    outputs: Annotated[Outputs, Field(min_length=1)] = Field(
        description="Files to write: glb, ply, obj, usd, abc, mdd, mat, csv; see the option `outputs` of a job."
    )
    fps: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] | None = Field(
        None, description="Frames per second of the written animation."
    )
    normals: Literal["static", "animated", "none"] | None = Field(None, description="As the option of a job.")
    colours: Literal["none", "error", "expected_error"] | None = Field(None, description="As the option of a job.")
    axes: Literal["tracks", "viewer"] | None = Field(None, description="As the option of a job.")
    glb_quantized: bool | None = Field(None, description="As the option of a job.")
    glb_motion: Literal["auto", "frames"] | None = Field(None, description="As the option of a job.")

    def applied_to(self, options: Options) -> Options:
        """Return the options of a job with the outputs and the restated options of this request."""
        stated = {name: getattr(self, name) for name in RESTATED if getattr(self, name) is not None}
        return options.model_copy(update={"outputs": self.outputs, **stated})
