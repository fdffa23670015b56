"""Films in the page: detection, first frame, submission, live tracks, and the result."""

from __future__ import annotations

import base64
import re

import cv2
import httpx
import numpy as np
import pytest
from browsing import NEEDS_CHROMIUM, heard
from filming import (
    BLUE,
    HEIGHT,
    RED,
    WIDTH,
    answer_with,
    colour_at_corner,
    drag,
    film_record,
    picture,
    sent_options,
)
from paging import drop, packed, until
from playwright.sync_api import Page, Route, expect

pytestmark = NEEDS_CHROMIUM


@pytest.mark.parametrize("name", ["film.webm", pytest.param("pictures.zip", marks=pytest.mark.long)])
def test_a_dropped_film_shows_its_first_frame_and_hides_other_inputs(
    filming: Page, films: dict[str, bytes], name: str
) -> None:
    drop(filming, {name: films[name]})
    expect(filming.locator("[data-part=film]")).to_contain_text(name)
    filming.get_by_role("img", name="First frame of the film").wait_for()
    red, green, blue = colour_at_corner(filming)
    assert red > 150
    assert max(green, blue) < 90
    expect(filming.get_by_text("turn the object by 30° or more, and keep it sharp and large")).to_be_visible()
    advice = "No region: everything in the picture is tracked, the background included. Draw around the object."
    expect(filming.get_by_text(advice)).to_be_visible()
    expect(filming.get_by_role("region", name="How your files are interpreted")).to_contain_text("6 frames")
    for part in ("tracks", "mesh", "ground_truth", "rotations"):
        expect(filming.locator(f"[data-part={part}]")).to_be_hidden()
    filming.get_by_role("button", name="Remove film").click()
    expect(filming.locator("[data-part=tracks]")).to_be_visible()
    expect(filming.get_by_role("img", name="First frame of the film")).to_be_hidden()


def test_the_code_of_a_job_quotes_the_names_of_its_files(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    answer_with(filming, film_record(url, finished))
    drop(filming, {"my film; 2.webm": films["film.webm"]})
    filming.get_by_role("button", name="Reconstruct").click()
    code = filming.get_by_role("region", name="Use from code")
    expect(code).to_contain_text('film="my film; 2.webm"')
    for language, words in (
        ("Shell", "pliant submit 'my film; 2.webm'"),
        ("curl", "-F 'film=@\"my film; 2.webm\"'"),  # a semicolon ends the name for curl
    ):
        filming.get_by_role("button", name=language, exact=True).click()
        expect(code).to_contain_text(words)


@pytest.mark.parametrize("name", [pytest.param("make.py", marks=pytest.mark.long), "mesh.obj"])
def test_a_file_that_does_not_belong_to_a_film_is_left_out(filming: Page, films: dict[str, bytes], name: str) -> None:
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    filming.keyboard.press("ArrowRight")
    filming.get_by_role("button", name="Use this region").click()
    drop(filming, {name: b"print()"})
    expect(filming.get_by_text(f"Left out: {name}. Only a mask picture can be added to a film.")).to_be_visible()
    film = {"name": name, "mimeType": "", "buffer": b"print()"}
    filming.get_by_label("Film", exact=True).set_input_files(film)  # type: ignore[arg-type]
    expect(filming.locator("[data-part=film]")).to_contain_text("film.webm")
    expect(filming.locator(".filming").get_by_role("status")).to_have_text("Rectangle, 160 × 120 pixels at 80, 60.")
    drop(filming, {"tracks.npz": packed(tracks=np.zeros((3, 4, 2)))})  # tracks replace the film
    expect(filming.get_by_text("Left out")).to_be_hidden()
    expect(filming.locator("[data-part=tracks]")).to_contain_text("tracks.npz")
    drop(filming, {"film.webm": films["film.webm"], "other.npz": packed(tracks=np.zeros((3, 4, 2)))})
    expect(filming.get_by_text("Left out: film.webm. A job has one film or one track file")).to_be_visible()
    expect(filming.locator("[data-part=tracks]")).to_contain_text("other.npz")
    drop(filming, {"make.py": b"print()"})
    expect(filming.get_by_text("Left out: make.py. This page does not know files of this kind.")).to_be_visible()
    expect(filming.locator("[data-part=tracks]")).to_contain_text("other.npz")


def test_a_film_job_is_run_again_with_its_region(filming: Page, url: str, finished: str) -> None:
    corners = [[10, 10], [90, 10], [90, 90]]
    record = film_record(url, finished, status="succeeded", artifacts=[], sentence="Converged.")
    record["options"] |= {"region_polygon": corners, "region_frame": 4}
    answer_with(filming, record)
    filming.goto(f"{url}/#job={finished}")
    filming.get_by_role("button", name="Run again with other options").click()
    filming.get_by_role("button", name="Reconstruct").click()
    until(lambda: filming.evaluate("window.sent !== undefined"))
    assert sent_options(filming)["region_polygon"] == corners
    assert sent_options(filming)["region_frame"] == 4


def test_the_rate_and_size_that_a_film_states_are_not_options_of_the_next_job(
    filming: Page, url: str, finished: str
) -> None:
    """Another choice of frames, or another film, has a rate of its own."""
    stated = {"fps": 30.000000000000004, "image_size": "320x240"}
    record = film_record(url, finished, status="succeeded", artifacts=[], sentence="Converged.")
    record["options"] |= {**stated, "frames": "::2"}
    record["interpretation"] |= stated
    answer_with(filming, record)
    filming.goto(f"{url}/#job={finished}")
    expect(filming.get_by_role("region", name="Use from code")).to_contain_text('"frames": "::2"')
    expect(filming.get_by_role("region", name="Use from code")).not_to_contain_text("fps")
    filming.get_by_role("button", name="More files").click()
    expect(filming.get_by_label("Frames per second")).to_have_value("30")
    filming.get_by_role("button", name="Run again with other options").click()
    filming.get_by_role("button", name="Reconstruct").click()
    until(lambda: filming.evaluate("window.sent !== undefined"))
    assert sent_options(filming)["frames"] == "::2"
    assert not stated.keys() & sent_options(filming).keys()


def test_the_form_shows_the_rate_and_size_of_the_film_instead_of_the_defaults(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    """Until the service has read the film, they are unknown; the default rate of tracks can still be chosen for a film."""
    asked: list[Route] = []
    filming.route("**/v1/inspect", lambda route: asked.append(route))
    filming.locator(".folds summary", has_text="Files to write").click()
    filming.locator(".folds summary", has_text="Lens").click()
    rate, size = filming.get_by_label("Frame rate"), filming.get_by_label("Picture size")
    expect(rate).to_have_value("25")
    drop(filming, {"film.webm": films["film.webm"]})
    expect(rate).to_have_attribute("placeholder", "the film's")
    expect(rate).to_have_value("")
    heard(filming, lambda: asked != [])
    stated = {"fps": 30000 / 1001, "image_size": "320x240"}
    seen = {**film_record(url, finished)["interpretation"], **stated, "sample": []}
    asked[0].fulfill(json=seen)
    expect(rate).to_have_attribute("placeholder", "29.97, the film's")
    expect(size).to_have_attribute("placeholder", "320x240, the film's")
    filming.get_by_role("button", name="Remove film").click()
    expect(rate).to_have_value("25")
    expect(size).to_have_attribute("placeholder", "automatic")

    filming.route("**/v1/inspect", lambda route: route.fulfill(json=seen))
    record = film_record(url, finished)
    record["options"] |= {**stated, "fps": 25.0}
    record["interpretation"] |= stated
    answer_with(filming, record)
    drop(filming, {"film.webm": films["film.webm"]})
    expect(rate).to_have_attribute("placeholder", "29.97, the film's")
    expect(filming.get_by_text("(1 changed)")).to_be_hidden()
    rate.fill("25")
    rate.press("Tab")
    expect(filming.get_by_text("(1 changed)")).to_be_visible()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_role("region", name="Use from code")).to_contain_text('"fps": 25}')
    assert sent_options(filming) == {"fps": 25}
    filming.get_by_text("New reconstruction").click()
    drop(filming, {"tracks.npz": packed(tracks=np.zeros((3, 4, 2)))})
    expect(rate).to_have_value("25")
    expect(filming.get_by_text("(1 changed)")).to_be_hidden()


def test_a_film_that_the_browser_cannot_show_is_sent_without_a_region(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    answer_with(filming, film_record(url, finished))
    drop(filming, {"old.mp4": films["old.mp4"]})
    expect(filming.get_by_text("This browser cannot decode the film")).to_be_visible()
    expect(filming.get_by_role("button", name="Draw a region")).to_be_hidden()
    expect(filming.get_by_text("How your files are interpreted")).to_be_visible()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert dict(filming.evaluate("window.sent"))["film"] == "old.mp4"
    assert "region_polygon" not in sent_options(filming)


@pytest.mark.parametrize("name", ["old.mp4", pytest.param("film.webm", marks=pytest.mark.long)])
def test_the_services_first_frame_is_used_if_the_browser_cannot_decode(
    filming: Page, url: str, films: dict[str, bytes], finished: str, name: str
) -> None:
    """The browser's own frame takes precedence, whichever arrives first; corners are in the film's pixels.

    The points of the running job move over it.
    """
    small = bytes(cv2.imencode(".jpg", np.full((HEIGHT // 2, WIDTH // 2, 3), BLUE, np.uint8))[1])
    seen = {
        **film_record(url, finished)["interpretation"],
        "sample": [],
        "image_size": f"{WIDTH}x{HEIGHT}",
        "first_frame": base64.b64encode(small).decode(),
    }
    filming.route("**/v1/inspect", lambda route: route.fulfill(json=seen))
    drop(filming, {name: films[name]})
    shown = filming.get_by_role("img", name="First frame of the film")
    expect(filming.get_by_text("How your files are interpreted")).to_be_visible()
    shown.wait_for()
    pixel = shown.evaluate("(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data]")
    assert (pixel[2] > 150) == (name == "old.mp4")
    record = film_record(url, finished)
    followed = {"frame": 3, "seconds": 0.6, "width": WIDTH, "height": HEIGHT, "points": [160, 120, 170, 130]}
    answer_with(filming, {**record, "progress": {**record["progress"], "followed": followed}})
    filming.get_by_role("button", name="Draw a region").click()
    filming.get_by_role("button", name="Rectangle").click()
    drag(filming, (0.25, 0.25), (0.75, 0.5))
    filming.get_by_role("button", name="Use this region").click()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    (left, top), _, (right, bottom), _ = sent_options(filming)["region_polygon"]
    assert np.allclose([left, top, right, bottom], [80, 60, 240, 120], atol=2)
    if name == "old.mp4":
        expect(
            filming.get_by_text("The picture stays at the first frame: this browser cannot decode the film.")
        ).to_be_visible()
        live = filming.get_by_role("img", name="The film with its tracked points")
        corner = live.evaluate("(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data]")
        assert corner[2] > 150 > corner[0], corner


def test_a_service_without_films_offers_no_film_input(page: Page, url: str) -> None:
    def without(route: Route) -> None:
        schema = httpx.get(route.request.url).json()
        schema["properties"].pop("region_polygon", None)
        route.fulfill(json=schema)

    page.route("**/v1/options", without)
    page.goto(url)
    page.get_by_text("Files to write", exact=True).wait_for()
    expect(page.get_by_text("Drop tracks and a mesh here")).to_be_visible()
    expect(page.locator("[data-part=film]")).to_be_hidden()


def test_the_camera_records_a_film(filming: Page) -> None:
    filming.get_by_role("button", name="Record with the camera").click()
    dialog = filming.get_by_role("dialog", name="Record a film")
    expect(dialog).to_contain_text("Recording stops after 20 seconds.")
    dialog.get_by_role("button", name="Record").click()
    expect(dialog).to_contain_text("19 s left")
    dialog.get_by_role("button", name="Stop").click()
    expect(dialog).to_have_count(0)
    expect(filming.locator("[data-part=film]")).to_contain_text("recording.")
    filming.get_by_role("img", name="First frame of the film").wait_for()
    expect(filming.get_by_role("button", name="Draw a region")).to_be_visible()


def test_a_running_film_job_shows_frame_points_progress_and_time_left(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    record = film_record(url, finished)
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("img", name="First frame of the film").wait_for()
    answer_with(filming, record)
    filming.get_by_role("button", name="Reconstruct").click()
    live = filming.get_by_role("img", name="The film with its tracked points")

    def reddest() -> list[int]:
        """A pixel of the picture's corner: the first frame is red, the others are blue."""
        corner = "(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data]"
        return list(live.evaluate(corner))

    until(lambda: reddest()[0] > 150 > reddest()[2])  # before any point is known
    assert filming.title() == "20\u00a0% – a film – Pliant"
    left = filming.locator(".figures div", has_text="Time left").locator("dd")
    first = left.inner_text()
    until(lambda: left.inner_text() != first)  # no message arrived: the page counts by itself
    filming.route(f"**/v1/jobs/{finished}", lambda route: route.abort())
    expect(left).to_have_text("–")  # the estimate may be outdated
    expect(filming.get_by_text("Tracking the film.", exact=True)).to_be_visible()
    followed = {"frame": 3, "seconds": 0.6, "width": WIDTH, "height": HEIGHT, "points": [160, 120, 170, 130]}
    moved = {**record["progress"], "followed": followed, "fraction": 0.3, "updated_at": "2099-01-01T00:00:00Z"}
    answer_with(filming, {**record, "progress": moved})
    expect(filming.get_by_text("Frame 3: 2 of the tracked points.")).to_be_visible()
    until(lambda: reddest()[2] > 150 > reddest()[0])
    middle = "(it) => [...it.getContext('2d').getImageData(Math.round(it.width * 160.5 / 320), Math.round(it.height / 2), 1, 1).data]"
    until(lambda: live.evaluate(middle)[0] > live.evaluate(middle)[2] + 60)  # a mark on the white disc
    assert filming.title() == "30\u00a0% – a film – Pliant"


def test_a_countdown_that_ends_before_the_job_shows_no_time(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    record = film_record(url, finished)
    answer_with(filming, {**record, "progress": {**record["progress"], "seconds_left": 3.0}})
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Reconstruct").click()
    left = filming.locator(".figures div", has_text="Time left").locator("dd")
    expect(left).to_have_text(re.compile(r"\d s"))
    expect(left).to_have_text("–")


NOTE = """() => {
  window.notes = [];
  window.Notification = class extends EventTarget {
    static permission = "default";
    static requestPermission() { this.permission = "granted"; return Promise.resolve("granted"); }
    constructor(title, options) { super(); window.notes.push(`${title} | ${options.body}`); }
  };
}"""


def test_users_who_opted_in_are_notified_when_the_job_ends(filming: Page, url: str, finished: str) -> None:
    filming.evaluate(NOTE)
    record = film_record(url, finished)
    answer_with(filming, record)
    filming.goto(f"{url}/#job={finished}")
    filming.get_by_role("button", name="Notify me at the end").click()
    expect(filming.get_by_role("button", name="You will be notified")).to_be_disabled()
    assert filming.evaluate("window.notes") == []
    done = httpx.get(f"{url}/v1/jobs/{finished}").json()
    judged = {"verdict": "do_not_use", "trust_sentence": "About 40 %."}
    answer_with(filming, {**done, "name": "a film", **judged})
    until(lambda: filming.evaluate("window.notes") == ["a film: do not use | About 40 %."])
    assert filming.title().endswith(" – a film – Pliant")


def test_the_result_of_a_film_shows_its_contact_sheet(filming: Page, url: str, finished: str) -> None:
    sheet = picture(RED, ".jpg")
    made = [
        {"name": name, "media_type": kind, "bytes": len(sheet), "sha256": "0" * 64, "description": words}
        for name, kind, words in (
            ("contact_sheet.jpg", "image/jpeg", "The tracks drawn over some frames of the film."),
            ("tracks.npz", "application/zip", "The tracks."),
        )
    ]
    record = film_record(url, finished, status="succeeded", artifacts=made, sentence="Converged.")
    record["interpretation"]["has_region"] = True
    answer_with(filming, record)
    filming.route("**/contact_sheet.jpg", lambda route: route.fulfill(body=sheet, content_type="image/jpeg"))
    filming.evaluate("sessionStorage.setItem('pliant-token', '')")
    for token in ("", "a-token"):  # with a token, the picture cannot be loaded by its address
        filming.evaluate("(token) => sessionStorage.setItem('pliant-token', token)", token)
        filming.goto("about:blank")
        filming.goto(f"{url}/#job={finished}")
        shown = filming.get_by_role("region", name="Tracked film").get_by_role("img")
        until(lambda shown=shown: shown.evaluate("(it) => it.naturalWidth") == WIDTH)  # type: ignore[misc]
        address = str(shown.get_attribute("src"))
        assert address.startswith("data:" if token else "v1/jobs/")
    files = filming.get_by_role("region", name="Files").get_by_role("link")
    assert files.all_inner_texts() == ["contact_sheet.jpg", "tracks.npz"]
    expect(filming.get_by_role("region", name="Use from code")).to_contain_text('film="film.mp4"')  # sent elsewhere
    expect(filming.get_by_role("region", name="Use from code")).to_contain_text('region="mask.png"')


def test_tracks_of_a_film_are_not_taken_for_a_film(filming: Page, url: str, finished: str) -> None:
    record = film_record(url, finished)
    record["interpretation"] |= {"format": "Pliant", "num_points": 30}
    record["progress"]["stage"] = "cameras"
    answer_with(filming, record)
    filming.goto("about:blank")
    filming.goto(f"{url}/#job={finished}")
    expect(filming.get_by_role("region", name="Use from code")).to_contain_text('submit(\n    "tracks.npz"')
    expect(filming.get_by_role("button", name="Cancel")).to_be_visible()
    expect(filming.get_by_text("The points appear as soon as they are tracked.")).to_be_hidden()


def test_the_expected_time_is_shown_until_the_remaining_time_is_known(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    """The record of a film's job has no estimate: the page keeps that of the check of its files."""
    estimate = {"memory_bytes": 2 * 10**8, "seconds": 20.0, "tracking_seconds": 100.0}
    stated = {"image_size": "320x240", "has_rotations": False}
    record = film_record(url, finished, status="queued", progress=None, place_in_queue=1)
    record["interpretation"] |= stated
    seen = {**record["interpretation"], "sample": [], "estimate": estimate}
    filming.route("**/v1/inspect", lambda route: route.fulfill(json=seen))
    answer_with(filming, record)
    drop(filming, {"film.webm": films["film.webm"]})
    found = filming.get_by_role("region", name="How your files are interpreted")
    sheet = "The test for a sheet such as paper can add half a minute; Surface: free omits it."
    expect(found).to_contain_text(f"Timeabout 2 minutes once it runs. {sheet}")
    filming.locator(".folds summary", has_text="Surface and smoothness").click()
    filming.get_by_label("Surface", exact=True).select_option(label="free")
    expect(found).to_contain_text("about 2 minutes once it runs")
    expect(found).not_to_contain_text("sheet")

    filming.get_by_role("button", name="Reconstruct").click()
    figures = filming.locator(".figures")
    expect(figures).to_have_text("Frames6Expected time2:00 min")
    progress = film_record(url, finished)["progress"]
    record |= {"status": "running", "progress": {**progress, "seconds_left": None}}
    filming.reload()
    expect(filming.get_by_text("Tracking the film.")).to_be_visible()
    expect(figures).to_have_text("Frames6Expected time2:00 min")
    record["progress"] = {**progress, "updated_at": "2100-01-01T00:00:00Z"}
    expect(figures).to_have_text(re.compile(r"Frames6Time left\d\d s"))


def test_the_expected_time_of_tracks_is_that_of_their_record(filming: Page, url: str, finished: str) -> None:
    """But not where a job only writes further files of a result."""
    estimate = {"memory_bytes": 2 * 10**8, "seconds": 20.0, "tracking_seconds": None}
    record = film_record(url, finished, status="queued", progress=None, place_in_queue=1)
    record["interpretation"] |= {"num_points": 300, "format": "unnamed", "estimate": estimate}
    answer_with(filming, record)
    filming.goto(f"{url}/#job={finished}")
    figures = filming.locator(".figures")
    expect(figures).to_have_text("Frames6Points300Expected time20 s")
    record["outputs_of"] = "f" * 32
    filming.reload()
    expect(figures).to_have_text("Frames6Points300")


def test_the_picture_of_a_film_is_no_higher_than_the_screen(filming: Page, films: dict[str, bytes]) -> None:
    """On a phone held sideways, the form is as wide as the screen."""
    filming.set_viewport_size({"width": 844, "height": 390})
    drop(filming, {"film.webm": films["film.webm"]})
    box = filming.get_by_role("img", name="First frame of the film").bounding_box()
    assert box is not None
    assert 200 < box["height"] < 0.6 * 390
    assert box["width"] / box["height"] == pytest.approx(WIDTH / HEIGHT, rel=0.02)
