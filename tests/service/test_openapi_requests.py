"""Schemathesis sends valid and invalid requests to a real service: no 5xx, no response that the OpenAPI document lacks.

`PLIANT_EXAMPLES=200 pytest -s tests/service/test_openapi_requests.py` sends more requests and prints the counts.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from pliant.service.app import create_app
from pliant.service.settings import ServiceSettings
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings
from pliant.worker.tokens import Scope, Tokens
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi import checks
from schemathesis.transport.serialization import Binary
from serving import Running, Serve, finish, form, tracks

EXAMPLES = int(os.environ.get("PLIANT_EXAMPLES", "4"))
"""Requests of each kind for each operation."""

UNASKED = [
    # A schema cannot express that bytes are a track file, so a request that matches it may be rejected; and unknown query
    # parameters and headers are ignored, as HTTP's own headers are.
    checks.positive_data_acceptance,
    checks.negative_data_rejection,
]

schemathesis.openapi.format("binary", st.one_of(st.just(tracks()), st.binary(max_size=300)).map(Binary))


def _document() -> dict[str, Any]:
    with TemporaryDirectory() as data:
        of_worker = Settings(data=Path(data))
        return create_app(Jobs.open(of_worker), ServiceSettings(), tokens=Tokens.open(of_worker)).openapi()


DOCUMENT = _document()
OPERATIONS = [(method.upper(), path) for path, methods in DOCUMENT["paths"].items() for method in methods]
SLOW = {("POST", "/v1/jobs"), ("PUT", "/v1/jobs/{id}")}
"""Operations whose forms take seconds to generate."""


@pytest.fixture(scope="module")
def guarded(serve: Serve) -> Running:
    return serve(auth="required", requests_per_minute=0, max_queued=0, stall_seconds=5.0)


@pytest.fixture(scope="module")
def schema(guarded: Running) -> Any:
    return schemathesis.openapi.from_dict(_plain(httpx.get(f"{guarded.url}/openapi.json").json()))


@pytest.fixture(scope="module")
def counts() -> Iterator[Counter[str]]:
    made: Counter[str] = Counter()
    yield made
    total = sum(made.values())
    print(f"\n{total} requests to {len(OPERATIONS)} operations: {dict(sorted(made.items()))}")


@pytest.fixture
def token(guarded: Running) -> str:
    return guarded.tokens.create("fuzz", scopes=[Scope.ADMIN])[1]


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE], ids=["fits", "does not fit"])
@pytest.mark.parametrize(
    ("method", "path"),
    [pytest.param(*each, marks=pytest.mark.slow if each in SLOW else ()) for each in OPERATIONS],
    ids=lambda part: str(part),
)
def test_every_response_is_declared(
    guarded: Running, schema: Any, counts: Counter[str], token: str, method: str, path: str, mode: GenerationMode
) -> None:
    operation = schema[path][method]
    headers = {"Authorization": f"Bearer {token}"}
    finished = _finished_job(guarded, headers) if "{id}" in path else ""

    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=True, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(case=operation.as_strategy(generation_mode=mode), known=st.booleans())
    def ask(case: Any, known: bool) -> None:
        if known and "{id}" in path and isinstance(case.path_parameters, dict):
            case.path_parameters["id"] = finished
            if "{name}" in path:
                case.path_parameters["name"] = "shapes.npz"
        answer = case.call(base_url=guarded.url, headers=headers, timeout=20)
        counts[str(answer.status_code)] += 1
        unasked = UNASKED
        if path == "/readyz":  # rightly 503: no worker runs here
            unasked = [*UNASKED, not_a_server_error]
        else:
            assert answer.status_code < 500, answer.text
        case.validate_response(answer, headers=headers, excluded_checks=unasked)

    try:
        ask()
    except Unsatisfiable:
        assert (path, mode) in [(each, GenerationMode.NEGATIVE) for each in ("/healthz", "/errors", "/errors/{code}")]
    assert httpx.get(f"{guarded.url}/healthz").status_code == 200
    assert guarded.left_on_disk == []


def _plain(part: Any) -> Any:
    """Rewrite uniform `prefixItems` as `items`: schemathesis 4.32 turns the former into a schema that it then rejects."""
    if isinstance(part, list):
        return [_plain(each) for each in part]
    if not isinstance(part, dict):
        return part
    plain = {key: _plain(value) for key, value in part.items()}
    if "prefixItems" in plain:
        plain["items"] = plain.pop("prefixItems")[0]
    return plain


def _finished_job(guarded: Running, headers: dict[str, str]) -> str:
    with httpx.Client(base_url=guarded.url, headers=headers, timeout=20) as http:
        id = str(http.post("/v1/jobs", files=form()).json()["id"])
    finish(guarded, id, b"result")
    return id
