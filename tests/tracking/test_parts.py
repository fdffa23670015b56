"""The parts of the tracker: regions, cuts, flow, seeding and rendered films."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import films
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter
from pliant.solver.evaluation.metrics import e3d_frame, e3d_frame_scaled
from pliant.solver.gallery import sphere
from pliant.tracking import FilmError
from pliant.tracking.appearance import Appearance, noise_variance
from pliant.tracking.decoding.pictures import natural
from pliant.tracking.flow import dense_flow, match, opencv_serial, sample
from pliant.tracking.frame_store import CACHED, FrameStore
from pliant.tracking.region import read_region
from pliant.tracking.rendering import Truth, render_film
from pliant.tracking.seeding import keep, neighbours, place, quads
from pliant.tracking.survey import find_cuts, sharpest, tracking_scale


def grey(count: int = 2, step: int = 2) -> list[np.ndarray]:
    return [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY) for p in films.textured_pictures(count, (96, 72), step=step)]


def test_importing_without_opencv_names_the_extra_to_install() -> None:
    code = "import sys; sys.modules['cv2'] = None\nimport pliant.tracking"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode != 0
    assert "pip install '.[film]'" in ran.stderr


def test_pliant_and_its_solver_do_not_import_opencv() -> None:
    code = "import sys, pliant, pliant.solver, pliant.solver.gallery; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_regions_are_read_from_masks_polygons_and_files(tmp_path: Path) -> None:
    mask = np.zeros((48, 64), bool)
    mask[10:30, 20:41] = True
    np.testing.assert_array_equal(read_region(mask, (64, 48)), mask)
    np.testing.assert_array_equal(read_region(mask.astype(np.uint8) * 255, (64, 48)), mask)
    np.testing.assert_array_equal(read_region([(20, 10), (40, 10), (40, 29), (20, 29)], (64, 48)), mask)
    Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_region(tmp_path / "mask.png", (64, 48)), mask)
    clear = np.dstack([np.zeros((48, 64, 3), np.uint8), mask.astype(np.uint8) * 255])
    Image.fromarray(clear).save(tmp_path / "clear.png")
    np.testing.assert_array_equal(read_region(str(tmp_path / "clear.png"), (64, 48)), mask)


def test_an_outline_that_runs_around_twice_leaves_no_hole() -> None:
    size = (64, 48)
    first, second = [(10, 10), (40, 10), (40, 30), (10, 30)], [(20, 20), (50, 20), (50, 40), (20, 40)]
    either = read_region(first, size) | read_region(second, size)
    whole = [*first, first[0], *second, second[0]]
    for twice in (whole, whole[::-1]):
        covered = read_region(twice, size)
        assert covered[either].all()
        assert covered[20:31, 20:41].all()  # inside both
        assert (covered & ~either).sum() <= 20  # beside the way from one to the other
    beyond = [(x - 30, y - 20) for x, y in first]
    np.testing.assert_array_equal(read_region(beyond * 2, size), read_region(beyond, size))
    inner = [(20, 15), (20, 25), (30, 25), (30, 15)]  # the other way round: a ring
    ring = read_region([*first, first[0], *inner, inner[0]], size)
    assert not ring[16:25, 21:30].any()
    assert ring[12, 12:39].all()


def disc(share: float, *, blur: float = 0.0) -> Image.Image:
    """Return an anti-aliased white disc on black, `share` of the picture's height across, blurred by a share of its width."""
    width, height = 320, 240
    picture = Image.new("L", (4 * width, 4 * height))
    x, y, radius = 2 * width, 2 * height, 2 * height * share
    ImageDraw.Draw(picture).ellipse([x - radius, y - radius, x + radius, y + radius], fill=255)
    return picture.resize((width, height), Image.Resampling.LANCZOS).filter(ImageFilter.GaussianBlur(blur * width))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.8, 0.97, 1.6])
@pytest.mark.parametrize("name", ["mask.png", "mask.jpg"])
def test_soft_and_compressed_outlines_are_masks(tmp_path: Path, name: str, share: float) -> None:
    for blur in (0, 0.005, 0.02):
        disc(share, blur=blur).save(tmp_path / name, quality=30)
        inside = np.asarray(disc(share, blur=blur)) >= 128
        assert (read_region(tmp_path / name, (320, 240)) != inside).mean() < 0.01


def cut_out() -> NDArray[np.uint8]:
    """Return a photograph that is black outside a disc."""
    return np.where(np.asarray(disc(0.5)) >= 128, photograph(), 0).astype(np.uint8)


def photograph() -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(films.textured_pictures(1, (80, 60))[0], (320, 240)))[..., 0]


@pytest.mark.parametrize(
    ("picture", "got"),
    [
        (photograph(), "a picture in which 90% of the pixels are in between"),
        (cut_out(), "a picture in which 13% of the pixels are in between"),
        (np.asarray(disc(0.5)) // 2, "a picture in which 15% of the pixels are in between"),
    ],
    ids=["photograph", "cut-out", "grey"],
)
def test_pictures_that_are_not_black_and_white_are_no_masks(
    tmp_path: Path, picture: NDArray[np.uint8], got: str
) -> None:
    Image.fromarray(picture).save(tmp_path / "mask.png")
    with pytest.raises(FilmError) as caught:
        read_region(tmp_path / "mask.png", (320, 240))
    assert caught.value.code == "wrong_region"
    hint = "Paint the object white and everything else black."
    assert str(caught.value) == f"region: expected a black and white mask, got {got}. {hint}"


@pytest.mark.parametrize(
    ("region", "code"),
    [
        (np.ones((10, 10), bool), "wrong_region_size"),
        (np.zeros((48, 64), bool), "empty_region"),
        (np.ones((48, 64, 3), np.uint8), "wrong_region"),
        (np.ones((48, 64)), "wrong_region"),
        ([(0, 0), (1, 1)], "wrong_polygon"),
        ([(0, 0), (1, np.nan), (5, 5)], "wrong_polygon"),
        ([(0, 0), (1,), (5, 5)], "wrong_polygon"),
        ("missing.png", "unreadable_region"),
        (Path(__file__), "unreadable_region"),
    ],
)
def test_wrong_regions_are_refused(region: object, code: str) -> None:
    with pytest.raises(FilmError) as caught:
        read_region(region, (64, 48))  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == (code, "region")


def test_a_mask_file_of_another_size_is_refused(tmp_path: Path) -> None:
    Image.new("L", (100, 80), 255).save(tmp_path / "mask.png")
    with pytest.raises(FilmError, match="got 100×80"):
        read_region(tmp_path / "mask.png", (64, 48))


def test_a_single_drop_in_similarity_is_a_cut_and_fast_motion_is_not() -> None:
    likeness = np.full(30, 0.95)
    assert find_cuts(likeness) == ()
    likeness[12] = 0.1
    assert find_cuts(likeness) == (12,)
    likeness[18:24] = 0.1  # fast motion
    assert find_cuts(likeness) == (12,)


def test_the_template_is_a_sharp_frame_of_the_middle() -> None:
    sharpness = np.zeros(30)
    sharpness[[3, 14, 28]] = 1
    assert sharpest(sharpness, 0, 30) == 14
    assert sharpest(sharpness, 20, 23) == 21


def test_small_films_are_enlarged_and_large_ones_reduced() -> None:
    assert tracking_scale((160, 120), 960) == 3
    assert tracking_scale((320, 240), 960) == 1.5
    assert tracking_scale((640, 480), 960) == 1
    assert tracking_scale((3840, 2160), 960) == 0.25


def test_matches_follow_the_motion_and_detect_lost_points() -> None:
    first, second = grey()
    points = np.array([[30.0, 30.0], [50.5, 40.25], [94.5, 40.0]], np.float32)
    with opencv_serial():
        found = match(dense_flow(first, second), dense_flow(second, first), points)
    np.testing.assert_allclose(found.points[:2] - points[:2], [[2, 0], [2, 0]], atol=0.15)
    np.testing.assert_array_equal(found.lost, [False, False, True])


def test_flow_continues_a_similar_one() -> None:
    first, second = grey(step=30)
    true = np.full((72, 96, 2), [30, 0], np.float32)
    similar = true + np.float32(1)
    with opencv_serial():
        alone, continued = dense_flow(first, second), dense_flow(first, second, similar)
    error, before = (np.linalg.norm(flow - true, axis=2)[16:-16, 8:56] for flow in (continued, alone))
    assert np.quantile(error, 0.9) < 0.2 < 2 < np.quantile(before, 0.9)
    np.testing.assert_array_equal(similar, true + 1)


def test_hidden_points_that_look_like_the_template_are_found() -> None:
    first, second = grey()
    seeds, _ = place(first, np.pad(np.ones((40, 64), bool), 16), step=4)
    look = Appearance.of(first, np.ones(first.shape, bool), seeds.points, neighbours(seeds.grid, len(seeds.points)))
    moved, visible = seeds.points + np.float32([2, 0]), np.arange(len(seeds.points)) % 3 > 0
    assert look.found(second, moved, visible).all()
    blank = np.full_like(second, 128)
    np.testing.assert_array_equal(look.found(blank, moved, visible), visible)
    half, every = second.copy(), np.ones(len(moved), bool)
    half[:, 50:] = 128
    found = look.found(half, moved, ~every)
    np.testing.assert_array_equal(found, look.agrees(half, moved, every))
    assert found[moved[:, 0] < 38].mean() > 0.9
    assert not found[moved[:, 0] > 58].any()


def test_sampling_is_bilinear() -> None:
    rows, columns = np.mgrid[:5, :6].astype(np.float32)
    field = np.stack([2 * columns + rows, columns * rows], axis=-1)
    points = np.array([[1.5, 2.25], [0, 0], [5, 4], [-3, 9]], np.float32)
    np.testing.assert_allclose(
        sample(field, points[:, None])[:, 0], [[5.25, 3.375], [0, 0], [14, 20], [4, 0]], atol=1e-5
    )


def test_sampling_takes_any_number_of_positions_and_channels() -> None:
    columns = np.tile(np.arange(8, dtype=np.float32), (6, 1))
    places = np.random.default_rng(0).uniform([0, 0], [7, 5], (70_000, 2)).astype(np.float32)
    for shape in ((70_000, 1, 2), (2, 35_000, 2), (1, 70_000, 2), (10_000, 7, 2)):
        given = places.reshape(shape)
        np.testing.assert_allclose(sample(columns, given), given[..., 0], atol=1 / 32)
        channels = sample(cv2.merge([columns, 2 * columns, 3 * columns]), given)
        np.testing.assert_allclose(channels, given[..., :1] * [1, 2, 3], atol=3 / 32)
    assert sample(columns, places[:0, None]).shape == (0, 1)


def test_patches_detect_occlusion() -> None:
    first, second = grey()
    seeds, _ = place(first, np.ones_like(first, bool), step=6)
    beside = neighbours(seeds.grid, len(seeds.points))
    appearance = Appearance.of(first, np.ones_like(first, bool), seeds.points, beside)
    moved = seeds.points + np.float32([2, 0])
    everything = np.ones(len(moved), bool)
    inner = ((moved > 12) & (moved < (84, 60))).all(axis=1)
    assert appearance.agrees(second, moved, everything)[inner].all()
    hidden = second.copy()
    hidden[:, :40] = np.random.default_rng(3).integers(0, 255, (72, 40))
    seen = appearance.agrees(hidden, moved, everything)
    assert seen[inner & (moved[:, 0] > 48)].all()
    assert not seen[inner & (moved[:, 0] < 34)].any()


def test_what_surrounds_the_region_does_not_count() -> None:
    """A disc moves before a background that changes; half of the patches at its outline show the background."""
    first, second = grey()
    disc = np.hypot(*(np.mgrid[:72, :96] - np.array([36, 46])[:, None, None])) < 26
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(72, 192)), (0, 0), 2.0)
    behind = np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)
    first, second = np.where(disc, first, behind[:, :96]), np.where(np.roll(disc, 2, axis=1), second, behind[:, 96:])
    seeds, _ = place(first, disc, step=4)
    moved, beside = seeds.points + np.float32([2, 0]), neighbours(seeds.grid, len(seeds.points))
    everything = np.ones(len(moved), bool)
    masked, whole = (
        Appearance.of(first, region, seeds.points, beside).agrees(second, moved, everything)
        for region in (disc, np.ones_like(disc))
    )
    assert masked.mean() > 0.97
    assert whole.mean() < 0.8
    slid = moved.copy()
    slid[:, 0] += 4  # as if they followed something else
    assert Appearance.of(first, disc, seeds.points, beside).agrees(second, slid, everything).mean() < 0.1


def test_hidden_neighbours_hide_a_point_sooner_at_the_edge_of_the_grid() -> None:
    first, second = grey()
    seeds, _ = place(first, np.ones_like(first, bool), step=8)
    beside = neighbours(seeds.grid, len(seeds.points))
    appearance = Appearance.of(first, np.ones_like(first, bool), seeds.points, beside)
    rows, columns = seeds.grid.shape
    row, column = rows // 2, columns // 2

    def seen(*hidden: tuple[int, int]) -> np.ndarray:
        visible = np.ones(len(seeds.points), bool)
        for cell in hidden:
            visible[seeds.grid[cell]] = False
        return appearance.agrees(second, seeds.points + np.float32([2, 0]), visible)

    assert seen()[seeds.grid[row, column]]
    assert seen((row, column - 1))[seeds.grid[row, column]]
    assert not seen((row, column - 1), (row, column + 1))[seeds.grid[row, column]]
    assert seen()[seeds.grid[1, 0]]
    assert not seen((2, 0))[seeds.grid[1, 0]]


def test_noise_is_estimated_on_texture() -> None:
    clean = grey(1)[0].astype(float)
    clean = cv2.GaussianBlur(clean, (0, 0), 3)
    noisy = np.clip(clean + np.random.default_rng(0).normal(0, 5, clean.shape), 0, 255).astype(np.uint8)
    assert noise_variance(noisy) == pytest.approx(25, rel=0.25)


def test_grids_lose_points_without_a_face_and_keep_their_order() -> None:
    image = grey(1)[0]
    seeds, share = place(image, np.ones_like(image, bool), step=8)
    assert share > 0.9
    rows, columns = seeds.grid.shape
    assert len(quads(seeds.grid)) == (rows - 1) * (columns - 1)
    wanted = np.ones(len(seeds.points), bool)
    wanted[seeds.grid[0, 1]] = False  # the corner next to it loses its only face
    grid, kept = keep(seeds.grid, wanted)
    gone = set(range(len(seeds.points))) - set(kept.tolist())
    assert gone == {int(seeds.grid[0, 0]), int(seeds.grid[0, 1])}
    np.testing.assert_array_equal(np.sort(grid[grid >= 0]), np.arange(len(kept)))
    beside = neighbours(grid, len(kept))
    assert beside[grid[0, 2]].tolist() == [-1, grid[0, 3], -1, grid[1, 2]]


def test_a_step_wider_than_the_picture_places_no_points() -> None:
    image = grey(1)[0]
    assert len(place(image, np.ones_like(image, bool), step=300)[0].points) == 0


def test_the_store_returns_frames_in_any_order() -> None:
    frames = [np.full((20, 30), value, np.uint8) for value in range(CACHED + 6)]
    with FrameStore() as store:
        for frame in frames:
            store.append(frame)
        for index in [*range(len(frames)), *reversed(range(len(frames)))]:
            np.testing.assert_array_equal(store.read(index), frames[index])


def test_names_sort_by_their_numbers() -> None:
    assert sorted(["b2", "a10", "a9", "a", "B1"], key=natural) == ["a", "a9", "a10", "B1", "b2"]


def test_a_rendered_film_agrees_with_its_ground_truth() -> None:
    film = render_film(sphere(4, 400, degrees=10), size=(96, 72), noise=0.0)
    row, column = np.nonzero(cv2.erode(film.region(0).astype(np.uint8), np.ones((15, 15))))
    points = np.stack([column, row], axis=1).astype(float)
    tracks, visible, shapes = film.follow(points, 0)
    np.testing.assert_allclose(tracks[0], points, atol=1e-9)
    assert visible[:2].mean() > 0.99
    centre = np.array([95, 71]) / 2
    np.testing.assert_allclose(film.focal * shapes[..., :2] / shapes[..., 2:] + centre, tracks, atol=1e-9)
    first, second = (cv2.cvtColor(film.frame(index), cv2.COLOR_RGB2GRAY).astype(np.float32) for index in (0, 1))

    def difference(offset: float) -> float:
        x, y = (np.ascontiguousarray(tracks[1:2, :, axis] + offset, dtype=np.float32) for axis in (0, 1))
        return float(np.abs(cv2.remap(second, x, y, cv2.INTER_CUBIC)[0] - first[row, column]).mean())

    assert difference(0.0) < 0.4 * min(difference(0.3), difference(-0.3))
    assert not np.isfinite(film.follow(np.array([[1.0, 1.0], [500.0, 5.0]]), 0)[0]).any()


def test_rendered_films_are_written_in_known_containers_only(tmp_path: Path) -> None:
    film = render_film(sphere(3, 50), size=(32, 32))
    with pytest.raises(FilmError, match=r"got film\.gif"):
        film.write(tmp_path / "film.gif")
    with pytest.raises(FilmError) as caught:
        film.write(tmp_path / "missing" / "film.avi")
    assert caught.value.code == "unwritable_film"


def test_shape_error_is_the_frame_error_after_one_scale_per_film() -> None:
    rng = np.random.default_rng(0)
    true, on = rng.normal(size=(4, 6, 3)), np.array([True, False, True, True, True, True, False, True])
    truth = Truth(on, true[..., :2], np.ones((4, 6), dtype=bool), true)
    found = np.zeros((4, 8, 3))
    found[:, on] = 7 * (true + 0.1 * rng.normal(size=true.shape))
    assert truth.shape_error(found) == pytest.approx(e3d_frame_scaled(found[:, on], true))
    assert truth.shape_error(found[:, [0, 1, 3, 4, 7]], [0, 1, 3, 4, 7]) == pytest.approx(
        e3d_frame_scaled(found[:, [0, 3, 4, 7]], true[:, [0, 2, 3, 5]])
    )
    assert truth.shape_error(found) < 0.2 < e3d_frame(found[:, on], true)
