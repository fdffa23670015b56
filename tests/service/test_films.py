"""Films over HTTP: rejected with a message or accepted, tracked by the worker, and cancelled."""

from __future__ import annotations

import base64
import io
import json
import threading
import zlib
from pathlib import Path

import films
import httpx
import numpy as np
import pytest
from crafting import png
from PIL import Image
from pliant.cli import app
from pliant.cli.exits import Exit
from pliant.cli.session import Session
from pliant.client import BadArgument, Client
from pliant.schemas.job import Job, Status
from pliant.service import submission
from pliant.service.multipart import own_name
from pliant.service.submission import FILES
from pliant.worker.execution import attempt
from pliant.worker.formats import InvalidInput
from serving import Running, tracks, until
from typer.testing import CliRunner

forked = pytest.mark.usefixtures("forked_readers")
PICTURES = films.textured_pictures(10, (96, 72))
QUICK = {
    "outputs": [],
    "prior": "smooth",
    "max_reweightings": 1,
    "grid_step": 8,
    "refine_rotations": False,
    "surface": "free",
    "camera": "orthographic",
}


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return films.write_film(tmp_path_factory.mktemp("film") / "film.mp4", PICTURES).read_bytes()


def mask(size: tuple[int, int] = (96, 72)) -> bytes:
    pixels = np.zeros(size[::-1], np.uint8)
    pixels[20:55, 20:70] = 255
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def parts(film: bytes | None, **more: object) -> dict[str, object]:
    given: dict[str, object] = {} if film is None else {"film": ("../film.mp4", film)}
    for name, value in more.items():
        text = name not in FILES
        given[name] = (None, value if isinstance(value, str) else json.dumps(value)) if text else (f"{name}.x", value)
    return given


def send(http: httpx.Client, film: bytes | None, **more: object) -> Job:
    answer = http.post("/v1/jobs", files=parts(film, **more))
    assert answer.status_code == 202, answer.text
    return Job.model_validate_json(answer.content)


def work(running: Running, id: str) -> Job:
    """Run the job as the worker's job process does."""
    attempt.run(id, running.jobs.records.get(id).attempt_id, settings=running.jobs.settings, worker="w")
    return running.jobs.get(id)


def test_a_film_becomes_a_job_with_tracks_and_shapes(running: Running, http: httpx.Client, film: bytes) -> None:
    job = send(http, film, region=mask(), options=QUICK)
    assert (job.options.image_size, job.options.fps) == ("96x72", 30.0)
    assert (job.interpretation.mesh_source, job.interpretation.num_frames) == ("film", 10)
    assert running.left_on_disk == []
    done = work(running, job.id)
    assert done.status is Status.SUCCEEDED, done.error
    names = [each.name for each in done.artifacts]
    assert names[:2] == ["tracks.npz", "contact_sheet.jpg"]
    assert done.interpretation.num_points > 16
    sheet = http.get(f"/v1/jobs/{job.id}/artifacts/contact_sheet.jpg")
    assert sheet.headers["content-type"] == "image/jpeg"
    with np.load(io.BytesIO(http.get(f"/v1/jobs/{job.id}/artifacts/tracks.npz").content)) as held:
        assert held["tracks"].shape == (10, done.interpretation.num_points, 2)


@pytest.mark.slow
@forked
def test_a_finished_job_has_the_rate_of_the_tracked_frames(
    running: Running, http: httpx.Client, tmp_path: Path
) -> None:
    film = films.with_uneven_times(films.write_film(tmp_path / "film.mp4", PICTURES), first=3).read_bytes()
    own, unset = send(http, film, options={**QUICK, "fps": 12}), send(http, film, options=QUICK)
    assert work(running, own.id).options.fps == 12
    job = work(running, unset.id)
    with np.load(io.BytesIO(http.get(f"/v1/jobs/{job.id}/artifacts/tracks.npz").content)) as tracks:
        assert job.options.fps == tracks["fps"] != unset.options.fps
    assert job.interpretation.fps == job.options.fps


@pytest.mark.slow
@forked
def test_a_film_without_a_region_succeeds_with_a_warning(running: Running, http: httpx.Client, film: bytes) -> None:
    done = work(running, send(http, film, options=QUICK).id)
    assert done.status is Status.SUCCEEDED, done.error
    assert any("No region was given" in sentence for sentence in done.warnings)


@forked
def test_a_film_sent_as_upload_or_form_part_is_the_same_request(http: httpx.Client, film: bytes) -> None:
    for id, content in (("the-film", film), ("the-mask", mask())):
        assert http.put(f"/v1/uploads/{id}", content=content).is_success
    key = {"Idempotency-Key": "once"}
    named = {"film_upload": (None, "the-film"), "region_upload": (None, "the-mask")}
    first = http.post("/v1/jobs", files=named, headers=key)
    assert first.status_code == 202, first.text
    again = http.post("/v1/jobs", files=parts(film, region=mask()), headers=key)
    assert again.json()["id"] == first.json()["id"]
    put = http.put("/v1/jobs/my-film", files=parts(film, options={"region_polygon": [[20, 20], [70, 20], [45, 55]]}))
    assert put.status_code == 202, put.text


@forked
def test_inspection_reads_a_film_without_tracking_it(running: Running, http: httpx.Client, film: bytes) -> None:
    before = running.waiting
    answer = http.post("/v1/inspect", files=parts(film, region=mask()))
    assert answer.status_code == 200, answer.text
    assert (answer.json()["num_frames"], answer.json()["num_points"], answer.json()["sample"]) == (10, 0, [])
    assert base64.b64decode(answer.json()["first_frame"]).startswith(b"\xff\xd8\xff")
    part, whole = (each.json()["estimate"] for each in (answer, http.post("/v1/inspect", files=parts(film))))
    assert 1e8 < part["memory_bytes"] < whole["memory_bytes"] < 1e9, "fewer points"
    assert 0 < part["tracking_seconds"] < 60
    assert 0 < part["seconds"] < whole["seconds"] < 60
    assert http.post("/v1/inspect", files={"tracks": tracks()}).json()["first_frame"] is None
    assert running.waiting == before


@forked
def test_an_inspection_notes_a_film_without_texture(http: httpx.Client, tmp_path: Path) -> None:
    blank = [np.full((72, 96, 3), 100 + 5 * i, np.uint8) for i in range(6)]
    film = films.write_film(tmp_path / "blank.mp4", blank).read_bytes()
    read = http.post("/v1/inspect", files=parts(film)).json()
    assert read["estimate"] is None
    assert read["notes"][-1].startswith("Frame 0 shows no texture that can be tracked.")


@forked
def test_a_film_whose_time_cannot_be_estimated_is_inspected(
    http: httpx.Client, film: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is accepted as a job, which decodes less of it before it is queued."""

    def fail(*_: object, **__: object) -> None:
        raise InvalidInput("too_slow", field="film", expected="", got="", hint="")

    monkeypatch.setattr(submission, "with_estimate", fail)
    answer = http.post("/v1/inspect", files=parts(film, region=mask()))
    assert answer.status_code == 200, answer.text
    assert (answer.json()["num_frames"], answer.json()["estimate"]) == (10, None)


KINDS = "an mp4, mov, webm, mkv or avi film, an animated GIF, a zip of pictures, or a folder of pictures"


@forked
def test_film_errors_use_the_users_file_name(http: httpx.Client, film: bytes) -> None:
    """The form's file name without its folder; for an upload, which has no file name, the job's name."""
    sentence = f"film: expected {KINDS}, got {{}}, which is none of these. Convert it: ffmpeg -i FILM film.mp4"
    answer = http.post("/v1/inspect", files={"film": ("../films/my take 3.mp4", b"%PDF-1.7")})
    assert answer.json()["detail"] == sentence.format("my take 3.mp4")
    assert http.put("/v1/uploads/no-film", content=b"%PDF-1.7").is_success
    named = {"film_upload": (None, "no-film"), "name": (None, "my take")}
    assert http.post("/v1/inspect", files=named).json()["detail"] == sentence.format("my take")
    wrong = {"film": ("take.mp4", film), "region": ("my mask.png", b"no picture")}
    assert "got my mask.png: " in http.post("/v1/inspect", files=wrong).json()["detail"]


def test_file_names_are_reduced_to_one_component_on_one_line() -> None:
    assert own_name("C:\\films\\my take 3.mp4") == "my take 3.mp4"
    assert own_name("../two\tlines\u2028.mp4") == "two lines .mp4"
    assert len(own_name("a" * 5000)) == 200


def huge(path: Path) -> bytes:
    """Pictures whose headers declare 5,000 × 5,000 pixels."""
    picture = png(5000, 5000, data=zlib.compress(bytes(1000)))
    return films.zip_of(path, dict.fromkeys(("1.png", "2.png", "3.png"), picture)).read_bytes()


BAD: dict[str, tuple[dict[str, object], str, str]] = {
    "playlist": ({"film": b"#EXTM3U\nfile:///etc/passwd\n"}, "playlist", "film"),
    "no film": ({"film": b"hello, I am a film"}, "unsupported_film", "film"),
    "empty": ({"film": b""}, "empty_film", "film"),
    "region alone": ({"region": mask()}, "missing_part", "film"),
    "film and tracks": ({"film": b"x", "tracks": tracks()}, "conflicting_parts", "tracks"),
    "film and mesh": ({"film": b"x", "mesh": "3x4"}, "conflicting_parts", "mesh"),
}


@forked
@pytest.mark.parametrize("case", BAD)
def test_invalid_films_and_part_combinations_are_rejected(running: Running, http: httpx.Client, case: str) -> None:
    given, code, field = BAD[case]
    files = {name: (None, value) if isinstance(value, str) else (name, value) for name, value in given.items()}
    refused(running, http, files, code, field)


def refused(running: Running, http: httpx.Client, files: dict[str, object], code: str, field: str) -> None:
    before = running.waiting
    answer = http.post("/v1/jobs", files=files)
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (422, code, field), problem
    assert problem["hint"]
    assert "/tmp" not in problem["detail"]
    assert running.left_on_disk == []
    assert running.waiting == before


@forked
def test_broken_films_invalid_regions_and_zip_bombs_are_rejected(
    running: Running, http: httpx.Client, film: bytes, tmp_path: Path
) -> None:
    refused(running, http, parts(film[: len(film) // 2]), "truncated_film", "film")
    refused(running, http, parts(film, region=mask((10, 10))), "wrong_region_size", "region")
    refused(running, http, parts(film, region=b"no picture"), "unreadable_region", "region")
    refused(running, http, parts(film, options={"region_polygon": [[900, 900], [910, 900], [910, 910]]}),
            "empty_region", "options.region_polygon")  # fmt: skip
    refused(
        running, http, parts(film, options={"region_polygon": [[1, 1]]}), "invalid_option", "options.region_polygon"
    )
    refused(running, http, parts(huge(tmp_path / "huge.zip")), "too_many_pixels", "film")
    bomb = films.zip_of(tmp_path / "bomb.zip", {"1.png": films.png(PICTURES[0]), "2.png": bytes(3 << 20)})
    refused(running, http, parts(bomb.read_bytes()), "too_few_frames", "film")


@forked
def test_a_film_that_cannot_be_tracked_fails_its_job_with_a_remedy(
    running: Running, http: httpx.Client, tmp_path: Path
) -> None:
    grey = films.write_film(tmp_path / "grey.mkv", [np.full((72, 96, 3), 126 + i, np.uint8) for i in range(5)])
    done = work(running, send(http, grey.read_bytes()).id)
    assert done.status is Status.FAILED
    assert done.error is not None
    assert (done.error.code, done.error.field) == ("no_texture", "region")
    assert "pattern" in done.error.detail


@pytest.mark.slow
@forked
def test_cancelling_stops_the_tracking(running: Running, http: httpx.Client, tmp_path: Path) -> None:
    long = films.write_film(tmp_path / "long.mkv", films.textured_pictures(150, (320, 240)))
    id = send(http, long.read_bytes(), options={"grid_step": 4}).id
    stage: list[str] = []

    def cancel() -> None:
        until(lambda: (progress := running.jobs.get(id).progress) is not None and progress.stage == "track")
        stage.append(running.jobs.get(id).progress.stage)  # type: ignore[union-attr]
        http.post(f"/v1/jobs/{id}/cancel")

    canceller = threading.Thread(target=cancel)
    canceller.start()
    done = work(running, id)
    canceller.join()
    assert stage == ["track"]
    assert done.status is Status.CANCELLED
    assert done.artifacts == []


@forked
def test_a_rerun_of_a_film_keeps_its_tracking_options(running: Running, http: httpx.Client, film: bytes) -> None:
    corners = [[20, 20], [70, 20], [70, 55]]
    given = {"region_polygon": corners, "frames": "0:8", "template_frame": 0, "max_points": 30}
    first = send(http, film, options={**QUICK, **given})
    assert work(running, first.id).status is Status.SUCCEEDED
    parts = {"inputs_of": (None, first.id), "options": (None, json.dumps({"loss": "l2", "frames": "0:6"}))}
    again = Job.model_validate_json(http.post("/v1/jobs", files=parts).content)
    assert again.options.region_polygon == first.options.region_polygon
    assert again.options.template_frame == 0
    assert (again.options.frames, again.options.max_points, again.options.grid_step) == ("0:6", 30, QUICK["grid_step"])
    assert (again.options.loss, again.options.prior) == ("l2", "gaussian")
    parts["options"] = (None, '{"region_polygon": null}')
    assert Job.model_validate_json(http.post("/v1/jobs", files=parts).content).options.region_polygon is None


@forked
def test_a_polygon_replaces_the_region_of_a_film_that_is_solved_again(
    running: Running, http: httpx.Client, film: bytes
) -> None:
    first = send(http, film, region=mask(), options=QUICK)
    assert work(running, first.id).status is Status.SUCCEEDED
    corners = [[20, 20], [70, 20], [70, 55], [20, 55]]
    changed = {"inputs_of": (None, first.id), "options": (None, json.dumps({**QUICK, "region_polygon": corners}))}
    again = Job.model_validate_json(http.post("/v1/jobs", files=changed).content)
    assert again.options.region_polygon is not None
    assert work(running, again.id).status is Status.SUCCEEDED


@forked
def test_more_frames_than_the_film_has_cannot_be_required_of_a_point(
    running: Running, http: httpx.Client, film: bytes
) -> None:
    refused(running, http, parts(film, options={"min_seen": 11}), "nothing_visible", "options.min_seen")
    straight = [[10, 10], [20, 20], [30, 30]]
    refused(running, http, parts(film, options={"region_polygon": straight}), "wrong_polygon", "options.region_polygon")


@forked
def test_client_and_command_line_send_films(running: Running, film: bytes, tmp_path: Path) -> None:
    path, region = tmp_path / "film.mp4", tmp_path / "mask.png"
    path.write_bytes(film)
    region.write_bytes(mask())
    with Client(running.url) as client:
        job = client.submit(film=path, region=region, options=QUICK)
        assert job.record.interpretation.mesh_source == "film"
        read = client.inspect(film=path, region=region)
        assert (read.format, read.image_size, read.num_frames) == ("film (mp4)", "96x72", 10)
        with Image.open(io.BytesIO(base64.b64decode(read.first_frame or ""))) as picture:
            assert picture.size == (96, 72)
        for wrong in ({}, {"tracks": np.zeros((4, 9, 2)), "film": path}):
            with pytest.raises(BadArgument, match="expected one of them"):
                client.submit(**wrong)  # type: ignore[arg-type]
        with pytest.raises(BadArgument, match="only valid with an array"):
            client.submit(film=path, visible=np.ones((10, 4)))
    command = ["submit", str(path), "--region", str(region), "--url", running.url, "--json"]
    ran = CliRunner().invoke(app, command, obj=Session())
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["interpretation"]["format"] == "film (mp4)"
    command[0] = "inspect"
    ran = CliRunner().invoke(app, command, obj=Session())
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout) | {"estimate": None} == job.record.interpretation.model_dump(mode="json")
    words = " ".join(CliRunner().invoke(app, command[:-1], obj=Session()).output.split())
    assert words.startswith(f"film {job.record.interpretation.notes[0]} estimate about 0.1 GB of memory, tracking ")
    region.write_bytes(mask((48, 36)))  # it is sent as well
    refused = CliRunner().invoke(app, command[:-1], obj=Session())
    assert (refused.exit_code, "region" in refused.output) == (Exit.REFUSED, True)
