"""The server that misbehaves does so, and our own client comes through it."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def clients(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT))
    return import_module("benchmarks.clients")


def tried(clients: ModuleType, trial: str, folder: Path) -> str:
    content = bytes(range(256)) * (clients.SIZE // 256)
    file = folder / "input.npz"
    file.write_bytes(content)
    with clients.serving(content) as (house, door):
        said: str = getattr(clients, trial)(
            house, door, lambda wish: clients.ask(sys.executable, "pliant", wish, door, file)
        )
    return said


@pytest.mark.parametrize(
    ("trial", "expected"),
    [
        ("failed", "`JobFailed`, the reason is in it"),
        ("lost", "1 job; the caller has its id"),
        ("broken", "whole; 24 MB sent in all"),
        ("flipped", "`CorruptDownload`"),
        ("token", "sends none"),
    ],
)
def test_our_client_comes_through(clients: ModuleType, trial: str, expected: str, tmp_path: Path) -> None:
    assert tried(clients, trial, tmp_path) == expected


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak of memory is read from /proc")
def test_sending_a_file_takes_no_memory(clients: ModuleType, tmp_path: Path) -> None:
    assert float(tried(clients, "memory", tmp_path).removesuffix(" MB")) < 8
