"""What docs/api.md and docs/settings.md say is what the code does."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pliant.service import metrics
from pliant.service.app import create_app
from pliant.service.middleware.auth import is_public, needed
from pliant.service.settings import ServiceSettings
from pliant.service.submission import FILES, TEXTS, UPLOADS
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import VARIABLES, Settings
from pliant.worker.tokens import Tokens

ROOT = Path(__file__).parents[2]
API = (ROOT / "docs" / "api.md").read_text()
SETTINGS = (ROOT / "docs" / "settings.md").read_text()
SOURCES = "\n".join(
    path.read_text() for folder in ("service", "worker", "client") for path in (ROOT / folder).rglob("*.py")
)


def document() -> dict[str, Any]:
    of_worker = Settings()
    app = create_app(Jobs.open(of_worker), ServiceSettings(), tokens=Tokens.open(of_worker))
    found: dict[str, Any] = app.openapi()
    return found


def test_every_address_is_in_the_table_with_its_scope_and_answers() -> None:
    said = {
        address: (scope, {int(each) for each in answers.split(", ")})
        for address, scope, answers in re.findall(
            r"^\| `([A-Z]+ /\S*)` \| .+ \| (\w+) \| ([\d, ]+) \|$", API, re.MULTILINE
        )
    }
    real: dict[str, tuple[str, set[int]]] = {}
    for path, operations in document()["paths"].items():
        for method, operation in operations.items():
            scope = needed(method.upper(), path)
            word = "none" if is_public(path) else "any" if scope is None else scope.value
            answers = {int(status) for status in operation["responses"] if int(status) < 400}
            real[f"{method.upper()} {path}"] = (word, answers)
    assert said == real


def test_every_error_status_that_is_declared_has_a_line_and_every_code_exists() -> None:
    lines = re.findall(r"^\| (\d{3}(?:, \d{3})*) \| (.+?) \|", API.partition("## Errors")[2], re.MULTILINE)
    listed = {int(status) for statuses, _ in lines for status in statuses.split(", ")}
    declared = {
        int(status)
        for operations in document()["paths"].values()
        for operation in operations.values()
        for status in operation["responses"]
        if int(status) >= 400
    }
    assert declared <= listed
    codes = [code for _, names in lines for code in re.findall(r"`(\w+)`", names)]
    assert len(codes) > 30
    put_together = {"unknown_option"}  # from "unknown_" and the field's name
    assert [code for code in codes if f'"{code}"' not in SOURCES and code not in put_together] == []


def test_every_part_of_a_submission_is_explained() -> None:
    table = API.partition("## Submitting")[2].partition("## Waiting")[0]
    parts = (FILES | TEXTS) - set(UPLOADS) | {"tracks_upload"}
    assert {part for part in parts if f"`{part}`" not in table} == set()


def test_every_metric_is_named() -> None:
    made = set(re.findall(r'"(pliant_\w+)"', Path(metrics.__file__).read_text()))
    assert len(made) > 10
    assert {name for name in made if f"`{name}`" not in API} == set()


def test_every_setting_is_in_the_table_and_no_other() -> None:
    listed = set(re.findall(r"^\| `(PLIANT_\w+)` \|", SETTINGS, re.MULTILINE))
    of_service = set(re.findall(r'"(PLIANT_\w+)"', (ROOT / "service" / "settings.py").read_text()))
    of_client = {"PLIANT_URL", "PLIANT_TOKEN", "PLIANT_WEBHOOK_SECRET"}
    assert listed == {variable for variable, _, _ in VARIABLES.values()} | of_service | of_client


def test_every_default_in_the_table_is_the_real_one() -> None:
    said = dict(re.findall(r"^\| `(PLIANT_\w+)` \| ([^|]+?) \|", SETTINGS, re.MULTILINE))
    defaults = Settings()
    for name, (variable, _, _) in VARIABLES.items():
        value = getattr(defaults, name)
        if isinstance(value, int | float) and not isinstance(value, bool):
            assert float(said[variable].replace(",", "")) == value, variable
    of_service = ServiceSettings()
    for variable, value in (
        ("PLIANT_PORT", of_service.port),
        ("PLIANT_MAX_BODY_MB", of_service.max_body_bytes // 2**20),
        ("PLIANT_MAX_QUEUED", of_service.max_queued),
        ("PLIANT_PARSERS", of_service.parsers),
    ):
        assert int(said[variable].replace(",", "")) == value, variable
    assert (said["PLIANT_AUTH"], said["PLIANT_HOST"]) == (of_service.auth, of_service.host)
