"""`pliant token`: what its commands print."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from io import StringIO

import pytest
from pliant.cli.commands.tokens import table_of
from pliant.worker.tokens import Scope, Token
from rich.console import Console

NOW = datetime.now(UTC)


def token(id: str, **fields: object) -> Token:
    made = {
        "name": "nightly runs",
        "scopes": (Scope.READ, Scope.SUBMIT),
        "owner": id,
        "sha256": "0" * 64,
        "created_at": NOW,
    }
    return Token.model_validate({"id": id, **made, **fields})


@pytest.mark.parametrize("width", [80, 60, 200])
def test_the_list_shows_ids_whole_at_any_width(width: int) -> None:
    tokens = [
        token("98b3295eb3f1"),
        token("0123456789ab", owner="98b3295eb3f1", expires_at=NOW + timedelta(days=9), max_queued=5),
    ]
    text = StringIO()
    Console(file=text, width=width).print(table_of(tokens))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    for each in tokens:
        assert sum(line.split()[1:2] == [each.id] for line in lines if len(line.split()) > 1) == 1


def test_the_list_shows_the_limits_that_a_token_has_of_its_own() -> None:
    limited = token("98b3295eb3f1", max_queued=5, max_running=2, max_body_bytes=100 << 20, requests_per_minute=60)
    text = StringIO()
    Console(file=text, width=200).print(table_of([limited, token("0123456789ab")]))
    assert "5 queued, 2 running, 100 MB a body, 60 requests a minute" in text.getvalue()
    assert len(table_of([token("0123456789ab")]).columns) == len(table_of([limited]).columns) - 1
