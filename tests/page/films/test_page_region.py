"""Drawing the region of a film: with mouse, touch and keyboard, on any frame, or as a mask picture."""

from __future__ import annotations

import os
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import AXE, NEEDS_CHROMIUM
from filming import (
    HEIGHT,
    WIDTH,
    answer_with,
    colour_at_corner,
    drag,
    film_record,
    sent_options,
)
from paging import BOTH_WIDTHS_AND_THEMES, drop, until
from playwright.sync_api import Browser, Page, Route, expect

pytestmark = NEEDS_CHROMIUM


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


def test_a_lasso_that_runs_around_twice_leaves_no_hole(filming: Page, films: dict[str, bytes]) -> None:
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    read = "(it) => [...it.getContext('2d').getImageData(it.width / 2, it.height / 2, 1, 1).data].slice(0, 3)"
    canvas = filming.get_by_role("application")
    undimmed = canvas.evaluate(read)
    around = ((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8), (0.2, 0.25))
    drag(filming, *around, *((x + 0.05, y + 0.05) for x, y in around))
    expect(filming.get_by_role("dialog").get_by_role("status")).to_contain_text("Lasso with")
    assert canvas.evaluate(read) == pytest.approx(undimmed, abs=2)
    filming.get_by_role("button", name="Cancel").click()


def test_a_region_is_drawn_after_a_drag_from_outside_has_selected_text(filming: Page, films: dict[str, bytes]) -> None:
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    drag(filming, (-0.1, -0.05), (0.5, 0.5), (1.1, 1.05))
    assert filming.evaluate("String(getSelection())") != ""
    drag(filming, (0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8))
    expect(filming.get_by_role("dialog").get_by_role("status")).to_contain_text("Lasso with")
    filming.get_by_role("button", name="Cancel").click()


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


FAILS_ONCE = """() => {
  const real = window.createImageBitmap;
  let failed = false;
  window.createImageBitmap = (source, ...more) => {
    if (failed || !(source instanceof HTMLVideoElement)) return real(source, ...more);
    failed = true;
    return Promise.reject(new DOMException("no picture yet", "InvalidStateError"));
  };
}"""


def test_decoding_the_first_frame_is_tried_again(filming: Page, films: dict[str, bytes]) -> None:
    filming.evaluate(FAILS_ONCE)
    drop(filming, {"film.webm": films["film.webm"]})
    expect(filming.get_by_role("button", name="Draw a region")).to_be_visible()


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


@pytest.mark.parametrize(
    "name",
    [
        "film.webm",
        pytest.param("moving.zip", marks=pytest.mark.long),
        pytest.param("moving.gif", marks=pytest.mark.long),
    ],
)
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


def test_frames_can_be_chosen_once_the_service_has_counted_them(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    """An upload from a phone takes longer than opening the dialog."""
    seen = {**film_record(url, finished)["interpretation"], "given_frames": 6, "sample": []}
    asked: list[Route] = []
    filming.route("**/v1/inspect", lambda route: asked.append(route))
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("button", name="Draw a region").click()
    slider = filming.get_by_role("slider", name="Frame to draw on")
    filming.wait_for_timeout(300)
    expect(slider).to_be_hidden()
    while not asked:
        filming.wait_for_timeout(50)
    asked[0].fulfill(json=seen)
    expect(slider).to_have_attribute("max", "5")


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
        pytest.param("mask first", marks=pytest.mark.long),
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

    touch("touchStart", (0.5, 0.5))  # a second finger ends the stroke, which changes nothing
    touch("touchStart", (0.5, 0.5), (0.6, 0.55))
    for step in (0.05, 0.1, 0.15):
        touch("touchMove", (0.5 - step, 0.5 - step), (0.6 + step, 0.55 + step))
    touch("touchEnd")
    expect(status).to_contain_text("160 × 132 pixels")
    filming.get_by_role("button", name="Undo").click()
    expect(status).to_contain_text("No region")


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
