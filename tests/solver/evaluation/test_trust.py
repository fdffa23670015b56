"""The verdict without ground truth: each criterion alone, and on results with known error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pliant.solver import Settings, Tracks, gallery, solve
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.solver.evaluation.trust import Verdict, assess, turned
from scipy.spatial.transform import Rotation

FRAMES, POINTS = 12, 30


def judged(**changed: Any) -> Any:
    rng = np.random.default_rng(0)
    shapes = rng.normal(size=(FRAMES, POINTS, 3))
    turn = changed.pop("turn", 60.0)
    rotations = Rotation.from_euler("y", np.linspace(0, turn, FRAMES)[:, None], degrees=True).as_matrix()
    given: dict[str, Any] = {
        "residuals": np.full((FRAMES, POINTS), 0.001),
        "visible": np.ones((FRAMES, POINTS)),
        "scales": np.ones(FRAMES),
        "shapes_std": np.full((FRAMES, POINTS), 0.02),
    }
    return assess(shapes, rotations, **{**given, **changed})


def test_a_result_without_reasons_against_it_is_good() -> None:
    trust = judged()
    assert trust.verdict is Verdict.GOOD
    assert trust.reasons == ()
    assert trust.expected_error == pytest.approx(0.02 / np.sqrt(3), rel=0.1)
    assert trust.interval is not None
    assert trust.interval[0] < trust.expected_error < trust.interval[1]
    assert trust.sentence == "Expected error about 1.2 % of the object's size; depth rests on 60° of turn."


@pytest.mark.parametrize(
    ("changed", "verdict", "words"),
    [
        ({"residuals": np.full((FRAMES, POINTS), 0.2)}, Verdict.WITH_CARE, "miss the tracks"),
        ({"residuals": np.full((FRAMES, POINTS), 0.9)}, Verdict.DO_NOT_USE, "miss the tracks"),
        ({"turn": 12.0}, Verdict.WITH_CARE, "turned by 12° only"),
        ({"turn": 2.0}, Verdict.DO_NOT_USE, "turned by 2° only"),
        (
            {"shapes_std": np.full((FRAMES, POINTS), 0.2)},
            Verdict.WITH_CARE,
            "may be as large as 43 % of the object's size",
        ),
        ({"shapes_std": np.full((FRAMES, POINTS), 0.9)}, Verdict.DO_NOT_USE, "may be as large as the object itself"),
        ({"visible": np.eye(FRAMES, POINTS) + np.eye(FRAMES, POINTS, 12)}, Verdict.DO_NOT_USE, "are not seen"),
        ({"planar": True}, Verdict.WITH_CARE, "thin sheet"),
        ({"depth_is_typical": True}, Verdict.WITH_CARE, "Let it turn further"),
        ({"modes": 7}, Verdict.WITH_CARE, "7 modes of deformation in 12 frames"),
    ],
)
def test_each_reason_alone_lowers_the_verdict(changed: dict[str, Any], verdict: Verdict, words: str) -> None:
    trust = judged(**changed)
    assert trust.verdict is verdict
    assert len(trust.reasons) == 1
    assert words in trust.reasons[0]


def test_the_most_severe_reason_comes_first() -> None:
    trust = judged(planar=True, turn=2.0)
    assert trust.verdict is Verdict.DO_NOT_USE
    assert "turned by" in trust.reasons[0]
    assert trust.interval is None
    assert "at least" in trust.sentence


def test_without_a_posterior_the_error_is_not_estimated() -> None:
    trust = judged(shapes_std=None)
    assert trust.expected_error is None
    assert trust.sentence.startswith("The error is not estimated")


def test_opposite_viewing_directions_count_as_one() -> None:
    rotations = Rotation.from_euler("y", [[0], [180]], degrees=True).as_matrix()
    assert turned(rotations) == pytest.approx(0, abs=1e-5)


@pytest.mark.slow
def test_a_face_is_good_and_its_error_lies_in_the_interval() -> None:
    made = gallery.corrupt(gallery.face(20, 150), noise=0.01, seed=1)
    found = solve(made.tracks, made.mesh)
    assert found.trust is not None
    assert found.trust.verdict is Verdict.GOOD
    assert found.trust.interval is not None
    assert found.trust.interval[0] < e3d_frame(found.shapes, made.shapes) < found.trust.interval[1]
    assert found.shapes_std is not None
    assert found.shapes_std.shape == found.shapes.shape[:2]
    assert not found.shapes_std.flags.writeable


@pytest.mark.slow
def test_noise_and_a_still_camera_give_do_not_use() -> None:
    rng = np.random.default_rng(0)
    noise = solve(Tracks.from_arrays(rng.normal(size=(20, 30, 2))))
    body = gallery.face(20, 100).tracks.points[:1] + 1e-3 * rng.normal(size=(20, 100, 2))
    for found in (noise, solve(Tracks.from_arrays(body), settings=Settings(prior="gaussian"))):
        assert found.trust is not None
        assert found.trust.verdict is Verdict.DO_NOT_USE
