"""Points that no frame shows lie on the thinnest plate through their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Mesh, Tracks, gallery, metrics, solve

MADE = gallery.face(16, 400, degrees=60, mesh="triangles")
CAMERAS = KnownCamera.from_arrays(MADE.rotations, MADE.scales)


def seen_but(points: list[int]) -> Tracks:
    visible = np.ones(MADE.tracks.points.shape[:2])
    visible[:, points] = 0
    return Tracks.from_arrays(MADE.tracks.points, visible)


def patch(centre: int, rings: int) -> list[int]:
    found = {centre}
    for _ in range(rings):
        found |= set(MADE.mesh.edges[np.isin(MADE.mesh.edges, list(found)).any(axis=1)].ravel().tolist())
    return sorted(found)


@pytest.mark.parametrize("cameras", [CAMERAS, None], ids=["known", "estimated"])
def test_a_hole_in_the_face_is_closed(cameras: KnownCamera | None) -> None:
    hole = patch(190, 2)
    assert len(hole) > 12
    found = solve(seen_but(hole), MADE.mesh, cameras=cameras)
    error = metrics.e3d_frame(found.shapes, MADE.shapes)
    assert error < 1.5 * metrics.e3d_frame(solve(MADE.tracks, MADE.mesh, cameras=cameras).shapes, MADE.shapes) + 0.02
    assert (found.weights[:, hole] == 0).all()
    sides = np.delete(np.arange(400), hole)
    centred = found.shapes[:, sides] - found.shapes[:, sides].mean(axis=1, keepdims=True)
    whole = solve(seen_but([]), MADE.mesh, cameras=cameras).shapes[:, sides]
    assert metrics.e3d_frame(centred, whole - whole.mean(axis=1, keepdims=True)) < 0.1


def test_what_hangs_on_nothing_stays_in_the_middle() -> None:
    alone = 77
    faces = MADE.mesh.faces[~(MADE.mesh.faces == alone).any(axis=1)]
    found = solve(seen_but([alone]), Mesh.from_faces(faces, 400), cameras=CAMERAS)
    size = np.linalg.norm(found.shapes, axis=2).mean()
    assert np.linalg.norm(found.shapes[:, alone], axis=1).max() < 0.2 * size


def test_nothing_moves_where_all_is_seen() -> None:
    from pliant.solver.unseen import close_surface

    class Untouched:
        laplacian = None
        confidence = np.ones((2, 3))

    state = object()
    assert close_surface(Untouched(), state) is state  # type: ignore[arg-type]
