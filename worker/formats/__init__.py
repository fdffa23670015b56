"""Readers: input files to validated records. Files that cannot be read are rejected with a code and a hint.

Names are imported on first access, so that the sandbox process loads only the parser it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.solver import InvalidInput
    from pliant.worker.formats.canonical import load_inputs, save_inputs
    from pliant.worker.formats.errors import AmbiguousInput
    from pliant.worker.formats.isolated_reader import store_inputs
    from pliant.worker.formats.read import read_inputs
    from pliant.worker.formats.records import GroundTruth, Inputs, Limits
    from pliant.worker.formats.texture import Texture

_HOME_OF = {
    "AmbiguousInput": "pliant.worker.formats.errors",
    "GroundTruth": "pliant.worker.formats.records",
    "Inputs": "pliant.worker.formats.records",
    "InvalidInput": "pliant.solver.errors",
    "Limits": "pliant.worker.formats.records",
    "Texture": "pliant.worker.formats.texture",
    "load_inputs": "pliant.worker.formats.canonical",
    "read_inputs": "pliant.worker.formats.read",
    "save_inputs": "pliant.worker.formats.canonical",
    "store_inputs": "pliant.worker.formats.isolated_reader",
}

__all__ = [
    "AmbiguousInput",
    "GroundTruth",
    "Inputs",
    "InvalidInput",
    "Limits",
    "Texture",
    "load_inputs",
    "read_inputs",
    "save_inputs",
    "store_inputs",
]


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'pliant.worker.formats' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)
