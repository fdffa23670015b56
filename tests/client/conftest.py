"""A real service for the tests of this folder: started once, with its queue and one worker, on a free port."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from pliant.client.cli.demo import running


@pytest.fixture(scope="session")
def service_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    pytest.importorskip("pliant.service.app")
    with running(tmp_path_factory.mktemp("service")) as url:
        yield url
