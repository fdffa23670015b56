"""The verdict without ground truth: each criterion alone, and on results with known error."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pliant.solver import (
    Camera,
    Choices,
    KnownCamera,
    Outcome,
    Settings,
    Solution,
    Trace,
    Tracks,
    gallery,
    solve,
)
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.solver.evaluation.trust import (
    INTERVAL,
    NO_POSTERIOR,
    Trust,
    Verdict,
    assess,
    assess_isometric,
    frames_behind,
    per_frame,
    size_of,
    turned,
)
from scipy.spatial.transform import Rotation

FRAMES, POINTS = 12, 30


CLOSE = {"focal": 100.0, "scales": np.where(np.arange(FRAMES) > 9, 1e3, 1.0)}
"""A camera that is too close to the object in the last two frames."""

CHOICES = Choices(
    basis_size=1, temporal_weight=1.0, spatial_weight=0.0, robust_scale=0.01, temporal_order=1, low_rank_weight=0.0, laplacian="none",
    unit=1.0, noise=0.01,
)  # fmt: skip


def solution_of(shapes: np.ndarray, rotations: np.ndarray, residuals: np.ndarray, **more: Any) -> Solution:
    none, scales, focal = np.zeros(0), more.pop("scales", np.ones(len(shapes))), more.pop("focal", None)
    camera = Camera(rotations, scales, np.zeros((len(shapes), 2)), focal=focal)
    given = {"weights": np.ones(residuals.shape), "choices": CHOICES, **more}
    return Solution(
        shapes=shapes, camera=camera, residuals=residuals, trace=Trace(none, none, none.astype(np.int32)),
        outcome=Outcome.CONVERGED, seconds={}, **given,
    )  # fmt: skip


def judged(**changed: Any) -> Any:
    rng = np.random.default_rng(0)
    shapes = rng.normal(size=(POINTS, 3)) + changed.pop("bending", 0.001) * rng.normal(size=(FRAMES, POINTS, 3))
    turn = changed.pop("turn", 60.0)
    rotations = Rotation.from_euler("y", np.linspace(0, turn, FRAMES)[:, None], degrees=True).as_matrix()
    residuals = changed.pop("residuals", np.full((FRAMES, POINTS), 0.001))
    std = changed.pop("shapes_std", np.full((FRAMES, POINTS), 0.02))
    camera = {name: changed.pop(name) for name in ("scales", "focal") if name in changed}
    solution = solution_of(shapes, rotations, residuals, shapes_std=std, **camera)
    visible = changed.pop("visible", np.ones((FRAMES, POINTS)))
    given: dict[str, Any] = {
        "held_out_error": None, "ordered": True, "planar": False, "modes": 0, "depth_is_typical": False,
        "shown": np.ones(FRAMES, dtype=bool), "unclear_camera": None,
    }  # fmt: skip
    return assess(solution, visible, **{**given, **changed})


def test_frames_that_show_nothing_do_not_count_as_turn() -> None:
    assert judged(shown=np.arange(FRAMES) < 7).turn_degrees == pytest.approx(60 * 6 / 11)


def test_an_isometric_surface_needs_no_turn_but_must_be_seen_and_explain_the_tracks() -> None:
    shapes = np.random.default_rng(0).normal(size=(FRAMES, POINTS, 3))
    still, near, seen = np.tile(np.eye(3), (FRAMES, 1, 1)), np.full((FRAMES, POINTS), 0.001), np.ones((FRAMES, POINTS))

    def isometric(
        residuals: Any = near,
        visible: Any = seen,
        warnings: tuple[str, ...] = (),
        *,
        std: float = 0.02,
        doubted: bool = False,
    ) -> Trust:
        choices, deviations = replace(CHOICES, warnings=warnings), np.full((FRAMES, POINTS), std * size_of(shapes))
        solution = solution_of(shapes, still, residuals, weights=visible, choices=choices, shapes_std=deviations)
        return assess_isometric(solution, ordered=False, doubted=doubted)

    good = isometric()
    assert (good.verdict, good.reasons) == (Verdict.GOOD, ())
    assert good.sentence == "Expected error about 2 % of the object's size; depth rests on constant lengths."
    assert good.interval == pytest.approx((0.02 * INTERVAL[0], 0.02 * INTERVAL[1]))
    doubtful = isometric(doubted=True)
    assert (doubtful.expected_error, doubtful.interval) == (good.expected_error, None)
    assert doubtful.sentence == "Expected error at least 2 % of the object's size; depth rests on constant lengths."
    assert isometric(std=0.1).reasons == ("The error may be as large as 36 % of the object's size.",)
    assert isometric(std=0.1, doubted=True).reasons == (
        "The error is expected to be at least 10 % of the object's size.",
    )
    little = isometric(visible=seen * (np.arange(POINTS) < 9))
    assert (little.verdict, little.reasons[0][:4]) == (Verdict.WITH_CARE, "70% ")
    assert isometric(np.full((FRAMES, POINTS), 0.9)).verdict is Verdict.DO_NOT_USE
    assert isometric(warnings=("The focal length is improbable.",)).reasons == ("The focal length is improbable.",)
    both = isometric(np.full((FRAMES, POINTS), 0.9), warnings=("The focal length is improbable.",))
    assert both.reasons[1] == "The focal length is improbable."
    rejected = np.where(np.arange(POINTS) < 20, near, 0.9)
    assert isometric(rejected, seen * (np.arange(POINTS) < 20)).residual == pytest.approx(0.001 / size_of(shapes))


def test_points_behind_a_pinhole_camera_are_found() -> None:
    camera = Camera(np.tile(np.eye(3), (3, 1, 1)), np.array([1.0, 1.0, 2.0]), np.zeros((3, 2)), focal=4.0)
    shapes = np.zeros((3, 4, 3))
    shapes[:, 0, 2] = -3.0
    assert frames_behind(camera, shapes).tolist() == [False, False, True]
    assert frames_behind(replace(camera, y_up=True), -shapes).tolist() == [False, False, True]
    assert not frames_behind(replace(camera, focal=None), shapes).any()


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
        ({"turn": 12.0}, Verdict.WITH_CARE, "turn by only 12°"),
        ({"turn": 2.0}, Verdict.DO_NOT_USE, "turn by only 2°"),
        (
            {"shapes_std": np.full((FRAMES, POINTS), 0.2)},
            Verdict.WITH_CARE,
            "may be as large as 44 % of the object's size",
        ),
        (
            {"shapes_std": np.full((FRAMES, POINTS), 0.9)},
            Verdict.DO_NOT_USE,
            "may be as large as 200 % of the object's size",
        ),
        ({"visible": np.eye(FRAMES, POINTS) + np.eye(FRAMES, POINTS, 12)}, Verdict.DO_NOT_USE, "are hidden"),
        (
            CLOSE,
            Verdict.DO_NOT_USE,
            "In 2 of 12 frames (the first is frame 10), points of the shape lie behind the camera.",
        ),
        (
            {"shown": np.arange(FRAMES) < 7},
            Verdict.WITH_CARE,
            "Almost no points are visible in 5 of 12 frames (the first is frame 7)",
        ),
        ({**CLOSE, "ordered": False}, Verdict.DO_NOT_USE, "In 2 of 12 frames, points"),
        (
            {"planar": True},
            Verdict.WITH_CARE,
            "The tracks are nearly those of a plane and hardly show bending; the surface is 45 % of its size off its plane",
        ),
        ({"depth_is_typical": True}, Verdict.WITH_CARE, "A turn of 60° hardly determines"),
        ({"modes": 7}, Verdict.WITH_CARE, "7 modes of deformation in 12 frames"),
        (
            {"held_out_error": 0.09},
            Verdict.WITH_CARE,
            "left out are 9 % of the object's size from where the others predict",
        ),
        ({"held_out_error": 0.7}, Verdict.DO_NOT_USE, "left out are 70 %"),
        ({"bending": 0.1}, Verdict.WITH_CARE, "turns by 5.5° in a frame, while the shape changes by 14 % of its size"),
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
    assert "turn by" in trust.reasons[0]
    assert trust.interval is None
    assert "at least" in trust.sentence


@pytest.mark.parametrize(("turn", "bounded"), [(12.0, False), (19.0, False), (21.0, True)])
def test_with_little_turn_the_expected_error_is_a_lower_bound(turn: float, bounded: bool) -> None:
    trust = judged(turn=turn)
    assert (trust.interval is not None) == bounded
    assert ("about" if bounded else "at least") in trust.sentence


def test_without_a_posterior_the_error_is_not_estimated() -> None:
    trust = judged(shapes_std=None)
    assert trust.expected_error is None
    assert trust.sentence.startswith("The error is not estimated")
    assert trust.verdict is Verdict.WITH_CARE
    assert trust.reasons == (NO_POSTERIOR,)


@pytest.mark.parametrize("options", [{"prior": "smooth"}, {"preset": "paper"}, {"method": "pseudo_inverse"}])
def test_methods_without_a_posterior_are_never_good(options: dict[str, Any]) -> None:
    """They explain the tracks, and the camera turns far enough, however wrong the depth is."""
    found = solve(gallery.face(16, 60, degrees=70).tracks, settings=Settings(**options)).trust
    assert found is not None
    assert found.turn_degrees > 20
    assert found.verdict is not Verdict.GOOD
    assert NO_POSTERIOR in found.reasons


def test_the_figures_behind_the_verdict_are_reported() -> None:
    trust = judged(held_out_error=0.01, turn=44.0)
    assert trust.verdict is Verdict.GOOD
    assert trust.held_out_error == 0.01
    assert trust.degrees_per_frame == pytest.approx(4.0)
    assert trust.deformation_per_frame == pytest.approx(0.001 * np.sqrt(2), rel=0.1)
    unordered = judged(bending=0.1, ordered=False)
    assert unordered.verdict is Verdict.GOOD
    assert (unordered.held_out_error, unordered.degrees_per_frame, unordered.deformation_per_frame) == (None,) * 3


def test_per_frame_figures_ignore_size_translation_and_opposite_views() -> None:
    rng = np.random.default_rng(1)
    base = rng.normal(size=(POINTS, 3))
    shapes = np.stack([base, 1.1 * base, base, 1.1 * base])
    rotations = Rotation.from_euler("y", np.array([[0], [3], [6], [9]]), degrees=True).as_matrix()
    rotations[1] = Rotation.from_euler("y", 180, degrees=True).as_matrix() @ rotations[1]
    turning, deforming = per_frame(40 * shapes + rng.normal(size=(4, 1, 3)), rotations)
    assert turning == pytest.approx(3.0)
    assert deforming == pytest.approx(0.1 / np.sqrt((1 + 1.1**2) / 2))
    assert per_frame(shapes[:1], rotations[:1]) == (None, None)


def test_frame_rate_does_not_change_the_ratio_of_rotation_to_deformation() -> None:
    angles = np.linspace(0, 1, 41)
    base, moving = np.random.default_rng(2).normal(size=(2, POINTS, 3))
    shapes = base + 0.5 * angles[:, None, None] * moving
    rotations = Rotation.from_euler("y", 60 * angles[:, None], degrees=True).as_matrix()
    one, other = per_frame(shapes, rotations), per_frame(shapes[::4], rotations[::4])
    assert all(each is not None for each in (*one, *other))
    assert np.divide(*other) == pytest.approx(np.divide(*one), rel=0.01)


def test_opposite_viewing_directions_count_as_one() -> None:
    rotations = Rotation.from_euler("y", [[0], [180]], degrees=True).as_matrix()
    assert turned(rotations) == pytest.approx(0, abs=1e-5)


def test_an_expected_error_without_an_interval_counts_as_well() -> None:
    trust = judged(shapes_std=np.full((FRAMES, POINTS), 0.9), depth_is_typical=True)
    assert trust.interval is None
    assert trust.verdict is Verdict.DO_NOT_USE
    assert trust.reasons[0] == "The error is expected to be at least 55 % of the object's size."


@pytest.mark.slow
def test_a_face_is_good_and_its_error_lies_in_the_interval() -> None:
    made = gallery.corrupt(gallery.face(12, 60), noise=0.01, seed=1)
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
    noise = solve(Tracks.from_arrays(rng.normal(size=(8, 20, 2))))
    body = gallery.face(8, 40).tracks.points[:1] + 1e-3 * rng.normal(size=(8, 40, 2))
    for found in (noise, solve(Tracks.from_arrays(body))):
        assert found.trust is not None
        assert found.trust.verdict is Verdict.DO_NOT_USE


def test_a_prior_of_weight_zero_gives_no_expected_error() -> None:
    made = gallery.face(8, 60)
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)
    found = solve(made.tracks, made.mesh, cameras=cameras, settings=Settings(temporal_weight=0.0))
    assert found.shapes_std is None
    assert found.trust is not None
    assert found.trust.expected_error is None


def test_given_weights_that_outweigh_the_tracks_need_care() -> None:
    close, far = np.full((FRAMES, POINTS), 0.02), np.full((FRAMES, POINTS), 0.04)  # noise .01
    assert judged(residuals=far).verdict is Verdict.GOOD
    assert judged(residuals=close, given_weights=True).verdict is Verdict.GOOD
    trust = judged(residuals=far, given_weights=True)
    assert (trust.verdict, trust.interval) == (Verdict.WITH_CARE, None)
    assert "more than 3 times the noise" in trust.reasons[0]
    assert judged(residuals=far, given_weights=True, shapes_std=None).reasons == (NO_POSTERIOR,)


@pytest.mark.parametrize("weight", ["temporal_weight", "spatial_weight"])
def test_the_solver_says_where_a_given_weight_outweighs_the_tracks(weight: str) -> None:
    film = gallery.face(12, 100)
    cameras = KnownCamera.from_arrays(film.rotations, film.scales)
    trust = solve(film.tracks, film.mesh, cameras=cameras, settings=Settings(**{weight: 10.0})).trust  # type: ignore[arg-type]
    assert trust is not None
    assert any("the priors outweigh the tracks" in reason for reason in trust.reasons)
