"""`inputs_of`: the inputs of an earlier job, solved again with other options."""

from __future__ import annotations

import httpx
import numpy as np
import pytest
from pliant.schemas.job import Job
from pliant.worker.formats import isolated_reader
from pliant.worker.formats.cost import estimated
from serving import Running, finish, form, npz, submit

FRAMES, ROWS, COLUMNS = 6, 4, 5


@pytest.fixture
def film_tracks() -> bytes:
    """A file as `pliant track` writes it, with the image size and the frame rate."""
    grid = np.arange(ROWS * COLUMNS, dtype=np.int32).reshape(ROWS, COLUMNS)
    start = 20.0 * np.stack(np.unravel_index(np.arange(ROWS * COLUMNS), grid.shape), axis=1)[:, ::-1] + 30
    tracks = start + np.random.default_rng(0).normal(size=(FRAMES, ROWS * COLUMNS, 2))
    seen = np.ones(tracks.shape[:2], bool)
    return npz(
        tracks=tracks.astype(np.float32), visibility=seen, confidence=seen.astype(np.float32), grid=grid,
        image_size=np.array([320, 240]), fps=np.array(12.0), template=np.array(0), frame_indices=np.arange(FRAMES),
    )  # fmt: skip


def again(http: httpx.Client, job: Job, **headers: str) -> httpx.Response:
    parts = {"inputs_of": (None, job.id), "options": (None, '{"loss": "huber", "prior": "smooth"}')}
    return http.post("/v1/jobs", files=parts, headers=headers)


def test_a_rerun_keeps_image_size_and_fps_of_the_file(running: Running, http: httpx.Client, film_tracks: bytes) -> None:
    first = submit(http, body=film_tracks)
    finish(running, first.id, b"x")
    second = Job.model_validate_json(again(http, first).content)
    for job in (first, second):
        assert (job.options.image_size, job.options.fps) == ("320x240", 12)
    assert second.options.loss == "huber"


def test_a_rerun_is_estimated_with_its_new_options(running: Running, http: httpx.Client) -> None:
    first = submit(http)
    finish(running, first.id, b"x")
    second = Job.model_validate_json(again(http, first).content)
    assert second.interpretation.estimate == estimated(6, 12, second.options) != first.interpretation.estimate


def test_a_repeated_rerun_finds_its_job_after_the_original_is_deleted(running: Running, http: httpx.Client) -> None:
    first = submit(http)
    finish(running, first.id, b"x")
    second = again(http, first, **{"Idempotency-Key": "once"})
    assert http.delete(f"/v1/jobs/{first.id}").status_code == 204
    repeated = again(http, first, **{"Idempotency-Key": "once"})
    assert (repeated.status_code, repeated.json()["id"]) == (202, second.json()["id"])
    assert again(http, first).json()["code"] == "unknown_job"


@pytest.mark.parametrize("coordinates", ["unit", "signed", "pixels"])
def test_a_rerun_keeps_the_image_size_that_converted_fractions(
    running: Running, http: httpx.Client, coordinates: str
) -> None:
    body = npz(tracks=np.random.default_rng(0).uniform(0.1, 0.9, (6, 12, 2)))
    first = submit(http, body=body, options={"coordinates": coordinates, "image_size": "640x480"})
    finish(running, first.id, b"x")
    second = Job.model_validate_json(again(http, first).content)
    fractions = coordinates != "pixels"
    assert second.options.image_size == ("640x480" if fractions else None)
    other = http.post(
        "/v1/jobs", files={"inputs_of": (None, first.id), "options": (None, '{"image_size": "6400x4800"}')}
    )
    assert other.status_code == (422 if fractions else 202)
    if fractions:
        assert (other.json()["code"], other.json()["field"]) == ("conflicting_parts", "options.image_size")


def test_a_rerun_with_contradictory_options_is_rejected(running: Running, http: httpx.Client) -> None:
    first = submit(http)
    finish(running, first.id, b"x")
    parts = {"inputs_of": (None, first.id), "options": (None, '{"focal": 900, "field_of_view": 60}')}
    answer = http.post("/v1/jobs", files=parts)
    assert (answer.status_code, answer.json()["field"]) == (422, "options.field_of_view")


@pytest.mark.parametrize(
    ("options", "code", "field"),
    [
        ('{"image_size": "3x2"}', "outside_picture", "image_size"),
        ('{"principal_point": "1000000,0"}', "principal_point_far", "principal_point"),
        ('{"laplacian": "grid8"}', "invalid_option", "laplacian"),
    ],
)
@pytest.mark.parametrize("large", [False, True])
def test_a_rerun_with_options_that_contradict_the_inputs_is_refused(
    running: Running,
    http: httpx.Client,
    monkeypatch: pytest.MonkeyPatch,
    options: str,
    code: str,
    field: str,
    large: bool,
) -> None:
    first = submit(http)
    finish(running, first.id, b"x")
    if large:  # in a process of its own
        monkeypatch.setattr(isolated_reader, "LARGE", 0)
    answer = http.post("/v1/jobs", files={"inputs_of": (None, first.id), "options": (None, options)})
    assert (answer.status_code, answer.json()["code"], answer.json()["field"]) == (422, code, f"options.{field}")
    good = http.post("/v1/jobs", files={"inputs_of": (None, first.id), "options": (None, '{"loss": "huber"}')})
    assert good.status_code == 202


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/inspect"])
@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"field_of_view": 60}, "field_of_view"),
        ({"focal": 900, "field_of_view": 60, "image_size": "640x480"}, "field_of_view"),
        ({"focal": 900, "camera": "orthographic"}, "focal"),
        ({"order": "any", "prior": "smooth"}, "order"),
    ],
)
def test_contradictory_options_are_rejected_before_queueing(
    running: Running, http: httpx.Client, path: str, options: dict[str, object], field: str
) -> None:
    before = running.waiting
    answer = http.post(path, files=form(options=options))
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_option")
    assert answer.json()["field"] == f"options.{field}"
    assert running.waiting == before
