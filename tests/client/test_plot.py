"""Plots: a lit surface for a mesh, points without a mesh or if it is too large."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from pliant.client import BadArgument, plot
from pliant.solver.gallery import flag

art3d = pytest.importorskip("mpl_toolkits.mplot3d.art3d")
SEQUENCE = flag(6, 60)
SHAPES = SEQUENCE.shapes - SEQUENCE.shapes.mean(axis=1, keepdims=True)


def test_quads_are_split_into_triangles_and_triangles_are_kept() -> None:
    np.testing.assert_array_equal(plot.split(np.array([[0, 1, 2, 3]], np.int32)), [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(plot.split(np.array([[4, 5, 6]], np.int32)), [[4, 5, 6]])
    assert plot.split(np.zeros((0, 3), np.int32)).shape == (0, 3)


def test_a_mesh_is_drawn_as_a_lit_surface() -> None:
    faces = SEQUENCE.mesh.faces
    figure = plot.draw(SHAPES, faces, 3, title="flag")
    assert [axes.get_title() for axes in figure.axes] == ["frame 0", "frame 2", "frame 5"]
    (surface,) = [each for each in figure.axes[1].collections if isinstance(each, art3d.Poly3DCollection)]
    assert len(surface.get_facecolor()) == 2 * len(faces)
    brightness = surface.get_facecolor()[:, :3].mean(axis=1)
    assert 0.2 < brightness.min() < brightness.max() - 0.02 <= 1.0
    written = io.BytesIO()
    figure.savefig(written, dpi=40)
    assert written.getvalue().startswith(b"\x89PNG")


@pytest.mark.parametrize("frames", [[5, 1], (5, 1), np.array([5, 1]), range(5, 0, -4)])
def test_frames_may_be_listed(frames: Any) -> None:
    figure = plot.draw(SHAPES, np.zeros((0, 3), np.int32), frames, title="flag")
    assert [axes.get_title() for axes in figure.axes] == ["frame 5", "frame 1"]


@pytest.mark.parametrize("frames", [0, -1, 2.5, None, "all", [], [6], [-1], [0.5], [[0, 1]]])
def test_frames_that_are_neither_a_number_nor_a_list_are_refused(frames: Any) -> None:
    with pytest.raises(
        BadArgument, match="frames: expected a number of frames, at least 1, or a list of frames from 0 to 5, got"
    ):
        plot.draw(SHAPES, np.zeros((0, 3), np.int32), frames, title="flag")


@pytest.mark.parametrize("most", [0, None])
def test_points_are_drawn_if_a_mesh_is_missing_or_too_large(monkeypatch: pytest.MonkeyPatch, most: int | None) -> None:
    faces = SEQUENCE.mesh.faces if most is not None else np.zeros((0, 3), np.int32)
    if most is not None:
        monkeypatch.setattr(plot, "MOST_TRIANGLES", most)
    figure = plot.draw(SHAPES, faces, 2, title="flag")
    assert [isinstance(each, art3d.Path3DCollection) for axes in figure.axes for each in axes.collections] == [
        True,
        True,
    ]


@pytest.mark.parametrize("y_axis", ["down", "up"])
def test_both_directions_of_y_are_drawn_upright_seen_from_the_camera(y_axis: str) -> None:
    """The camera looks along z with y down, against z with y up."""
    right, upwards, nearer = np.eye(3)
    if y_axis == "down":
        upwards, nearer = -upwards, -nearer
    shape = np.array([0 * right, right, upwards, nearer])
    figure = plot.draw(shape[None], np.zeros((0, 3), np.int32), 1, title="", y_axis=y_axis)
    (points,) = figure.axes[0].collections
    drawn = np.stack(points._offsets3d, axis=1)
    np.testing.assert_array_equal(drawn, [[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, -1, 0]])
