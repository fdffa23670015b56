"""Messages for values that pydantic rejects."""

from __future__ import annotations

from typing import Annotated

import pytest
from pliant.schemas.options import Options
from pliant.schemas.outputs import OutputRequest
from pliant.schemas.shares import ShareRequest
from pliant.schemas.validation import alternatives, expectation
from pydantic import BaseModel, Field, ValidationError


class Named(BaseModel):
    name: Annotated[str, Field(pattern="^[a-z]$")]


class Below(BaseModel):
    share: Annotated[float, Field(lt=0.5)]


@pytest.mark.parametrize(
    ("model", "given", "words"),
    [
        (Options, {"loss": "l3"}, "'l1', 'l2' or 'huber'"),
        (Options, {"fps": 0}, "more than 0"),
        (ShareRequest, {"expires_in": -1}, "at least 60"),
        (ShareRequest, {"expires_in": 10**9}, "at most 31,622,400"),
        (Below, {"share": 1}, "less than 0.5"),
        (Options, {"seed": "x"}, "a valid integer"),
        (Options, {"seed": 1.5}, "a valid integer"),
        (Options, {"refine_rotations": "maybe"}, "a valid boolean"),
        (OutputRequest, {"outputs": ["glb"], "normal": "none"}, "no value, because the name is unknown"),
        (Options, {"region_polygon": "80,30 160,30 160,150"}, "a list in brackets"),
        (Named, {}, "a value"),
        (Named, {"name": "B"}, "text that matches ^[a-z]$"),
    ],
)
def test_pydantic_errors_become_expectations(model: type[BaseModel], given: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError) as caught:
        model.model_validate(given)
    assert expectation(caught.value.errors()[0]) == words


def test_alternatives_are_listed_with_or() -> None:
    assert alternatives(["high", "normal", "low"]) == "high, normal or low"
    assert alternatives(["on", "off"]) == "on or off"
    assert alternatives(["on"]) == "on"
