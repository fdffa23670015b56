"""Messages for values that pydantic rejects."""

from __future__ import annotations

import pytest
from pliant.schemas.options import Options
from pliant.schemas.validation import expectation
from pydantic import BaseModel, ValidationError


class Named(BaseModel):
    name: str


@pytest.mark.parametrize(
    ("model", "given", "words"),
    [
        (Options, {"loss": "l3"}, "'l1', 'l2' or 'huber'"),
        (Options, {"fps": 0}, "greater than 0"),
        (Options, {"seed": "x"}, "a valid integer, unable to parse string as an integer"),
        (Named, {}, "a value"),
    ],
)
def test_pydantic_errors_become_expectations(model: type[BaseModel], given: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError) as caught:
        model.model_validate(given)
    assert expectation(caught.value.errors()[0]) == words
