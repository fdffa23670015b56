"""The estimate of memory and time before a solve."""

from __future__ import annotations

import pytest
from pliant.schemas.options import Options
from pliant.solver.limits import BLOCK_OBSERVATIONS
from pliant.worker.formats.cost import BEYOND, BYTES, LEARNING, LIBRARIES, SECONDS, estimated, largest_that_fits


@pytest.mark.parametrize("prior", ["gaussian", "smooth", "smooth+low_rank"])
@pytest.mark.parametrize("points", [1_000, 100_000, 1_000_000])
def test_the_largest_job_that_fits_agrees_with_the_estimate(prior: str, points: int) -> None:
    options = Options(prior=prior)
    memory = estimated(50, points, options).memory_bytes
    most_points, most_frames = largest_that_fits(memory, 50, points, options)
    assert most_points == points
    assert most_frames == 50
    assert largest_that_fits(memory - 50 * BYTES[prior], 50, points, options)[0] < points


def test_large_jobs_need_less_memory_per_additional_observation() -> None:
    large = estimated(100, 1_000_000, Options()).memory_bytes
    assert large == LIBRARIES + BYTES["gaussian"] * BLOCK_OBSERVATIONS + BEYOND * (100_000_000 - BLOCK_OBSERVATIONS)
    assert estimated(100, 1_000_000, Options(prior="smooth+low_rank")).memory_bytes > large


def test_films_are_learned_from_every_nth_frame_and_photographs_from_all() -> None:
    film, photographs = (estimated(300, 1, Options(order=order)).seconds for order in ("film", "any"))
    assert film == estimated(150, 1, Options(order="film")).seconds
    assert photographs == pytest.approx(SECONDS + 300 * LEARNING[True, False], abs=0.1)


def test_the_smooth_prior_counts_the_gram_matrix_of_all_frames() -> None:
    long = estimated(3000, 300, Options(prior="smooth"))
    assert 1.1e9 / 1.5 < long.memory_bytes < 1.5 * 1.1e9  # 1.1 GB and 47 s were measured
    assert 47 / 1.5 < long.seconds < 1.5 * 47
    points, frames = largest_that_fits(10**9, 3000, 300, Options(prior="smooth"))
    assert 0 < points < 300
    assert 2000 < frames < 3000


@pytest.mark.parametrize(
    ("frames", "points", "measured"),
    [(20, 144, 7.9), (60, 144, 13.9), (150, 10_000, 23.8), (600, 144, 46.2), (3000, 144, 221)],
)
def test_sheets_are_estimated_within_a_factor_of_two(frames: int, points: int, measured: float) -> None:
    seconds = estimated(frames, points, Options(surface="isometric", image_size=(1280, 720))).seconds
    assert measured / 2 < seconds < 2 * measured
