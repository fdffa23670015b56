"""Tracks of rendered films compared with their truth, and the tracker on difficult films."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import films
import numpy as np
import pytest
from pliant.solver.gallery import face, flag, sphere
from pliant.tracking import FilmError, TrackedFilm, TrackingStep, TrackingStopped, track_film
from pliant.tracking.advice import warnings_of
from pliant.tracking.contact_sheet import view_of
from pliant.tracking.planning.plan import _farthest
from pliant.tracking.rendering import RenderedFilm
from pliant.tracking.survey import middle_of

FRAMES = 16


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RenderedFilm]:
    path = tmp_path_factory.mktemp("films") / "sphere.avi"
    return path, films.rendered(sphere(FRAMES, 600, degrees=20), path, size=(96, 72))


@pytest.fixture(scope="module")
def tracked(turning: tuple[Path, RenderedFilm]) -> TrackedFilm:
    path, film = turning
    return track_film(path, region=film.region(8), region_frame=8, grid_step=3, threads=1)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("face", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("flag", marks=pytest.mark.slow),
        pytest.param("sphere", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("occluded", marks=pytest.mark.slow),
    ],
)
def test_tracks_agree_with_the_truth(tmp_path: Path, name: str) -> None:
    sequence = {
        "face": lambda: face(20, 1500, degrees=25),
        "flag": lambda: flag(10, 800, degrees=15),
        "sphere": lambda: sphere(12, 600, degrees=18),
        "occluded": lambda: flag(10, 800, degrees=10),
    }[name]()
    size = films.SIZE if name == "face" else (120, 90)
    film = films.rendered(sequence, tmp_path / "film.avi", size=size, occluder=name == "occluded")
    start = {"face": 8, "flag": 5, "sphere": 6, "occluded": 4}[name]
    tracked = track_film(tmp_path / "film.avi", region=film.region(start), region_frame=start)
    result = films.accuracy(tracked, film)
    assert result["median"] <= 0.3, result
    assert result["p95"] <= 1.5, result
    assert result["precision"] >= 0.97, result
    assert result["recall"] >= 0.8, result
    assert tracked.template == start
    # Confidence is informative: the more confident half of the visible points is more accurate.
    true, seen, _ = film.follow(tracked.tracks[start].astype(float), start)
    right = tracked.visibility & seen & np.isfinite(true).all(axis=2)
    right[start] = False
    error, sure = np.linalg.norm(tracked.tracks - true, axis=2)[right], tracked.confidence[right]
    middle = np.median(sure)
    assert np.median(error[sure > middle]) < 0.9 * np.median(error[sure <= middle])


def test_the_result_is_a_mesh_in_the_films_pixels(
    turning: tuple[Path, RenderedFilm], tracked: TrackedFilm, tmp_path: Path
) -> None:
    _, film = turning
    count = tracked.tracks.shape[1]
    assert tracked.tracks.shape == (FRAMES, count, 2)
    assert (tracked.tracks.dtype, tracked.visibility.dtype, tracked.confidence.dtype) == (np.float32, bool, np.float32)
    assert tracked.image_size == (96, 72)
    assert tracked.fps == pytest.approx(30)
    assert tracked.visibility[8].all()
    np.testing.assert_array_equal(tracked.confidence > 0, tracked.visibility)
    np.testing.assert_array_equal(np.sort(tracked.grid[tracked.grid >= 0]), np.arange(count))
    assert set(tracked.faces.ravel()) == set(range(count)), "every point belongs to a face"
    corners = tracked.tracks[8][tracked.faces]
    np.testing.assert_allclose(corners[:, 3] - corners[:, 0], np.tile([3, 0], (len(corners), 1)), atol=1e-4)
    np.testing.assert_allclose(corners[:, 1] - corners[:, 0], np.tile([0, 3], (len(corners), 1)), atol=1e-4)
    column, row = np.round(tracked.tracks[8]).astype(int).T
    assert film.region(8)[row, column].mean() > 0.97
    np.testing.assert_allclose(tracked.uv * [96, 72] - 0.5, tracked.tracks[8], atol=1e-4)
    assert np.abs(tracked.template_image.astype(int) - film.frame(8)).mean() < 6, "the template in colour"
    tracked.save_npz(tmp_path / "tracks.npz")
    with np.load(tmp_path / "tracks.npz") as stored:
        np.testing.assert_array_equal(stored["tracks"], tracked.tracks)
        np.testing.assert_array_equal(stored["faces"], tracked.faces)
        assert tuple(stored["image_size"]) == (96, 72)
        assert int(stored["template"]) == 8


def test_the_contact_sheet_shows_film_and_tracks(turning: tuple[Path, RenderedFilm], tracked: TrackedFilm) -> None:
    _, film = turning
    sheet = tracked.contact_sheet()
    assert len(sheet) < 200_000
    picture = cv2.imdecode(np.frombuffer(sheet, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (2 * 240, 3 * 320, 3)
    left, top, width, height = tracked.thumbnail_view
    assert width / height == pytest.approx(96 / 72, abs=0.05)
    part = np.s_[top : top + height, left : left + width]
    bare = cv2.resize(film.frame(0)[part], (320, 240), interpolation=cv2.INTER_AREA)[..., ::-1]
    drawn = np.abs(picture[:240, :320].astype(int) - bare).max(axis=2) > 80
    outside = ~cv2.resize(film.region(0)[part].astype(np.uint8), (320, 240)).astype(bool)
    outside[215:, :80] = False  # the time
    assert drawn[~outside].mean() > 0.03
    assert drawn[outside].mean() < 0.02


def test_the_contact_sheet_shows_a_small_object_large(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mkv", films.textured_pictures(6, (320, 240)))
    tracked = track_film(path, region=[(200, 60), (240, 60), (240, 90), (200, 90)])
    left, top, width, height = tracked.thumbnail_view
    assert (width / 40, height / 30) == pytest.approx((1.4, 1.4), abs=0.15)
    seen = tracked.tracks[tracked.visibility]
    assert (seen.min(axis=0) > (left, top)).all()
    assert (seen.max(axis=0) < (left + width - 1, top + height - 1)).all()
    assert tracked.thumbnails.shape[1:] == (240, 320, 3)


@pytest.mark.parametrize(
    ("corners", "view"),
    [
        ([(0, 0), (99, 49)], (0, 0, 100, 50)),
        ([(0, 0), (9, 9)], (0, 0, 26, 13)),
        ([(90, 40), (99, 49)], (74, 37, 26, 13)),
        ([(45, 10), (54, 39)], (11, 6, 78, 39)),
        ([(50, 25), (50, 25)], (49, 25, 3, 1)),
    ],
    ids=["the whole picture", "a corner", "the other corner", "a tall object", "a point"],
)
def test_the_view_of_points_lies_in_the_picture(
    corners: list[tuple[int, int]], view: tuple[int, int, int, int]
) -> None:
    tracks = np.array([corners, [(-500, -500), corners[0]]], np.float32)  # a point that is not visible
    visible = np.array([[True, True], [False, True]])
    assert view_of(tracks, visible, (100, 50)) == view


@pytest.mark.slow
def test_the_result_does_not_depend_on_threads(turning: tuple[Path, RenderedFilm], tracked: TrackedFilm) -> None:
    path, film = turning
    before = cv2.getNumThreads()
    two = track_film(path, region=film.region(8), region_frame=8, grid_step=3, threads=2)
    for name in ("tracks", "visibility", "confidence", "faces"):
        np.testing.assert_array_equal(getattr(tracked, name), getattr(two, name))
    early = [
        track_film(path, region=film.region(2), region_frame=2, frames=":9", grid_step=3, threads=threads)
        for threads in (1, 2)
    ]
    np.testing.assert_array_equal(early[0].tracks, early[1].tracks)
    assert cv2.getNumThreads() == before


@pytest.mark.slow
def test_a_region_is_transferred_to_another_template_frame(turning: tuple[Path, RenderedFilm]) -> None:
    path, film = turning
    steps: list[TrackingStep] = []
    tracked = track_film(path, region=film.region(0), template_frame=9, grid_step=3, on_step=steps.append)
    assert tracked.template == 9
    column, row = np.round(tracked.tracks[9]).astype(int).T
    assert film.region(9)[row, column].mean() > 0.95
    covered = cv2.dilate(_mask(tracked, 9, (72, 96)), np.ones((5, 5), np.uint8)) > 0
    assert (covered & film.region(9)).sum() > 0.65 * film.region(9).sum()
    assert list(dict.fromkeys(step.stage for step in steps)) == ["read", "locate", "track", "fit", "refine"]
    for stage in ("track", "refine"):
        assert [step.done for step in steps if step.stage == stage] == list(range(2, FRAMES + 1))
    assert all(step.total == FRAMES for step in steps if step.stage in ("track", "refine"))
    fitted = [(step.done, step.total) for step in steps if step.stage == "fit"]
    assert [done for done, _ in fitted] == list(range(1, len(fitted) + 1))
    assert len(fitted) <= fitted[-1][1]  # type: ignore[operator]
    assert steps[0] == TrackingStep("read", 1, None)


def _mask(tracked: TrackedFilm, frame: int, shape: tuple[int, int]) -> np.ndarray:
    mask = np.zeros(shape, np.uint8)
    column, row = np.round(tracked.tracks[frame]).astype(int).T
    mask[row, column] = 1
    return mask


@pytest.mark.parametrize("stage", ["read", "locate", "track", "fit", "refine"])
def test_tracking_stops_at_every_stage(turning: tuple[Path, RenderedFilm], stage: str) -> None:
    path, film = turning
    reached = threading.Event()
    steps: list[TrackingStep] = []

    def on_step(step: TrackingStep) -> None:
        steps.append(step)
        if step.stage == stage:
            reached.set()

    with pytest.raises(TrackingStopped, match="stopped before it finished"):
        track_film(
            path, region=film.region(0), template_frame=9, grid_step=4, on_step=on_step, should_stop=reached.is_set
        )
    assert [step.stage for step in steps].count(stage) == 1, "nothing more happens after the request"


def test_tracking_stops_between_its_two_passes(turning: tuple[Path, RenderedFilm]) -> None:
    path, film = turning
    last = threading.Event()

    def on_step(step: TrackingStep) -> None:
        if step.stage == "track" and step.done == FRAMES:
            last.set()

    with pytest.raises(TrackingStopped):
        track_film(path, region=film.region(8), region_frame=8, grid_step=4, on_step=on_step, should_stop=last.is_set)


def test_without_a_region_the_whole_picture_is_tracked_with_a_warning(tmp_path: Path) -> None:
    behind, before = (films.textured_pictures(8, (96, 72), seed=seed) for seed in (0, 7))
    for number, (picture, thing) in enumerate(zip(behind, before, strict=True)):
        picture[20 + number : 50 + number, 30:70] = thing[20:50, 30:70]  # moves down, the background to the right
    told: list[list[str]] = []
    path = films.write_film(tmp_path / "film.mkv", behind)
    tracked = track_film(path, grid_step=6, region_frame=3, on_warnings=told.append)
    assert 8 // 3 <= tracked.template < 8 - 8 // 3
    assert np.ptp(tracked.tracks[tracked.template], axis=0).min() > 50
    assert tracked.warnings[:3] == (
        "No region was given, so everything in the picture is tracked, background included. Draw around the object.",
        "region_frame has no effect without a region.",
        "Only 8 frames are tracked. Film two seconds or more, while the object turns.",
    )
    assert [each[:2] for each in told] == [list(tracked.warnings[:2])] * len(
        told
    )  # whoever prints the new ones repeats none


def test_a_selection_keeps_the_films_frame_numbers(turning: tuple[Path, RenderedFilm]) -> None:
    path, film = turning
    tracked = track_film(path, region=film.region(8), region_frame=8, frames="2::3", grid_step=3)
    np.testing.assert_array_equal(tracked.film.frame_indices, [2, 5, 8, 11, 14])
    assert tracked.template == 2
    np.testing.assert_allclose(tracked.frame_times, np.array([2, 5, 8, 11, 14]) / 30, atol=2e-3)
    assert tracked.fps == pytest.approx(10, rel=0.01)
    assert films.accuracy(tracked, film)["median"] < 0.5


def test_only_the_templates_shot_is_tracked(tmp_path: Path) -> None:
    one, other = (films.textured_pictures(10, (96, 72), seed=seed) for seed in (0, 7))
    path = films.write_film(tmp_path / "film.mkv", one + other)
    polygon = [(20, 20), (70, 20), (70, 55), (20, 55)]
    tracked = track_film(path, region=polygon, region_frame=14, grid_step=4)
    assert tracked.film.cuts == (10,)
    np.testing.assert_array_equal(tracked.film.frame_indices, np.arange(10, 20))
    expected = "The film has a cut (at frame 10). Only frames 10 to 19 are tracked. Film the object in one take."
    assert tracked.warnings == (expected,)
    assert tracked.visibility.mean() > 0.9


def test_a_cut_is_told_before_the_shot_is_refused_for_its_texture(tmp_path: Path) -> None:
    black = [np.zeros((72, 96, 3), np.uint8)] * 8
    path = films.write_film(tmp_path / "film.mkv", [*black, *films.textured_pictures(12, (96, 72))])
    told: list[list[str]] = []
    with pytest.raises(FilmError) as caught:
        track_film(path, region=[(20, 20), (70, 20), (70, 55)], grid_step=4, on_warnings=told.append)
    assert caught.value.code == "no_texture"
    assert told[-1][0].startswith("The film has a cut (at frame 8). Only frames 0 to 7 are tracked.")


def test_a_still_film_gets_a_warning(tmp_path: Path) -> None:
    random, (picture,) = np.random.default_rng(0), films.textured_pictures(1, (96, 72))
    noisy = [np.clip(picture + random.normal(0, 2, picture.shape), 0, 255).astype(np.uint8) for _ in range(12)]
    path = films.write_film(tmp_path / "film.mkv", noisy)
    tracked = track_film(path, region=[(20, 20), (70, 20), (70, 55), (20, 55)], grid_step=4)
    assert tracked.warnings == (
        "Nothing moves in this film, so it holds no information about depth. Turn the object by 30° or more to both sides, "
        "or walk around it.",
    )


@pytest.mark.parametrize(
    ("deviation", "share", "placed", "expected"),
    [
        (1.4, 1.0, 20, []),
        (1.6, 0.04, 20, []),
        (
            1.6,
            0.5,
            20,
            ["In 50% of the visible positions, the picture fits the template poorly; these points may be off by"],
        ),
        (1.4, 1.0, 30, ["33% of the points were left out, because they are visible in less than 20% of the frames"]),
    ],
)
def test_uncertain_positions_and_points_left_out_get_warnings(
    deviation: float, share: float, placed: int, expected: list[str]
) -> None:
    random = np.random.default_rng(0)
    tracks = random.uniform(0, 200, (10, 20, 2)).astype(np.float32)
    visible, variance = np.ones((10, 20), bool), np.full((10, 20), 0.01, np.float32)
    visible[:, -1] = False
    variance[:, -1] = 100.0  # a hidden position may be uncertain
    seen = np.flatnonzero(visible)
    variance.flat[seen[: round(share * len(seen))]] = deviation**2
    found = warnings_of(tracks, visible, variance, 0, placed=placed, least_seen=0.2)
    assert [one[: len(begins)] for one, begins in zip(found, expected, strict=True)] == expected


def test_parts_that_stay_hidden_are_counted_as_left_out(tmp_path: Path) -> None:
    pictures, random = [picture.copy() for picture in films.textured_pictures(10, (96, 72))], np.random.default_rng(0)
    for picture in pictures[1:]:
        picture[:, 45:] = random.integers(0, 255, picture[:, 45:].shape, dtype=np.uint8)
    path = films.write_film(tmp_path / "film.mkv", pictures)
    tracked = track_film(path, region=[(10, 10), (86, 10), (86, 62), (10, 62)], region_frame=0)
    (left_out,) = (one for one in tracked.warnings if "left out" in one)
    assert 30 < int(left_out.split("%")[0]) < 80


def test_a_film_of_three_frames_is_tracked_and_one_of_two_refused(tmp_path: Path) -> None:
    pictures = films.textured_pictures(3, (96, 72))
    tracked = track_film(films.write_film(tmp_path / "three.mkv", pictures), grid_step=4)
    assert tracked.tracks.shape[0] == 3
    assert "Only 3 frames are tracked. Film two seconds or more, while the object turns." in tracked.warnings
    with pytest.raises(FilmError, match="at least 3 frames, got 2") as caught:
        track_film(films.write_film(tmp_path / "two.mkv", pictures[:2]))
    assert caught.value.code == "too_few_frames"


def test_a_shot_too_short_is_refused(tmp_path: Path) -> None:
    pictures = films.textured_pictures(12, (96, 72)) + films.textured_pictures(2, (96, 72), seed=7)
    with pytest.raises(FilmError, match="between two cuts"):
        track_film(films.write_film(tmp_path / "film.mkv", pictures), region=np.ones((72, 96), bool), region_frame=13)


def test_a_region_without_texture_is_refused(tmp_path: Path) -> None:
    pictures = films.textured_pictures(6, (96, 72))
    for picture in pictures:
        picture[10:60, 10:60] = 120
    mask = np.zeros((72, 96), bool)
    mask[18:52, 18:52] = True
    with pytest.raises(FilmError) as caught:
        track_film(films.write_film(tmp_path / "film.mkv", pictures), region=mask)
    assert caught.value.code == "no_texture"
    assert str(caught.value) == (
        "region: expected texture for at least 16 points in the template, got 0 (texture in 0% of the region). Draw a larger region, "
        "use a smaller grid_step, or film a surface with a pattern, in focus and in good light."
    )


@pytest.mark.parametrize("frames", [4, 8])
def test_unrelated_frames_are_rejected(tmp_path: Path, frames: int) -> None:
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(frames)]
    path = films.write_film(tmp_path / "film.mkv", pictures)
    region = [(20, 20), (100, 20), (100, 75), (20, 75)]
    with pytest.raises(FilmError, match="Film more slowly") as caught:
        track_film(path, region=region)
    assert caught.value.code == "tracks_lost"


def test_the_template_is_the_region_s_frame_or_one_in_the_middle(tmp_path: Path) -> None:
    pictures = [picture.copy() for picture in films.textured_pictures(9, (96, 72))]
    path, region = films.write_film(tmp_path / "film.mkv", pictures), [(10, 20), (40, 20), (40, 55), (10, 55)]
    for drawn in (3, 5):
        tracked = track_film(path, region=region, region_frame=drawn, grid_step=4)
        assert tracked.template == drawn, "in the middle third"
    for drawn in (0, 2, 6, 8):
        tracked = track_film(path, region=region, region_frame=drawn, grid_step=4)
        assert tracked.template in middle_of(0, 9)
        moved = tracked.template - drawn
        across = tracked.tracks[tracked.template][:, 0]
        assert (across.min(), across.max()) == pytest.approx((10 + moved, 40 + moved), abs=5)


@pytest.mark.parametrize(("speed", "template"), [(3, 5), (6, 3), (60, 0)])
def test_a_region_lost_before_the_middle_is_tracked_from_a_frame_on_the_way(
    tmp_path: Path, speed: int, template: int
) -> None:
    """A blank panel rises and covers two thirds of the region, in the last case at once."""
    picture = films.textured_pictures(1, (96, 72))[0]
    pictures = [np.array(picture) for _ in range(24)]
    for number, shown in enumerate(pictures[1:], start=1):
        shown[max(32, 58 - speed * number) :] = 120
    path = films.write_film(tmp_path / "film.mkv", pictures)
    lost = track_film(path, region=[(10, 20), (60, 20), (60, 55), (10, 55)], grid_step=4)
    assert lost.template == pytest.approx(template, abs=2 if template else 0)
    said = [each for each in lost.warnings if each.startswith("The region was mostly lost on the way to the middle")]
    assert len(said) == 1
    assert f"from frame {lost.template}. " in said[0]


@pytest.mark.parametrize(
    ("shares", "row"),
    [
        ((1.0, 0.9, 0.6), 20),  # the middle, although 10 has more
        ((1.0, 0.9, 0.4), 10),
        ((1.0, 0.5, 0.4), 10),  # .5 · 10 > 1 · 4
        ((1.0, 0.4, 0.4), 4),
        ((0.4, 0.4, 0.4), None),
        ((0.4, 2.0, 0.4), 10),  # enlarged
    ],
)
def test_the_template_on_the_way_shows_most_of_the_region_for_longest(
    shares: tuple[float, ...], row: int | None
) -> None:
    region = np.zeros((20, 20), bool)
    region.ravel()[:100] = True
    parts = [
        (place, np.arange(400).reshape(20, 20) < 100 * share) for place, share in zip((4, 10, 20), shares, strict=True)
    ]
    found = _farthest(iter(parts), region, 0, 20)
    assert (found is None) == (row is None)
    if found is not None:
        assert found[0] == row
        np.testing.assert_array_equal(found[1], dict(parts)[row])


def test_a_region_lost_before_the_template_is_rejected(tmp_path: Path) -> None:
    pictures = [picture.copy() for picture in films.textured_pictures(14, (96, 72))]
    for number, picture in enumerate(pictures):
        picture[max(14, 72 - 6 * number) :] = 120  # a blank panel rises and covers the region
    path = films.write_film(tmp_path / "film.mkv", pictures)
    with pytest.raises(FilmError, match="Draw the region in the template frame itself") as caught:
        track_film(path, region=[(10, 20), (40, 20), (40, 55), (10, 55)], template_frame=13)
    assert caught.value.code == "region_lost"


@pytest.mark.slow
def test_uneven_frame_times_and_a_damaged_end_give_warnings(tmp_path: Path) -> None:
    pictures = films.textured_pictures(14, (96, 72))
    path = films.with_uneven_times(films.write_film(tmp_path / "film.mp4", pictures), first=7)
    region = [(20, 20), (50, 20), (50, 44), (20, 44)]
    tracked = track_film(path, region=region)
    assert "The time between frames varies; frame_times holds the true times." in tracked.warnings
    path = films.write_film(tmp_path / "film.avi", pictures)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    tracked = track_film(path, region=region)
    assert 3 <= len(tracked.tracks) < 12
    assert any("its end is damaged or missing" in note for note in tracked.warnings)


def test_a_tiny_region_cannot_be_transferred(turning: tuple[Path, RenderedFilm]) -> None:
    with pytest.raises(FilmError, match="Draw a larger region") as caught:
        track_film(turning[0], region=[(40, 40), (41, 40), (41, 41)], template_frame=9)
    assert caught.value.code == "region_lost"


def test_a_frame_skipped_by_the_selection_stands_for_the_nearest_used_one(turning: tuple[Path, RenderedFilm]) -> None:
    path, film = turning
    tracked = track_film(path, region=film.region(15), region_frame=15, template_frame=15, frames="::2", grid_step=3)
    assert tracked.film.frame_indices[tracked.template] == 14


def test_a_narrow_film_is_tracked_in_its_own_pixels(tmp_path: Path) -> None:
    pictures = films.textured_pictures(
        4, (1600, 20), step=4
    )  # 960 × 12 pixels for the tracker, which takes at least 16
    path = films.zip_of(tmp_path / "film.zip", {f"{i}.png": films.png(p) for i, p in enumerate(pictures)})
    tracked = track_film(path)
    assert tracked.uv.max() < 1
    np.testing.assert_allclose(np.ptp(tracked.tracks[tracked.template], axis=0), [1585, 14], atol=7)
    step = np.diff(tracked.tracks, axis=0)[tracked.visibility[1:] & tracked.visibility[:-1]]
    np.testing.assert_allclose(np.median(step, axis=0), [4, 0], atol=0.2)


def test_tracks_of_reduced_films_are_in_the_original_pixels(tmp_path: Path) -> None:
    pictures = [cv2.resize(p, (768, 576), interpolation=cv2.INTER_CUBIC) for p in films.textured_pictures(6, (96, 72))]
    path = films.write_film(tmp_path / "film.mkv", pictures)
    tracked = track_film(path, region=[(200, 150), (500, 150), (500, 400), (200, 400)], longest_side=192)
    step = np.diff(tracked.tracks, axis=0)[tracked.visibility[1:] & tracked.visibility[:-1]]
    np.testing.assert_allclose(np.median(step, axis=0), [8, 0], atol=0.3)
    assert tracked.template_image.shape == (576, 768, 3)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("grid_step", 0.0),
        ("grid_step", 1000.0),
        ("grid_step", "4"),
        ("longest_side", 10),
        ("threads", 0),
        ("threads", 1.5),
    ],
)
def test_options_out_of_range_are_refused(option: str, value: float) -> None:
    with pytest.raises(FilmError) as caught:
        track_film("film.mp4", **{option: value})  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("out_of_range", option)


@pytest.mark.parametrize("field", ["region_frame", "template_frame"])
@pytest.mark.parametrize("frame", [-1, 16])
def test_frames_outside_the_film_are_refused(turning: tuple[Path, RenderedFilm], field: str, frame: int) -> None:
    with pytest.raises(FilmError) as caught:
        track_film(turning[0], region=turning[1].region(0), **{field: frame})  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("no_such_frame", field)


def test_points_closer_than_the_pixels_of_the_trackers_frames_are_refused(tmp_path: Path) -> None:
    pictures = [cv2.resize(p, (768, 576), interpolation=cv2.INTER_CUBIC) for p in films.textured_pictures(3, (96, 72))]
    path = films.write_film(tmp_path / "film.mkv", pictures)
    with pytest.raises(FilmError) as caught:
        track_film(path, grid_step=3.9, longest_side=192)
    assert (caught.value.code, caught.value.field) == ("out_of_range", "grid_step")
    assert "expected at least 4 pixels, one of the tracker's frames, got 3.9" in str(caught.value)
    region = [(200, 150), (300, 150), (300, 250), (200, 250)]
    assert track_film(path, region=region, grid_step=4, longest_side=192).tracks.shape[1] > 300


def test_a_grid_too_wide_for_the_region_is_named_as_such(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mkv", films.textured_pictures(3, (320, 240)))
    with pytest.raises(FilmError) as caught:
        track_film(path, region=[(60, 60), (80, 60), (80, 80), (60, 80)], grid_step=100)
    assert (caught.value.code, caught.value.got) == ("no_texture", "0 (no point of the grid lies in the region)")


@pytest.mark.parametrize(("size", "shape"), [((16, 1720), (960, 320)), ((1720, 16), (80, 320))])
def test_very_long_films_have_a_contact_sheet(tmp_path: Path, size: tuple[int, int], shape: tuple[int, int]) -> None:
    tracked = track_film(films.write_film(tmp_path / "film.avi", films.textured_pictures(4, size)))
    assert tracked.thumbnails.shape == (4, *shape, 3)
    picture = cv2.imdecode(np.frombuffer(tracked.contact_sheet(), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (2 * shape[0], 3 * shape[1], 3)


@pytest.mark.slow
def test_points_outside_the_picture_are_hidden(tmp_path: Path) -> None:
    """The texture moves out to the right; in the second pass, repeated pixels of the border look like what has left."""
    path = films.write_film(tmp_path / "film.mkv", films.textured_pictures(16, (160, 120), step=4))
    tracked = track_film(path, region=[(60, 20), (154, 20), (154, 100), (60, 100)])
    right, bottom = 159 + 0.5, 119 + 0.5
    outside = ((tracked.tracks < -0.5) | (tracked.tracks > (right, bottom))).any(axis=2)
    assert outside.mean() > 0.1
    assert not (outside & tracked.visibility).any()
    true = tracked.tracks[0, :, 0] + 4 * np.arange(16)[:, None]
    assert tracked.visibility[(true <= 159) & (true >= 0)].mean() > 0.97
    assert tracked.visibility[true > 160].mean() < 0.01


def test_frames_of_a_carried_region_are_counted_to_the_last(turning: tuple[Path, RenderedFilm]) -> None:
    path, film = turning
    steps: list[TrackingStep] = []
    track_film(path, region=film.region(0), template_frame=9, grid_step=6, on_step=steps.append)
    located = [step for step in steps if step.stage == "locate"]
    assert [step.done for step in located] == [2, 4, 6, 8, 9]
    assert {step.total for step in located} == {9}


def test_a_portrait_film_is_tracked_upright(tmp_path: Path) -> None:
    path = films.turned_by_90(films.write_film(tmp_path / "film.mp4", films.textured_pictures(6, (96, 72))))
    tracked = track_film(path, region=[(18, 20), (54, 20), (54, 76), (18, 76)], grid_step=4)
    assert (tracked.image_size, tracked.template_image.shape) == ((72, 96), (96, 72, 3))
    assert tracked.warnings == ("Only 6 frames are tracked. Film two seconds or more, while the object turns.",)
    step = np.diff(tracked.tracks, axis=0)[tracked.visibility[1:] & tracked.visibility[:-1]]
    np.testing.assert_allclose(np.abs(np.median(step, axis=0)), [0, 1], atol=0.2)  # to the right as recorded


@pytest.mark.slow
def test_a_4k_film_is_reduced_for_tracking(tmp_path: Path) -> None:
    small = films.textured_pictures(3, (192, 108))
    pictures = [cv2.resize(p, (3840, 2160), interpolation=cv2.INTER_LINEAR) for p in small]
    path = films.write_film(tmp_path / "film.mp4", pictures)
    tracked = track_film(path, region=[(800, 500), (3000, 500), (3000, 1700), (800, 1700)])
    assert tracked.image_size == (3840, 2160)
    assert tracked.warnings == ("Only 3 frames are tracked. Film two seconds or more, while the object turns.",)
    step = np.diff(tracked.tracks, axis=0)[tracked.visibility[1:] & tracked.visibility[:-1]]
    np.testing.assert_allclose(np.median(step, axis=0), [20, 0], atol=1)
    assert 1000 < tracked.tracks.shape[1] < 6000
