"""The glTF files as played by three.js in a browser, compared with the arrays of the NPZ."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browsing import differing_pixels
from playwright.sync_api import Page
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.artifacts.geometry import upright, viewer_scale
from results import make_result
from three_page import Played, three_page

pytestmark = pytest.mark.chromium


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with three_page() as page:
        yield page


@pytest.fixture
def played(page: Page, tmp_path: Path):
    """Write a result, open its glTF, and return the shapes of its NPZ in the scene's axes and size too."""

    def opened(*sizes: int, **wishes: object) -> tuple[Played, np.ndarray]:
        inputs, solution, options = make_result(*sizes, **wishes)
        write_artifacts(inputs, solution, options, build_report(inputs, solution, options, metrics={}), tmp_path)
        with np.load(tmp_path / "shapes.npz") as arrays:
            shapes = upright(arrays["shapes"], inputs.interpretation.y_axis)
        return Played(page, tmp_path / "shapes.glb"), shapes * viewer_scale(shapes)

    yield opened
    page.unroute("**/shapes.glb")


@pytest.mark.parametrize(
    ("wishes", "bound"),
    [
        ({}, 1e-6),
        ({"mesh": "none"}, 1e-6),
        ({"y_axis": "up", "normals": "animated", "colours": "error"}, 1e-6),
        ({"glb_quantized": True, "normals": "none"}, 5e-5),
    ],
)
def test_every_vertex_matches_the_npz(played, wishes: dict[str, object], bound: float) -> None:
    shown, shapes = played(9, 5, 6, fps=10, glb_motion="frames", **wishes)
    assert shown.targets == 9
    assert shown.duration == pytest.approx(0.8)
    assert shown.kind == ("Points" if wishes.get("mesh") == "none" else "Mesh")
    size = np.ptp(shapes)
    between = (shapes[3] + shapes[4]) / 2
    for time, expected in ((0.0, shapes[0]), (0.5, shapes[5]), (0.35, between), (0.8, shapes[8])):
        np.testing.assert_allclose(shown.positions(time), expected, atol=bound * size)
    assert np.abs(shapes[5] - shapes[0]).max() > 1000 * bound * size


def test_modes_play_back_within_their_error_bound(played) -> None:
    shown, shapes = played(230, 5, 6, fps=10)
    assert shown.targets < 20
    diagonal = np.linalg.norm(np.ptp(shapes, axis=(0, 1)))
    for frame in (0, 117, 229):
        error = np.linalg.norm(shown.positions(frame / 10) - shapes[frame], axis=1)
        assert error.max() < 1e-3 * diagonal


@pytest.mark.parametrize("wishes", [{}, {"glb_quantized": True, "colours": "error"}])
def test_rendered_vertices_match_the_npz(page: Page, played, wishes: dict[str, object]) -> None:
    """The shader recomputes the positions, so a wrong target, weight or normal is visible."""
    shown, shapes = played(9, 20, 24, fps=10, normals="animated", **wishes)
    for frame in (0, 4, 8):
        moved = shown.picture(frame / 10)
        assert differing_pixels(moved, shown.plain(shapes[frame])) < 0.003
        other = (frame + 3) % 9
        assert differing_pixels(moved, shown.plain(shapes[other])) > 0.03
