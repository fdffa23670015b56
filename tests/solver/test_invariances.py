"""Invariance to the image axes, the unit, the order of points and frames, and the precision.

With known cameras, both results agree up to the accuracy of the inner solves. With estimated cameras, world axes and randomly
sampled points may differ, so the errors against the truth are compared.
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
"""Relative difference allowed because conjugate gradients stop at a reduction, not at the exact solution."""

LEARNED = 2e-3
"""Tolerance for a covariance learned from completed tracks: the entries held out to choose the completion's rank depend on the
order of the frames."""

TIGHT: dict[str, object] = {"tolerance": 1e-7, "max_reweightings": 400}


@dataclass(frozen=True, eq=False)
class Scene:
    """All inputs of a solve, so that they can be transformed together; solutions are cached for several tests."""

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
        size = 2 if estimated else None  # one factorization takes less time
        return solve(tracks, self.mesh, cameras=cameras, settings=Settings(basis_size=size, **settings))  # type: ignore[arg-type]

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
    """The same film with a rolled camera: tracks and cameras rotate, the shapes stay."""
    turn = about_the_axis(degrees)
    return replace(given, points=given.points @ turn[:2, :2].T, rotations=turn @ given.rotations)


def moved(given: Scene) -> Scene:
    """Every frame shifted by its own amount, large compared with the object."""
    shift = np.random.default_rng(1).uniform(-3000, 3000, (len(given.points), 1, 2))
    return replace(given, points=given.points + shift)


def mirrored(given: Scene) -> Scene:
    """y up instead of down: a proper camera then sees the mirror image of the shapes."""
    flip, both = np.array([1.0, -1.0, 1.0]), np.array([1.0, -1.0])
    rotations = given.rotations * flip[:, None] * flip
    return replace(given, points=given.points * both, rotations=rotations, shapes=given.shapes * flip)


def permuted(given: Scene) -> tuple[Scene, np.ndarray]:
    """Permute points and mesh; also return the old index of every new point."""
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
    ("loss", "degrees"),
    [
        pytest.param("l1", 90, marks=LONG),
        pytest.param("l1", 180, marks=LONG),
        pytest.param("l2", 33, marks=LONG),
        ("huber", 33),
    ],
)
def test_shapes_do_not_depend_on_camera_roll(loss: str, degrees: float) -> None:
    """L1 acts along each image axis (as in the paper), so it is invariant to quarter turns only; the others to any angle."""
    straight, askew = (each.solved(loss=loss, **TIGHT) for each in (SCENE, rolled(SCENE, degrees)))
    assert_same(askew.shapes, straight.shapes)
    assert_same(askew.residuals, straight.residuals, 10 * CLOSE)


@pytest.mark.long
def test_l1_along_the_axes_changes_little_at_a_roll_of_45_degrees() -> None:
    straight, askew = SCENE.solved(), rolled(SCENE, 45).solved()
    apart = np.linalg.norm(askew.shapes - straight.shapes) / np.linalg.norm(straight.shapes)
    assert 1e-4 < apart < 0.03


@pytest.mark.parametrize("prior", ["smooth", "smooth+low_rank"])
def test_shapes_do_not_depend_on_the_image_position(prior: str) -> None:
    here, there = SCENE.solved(prior=prior), moved(SCENE).solved(prior=prior)
    assert_same(there.shapes, here.shapes, 1e-6)
    assert_same(
        projected(there.camera, there.shapes), moved(SCENE).points - SCENE.points + projected(here.camera, here.shapes)
    )


@pytest.mark.parametrize(
    ("given", "factor"),
    [pytest.param(SCENE, 2.0**-20, marks=LONG), pytest.param(SCENE, 0.5, marks=LONG), (SCENE, 2.0**20),
     pytest.param(COMPLETE, 1e-6, marks=LONG), pytest.param(COMPLETE, 0.37, marks=LONG), (COMPLETE, 1e6)],
    ids=["2^-20", "2^-1", "2^20", "complete-1e-6", "complete-0.37", "complete-1e6"],
)  # fmt: skip
def test_changing_the_unit_only_rescales_the_result(given: Scene, factor: float) -> None:
    """With hidden entries, powers of two are used, which are exact: refinement on the observations amplifies rounding."""
    plain, scaled = (each.solved() for each in (given, replace(given, points=given.points * factor)))
    assert_same(scaled.shapes / factor, plain.shapes, 1e-6)
    assert_same(scaled.residuals / factor, plain.residuals, 1e-5)
    np.testing.assert_allclose(scaled.weights, plain.weights, atol=1e-4)  # steep: a residual's rounding over ε
    assert scaled.choices.temporal_weight == pytest.approx(plain.choices.temporal_weight, rel=1e-9)
    assert scaled.choices.noise / factor == pytest.approx(plain.choices.noise, rel=1e-9)


@pytest.mark.parametrize(
    "settings", [{"prior": "smooth"}, pytest.param({"prior": "smooth", "temporal_order": 2}, marks=LONG), {}], ids=str
)
@pytest.mark.parametrize("given", [pytest.param(SCENE, id="grid"), pytest.param(TRIANGLES, id="triangles", marks=LONG)])
def test_reversing_the_film_reverses_the_shapes(given: Scene, settings: dict[str, object]) -> None:
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


def test_flipping_the_y_axis_mirrors_the_shapes() -> None:
    down, up = SCENE.solved(**TIGHT), mirrored(SCENE).solved(**TIGHT)
    assert_same(up.shapes * [1, -1, 1], down.shapes)


NOISY = scene(12, 200, outliers=0.0, hidden=0.0)
TRANSFORMED = {
    "askew": rolled(NOISY, 33),
    "moved": moved(NOISY),
    "mirrored": mirrored(NOISY),
    "permuted": permuted(NOISY)[0],
    "backwards": reversed_in_time(NOISY),
    "in another unit": in_another_unit(NOISY),
    "askew, moved, mirrored and in another unit": in_another_unit(mirrored(moved(rolled(NOISY, 33)))),
}
QUICK = ("askew, moved, mirrored and in another unit",)


@pytest.fixture(scope="module")
def plain_error() -> float:
    return NOISY.error(NOISY.solved(estimated=True))


@pytest.mark.parametrize("how", [each if each in QUICK else pytest.param(each, marks=LONG) for each in TRANSFORMED])
def test_error_with_estimated_cameras_is_invariant_to_transformations(how: str, plain_error: float) -> None:
    given = TRANSFORMED[how]
    assert 0.01 < plain_error < 0.06
    assert given.error(given.solved(estimated=True)) == pytest.approx(plain_error, rel=0.05)


@pytest.mark.parametrize("prior", ["smooth", "smooth+low_rank"])
@pytest.mark.parametrize("given", [SCENE, TRIANGLES], ids=["grid", "triangles"])
def test_single_precision_matches_double_within_its_accuracy(given: Scene, prior: str) -> None:
    double, single = (
        given.solved(precision=p, prior=prior, max_reweightings=8, tolerance=1e-12) for p in ("float64", "float32")
    )
    apart = np.linalg.norm(single.shapes - double.shapes) / np.linalg.norm(double.shapes)
    assert 1e-9 < apart < 2e-3  # equal bits would mean that nothing was done in single precision
    assert given.error(single) == pytest.approx(given.error(double), rel=1e-3)


@pytest.mark.parametrize("prior", ["smooth", "smooth+low_rank"])
@pytest.mark.parametrize("loss", ["l1", "l2", "huber"])
def test_converged_objective_is_close_to_that_of_a_finer_tolerance(loss: str, prior: str) -> None:
    """The objective at the default tolerance is near what a thousand times finer one reaches."""
    usual, fine = SCENE.solved(loss=loss, prior=prior), SCENE.solved(loss=loss, prior=prior, **TIGHT)
    gap = usual.trace.objective[-1] / fine.trace.objective[-1] - 1
    assert -1e-9 <= gap < 2e-3
