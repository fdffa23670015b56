"""Films in the page: detection, first frame, drawing a region, submission, and tracks beside the result."""

from __future__ import annotations

import base64
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from browsing import why_not
from paging import BOTH_WIDTHS_AND_THEMES, drop, until
from playwright.sync_api import Page, Route, expect

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
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("film/10.png", picture(BLUE))
        archive.writestr("film/9.png", picture(RED))
        archive.writestr("__MACOSX/film/._1.png", b"not a picture")
    return {**found, "pictures.zip": packed.getvalue()}


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
    expect(filming.get_by_text("No region: the whole picture is tracked.")).to_be_visible()
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
    keys.press("ArrowRight")
    expect(status).to_have_text("Rectangle, 160 × 120 pixels at 80, 60.")
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
    """The browser's own frame takes precedence, whichever arrives first; corners are in the film's pixels."""
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
    answer_with(filming, film_record(url, finished))
    filming.get_by_role("button", name="Draw a region").click()
    filming.get_by_role("button", name="Rectangle").click()
    drag(filming, (0.25, 0.25), (0.75, 0.5))
    filming.get_by_role("button", name="Use this region").click()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    (left, top), _, (right, bottom), _ = sent_options(filming)["region_polygon"]
    assert np.allclose([left, top, right, bottom], [80, 60, 240, 120], atol=2)


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
    followed = {"frame": 3, "seconds": 0.6, "width": WIDTH, "height": HEIGHT, "points": [160, 120, 170, 130]}
    moved = {**record["progress"], "followed": followed, "fraction": 0.3, "updated_at": "2099-01-01T00:00:00Z"}
    answer_with(filming, {**record, "progress": moved})
    expect(filming.get_by_text("Frame 3: 2 of the tracked points.")).to_be_visible()
    until(lambda: reddest()[2] > 150 > reddest()[0])
    middle = "(it) => [...it.getContext('2d').getImageData(Math.round(it.width * 160.5 / 320), Math.round(it.height / 2), 1, 1).data]"
    until(lambda: live.evaluate(middle)[0] > live.evaluate(middle)[2] + 60)  # a mark on the white disc
    assert filming.title() == "30\u00a0% – a film – Pliant"


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
    expect(filming.get_by_role("region", name="Use from code")).to_contain_text('film="film.mp4"')


@pytest.mark.parametrize(("width", "scheme"), BOTH_WIDTHS_AND_THEMES)
def test_form_and_dialog_have_no_accessibility_finding(
    filming: Page, films: dict[str, bytes], scheme: str, width: int
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

    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    drag(filming, (0.3, 0.3), (0.5, 0.15), (0.7, 0.3), (0.75, 0.6), (0.5, 0.85), (0.25, 0.6))
    check("region")
    filming.get_by_role("button", name="Use this region").click()
    filming.get_by_role("button", name="Change the region").scroll_into_view_if_needed()
    check("film")
