"""The router of the API's routes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastapi import APIRouter


class Router(APIRouter):
    """A router whose GET routes also answer HEAD, with the same status and headers (RFC 9110); the server omits the body."""

    def add_api_route(
        self, path: str, endpoint: Callable[..., Any], *, include_in_schema: bool = True, **settings: Any
    ) -> None:
        """Add a route, and one for HEAD, which OpenAPI leaves out, beside a GET route."""
        super().add_api_route(path, endpoint, include_in_schema=include_in_schema, **settings)
        if settings["methods"] == ["GET"]:
            super().add_api_route(path, endpoint, include_in_schema=False, **settings | {"methods": ["HEAD"]})
