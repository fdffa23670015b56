"""Synthetic example sequences, as input files in formats that the readers accept."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pliant.solver.gallery import Sequence, corrupt, face, flag, sphere
from pliant.worker.errors import UnknownExample
from pliant.worker.films import example as example_film

Write = Callable[[Sequence], bytes]


@dataclass(frozen=True, slots=True)
class Example:
    """An example: its title, its generator, and its files as pairs of form field and file name."""

    name: str
    title: str
    make: Callable[[], Sequence]
    files: tuple[tuple[str, str], ...] = (("tracks", "tracks.npz"), ("mesh", "mesh.npz"), ("ground_truth", "truth.npz"))


def _npz(**arrays: ArrayLike) -> bytes:
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays)
    return packed.getvalue()


WRITERS: dict[str, Write] = {
    "tracks.npz": lambda sequence: _npz(
        tracks=sequence.tracks.points.astype(np.float32), visibility=sequence.tracks.visible > 0
    ),
    "mesh.npz": lambda sequence: _npz(faces=sequence.mesh.faces),
    "truth.npz": lambda sequence: _npz(shapes=sequence.shapes.astype(np.float32), rotations=sequence.rotations),
}

EXAMPLES = {
    example.name: example
    for example in (
        Example("face", "talking face", lambda: corrupt(face(30, 1500, degrees=40), noise=0.002, outliers=0.02)),
        Example("flag", "waving flag", lambda: corrupt(flag(30, 800), noise=0.002, hidden=0.05)),
        Example("sphere", "breathing sphere", lambda: sphere(30, 500)),
    )
}
"""Examples that are solved within seconds. Each has noise, outliers or hidden points."""


def example_file(name: str, file: str) -> bytes:
    """Return one input file of an example, with identical bytes on every call.

    Raises
    ------
    UnknownExample
        There is no such example, or it has no such file.
    """
    films = [f"{example_film.NAME}/{example_film.FILE}"] if example_film.available() else []
    if f"{name}/{file}" in films:
        return example_film.film()
    example = EXAMPLES.get(name)
    if example is None or file not in (listed for _, listed in example.files):
        known = [f"{one.name}/{listed}" for one in EXAMPLES.values() for _, listed in one.files]
        raise UnknownExample(name, file, known=[*known, *films])
    return WRITERS[file](example.make())
