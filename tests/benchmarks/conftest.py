"""Access to the benchmarks."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest


@pytest.fixture
def bench(monkeypatch):
    """Return a function that imports a module of the benchmarks from the root of the repository, as they do."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent.parent))
    return lambda name: import_module(f"benchmarks.{name}")
