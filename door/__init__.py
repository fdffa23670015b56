"""Turn films or dense 2-D point tracks of a deforming object into a moving 3-D mesh.

``from pliant import Client`` talks to a running service; ``from pliant import solve`` reconstructs in this process. Names are
loaded on first use, so ``import pliant`` itself loads neither NumPy nor httpx.
"""

if __name__ != "pliant":
    raise ImportError(f"import this folder as pliant, not as {__name__!r}: install it with pip install -e .")

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.client import AsyncClient, Client
    from pliant.solver import solve

    __version__: str

_HOME_OF = {"AsyncClient": "pliant.client", "Client": "pliant.client", "solve": "pliant.solver"}

__all__ = ["AsyncClient", "Client", "__version__", "solve"]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("pliant")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'pliant' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
