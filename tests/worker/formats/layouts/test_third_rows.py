"""Tracks with a third coordinate: ones are left out, and three rows per frame are not read as two."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.solver.gallery import face
from pliant.worker.formats.tracks.interpretation import understand
from pliant.worker.formats.tracks.third_rows import has_three_blocks
from track_files import HIDDEN, F, P

Write = Callable[[np.ndarray], np.ndarray]


def interleaved(points: np.ndarray) -> np.ndarray:
    return points.transpose(0, 2, 1).reshape(-1, points.shape[1])


def stacked(points: np.ndarray) -> np.ndarray:
    return points.transpose(2, 0, 1).reshape(-1, points.shape[1])


@pytest.mark.parametrize(
    "third", [np.ones((F, P, 1)), np.where(np.isnan(HIDDEN[..., :1]), np.nan, 1)], ids=["1", "1 or NaN"]
)
@pytest.mark.parametrize(
    ("write", "order", "which"),
    [
        (interleaved, "frames_points", "every third row"),
        (stacked, "frames_points", "the last third of the rows"),
        (lambda points: interleaved(points).T, "points_frames", "every third column"),
        (lambda points: stacked(points).T, "points_frames", "the last third of the columns"),
        (lambda points: points, "frames_points", "the third number of each point"),
        (lambda points: points.transpose(1, 0, 2), "points_frames", "the third number of each point"),
        (lambda points: points.transpose(0, 2, 1), "frames_points", "the third number of each point"),
        (lambda points: points.transpose(2, 1, 0), "points_frames", "the third number of each point"),
    ],
    ids=[
        "(3F, P)",
        "(3F, P) stacked",
        "(P, 3F)",
        "(P, 3F) stacked",
        "(F, P, 3)",
        "(P, F, 3)",
        "(F, 3, P)",
        "(3, P, F)",
    ],
)
def test_ones_of_homogeneous_coordinates_are_left_out(third: np.ndarray, write: Write, order: str, which: str) -> None:
    got = understand({"W": write(np.concatenate([HIDDEN, third], axis=2))}, Options.model_validate({"layout": order}))
    np.testing.assert_array_equal(got.points, HIDDEN)
    assert got.notes[0] == f"In W, {which} is 1, as in homogeneous coordinates, and is not used."


@pytest.mark.parametrize(("write", "rows"), [(interleaved, "interleaved"), (stacked, "stacked")])
@pytest.mark.parametrize(("frames", "count"), [(20, 149), (20, 150), (21, 150)])
def test_three_rows_per_frame_are_not_read_as_two(write: Write, rows: str, frames: int, count: int) -> None:
    sequence = face(frames, count)
    depth = 300 + sequence.shapes[..., 2:]
    array = write(np.concatenate([sequence.tracks.points, depth], axis=2))
    with pytest.raises(InvalidInput) as caught:
        understand({"W": array}, Options())
    assert caught.value.code == "wrong_shape"
    assert f"three {rows} rows per frame" in str(caught.value)


@pytest.mark.parametrize("write", [interleaved, stacked])
def test_two_rows_per_frame_whose_number_is_a_multiple_of_three_are_read(write: Write) -> None:
    points = face(21, 150).tracks.points
    np.testing.assert_array_equal(understand({"W": write(points)}, Options()).points, points)


def test_the_option_rows_overrules_three_rows_per_frame() -> None:
    sequence = face(20, 149)
    array = interleaved(np.concatenate([sequence.tracks.points, 300 + sequence.shapes[..., 2:]], axis=2))
    got = understand({"W": array}, Options.model_validate({"rows": "interleaved"}))
    assert got.points.shape == (30, 149, 2)


def test_photographs_in_no_order_are_not_taken_for_three_blocks() -> None:
    random = np.random.default_rng(0)
    shape = random.normal(size=(60, 3))
    taken = []
    for count in range(12, 60, 3):
        views = np.linalg.qr(random.normal(size=(count, 3, 3)))[0]
        taken.append(has_three_blocks(np.concatenate([views[:, 0] @ shape.T, views[:, 1] @ shape.T])))
    assert not any(taken)
