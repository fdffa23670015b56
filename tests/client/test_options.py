"""The options on the wire and the settings of the solver say the same."""

from __future__ import annotations

import dataclasses

from pliant.client.options import SOLVER_FIELDS, Options
from pliant.solver import Settings


def test_options_mirror_the_settings_name_for_name_and_default_for_default() -> None:
    settings = {field.name: field.default for field in dataclasses.fields(Settings)}
    options = {name: Options.model_fields[name].default for name in SOLVER_FIELDS}
    assert options == settings


def test_every_option_says_what_it_means() -> None:
    assert all(field.description for field in Options.model_fields.values())
