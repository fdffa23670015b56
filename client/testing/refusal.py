"""What the double answers when it says no."""

from __future__ import annotations

from typing import Any

from pliant.schemas.job import Problem


class Refusal(Exception):
    """What the double answers instead of a result."""

    def __init__(self, status: int, code: str, detail: str, **more: Any) -> None:
        super().__init__(detail)
        self.problem = Problem(
            title=code.replace("_", " ").capitalize(), status=status, code=code, detail=detail, **more
        )
