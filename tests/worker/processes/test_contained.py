"""The pipe over which a contained process sends its progress."""

from __future__ import annotations

import os
from typing import Any

import pytest
from pliant.worker.processes.contained import _Progress


def test_lines_that_are_not_json_objects_are_skipped() -> None:
    stated: list[dict[str, Any]] = []
    with _Progress(stated.append) as progress:
        assert progress.target is not None
        os.write(progress.target, b'{"done": 0.5}\n{"done"\n[1]\n{"done": 1.0}\n{"torn')
        progress.read()
    assert stated == [{"done": 0.5}, {"done": 1.0}]


def test_an_error_of_the_callback_passes_through() -> None:
    def fail(_: dict[str, Any]) -> None:
        raise ValueError("a fault of the caller")

    with _Progress(fail) as progress:
        assert progress.target is not None
        os.write(progress.target, b'{"done": 0.5}\n')
        with pytest.raises(ValueError, match="a fault of the caller"):
            progress.read()
