"""The frame rate of a film job: that of the tracked frames, unless the job sets one."""

from __future__ import annotations

import json
from pathlib import Path

import films
import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.worker.execution.film import reconstruct_film
from pliant.worker.films.sources import FilmSource, open_source, save_source
from pliant.worker.films.tracker import described, film_options, read_film
from pliant.worker.jobs.finished import Finished

QUICK = {"outputs": (), "prior": "smooth", "max_reweightings": 1, "grid_step": 8, "refine_rotations": False,
         "surface": "free", "camera": "orthographic"}  # fmt: skip
RECORDED = 30.0


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film whose frames last three times as long from the third on, which a selection of frames leaves out of its stated rate."""
    path = films.write_film(
        tmp_path_factory.mktemp("film") / "film.mp4", films.textured_pictures(12, (96, 72)), fps=RECORDED
    )
    return films.with_uneven_times(path, first=3)


def solved(film: Path, folder: Path, *, fps: float | None) -> tuple[Finished, dict[str, float], float]:
    """Reconstruct a film as a job does; return the result, the options in its report, and the rate in its tracks."""
    given = Options(**QUICK) if fps is None else Options(**QUICK, fps=fps)
    source = FilmSource(film, own_rate="fps" in given.model_fields_set)
    options = film_options(given, read_film(source, given).facts)
    (folder / "scratch").mkdir()
    done = reconstruct_film(source, options, folder / "out", scratch=folder / "scratch")
    report = json.loads((folder / "out" / "report.json").read_text())
    with np.load(folder / "out" / "tracks.npz") as tracks:
        return done, report["options"], float(tracks["fps"])


@pytest.mark.slow
def test_the_rate_is_that_of_the_tracked_frames(uneven: Path, tmp_path: Path) -> None:
    done, reported, rate = solved(uneven, tmp_path, fps=None)
    stated = read_film(FilmSource(uneven), Options()).facts.fps
    assert abs(rate - stated) > 0.5, "the file states another rate than its frames have"
    assert done.options is not None
    assert done.interpretation is not None
    assert (reported["fps"], done.options.fps, done.interpretation.fps) == (rate, rate, rate)
    assert done.interpretation.image_size == "96x72"


@pytest.mark.slow
def test_a_rate_that_the_job_sets_is_kept_even_if_the_file_states_the_same(uneven: Path, tmp_path: Path) -> None:
    stated = read_film(FilmSource(uneven), Options()).facts.fps
    done, reported, rate = solved(uneven, tmp_path, fps=stated)
    assert done.options is not None
    assert reported["fps"] == done.options.fps == stated != rate


@pytest.mark.parametrize("own", [True, False])
def test_a_stored_film_keeps_whether_the_job_sets_the_rate(uneven: Path, tmp_path: Path, own: bool) -> None:
    source = FilmSource(uneven, own_rate=own)
    save_source(source, described(read_film(source, Options()).facts, Options()), tmp_path / "inputs.npz")
    assert open_source(tmp_path / "inputs.npz", tmp_path / "back").own_rate is own
