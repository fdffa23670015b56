"""Every documented track format gives the same bits as the canonical file, before and after the solve."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from pliant.cli import app
from pliant.schemas.options import Options
from pliant.solver import Solution, solve
from pliant.worker.formats import Inputs, read_inputs
from pliant.worker.formats.solver_settings import solver_settings
from track_files import COLUMNS, FORMATS, ROWS, Written
from typer.testing import CliRunner

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("forked_readers")]

DOCUMENT = Path(__file__).parents[3] / "docs" / "reference" / "formats.md"
MESH = f"{ROWS}x{COLUMNS}"
QUICK = {"method": "temporal", "refine_rotations": False, "basis_size": 1, "y_axis": "down"}
SOLVED = ("npz, points first", "MATLAB v7.3, 2 × P × F", "CSV")
"""Formats whose tracks are also solved: the solver gets nothing of a format but the arrays that are compared for each."""


def solved(inputs: Inputs) -> Solution:
    return solve(inputs.tracks, inputs.mesh, settings=solver_settings(Options.model_validate(QUICK)))


@pytest.mark.parametrize("made", FORMATS, ids=str)
def test_every_format_equals_the_canonical_file(made: Written, tmp_path: Path) -> None:
    path = tmp_path / f"tracks.{made.suffix}"
    made.write(path)
    canonical = {"tracks": made.points} | ({} if made.visibility is None else {"visibility": made.visibility})
    np.savez(tmp_path / "canonical.npz", **canonical)
    options = Options.model_validate({**QUICK, **made.options})
    got = read_inputs(tracks=path, mesh=MESH, options=options)
    right = read_inputs(tracks=tmp_path / "canonical.npz", mesh=MESH, options=Options.model_validate(QUICK))
    assert got.mesh is not None
    assert right.mesh is not None
    for mine, theirs in (
        (got.tracks.points, right.tracks.points),
        (got.tracks.visible, right.tracks.visible),
        (got.mesh.faces, right.mesh.faces),
    ):
        # The order in memory too, on which the last bits of a sum depend.
        assert (mine.dtype, mine.strides, mine.tobytes()) == (theirs.dtype, theirs.strides, theirs.tobytes())
    assert got.interpretation.format == made.recognised
    if made.truth is not None:
        assert got.ground_truth is not None
        np.testing.assert_array_equal(got.ground_truth.shapes, made.truth)
    if made.title in SOLVED:
        solutions = solved(got), solved(right)
        for part in (lambda solution: solution.shapes, lambda solution: solution.camera.rotations):
            assert part(solutions[0]).tobytes() == part(solutions[1]).tobytes()

    pairs = [word for pair in {**QUICK, **made.options}.items() for word in ("-O", "{}={}".format(*pair))]
    ran = CliRunner().invoke(app, ["inspect", str(path), "--mesh", MESH, *pairs, "--json"])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout) == got.interpretation.model_dump(mode="json")


def test_the_documented_table_is_the_tested_one() -> None:
    rows = re.findall(r"^\| (.+?) \| (.+?) \|$", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    assert [row for row in rows if row in {(made.title, made.layout) for made in FORMATS}] == [
        (made.title, made.layout) for made in FORMATS
    ]


def test_confidence_beside_visibility_multiplies_it(tmp_path: Path) -> None:
    rows = [f"{f},{p},{10 * p + f},{p * p + 2 * f},{int(p > 0)},{0.6 + 0.1 * p}" for f in range(4) for p in range(5)]
    (tmp_path / "tracks.csv").write_text("frame,point,x,y,visible,confidence\n" + "\n".join(rows))
    got = read_inputs(tracks=tmp_path / "tracks.csv", mesh="none", options=Options())
    np.testing.assert_allclose(got.tracks.visible, np.tile([0, 0.7, 0.8, 0.9, 1.0], (4, 1)))
