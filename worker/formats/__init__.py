"""Readers: files as people have them in, checked records out. What cannot be read is refused with a code and a hint."""

from pliant.solver import InvalidInput
from pliant.worker.formats.apart import store_inputs
from pliant.worker.formats.canonical import load_inputs, save_inputs
from pliant.worker.formats.errors import AmbiguousInput
from pliant.worker.formats.read import read_inputs
from pliant.worker.formats.records import GroundTruth, Inputs, Limits

__all__ = [
    "AmbiguousInput",
    "GroundTruth",
    "Inputs",
    "InvalidInput",
    "Limits",
    "load_inputs",
    "read_inputs",
    "save_inputs",
    "store_inputs",
]
