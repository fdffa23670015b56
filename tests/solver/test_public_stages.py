"""The stages of a reconstruction, one by one: their composition is `solve`, and each can be repeated with other inputs."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pliant.solver import (
    Cameras,
    InvalidInput,
    InvalidSettings,
    KnownCamera,
    Outcome,
    Prior,
    Settings,
    Solution,
    Step,
    Tracks,
    estimate_cameras,
    find_outliers,
    gallery,
    learn_prior,
    solve,
    solve_shapes,
)
from pliant.solver.evaluation import metrics
from pliant.solver.shapes import uncertainty

MADE = gallery.face(8, 40, degrees=60, mesh="triangles")
KNOWN = KnownCamera.from_arrays(MADE.rotations, MADE.scales)
SPOILED = gallery.corrupt(MADE, outliers=0.04, seed=1).tracks


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return estimate_cameras(MADE.tracks, KNOWN)


@pytest.fixture(scope="module")
def prior(cameras: Cameras) -> Prior:
    return learn_prior(MADE.tracks, cameras)


@pytest.fixture(scope="module")
def solution(cameras: Cameras, prior: Prior) -> Solution:
    return solve_shapes(MADE.tracks, cameras, prior, MADE.mesh)


def assert_same(one: Solution, other: Solution) -> None:
    for name in ("shapes", "residuals", "weights", "inlier_probability"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.camera.rotations, other.camera.rotations)
    np.testing.assert_array_equal(one.trace.objective, other.trace.objective)
    assert one.outcome is other.outcome
    of_solve = {"order": "", "surface": ""}  # which the stages do not decide
    assert one.choices.reasons | of_solve == other.choices.reasons | of_solve


def composed(tracks: Tracks, known: KnownCamera | None, settings: Settings) -> Solution:
    cameras = estimate_cameras(tracks, known, settings=settings)
    if not settings.gaussian:
        return solve_shapes(tracks, cameras, mesh=MADE.mesh)
    prior = learn_prior(tracks, cameras)
    found = solve_shapes(tracks, cameras, prior, MADE.mesh)
    np.testing.assert_array_equal(find_outliers(tracks, cameras, prior, MADE.mesh), found.inlier_probability == 0)
    return found


@pytest.mark.parametrize(
    ("known", "settings"),
    [
        (KNOWN, Settings(order="film")),
        (None, Settings(prior="smooth", refine_rotations=False)),
        pytest.param(KNOWN, Settings(order="film", focal=900.0), marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param(None, Settings(order="film"), marks=[pytest.mark.slow, pytest.mark.long]),
    ],
    ids=["known", "smooth", "perspective", "default"],
)
def test_solve_is_the_composition_of_its_stages(known: KnownCamera | None, settings: Settings) -> None:
    whole = solve(SPOILED, MADE.mesh, cameras=known, settings=settings)
    assert_same(composed(SPOILED, known, settings), whole)
    if settings.gaussian:
        assert (whole.weights == 0).any(), "outliers were rejected on the way"


def test_cameras_project_and_the_prior_states_its_covariance(cameras: Cameras, prior: Prior) -> None:
    assert cameras.project(MADE.shapes).shape == MADE.tracks.points.shape
    left = cameras.project(MADE.shapes) - MADE.tracks.points
    assert np.abs(left - left.mean(axis=1, keepdims=True)).max() < 1e-6 * prior.unit
    assert prior.modes.shape[0] == 8
    walk = prior.covariance - prior.modes @ prior.modes.T
    np.testing.assert_allclose(np.diag(walk, 1)[0], walk[0, 1])
    assert np.linalg.eigvalsh(prior.covariance)[0] > -1e-9 * prior.unit**2
    assert np.trace(prior.axis_covariance) == pytest.approx(3)
    spread = np.square(MADE.shapes).sum(axis=2).mean()
    assert 0.3 * spread < np.trace(prior.mean_covariance) + 3 * np.diag(prior.covariance).mean() < 3 * spread
    assert prior.walk_variance > 0


def test_reprs_are_short(cameras: Cameras, prior: Prior, solution: Solution) -> None:
    assert repr(cameras) == "<Cameras of 8 frames, orthographic>"
    assert repr(prior).startswith("<Prior of 8 frames: ")
    assert repr(solution).startswith(f"<Solution of 8 frames × {MADE.tracks.num_points} points, converged")
    assert repr(solution.camera) == "<Camera of 8 frames, orthographic>"
    assert repr(replace(solution.camera, focal=912.34)) == "<Camera of 8 frames, focal length 912.3>"
    assert all(len(repr(each)) < 90 for each in (cameras, prior, solution))


def test_one_noise_is_used_and_reported(prior: Prior, solution: Solution) -> None:
    """With the loss `l1` the weight of the prior is σ/√8 in normalized units (`energy.hyperparameters`)."""
    choices = solution.choices
    assert choices.noise == prior.noise_std
    assert choices.temporal_weight * 8**0.5 * choices.unit == pytest.approx(choices.noise, rel=1e-12)


def test_starting_at_the_solution_converges_at_once(cameras: Cameras, prior: Prior, solution: Solution) -> None:
    again = solve_shapes(MADE.tracks, cameras, prior, MADE.mesh, start=solution)
    assert len(again.trace.objective) <= 3 < len(solution.trace.objective)
    assert again.trace.objective[-1] <= solution.trace.objective[-1] * (1 + 1e-9)
    assert metrics.e3d_frame(again.shapes, solution.shapes) < 1e-3
    np.testing.assert_allclose(again.choices.spatial_weight, solution.choices.spatial_weight)


def test_a_perturbed_start_converges_to_the_same_energy_and_shapes(
    cameras: Cameras, prior: Prior, solution: Solution
) -> None:
    given = solution.shapes + 0.05 * solution.choices.unit * np.random.default_rng(0).normal(size=solution.shapes.shape)
    tight = Settings(tolerance=1e-6, max_reweightings=200)
    away = solve_shapes(MADE.tracks, cameras, prior, MADE.mesh, start=given, settings=tight)
    here = solve_shapes(MADE.tracks, cameras, prior, MADE.mesh, settings=tight)
    assert away.trace.objective[0] > here.trace.objective[-1]
    assert away.trace.objective[-1] == pytest.approx(here.trace.objective[-1], rel=1e-2)
    assert metrics.e3d_frame(away.shapes, here.shapes) < 0.02


@pytest.mark.parametrize("size", [1e3, 1e10])
def test_an_absurd_start_gives_the_shapes_of_no_start(cameras: Cameras, size: float) -> None:
    """Starting at 1e10 times the size, the solve without a learned prior stopped as converged at .9e10."""
    absurd = size * MADE.scales.mean() * np.random.default_rng(0).normal(size=MADE.shapes.shape)
    here = solve_shapes(MADE.tracks, cameras, None, MADE.mesh)
    away = solve_shapes(MADE.tracks, cameras, None, MADE.mesh, start=absurd)
    np.testing.assert_array_equal(away.shapes, here.shapes)


def test_cameras_and_prior_of_some_points_give_the_shapes_of_all(solution: Solution) -> None:
    some = Tracks.from_arrays(MADE.tracks.points[:, ::2])
    cameras = estimate_cameras(some, KNOWN)
    found = solve_shapes(MADE.tracks, cameras, learn_prior(some, cameras), MADE.mesh)
    assert found.shapes.shape == MADE.shapes.shape
    assert metrics.e3d_frame(found.shapes, MADE.shapes) < 1.5 * metrics.e3d_frame(solution.shapes, MADE.shapes) + 0.01


def test_a_prior_is_learned_from_cameras_of_any_settings() -> None:
    cameras = estimate_cameras(MADE.tracks, KNOWN, settings=Settings(prior="smooth"))
    smooth = solve_shapes(MADE.tracks, cameras, mesh=MADE.mesh)
    learned = solve_shapes(MADE.tracks, cameras, learn_prior(MADE.tracks, cameras), MADE.mesh, settings=Settings())
    assert smooth.shapes_std is None
    assert learned.shapes_std is not None
    assert metrics.e3d_frame(learned.shapes, MADE.shapes) < metrics.e3d_frame(smooth.shapes, MADE.shapes)
    plain = solve_shapes(MADE.tracks, cameras, None, MADE.mesh, settings=Settings())
    assert plain.choices.reasons["weights"] == smooth.choices.reasons["weights"], "without a prior it is the smooth one"


def test_every_stage_reports_its_steps_and_its_end(cameras: Cameras, prior: Prior) -> None:
    for run in (
        lambda on_step: estimate_cameras(MADE.tracks, KNOWN, on_step=on_step),
        lambda on_step: learn_prior(MADE.tracks, cameras, on_step=on_step),
        lambda on_step: find_outliers(MADE.tracks, cameras, prior, on_step=on_step),
        lambda on_step: solve_shapes(MADE.tracks, cameras, prior, on_step=on_step),
    ):
        steps: list[Step] = []
        run(steps.append)
        fractions = [step.fraction for step in steps]
        assert fractions == sorted(fractions)
        assert fractions[-1] == 1
        assert len(fractions) > 1 or run.__code__.co_names[0] == "find_outliers"


def test_every_stage_can_be_stopped(cameras: Cameras, prior: Prior) -> None:
    early = estimate_cameras(SPOILED, should_stop=lambda: True)
    assert early.stopped
    assert np.isfinite(early.camera.rotations).all()
    assert not cameras.stopped
    stopped = learn_prior(MADE.tracks, cameras, should_stop=lambda: True)
    assert stopped.stopped
    assert np.isfinite(stopped.covariance).all()
    noisy = estimate_cameras(SPOILED, KNOWN)
    assert not find_outliers(SPOILED, noisy, learn_prior(SPOILED, noisy), should_stop=lambda: True).any()
    found = solve_shapes(MADE.tracks, cameras, prior, should_stop=lambda: True)
    assert found.outcome is Outcome.STOPPED
    assert np.isfinite(found.shapes).all()


@pytest.mark.slow
def test_every_random_generator_uses_the_seed_of_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    made, original = set(), np.random.default_rng

    def seeded(seed: object = None) -> np.random.Generator:
        made.add((Path(sys._getframe(1).f_code.co_filename).stem, seed))
        return original(seed)  # type: ignore[arg-type]

    few = Tracks.from_arrays(MADE.tracks.points[:, :14])
    many = gallery.face(4, 300, degrees=60)
    visible = original(0).random(many.tracks.visible.shape) > 0.2
    monkeypatch.setattr(np.random, "default_rng", seeded)
    monkeypatch.setattr(uncertainty, "MAX_PATTERNS", 100)
    settings = Settings(seed=7, max_reweightings=2)
    solve(few, cameras=KNOWN, settings=settings)
    solve(
        Tracks.from_arrays(many.tracks.points, visible), many.mesh,
        cameras=KnownCamera.from_arrays(many.rotations, many.scales), settings=settings,
    )  # fmt: skip
    assert {seed for _, seed in made} == {7}
    assert {name for name, _ in made} == {
        "completion",
        "model_order",
        "early_stopping",
        "uncertainty",
        "aggregation",
        "observed",
    }


def test_mismatched_inputs_are_rejected(cameras: Cameras, prior: Prior, solution: Solution) -> None:
    tracks = MADE.tracks
    fewer = Tracks.from_arrays(tracks.points[:6])
    in_perspective = estimate_cameras(tracks, KNOWN, settings=Settings(order="film", focal=900.0))
    short = estimate_cameras(fewer, KnownCamera.from_arrays(MADE.rotations[:6], MADE.scales[:6]))
    for field, call in (
        ("cameras", lambda: learn_prior(SPOILED, cameras)),
        ("cameras", lambda: solve_shapes(fewer, cameras, prior)),
        ("prior", lambda: solve_shapes(tracks, cameras, learn_prior(fewer, short))),
        ("prior", lambda: solve_shapes(tracks, in_perspective, learn_prior(fewer, short))),
        ("start", lambda: solve_shapes(tracks, cameras, prior, start=solution.shapes[:, :5])),
        ("start", lambda: solve_shapes(tracks, cameras, prior, start=solution.shapes * np.nan)),
        ("start", lambda: solve_shapes(tracks, cameras, prior, start=solution.shapes * 1e200)),
        ("start", lambda: solve_shapes(tracks, cameras, prior, start="shapes")),  # type: ignore[arg-type]
        ("rotations", lambda: estimate_cameras(fewer, KNOWN)),
    ):
        with pytest.raises(InvalidInput) as caught:
            call()
        assert caught.value.field == field
    with pytest.raises(InvalidSettings, match="with a learned prior"):
        solve_shapes(tracks, cameras, prior, settings=Settings(prior="smooth"))


@pytest.mark.parametrize("prior", [pytest.param("gaussian", marks=pytest.mark.slow), "smooth"])
def test_the_unit_of_given_scales_is_that_of_the_shapes_only(prior: str) -> None:
    # Rounding differs between the units, so at the usual tolerance the two solves may end one reweighting apart.
    settings = Settings(prior=prior, tolerance=1e-7, max_reweightings=300)  # type: ignore[arg-type]
    changing = np.linspace(0.9, 1.1, len(MADE.rotations))

    def solved(unit: float) -> tuple[Solution, Cameras]:
        known = KnownCamera.from_arrays(MADE.rotations, changing / unit)
        return solve(MADE.tracks, MADE.mesh, cameras=known, settings=settings), estimate_cameras(
            MADE.tracks, known, settings=settings
        )

    (one, cameras), (other, again) = solved(1.0), solved(1000.0)
    np.testing.assert_allclose(other.shapes, 1000 * one.shapes, atol=1e-4 * 1000 * np.abs(one.shapes).max())
    np.testing.assert_allclose(other.camera.project(other.shapes), one.camera.project(one.shapes), atol=1e-2)
    np.testing.assert_allclose(other.camera.scales, changing / 1000)
    np.testing.assert_allclose(again.camera.scales, changing / 1000)
    if prior == "gaussian":
        assert one.shapes_std is not None
        assert other.shapes_std is not None
        np.testing.assert_allclose(other.shapes_std, 1000 * one.shapes_std, rtol=1e-4)
    first, second = (learn_prior(MADE.tracks, each) for each in (cameras, again))
    np.testing.assert_allclose(second.covariance, 1e6 * first.covariance, rtol=1e-4)
    assert second.noise_std == pytest.approx(first.noise_std)
    start = solve_shapes(MADE.tracks, again, second, MADE.mesh, settings=Settings(), start=other)
    fresh = solve_shapes(MADE.tracks, again, second, MADE.mesh, settings=Settings())
    np.testing.assert_allclose(start.shapes, fresh.shapes, atol=2e-3 * np.abs(fresh.shapes).max())


@pytest.mark.parametrize("camera", ["auto", "scaled_orthographic"])
def test_depths_point_away_from_the_camera_whatever_the_direction_of_y(camera: str) -> None:
    settings = Settings(camera=camera, prior="smooth")  # type: ignore[arg-type]
    known = KnownCamera.from_arrays(MADE.rotations)
    down = solve(MADE.tracks, MADE.mesh, cameras=known, settings=settings)
    turned = np.diag([1.0, -1.0, -1.0])
    mirrored = Tracks.from_arrays(MADE.tracks.points * [1, -1], MADE.tracks.visible)
    up = solve(
        mirrored,
        MADE.mesh,
        cameras=KnownCamera.from_arrays(turned @ MADE.rotations),
        settings=replace(settings, y_up=True),
    )
    assert up.camera.y_up
    np.testing.assert_allclose(up.camera.depths(up.shapes), down.camera.depths(down.shapes), atol=1e-3)


def test_the_most_confident_observation_counts_as_one() -> None:
    cameras = estimate_cameras(MADE.tracks, KNOWN, settings=Settings(prior="smooth"))
    surer = Tracks.from_arrays(MADE.tracks.points, np.where(np.arange(40) == 3, 1.0, 0.2) + np.zeros((8, 1)))
    fainter = Tracks.from_arrays(MADE.tracks.points, 0.1 * surer.visible)
    of_fainter = estimate_cameras(fainter, KNOWN, settings=Settings(prior="smooth"))
    for observations in (cameras.observations.of(surer), of_fainter.observations.of(surer)):
        assert observations.normalized.visible.max() == 1.0
    shown = observations.without(surer.visible == 1.0)
    assert shown.normalized.visible.max() == 1.0
    assert shown.with_all().normalized.visible.max() == 1.0


@pytest.mark.parametrize("wrong", [Tracks(MADE.tracks.points.astype(int), MADE.tracks.visible), MADE.tracks.points])
def test_every_stage_refuses_tracks_made_without_validation(wrong: Tracks, cameras: Cameras, prior: Prior) -> None:
    for stage, more in (
        (estimate_cameras, ()),
        (learn_prior, (cameras,)),
        (find_outliers, (cameras, prior)),
        (solve_shapes, (cameras, prior)),
    ):
        with pytest.raises(InvalidInput, match=r"Tracks\.from_arrays") as caught:
            stage(wrong, *more)  # type: ignore[operator]
        assert (caught.value.code, caught.value.field) == ("wrong_type", "tracks")


def test_stages_refuse_arguments_of_other_types(cameras: Cameras, prior: Prior) -> None:
    tracks, mesh = MADE.tracks, MADE.mesh
    calls: list[tuple[str, Any]] = [
        ("cameras", lambda: learn_prior(tracks, KNOWN)),  # type: ignore[arg-type]
        ("cameras", lambda: find_outliers(tracks, KNOWN, prior)),  # type: ignore[arg-type]
        ("cameras", lambda: solve_shapes(tracks, KNOWN, prior, mesh)),  # type: ignore[arg-type]
        ("prior", lambda: find_outliers(tracks, cameras, mesh)),  # type: ignore[arg-type]
        ("prior", lambda: solve_shapes(tracks, cameras, mesh)),  # type: ignore[arg-type]
        ("mesh", lambda: solve_shapes(tracks, cameras, prior, mesh.faces)),  # type: ignore[arg-type]
        ("settings", lambda: solve_shapes(tracks, cameras, prior, mesh, settings={})),  # type: ignore[arg-type]
    ]
    for field, call in calls:
        with pytest.raises(InvalidInput, match=f"{field}: expected a .*, got a value of type") as caught:
            call()
        assert caught.value.code == "wrong_type"
