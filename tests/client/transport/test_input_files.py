"""Files written from the arrays of a submission."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pliant.client import BadArgument
from pliant.client.input_files import mesh_part, tracks_file
from pliant.solver import Mesh

TRACKS = np.arange(48.0).reshape(3, 8, 2)


def test_arrays_of_a_dictionary_keep_their_names(tmp_path: Path) -> None:
    """`file` and `allow_pickle` are arguments of `numpy.savez`, and still names of arrays."""
    given = {"tracks": TRACKS, "file": np.arange(3), "allow_pickle": np.ones(2, dtype=bool), "in-order": np.float32(4)}
    with np.load(tracks_file(given, None, tmp_path)) as read:
        assert sorted(read.files) == sorted(given)
        for name, array in given.items():
            np.testing.assert_array_equal(read[name], array)
            assert read[name].dtype == np.asarray(array).dtype


def test_equal_arrays_give_equal_bytes(tmp_path: Path) -> None:
    """The service recognises a repeated submission by them."""
    first, second = (tracks_file({"tracks": each}, None, tmp_path).read_bytes() for each in (TRACKS, TRACKS.copy()))
    assert first == second


def test_values_that_are_no_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadArgument, match="odd"):
        tracks_file({"odd": [[1], [2, 3]]}, None, tmp_path)


@pytest.mark.parametrize("mesh", [trimesh.creation.box(), Mesh.from_faces([[0, 1, 2]], 3)], ids=["trimesh", "solver"])
def test_an_object_that_has_faces_is_refused_and_they_are_named(mesh: Any, tmp_path: Path) -> None:
    with pytest.raises(BadArgument, match=r"mesh: expected faces .*, got a value of type \w+\. .*mesh\.faces"):
        mesh_part(mesh, tmp_path)
    with np.load(mesh_part(mesh.faces, tmp_path)) as read:
        np.testing.assert_array_equal(read["faces"], mesh.faces)
