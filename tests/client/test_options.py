"""The options of the wire contract match the settings of the solver."""

from __future__ import annotations

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pliant.schemas
import pytest
from pliant.schemas.options import SOLVER_FIELDS, Options
from pliant.schemas.outputs import OutputRequest
from pliant.schemas.suggestions import closest
from pliant.solver import Settings
from pydantic import ValidationError


def test_options_mirror_the_solver_settings_and_their_defaults() -> None:
    settings = {field.name: field.default for field in dataclasses.fields(Settings)}
    del settings["y_up"]  # comes from how the tracks were read
    options = {name: Options.model_fields[name].default for name in SOLVER_FIELDS}
    assert options == settings


def test_every_option_has_a_description() -> None:
    assert all(field.description for field in Options.model_fields.values())


def test_type_checkers_see_which_fields_have_a_default() -> None:
    """Without a plugin they recognise `default=` only by its keyword (PEP 681), and else ask users for every field of a record."""
    (folder,) = pliant.schemas.__path__
    calls = [
        node
        for path in Path(folder).glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
    ]
    fields = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "Field"]
    assert len(fields) > 50
    assert not [ast.unparse(call) for call in fields if call.args]


@pytest.mark.parametrize("given", ["usd, glb,usd", ["usd", "glb"], ("glb", "usd")])
def test_outputs_are_a_list_or_comma_separated_names(given: object) -> None:
    assert Options(outputs=given).outputs == ("glb", "usd")
    assert Options.model_validate_json(Options(outputs=given).model_dump_json()).outputs == ("glb", "usd")


def test_a_principal_point_is_two_comma_separated_numbers() -> None:
    assert Options.model_validate({"principal_point": "320,240.5"}).principal_point == "320,240.5"
    with pytest.raises(ValueError, match="principal_point"):
        Options.model_validate({"principal_point": "320"})


def test_pairs_of_numbers_are_accepted_for_texts_of_two_numbers() -> None:
    given = Options.model_validate({"image_size": (np.int64(320), 240), "principal_point": (159.5, 119.5)})
    assert (given.image_size, given.principal_point) == ("320x240", "159.5,119.5")
    for wrong in ((320, 240, 3), ("a", "b"), 320, (0, 240)):
        with pytest.raises(ValueError, match="width and height in pixels, such as 1920x1080"):
            Options.model_validate({"image_size": wrong})


@pytest.mark.parametrize("kind", [np.int64, np.float64, np.float32])
def test_arrays_of_two_numbers_are_accepted_like_pairs(kind: type) -> None:
    given = Options.model_validate(
        {"image_size": np.array([320, 240], kind), "principal_point": np.array([159, 119], kind)}
    )
    assert (given.image_size, given.principal_point) == ("320x240", "159,119")
    assert Options.model_validate({"principal_point": np.array([159.5, 119])}).principal_point == "159.5,119"
    assert Options.model_validate({"image_size": (320.0, 240.0)}).image_size == "320x240"
    for wrong in (
        np.array([320.5, 240]),
        np.array([320, np.nan]),
        np.array([1, 2, 3]),
        np.zeros((2, 2)),
        np.array(320),
    ):
        with pytest.raises(ValueError, match="width and height in pixels, such as 1920x1080"):
            Options.model_validate({"image_size": wrong})


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("los", "loss"), ("focal_length", "focal"), ("image-size", "image_size"), ("imagesize", "image_size"), ("Fps", "fps"),
        ("frobnicate", None), ("x", None), ("loss" * 50, None),
    ],
)  # fmt: skip
def test_an_unknown_name_suggests_the_option_that_was_meant(given: str, meant: str | None) -> None:
    assert closest(given, Options.model_fields) == meant


def test_another_word_for_a_name_is_known_where_the_name_is() -> None:
    assert closest("mask", ["mesh", "region"]) == "region"
    assert closest("mask", ["task", "mesh"]) == "task"


@pytest.mark.parametrize("given", [{"fps": True}, {"seed": False}, {"temporal_order": True}, {"min_seen": True}])
def test_a_boolean_is_no_number(given: dict[str, bool]) -> None:
    with pytest.raises(ValidationError, match="a number"):
        Options.model_validate(given)
    assert Options.model_validate({"refine_rotations": False}).refine_rotations is False
    with pytest.raises(ValidationError, match="a number"):
        OutputRequest.model_validate({"outputs": ["glb"], "fps": True})


def test_an_unknown_output_is_rejected_with_the_known_names() -> None:
    with pytest.raises(ValueError, match="'glb', 'ply', 'obj', 'usd', 'abc', 'mdd', 'mat' or 'csv'"):
        Options(outputs="glb,fbx")
    assert Options(outputs="").outputs == ()
