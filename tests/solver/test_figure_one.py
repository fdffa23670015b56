"""Figure 1 of Dai, Deng, He (2017), qualitatively: the gain of each step of the method on a face with gross outliers.

Published e3d of a sequence with outliers: pseudo-inverse .5084, temporal .1835, with space .0757, with L1 .0700.
"""

from __future__ import annotations

import pytest
from pliant.solver import KnownCamera, Settings, gallery, solve
from pliant.solver.evaluation import metrics

FACE = gallery.face(24, 400)


def errors(sequence: gallery.Sequence, *, estimated: bool) -> list[float]:
    cameras = None if estimated else KnownCamera.from_arrays(sequence.rotations, sequence.scales)
    return [
        metrics.e3d_frame(
            solve(
                sequence.tracks, sequence.mesh, cameras=cameras, settings=Settings(method=method, prior="smooth")  # type: ignore[arg-type]
            ).shapes,
            FACE.shapes,
        )
        for method in ("pseudo_inverse", "temporal", "spatio_temporal", "robust")
    ]  # fmt: skip


@pytest.mark.parametrize(
    "estimated", [pytest.param(False, id="known"), pytest.param(True, id="estimated", marks=pytest.mark.long)]
)
@pytest.mark.parametrize("outliers", [pytest.param(0.05, marks=pytest.mark.long), 0.10])
@pytest.mark.slow
def test_every_step_helps_against_outliers(outliers: float, estimated: bool) -> None:
    flat, temporal, spatial, robust = errors(gallery.corrupt(FACE, outliers=outliers, seed=1), estimated=estimated)
    assert 0.3 < flat < 0.7
    assert flat > 1.5 * temporal
    assert temporal > 1.3 * spatial
    assert spatial > 1.3 * robust
    assert 0.01 < robust < 0.1


def test_clean_tracks_keep_the_published_temporal_weight() -> None:
    flat, temporal, spatial, robust = errors(FACE, estimated=False)
    assert 0.1 < flat < 0.4
    assert flat > 3 * temporal
    assert max(temporal, spatial, robust) < 0.06
    known = KnownCamera.from_arrays(FACE.rotations, FACE.scales)
    chosen = solve(FACE.tracks, cameras=known, settings=Settings(method="temporal")).choices
    assert chosen.temporal_weight == 1e-3
