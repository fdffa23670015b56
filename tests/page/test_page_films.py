"""Films in the page: detection, first frame, drawing a region, submission, and tracks beside the result."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from browsing import why_not
from paging import BOTH_WIDTHS_AND_THEMES, drop, packed, until
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

pytestmark = [
    pytest.mark.chromium,
    pytest.mark.skipif(why_not() is not None and not os.environ.get("CI"), reason=str(why_not())),
]
cv2 = pytest.importorskip("cv2")

AXE = Path(__file__).parents[2] / "service" / "web" / "node_modules" / "axe-core" / "axe.min.js"
WIDTH, HEIGHT = 320, 240
RED, BLUE = (40, 40, 210), (210, 40, 40)  # BGR

KEEP_SENT = """() => {
  const send = XMLHttpRequest.prototype.send;
  XMLHttpRequest.prototype.send = function (form) {
    window.sent = [...form].map(([name, value]) => [name, value instanceof File ? value.name : value]);
    return send.call(this, form);
  };
}"""


def picture(colour: tuple[int, int, int], name: str = ".png") -> bytes:
    frame = np.full((HEIGHT, WIDTH, 3), colour, np.uint8)
    cv2.circle(frame, (WIDTH // 2, HEIGHT // 2), 70, (235, 235, 235), -1)
    return bytes(cv2.imencode(name, frame)[1])


@pytest.fixture(scope="session")
def films(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Films of six frames, the first of them red, the others blue; an mp4 in a codec that browsers do not decode."""
    folder, found = tmp_path_factory.mktemp("films"), {}
    frames = [cv2.imdecode(np.frombuffer(picture(RED if i == 0 else BLUE), np.uint8), 1) for i in range(6)]
    for name, codec in (("film.webm", "VP80"), ("old.mp4", "mp4v")):
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter_fourcc(*codec), 5, (WIDTH, HEIGHT))
        assert writer.isOpened()
        for frame in frames:
            writer.write(frame)
        writer.release()
        found[name] = (folder / name).read_bytes()
    listed = io.BytesIO()
    with zipfile.ZipFile(listed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("film/10.png", picture(BLUE))
        archive.writestr("film/9.png", picture(RED))
        archive.writestr("__MACOSX/film/._1.png", b"not a picture")
    return {**found, "pictures.zip": listed.getvalue(), **moving()}


def moving() -> dict[str, bytes]:
    """The same six frames as a zip of pictures and as an animation."""
    pictures = [picture(RED if i == 0 else BLUE) for i in range(6)]
    listed, animation = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(listed, "w") as archive:
        for index, each in enumerate(pictures):
            archive.writestr(f"{index}.png", each)
    first, *others = (Image.open(io.BytesIO(each)) for each in pictures)
    # Equal frames would be joined to one.
    others = [Image.fromarray(np.asarray(each) // 8 * 8 + np.uint8(index)) for index, each in enumerate(others)]
    first.save(animation, "GIF", save_all=True, append_images=others, duration=60)
    return {"moving.zip": listed.getvalue(), "moving.gif": animation.getvalue()}


@pytest.fixture
def filming(page: Page, url: str, finished: str) -> Page:
    """The front page of a service that tracks films; its answers are prepared, and no job is created."""
    page.route("**/v1/options", with_film_options)
    page.route("**/v1/inspect", lambda route: route.fulfill(json=film_record(url, finished)["interpretation"]))
    page.goto(url)
    page.evaluate(KEEP_SENT)
    page.get_by_text("Drop a film here").wait_for()
    return page


def with_film_options(route: Route) -> None:
    schema = httpx.get(route.request.url).json()  # not `route.fetch`, which fails once the page has navigated away
    schema["properties"].setdefault("region_polygon", {"type": "array", "default": None, "description": "Drawn."})
    route.fulfill(json=schema)


def film_record(url: str, finished: str, **fields: Any) -> dict[str, Any]:
    """Return the record of a running film job, derived from that of a finished job."""
    record = httpx.get(f"{url}/v1/jobs/{finished}").json()
    read = {"num_frames": 6, "num_points": 0, "num_faces": 0, "mesh_source": "film", "format": "film (webm)"}
    notes = ["A film of 320×240 pixels, 6 frames, 5 frames per second. Its points are tracked when the job runs."]
    record["interpretation"] |= {**read, "notes": notes, "has_ground_truth": False}
    progress = {"stage": "track", "fraction": 0.2, "updated_at": record["finished_at"], "seconds_left": 30.0}
    progress |= {"reweighting": 0, "max_reweightings": 0, "objective": None, "residual": None}
    running = {"status": "running", "progress": progress, "metrics": None, "artifacts": [], "finished_at": None}
    return {**record, **running, "name": "a film", "sentence": None, **fields}


def answer_with(page: Page, record: dict[str, Any]) -> None:
    def jobs(route: Route) -> None:
        if route.request.method == "POST":
            route.fulfill(status=202, json=record)
        else:
            route.fulfill(json={"jobs": [record], "next": None})

    page.route("**/v1/jobs", jobs)
    page.route("**/v1/jobs?*", jobs)
    page.route(f"**/v1/jobs/{record['id']}", lambda route: route.fulfill(json=record))
    page.route(f"**/v1/jobs/{record['id']}/events", lambda route: route.fulfill(status=404, json={}))


def drag(page: Page, *places: tuple[float, float]) -> None:
    """Drag through points given as fractions of the picture's width and height."""
    box = page.get_by_role("application").bounding_box()
    assert box is not None
    at = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in places]
    page.mouse.move(*at[0])
    page.mouse.down()
    for place in at[1:]:
        page.mouse.move(*place, steps=6)
    page.mouse.up()


def colour_at_corner(page: Page) -> list[int]:
    canvas = page.get_by_role("img", name="First frame of the film")
    read = "(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data].slice(0, 3)"
    return list(canvas.evaluate(read))


def sent_options(page: Page) -> dict[str, Any]:
    return dict(json.loads(dict(page.evaluate("window.sent"))["options"]))


@pytest.mark.parametrize("name", ["film.webm", "pictures.zip"])
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


def test_a_region_drawn_with_the_mouse_is_sent_with_the_film(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    answer_with(filming, film_record(url, finished))
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    status = filming.get_by_role("dialog").get_by_role("status")
    drag(filming, (0.5, 0.5), (0.501, 0.501))
    expect(status).to_have_text("The region is too small. Drag to draw a larger one.")
    drag(filming, (0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8))
    expect(status).to_contain_text("Lasso with")
    filming.get_by_role("button", name="Rectangle").click()
    drag(filming, (0.75, 0.75), (0.25, 0.5))
    expect(status).to_contain_text("Rectangle, 160 × 60 pixels at 80, 120.")
    filming.get_by_role("button", name="Undo").click()
    expect(status).to_contain_text("Lasso with")
    filming.get_by_role("button", name="Use this region").click()
    expect(filming.get_by_role("dialog")).to_have_count(0)
    expect(filming.get_by_role("button", name="Change the region")).to_be_focused()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film; about 30 seconds left.")).to_be_visible()

    assert {name: value for name, value in filming.evaluate("window.sent") if name != "options"} == {
        "film": "film.webm",
        "name": "film",
    }
    corners = np.array(sent_options(filming)["region_polygon"])
    assert 4 < len(corners) <= 500
    assert corners.min(0) == pytest.approx([0.2 * WIDTH, 0.2 * HEIGHT], abs=2)
    assert corners.max(0) == pytest.approx([0.8 * WIDTH, 0.8 * HEIGHT], abs=2)


def test_a_region_is_drawn_with_the_keyboard_only(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    answer_with(filming, film_record(url, finished))
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").press("Enter")
    expect(filming.get_by_role("application")).to_be_focused()
    status = filming.get_by_role("dialog").get_by_role("status")
    keys = filming.keyboard
    use = filming.get_by_role("button", name="Use this region")
    rectangle, lasso = (filming.get_by_role("button", name=name) for name in ("Rectangle", "Lasso"))
    expect(use).to_be_disabled()
    keys.press("Enter")  # there is no region yet
    expect(use).to_be_visible()
    expect(lasso).to_have_attribute("aria-pressed", "true")
    keys.press("ArrowRight")
    expect(status).to_have_text("Rectangle, 160 × 120 pixels at 80, 60.")
    expect(rectangle).to_have_attribute("aria-pressed", "true")
    expect(lasso).to_have_attribute("aria-pressed", "false")
    expect(use).to_be_enabled()
    keys.press("ArrowRight")
    keys.press("ArrowUp")
    keys.press("Shift+ArrowDown")
    keys.press("Shift+ArrowLeft")
    expect(status).to_have_text("Rectangle, 157 × 123 pixels at 83, 57.")
    keys.press("Control+z")
    expect(status).to_have_text("Rectangle, 160 × 123 pixels at 83, 57.")
    for _ in range(60):
        keys.press("ArrowLeft")
    expect(status).to_have_text("Rectangle, 160 × 123 pixels at 0, 57.")
    keys.press("Enter")
    expect(filming.get_by_role("dialog")).to_have_count(0)
    filming.get_by_role("button", name="Change the region").press("Enter")
    keys.press("ArrowDown")
    keys.press("Escape")  # discards the change
    expect(filming.get_by_role("dialog")).to_have_count(0)
    filming.get_by_role("button", name="Reconstruct").press("Enter")
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert sent_options(filming)["region_polygon"] == [[0, 57], [160, 57], [160, 180], [0, 180]]


def test_keys_work_after_a_click_on_a_button_of_the_dialog(filming: Page, films: dict[str, bytes]) -> None:
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    status = filming.get_by_role("dialog").get_by_role("status")
    for _ in range(3):
        filming.keyboard.press("ArrowRight")
    expect(status).to_contain_text("at 86, 60.")
    undo = filming.get_by_role("button", name="Undo")
    undo.click()
    expect(status).to_contain_text("at 83, 60.")
    filming.keyboard.press("Control+z")
    expect(status).to_contain_text("at 80, 60.")
    undo.click()  # nothing is left to undo, so the button that has the focus is disabled
    expect(status).to_contain_text("No region")
    filming.keyboard.press("ArrowRight")
    expect(status).to_contain_text("at 80, 60.")
    expect(filming.get_by_text("Keyboard: arrow keys move the region")).to_be_visible()
    filming.keyboard.press("Escape")
    expect(filming.get_by_role("dialog")).to_have_count(0)


def test_touch_screens_show_no_keyboard_hint(browser: Browser, url: str, films: dict[str, bytes]) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(url)
    page.get_by_text("Drop a film here").wait_for()
    drop(page, {"film.webm": films["film.webm"]})
    page.get_by_role("button", name="Draw a region").click()
    expect(page.get_by_text("Keyboard: arrow keys move the region")).to_be_hidden()
    context.close()


def turn_to(page: Page, frame: int) -> None:
    """Move the slider of the dialog to a frame with the keyboard, and wait until its picture is shown."""
    slider = page.get_by_role("slider", name="Frame to draw on")
    slider.press("Home")
    for _ in range(frame):
        slider.press("ArrowRight")
    page.get_by_role("application", name=f"Frame {frame} of the film").wait_for()


def inspected(page: Page, url: str, finished: str, **fields: Any) -> None:
    """Let the service answer with these facts about the film."""
    seen = {**film_record(url, finished)["interpretation"], "given_frames": 6, "sample": [], **fields}
    page.route("**/v1/inspect", lambda route: route.fulfill(json=seen))


@pytest.mark.parametrize("name", ["film.webm", pytest.param("moving.zip", marks=pytest.mark.long), "moving.gif"])
def test_a_region_is_drawn_on_another_frame(
    filming: Page, url: str, films: dict[str, bytes], finished: str, name: str
) -> None:
    inspected(filming, url, finished)
    answer_with(filming, film_record(url, finished))
    drop(filming, {name: films[name]})
    expect(filming.get_by_text("How your files are interpreted")).to_be_visible()
    filming.get_by_role("button", name="Draw a region").click()
    slider = filming.get_by_role("slider", name="Frame to draw on")
    expect(slider).to_have_attribute("max", "5")
    turn_to(filming, 3)
    drawn = filming.get_by_role("application")
    pixel = drawn.evaluate("(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data]")
    assert pixel[2] > 150 > pixel[0]  # only the first frame is red
    drag(filming, (0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8))
    filming.get_by_role("button", name="Use this region").click()
    expect(filming.get_by_text("Drawn on frame 3.")).to_be_visible()
    shown = filming.get_by_role("img", name="Frame 3 of the film")
    assert shown.evaluate("(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data]")[2] > 60

    filming.get_by_role("button", name="Change the region").click()
    expect(slider).to_have_value("3")
    turn_to(filming, 1)
    filming.get_by_role("button", name="Cancel").click()
    expect(filming.get_by_text("Drawn on frame 3.")).to_be_visible()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert sent_options(filming)["region_frame"] == 3
    assert len(sent_options(filming)["region_polygon"]) > 3


@pytest.mark.parametrize(
    "frames", [None, pytest.param(5, marks=pytest.mark.long), pytest.param(8, marks=pytest.mark.long)]
)
def test_frames_without_certain_numbers_cannot_be_chosen(
    filming: Page, url: str, films: dict[str, bytes], finished: str, frames: int | None
) -> None:
    """The film has 6 frames; with another number, evenly spaced frames have other times than the film's."""
    inspected(filming, url, finished, given_frames=frames)
    drop(filming, {"film.webm": films["film.webm"]})
    expect(filming.get_by_text("How your files are interpreted")).to_be_visible()
    filming.get_by_role("button", name="Draw a region").click()
    filming.wait_for_timeout(1500)
    expect(filming.get_by_role("slider", name="Frame to draw on")).to_be_hidden()
    expect(filming.get_by_role("application", name="First frame of the film")).to_be_visible()


def mask(*, inside: int = 255) -> bytes:
    """A picture of the film's size, with the middle half marked."""
    marked = np.full((HEIGHT, WIDTH), 255 - inside, np.uint8)
    marked[HEIGHT // 4 : -HEIGHT // 4, WIDTH // 4 : -WIDTH // 4] = inside
    return bytes(cv2.imencode(".png", marked)[1])


@pytest.mark.parametrize(
    "order",
    [
        pytest.param("film first", marks=pytest.mark.long),
        "mask first",
        pytest.param("together", marks=pytest.mark.long),
        "chosen",
    ],
)
def test_a_picture_beside_a_film_is_its_region(
    filming: Page, url: str, films: dict[str, bytes], finished: str, order: str
) -> None:
    answer_with(filming, film_record(url, finished))
    film, marked = {"film.webm": films["film.webm"]}, {"mask.png": mask()}
    if order == "mask first":
        drop(filming, marked)
        expect(filming.locator("[data-part=mesh]")).to_contain_text("each pixel that is not black is a point")
    drop(filming, {**marked, **film} if order == "together" else film)
    if order == "film first":
        drop(filming, marked)
    if order == "chosen":
        with filming.expect_file_chooser() as opened:
            filming.get_by_role("button", name="Choose a mask picture").click()
        opened.value.set_files({"name": "mask.png", "mimeType": "image/png", "buffer": mask()})
    shown = filming.get_by_text("Region of the first frame: the mask picture mask.png. What is white in it is tracked.")
    expect(shown).to_be_visible()
    until(lambda: colour_at_corner(filming)[0] < 140)  # darkened outside the mask
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert dict(filming.evaluate("window.sent"))["region"] == "mask.png"
    assert dict(filming.evaluate("window.sent"))["film"] == "film.webm"
    assert "mesh" not in dict(filming.evaluate("window.sent"))
    assert "region_polygon" not in sent_options(filming)
    code = filming.get_by_role("region", name="Use from code")
    expect(code).to_contain_text('film="film.webm"')
    expect(code).to_contain_text('region="mask.png"')
    expect(code).to_contain_text("# array (6, points, 3)")
    filming.reload()
    expect(code).to_contain_text('region="mask.png"')


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


def test_a_mask_and_a_drawn_region_exclude_each_other(filming: Page, films: dict[str, bytes]) -> None:
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    filming.keyboard.press("ArrowRight")
    filming.get_by_role("button", name="Use this region").click()
    drop(filming, {"mask.png": mask()})
    words = filming.locator(".filming").get_by_role("status")
    expect(words).to_contain_text("the mask picture mask.png")
    filming.get_by_role("button", name="Draw a region").click()
    filming.keyboard.press("ArrowRight")
    filming.get_by_role("button", name="Use this region").click()
    expect(words).to_have_text("Rectangle, 160 × 120 pixels at 80, 60.")
    drop(filming, {"mask.png": mask()})
    filming.get_by_role("button", name="Remove the region").click()
    expect(words).to_contain_text("No region")
    expect(filming.get_by_role("button", name="Remove the region")).to_be_hidden()


def test_a_mask_of_another_size_is_refused_beside_the_film(page: Page, url: str, films: dict[str, bytes]) -> None:
    page.goto(url)
    page.get_by_text("Drop a film here").wait_for()
    drop(page, {"film.webm": films["film.webm"], "mask.png": bytes(cv2.imencode(".png", np.eye(50) * 255)[1])})
    expect(page.locator("[data-part=film]").get_by_role("alert")).to_contain_text("320×240 pixels", timeout=60_000)


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
    drop(filming, {"make.py": b"print()"})
    expect(filming.get_by_text("Left out: make.py. This page does not know files of this kind.")).to_be_visible()
    expect(filming.locator("[data-part=tracks]")).to_contain_text("tracks.npz")


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


def test_a_region_can_be_drawn_by_touch(filming: Page, films: dict[str, bytes]) -> None:
    filming.set_viewport_size({"width": 390, "height": 844})
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    box = filming.get_by_role("application").bounding_box()
    assert box is not None
    touches = filming.context.new_cdp_session(filming)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": box["x"] + x * box["width"], "y": box["y"] + y * box["height"]} for x, y in places]
        touches.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", (0.25, 0.25))
    for place in ((0.5, 0.2), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)):
        touch("touchMove", place)
    touch("touchEnd")
    status = filming.get_by_role("dialog").get_by_role("status")
    expect(status).to_contain_text("Lasso with")
    expect(status).to_contain_text("160 × 132 pixels")


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


@pytest.mark.parametrize("name", ["old.mp4", "film.webm"])
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


@pytest.mark.parametrize(("width", "scheme"), BOTH_WIDTHS_AND_THEMES)
def test_form_and_dialog_have_no_accessibility_finding(
    filming: Page, url: str, films: dict[str, bytes], finished: str, scheme: str, width: int
) -> None:
    if not AXE.is_file() and not os.environ.get("CI"):
        pytest.skip("axe-core is not installed; say `make page`")
    filming.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
    filming.set_viewport_size({"width": width, "height": 800 if width == 1280 else 844})

    def check(name: str) -> None:
        filming.evaluate(AXE.read_text())
        found = filming.evaluate("axe.run().then((found) => found.violations)")
        assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found] == [], name
        assert filming.evaluate("document.documentElement.scrollWidth") <= width
        if folder := os.environ.get("PLIANT_SCREENSHOTS"):
            filming.screenshot(path=f"{folder}/{name}-{width}-{scheme}.png")

    inspected(filming, url, finished)
    drop(filming, {"film.webm": films["film.webm"]})
    expect(filming.get_by_text("How your files are interpreted")).to_be_visible()
    filming.get_by_role("button", name="Draw a region").click()
    turn_to(filming, 3)
    drag(filming, (0.3, 0.3), (0.5, 0.15), (0.7, 0.3), (0.75, 0.6), (0.5, 0.85), (0.25, 0.6))
    check("region")
    filming.get_by_role("button", name="Use this region").click()
    filming.get_by_role("button", name="Change the region").scroll_into_view_if_needed()
    check("film")
