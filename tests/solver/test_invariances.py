"""What must not matter does not: where the image's axes lie, the unit, the order of points and frames, the precision.

Known cameras: the two answers agree to what the inner solves leave open. Estimated cameras: the answer may choose other axes, and
randomly sampled points may be other ones, so it is compared by its error against the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from pliant.solver import Camera, KnownCamera, Mesh, Settings, Solution, Tracks, gallery, solve
from pliant.solver.evaluation import metrics

pytestmark = pytest.mark.slow

LONG = pytest.mark.long
"""For cases whose parts other cases cover."""

CLOSE = 2e-4
"""Relative difference that conjugate gradients, stopped at a reduction and not at the exact answer, may leave."""

LEARNED = 2e-3
"""A covariance is learned from completed tracks, and which entries are held out to choose the completion's rank is drawn anew
for another order of frames."""

TIGHT: dict[str, object] = {"tolerance": 1e-7, "max_reweightings": 400}


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything a solve is given, so that it can be transformed as a whole. What several tests solve is solved once."""

    points: np.ndarray
    visible: np.ndarray
    mesh: Mesh
    rotations: np.ndarray
    scales: np.ndarray
    shapes: np.ndarray

    @cache  # noqa: B019 - as long as the module's own scenes
    def solved(self, *, estimated: bool = False, **settings: object) -> Solution:
        cameras = None if estimated else KnownCamera.from_arrays(self.rotations, self.scales)
        tracks = Tracks.from_arrays(self.points, self.visible)
        return solve(tracks, self.mesh, cameras=cameras, settings=Settings(**settings))  # type: ignore[arg-type]

    def error(self, solution: Solution) -> float:
        return metrics.e3d_frame(solution.shapes, self.shapes)


def scene(
    frames: int = 12, points: int = 120, *, mesh: str = "grid", outliers: float = 0.05, hidden: float = 0.1
) -> Scene:
    made = gallery.face(frames, points, degrees=45, scale_change=0.05, mesh=mesh)  # type: ignore[arg-type]
    spoiled = gallery.corrupt(made, outliers=outliers, noise=0.003, hidden=hidden, seed=4)
    return Scene(
        spoiled.tracks.points, spoiled.tracks.visible, made.mesh, made.rotations, made.scales, np.array(made.shapes)
    )


SCENE = scene()
TRIANGLES = scene(mesh="triangles")
COMPLETE = scene(outliers=0.0, hidden=0.0)


def assert_same(found: np.ndarray, expected: np.ndarray, close: float = CLOSE) -> None:
    apart = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    assert apart < close, f"{apart:.2e} apart"


def projected(camera: Camera, shapes: np.ndarray) -> np.ndarray:
    image = np.einsum("f,fij,fpj->fpi", camera.scales, camera.rotations[:, :2], shapes)
    return np.asarray(image + camera.translations[:, None])


def about_the_axis(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def rolled(given: Scene, degrees: float) -> Scene:
    """The same film, the camera held askew: tracks and cameras turn, the shapes stay."""
    turn = about_the_axis(degrees)
    return replace(given, points=given.points @ turn[:2, :2].T, rotations=turn @ given.rotations)


def moved(given: Scene) -> Scene:
    """Every frame shifted by its own amount, far against the object's size."""
    shift = np.random.default_rng(1).uniform(-3000, 3000, (len(given.points), 1, 2))
    return replace(given, points=given.points + shift)


def mirrored(given: Scene) -> Scene:
    """y up instead of down: a proper camera then sees the mirror image of the shapes."""
    flip, both = np.array([1.0, -1.0, 1.0]), np.array([1.0, -1.0])
    rotations = given.rotations * flip[:, None] * flip
    return replace(given, points=given.points * both, rotations=rotations, shapes=given.shapes * flip)


def permuted(given: Scene) -> tuple[Scene, np.ndarray]:
    """Points in another order, the mesh with them; returns where every new point was."""
    order = np.random.default_rng(2).permutation(given.points.shape[1])
    back = np.argsort(order)
    if given.mesh.grid is not None:
        mesh = Mesh.from_grid(np.where(given.mesh.grid >= 0, back[given.mesh.grid], -1))
    else:
        mesh = Mesh.from_faces(back[given.mesh.faces], len(order))
    return (
        replace(
            given,
            points=given.points[:, order],
            visible=given.visible[:, order],
            mesh=mesh,
            shapes=given.shapes[:, order],
        ),
        order,
    )


def in_another_unit(given: Scene) -> Scene:
    return replace(given, points=given.points * 0.37, shapes=given.shapes * 0.37)


def reversed_in_time(given: Scene) -> Scene:
    return Scene(
        given.points[::-1],
        given.visible[::-1],
        given.mesh,
        given.rotations[::-1],
        given.scales[::-1],
        given.shapes[::-1],
    )


@pytest.mark.parametrize(
    ("loss", "degrees"), [("l1", 90), pytest.param("l1", 180, marks=LONG), ("l2", 33), ("huber", 33)]
)
def test_the_camera_may_be_held_askew(loss: str, degrees: float) -> None:
    """L1 is taken along each image axis (as in the paper), so it knows quarter turns alone; the others any angle."""
    straight, askew = (each.solved(loss=loss, **TIGHT) for each in (SCENE, rolled(SCENE, degrees)))
    assert_same(askew.shapes, straight.shapes)
    assert_same(askew.residuals, straight.residuals, 10 * CLOSE)


def test_l1_along_the_axes_hardly_notices_other_angles() -> None:
    straight, askew = SCENE.solved(), rolled(SCENE, 45).solved()
    apart = np.linalg.norm(askew.shapes - straight.shapes) / np.linalg.norm(straight.shapes)
    assert 1e-4 < apart < 0.03


@pytest.mark.parametrize("prior", ["smooth", "smooth+low_rank"])
def test_where_the_object_stands_in_the_image_does_not_matter(prior: str) -> None:
    here, there = SCENE.solved(prior=prior), moved(SCENE).solved(prior=prior)
    assert_same(there.shapes, here.shapes, 1e-6)
    assert_same(
        projected(there.camera, there.shapes), moved(SCENE).points - SCENE.points + projected(here.camera, here.shapes)
    )


@pytest.mark.parametrize(
    ("given", "factor"),
    [(SCENE, 2.0**-20), pytest.param(SCENE, 0.5, marks=LONG), (SCENE, 2.0**20),
     (COMPLETE, 1e-6), pytest.param(COMPLETE, 0.37, marks=LONG), (COMPLETE, 1e6)],
    ids=["2^-20", "2^-1", "2^20", "complete-1e-6", "complete-0.37", "complete-1e6"],
)  # fmt: skip
def test_the_unit_scales_the_shapes_and_nothing_else(given: Scene, factor: float) -> None:
    """Where entries are hidden, by powers of two, which round nothing: refinement on the observations multiplies rounding."""
    plain, scaled = (each.solved() for each in (given, replace(given, points=given.points * factor)))
    assert_same(scaled.shapes / factor, plain.shapes, 1e-6)
    assert_same(scaled.residuals / factor, plain.residuals, 1e-5)
    np.testing.assert_allclose(scaled.weights, plain.weights, atol=1e-4)  # steep: a residual's rounding over ε
    assert scaled.choices.temporal_weight == pytest.approx(plain.choices.temporal_weight, rel=1e-9)
    assert scaled.choices.noise / factor == pytest.approx(plain.choices.noise, rel=1e-9)


@pytest.mark.parametrize("settings", [{"prior": "smooth"}, {"prior": "smooth", "temporal_order": 2}, {}], ids=str)
@pytest.mark.parametrize("given", [pytest.param(SCENE, id="grid"), pytest.param(TRIANGLES, id="triangles", marks=LONG)])
def test_a_film_run_backwards_gives_the_shapes_backwards(given: Scene, settings: dict[str, object]) -> None:
    forwards, backwards = (each.solved(**settings, **TIGHT) for each in (given, reversed_in_time(given)))
    assert_same(backwards.shapes[::-1], forwards.shapes, CLOSE if settings else LEARNED)


@pytest.mark.parametrize(
    ("given", "prior"),
    [
        pytest.param(SCENE, "smooth", id="grid-smooth"),
        pytest.param(SCENE, "gaussian", id="grid-gaussian"),
        pytest.param(TRIANGLES, "smooth", id="triangles-smooth"),
        pytest.param(TRIANGLES, "gaussian", id="triangles-gaussian", marks=LONG),
    ],
)
def test_the_order_of_the_points_does_not_matter(given: Scene, prior: str) -> None:
    shuffled, order = permuted(given)
    found, expected = (each.solved(prior=prior, **TIGHT) for each in (shuffled, given))
    assert_same(found.shapes, expected.shapes[:, order])


def test_y_may_point_up_or_down() -> None:
    down, up = SCENE.solved(**TIGHT), mirrored(SCENE).solved(**TIGHT)
    assert_same(up.shapes * [1, -1, 1], down.shapes)


NOISY = scene(16, 300, outliers=0.0, hidden=0.0)
TRANSFORMED = {
    "askew": rolled(NOISY, 33),
    "moved": moved(NOISY),
    "mirrored": mirrored(NOISY),
    "permuted": permuted(NOISY)[0],
    "backwards": reversed_in_time(NOISY),
    "in another unit": in_another_unit(NOISY),
    "moved, mirrored and in another unit": in_another_unit(mirrored(moved(NOISY))),
}
QUICK = ("askew", "permuted", "moved, mirrored and in another unit")


@pytest.fixture(scope="module")
def plain_error() -> float:
    return NOISY.error(NOISY.solved(estimated=True))


@pytest.mark.parametrize("how", [each if each in QUICK else pytest.param(each, marks=LONG) for each in TRANSFORMED])
def test_estimated_cameras_are_as_good_however_the_film_was_taken(how: str, plain_error: float) -> None:
    given = TRANSFORMED[how]
    assert 0.01 < plain_error < 0.06
    assert given.error(given.solved(estimated=True)) == pytest.approx(plain_error, rel=0.05)


@pytest.mark.parametrize("prior", ["smooth", "smooth+low_rank"])
@pytest.mark.parametrize("given", [SCENE, TRIANGLES], ids=["grid", "triangles"])
def test_single_precision_gives_the_same_answer_to_its_own_digits(given: Scene, prior: str) -> None:
    double, single = (
        given.solved(precision=p, prior=prior, max_reweightings=8, tolerance=1e-12) for p in ("float64", "float32")
    )
    apart = np.linalg.norm(single.shapes - double.shapes) / np.linalg.norm(double.shapes)
    assert 1e-9 < apart < 2e-3  # equal bits would mean that nothing was done in single precision
    assert given.error(single) == pytest.approx(given.error(double), rel=1e-3)


@pytest.mark.parametrize("prior", ["smooth", "smooth+low_rank"])
@pytest.mark.parametrize("loss", ["l1", "l2", "huber"])
def test_converged_means_that_no_direction_is_left_to_gain(loss: str, prior: str) -> None:
    """Two roads to the minimum meet: the usual tolerance is near what a thousand times finer one reaches."""
    usual, fine = SCENE.solved(loss=loss, prior=prior), SCENE.solved(loss=loss, prior=prior, **TIGHT)
    gap = usual.trace.objective[-1] / fine.trace.objective[-1] - 1
    assert -1e-9 <= gap < 2e-3
