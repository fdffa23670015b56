"""The synchronous client in the repository is what `make client` generates from the asynchronous one."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

BUILD = runpy.run_path(str(Path(__file__).parents[2] / "build_client.py"))
SOURCE, TARGET = BUILD["SOURCE"], BUILD["TARGET"]

pytest.importorskip("unasync")


def test_the_committed_client_is_the_generated_one(tmp_path: Path) -> None:
    folder = tmp_path / "client" / "_sync"
    folder.mkdir(parents=True)
    BUILD["generate"](folder)
    generated = {path.name: path.read_text() for path in folder.glob("*.py")}
    committed = {path.name: path.read_text() for path in TARGET.glob("*.py")}
    assert generated == committed, "run `make client`"
    assert set(generated) == {path.name for path in SOURCE.glob("*.py")}


def test_the_generated_client_contains_no_async_code() -> None:
    for path in TARGET.glob("*.py"):
        lines = path.read_text().splitlines()
        assert lines[0] == f"# Generated from client/_async/{path.name} by `make client`. Edit that file instead."
        left = [line for line in lines[1:] if "await" in line or "async" in line.lower()]
        assert left == []
