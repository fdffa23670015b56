"""The examples that the page offers are what the readers take, and come out the same every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.worker.errors import UnknownExample
from pliant.worker.examples import EXAMPLES, example_file
from pliant.worker.formats import read_inputs


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_every_example_is_read_as_described(name: str, tmp_path: Path) -> None:
    parts = {}
    for part, file in EXAMPLES[name].files:
        parts[part] = tmp_path / file
        parts[part].write_bytes(example_file(name, file))
    inputs = read_inputs(
        tracks=parts["tracks"], mesh=parts["mesh"], ground_truth=parts["ground_truth"], options=Options()
    )
    made = EXAMPLES[name].make()
    assert inputs.interpretation.has_ground_truth
    assert inputs.interpretation.mesh_source == "given"
    assert inputs.interpretation.num_faces == len(made.mesh.faces)
    seen = made.tracks.visible > 0
    np.testing.assert_array_equal(inputs.tracks.visible > 0, seen)
    np.testing.assert_allclose(inputs.tracks.points[seen], made.tracks.points[seen], atol=1e-4)
    assert inputs.ground_truth is not None
    np.testing.assert_allclose(inputs.ground_truth.shapes, made.shapes, atol=1e-4)


def test_the_same_bytes_every_time() -> None:
    assert example_file("flag", "tracks.npz") == example_file("flag", "tracks.npz")


@pytest.mark.parametrize(
    ("name", "file"), [("absent", "tracks.npz"), ("face", "absent.npz"), ("face", "../tracks.npz")]
)
def test_an_unknown_example_names_those_there_are(name: str, file: str) -> None:
    with pytest.raises(UnknownExample, match=r"There are: face/tracks\.npz, face/mesh\.npz"):
        example_file(name, file)
