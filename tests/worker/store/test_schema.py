"""Records of a newer version are refused, also where the store answers only after the start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from fastapi.testclient import TestClient
from pliant.service import __main__ as service
from pliant.service.app import create_app
from pliant.service.settings import ServiceSettings
from pliant.worker import __main__ as worker
from pliant.worker.errors import NewerData, StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.store.schema import CURRENT
from pliant.worker.tokens import Tokens


@pytest.fixture
def newer(settings: Settings) -> Settings:
    """An installation of a newer version."""
    client: Any = connect(settings.redis, decode=True)
    client.set(f"{settings.queue}:schema", CURRENT + 1)
    client.close()
    return settings


@pytest.fixture
def away(newer: Settings, tmp_path: Path) -> tuple[Settings, Callable[[], None]]:
    """The same installation with a store that does not answer before the function is called."""
    socket = tmp_path / "store"
    return replace(newer, redis_url=f"unix://{socket}"), lambda: socket.symlink_to(urlsplit(newer.redis).path)


def use_environment(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in settings.to_environment().items():
        monkeypatch.setenv(name, value)
    for process in (service, worker):
        monkeypatch.setattr(process, "configure_logging", lambda *_: None)


def test_a_new_installation_has_the_current_version(settings: Settings) -> None:
    Jobs.open(settings).page()
    client: Any = connect(settings.redis, decode=True)
    assert client.get(f"{settings.queue}:schema") == str(CURRENT)
    client.close()
    assert Jobs.open(settings).page().jobs == []


@pytest.mark.parametrize("main", [service.main, worker.main])
def test_data_of_a_newer_version_is_refused_by_every_process(
    main: Callable[[list[str]], int], newer: Settings, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    use_environment(newer, monkeypatch)
    assert main([]) in (1, 2)
    assert "written by a newer Pliant" in capsys.readouterr().err


def test_the_version_is_checked_when_a_store_that_was_away_answers(away: tuple[Settings, Callable[[], None]]) -> None:
    settings, come_back = away
    jobs = Jobs.open(settings)
    with pytest.raises(StoreUnavailable):
        jobs.page()
    come_back()
    for _ in range(2):
        with pytest.raises(NewerData):
            jobs.page()


def test_a_service_whose_store_was_away_serves_no_data_of_a_newer_version(
    away: tuple[Settings, Callable[[], None]],
) -> None:
    settings, come_back = away
    app = create_app(Jobs.open(settings), ServiceSettings(), tokens=Tokens.open(settings))
    with TestClient(app, base_url="http://127.0.0.1") as http:
        assert http.get("/v1/jobs").json()["code"] == "store_unavailable"
        come_back()
        assert http.get("/v1/jobs").json()["code"] == "newer_data"


@pytest.mark.parametrize("task", ["work", "reconcile"])
def test_a_worker_does_not_start_without_its_store(
    task: str, away: tuple[Settings, Callable[[], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    use_environment(away[0], monkeypatch)
    assert worker.main([task]) == 1
