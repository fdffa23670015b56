"""The estimate of memory and time before a solve."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options, Output
from pliant.solver.limits import BLOCK_OBSERVATIONS
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import load_inputs
from pliant.worker.formats.cost import (
    BEYOND,
    BYTES,
    FILE_BYTES,
    FILM_POINTS,
    LEARNING,
    LIBRARIES,
    SECONDS,
    USUAL_FILE_BYTES,
    estimated,
    expected_files,
    largest_that_fits,
)
from worker_house import SHORT, make_inputs


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


def test_the_expected_size_of_files_is_about_theirs(tmp_path: Path) -> None:
    make_inputs(tmp_path / "inputs.npz", frames=16, points=900)
    inputs = load_inputs(tmp_path / "inputs.npz")
    options = SHORT.model_copy(update={"outputs": tuple(name for name in FILE_BYTES if name not in ("usd", "abc"))})
    observations = inputs.tracks.num_frames * inputs.tracks.num_points
    found = reconstruct(inputs, options, tmp_path / "files")
    expected = expected_files(inputs.interpretation, options)
    assert expected == observations * (sum(FILE_BYTES[name] for name in options.outputs) + USUAL_FILE_BYTES)
    assert expected / 1.3 < sum(each.bytes for each in found.artifacts) < 1.1 * expected


def test_every_output_has_a_size_and_a_film_has_that_of_the_usual_points(interpretation: Interpretation) -> None:
    assert set(FILE_BYTES) == set(get_args(Output))
    film = interpretation.model_copy(update={"mesh_source": "film", "num_frames": 100, "num_points": 0})
    options = Options(outputs=("mdd",))
    each = 100 * (FILE_BYTES["mdd"] + USUAL_FILE_BYTES)
    assert expected_files(film, options) == FILM_POINTS * each
    assert expected_files(film, options.model_copy(update={"max_points": 50})) == 50 * each
    tracked = film.model_copy(update={"num_points": 7})
    assert expected_files(tracked, options, further=True) == 7 * 100 * FILE_BYTES["mdd"]
