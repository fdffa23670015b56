"""A reload of the page: the drawn region and the options are kept in the tab, films are not."""

from __future__ import annotations

import re

from browsing import NEEDS_CHROMIUM, heard
from filming import KEEP_SENT, answer_with, colour_at_corner, film_record, sent_options
from paging import drop, until
from playwright.sync_api import Dialog, Page, expect

pytestmark = NEEDS_CHROMIUM


def draw_with_keys(page: Page, *keys: str) -> None:
    page.get_by_role("button", name=re.compile(r"Draw a region|Change the region")).click()
    page.get_by_role("application").wait_for()
    for key in keys:
        page.keyboard.press(key)
    page.get_by_role("button", name="Use this region").click()


def reload(page: Page) -> None:
    page.reload()
    page.get_by_text("Drop a film here").wait_for()
    page.evaluate(KEEP_SENT)


def test_the_region_is_restored_with_its_film_after_a_reload(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    """Phones give a film another name and time whenever it is chosen; another film has no region."""
    answer_with(filming, film_record(url, finished))
    words = filming.locator(".filming").get_by_role("status")
    drop(filming, {"film.webm": films["film.webm"]})
    draw_with_keys(filming, "ArrowRight", "ArrowRight")
    expect(words).to_have_text("Rectangle, 160 × 120 pixels at 83, 60.")
    reload(filming)
    kept = filming.get_by_text("The region you drew on film.webm is kept: choose the film again to use it.")
    expect(kept).to_be_visible()
    drop(filming, {"moving.gif": films["moving.gif"]})
    expect(kept).to_be_hidden()
    expect(words).to_contain_text("No region")
    drop(filming, {"IMG_0042.webm": films["film.webm"]})
    expect(words).to_have_text("Rectangle, 160 × 120 pixels at 83, 60. Restored: you drew it on this film before.")
    until(lambda: colour_at_corner(filming)[0] < 140)  # darkened outside the region
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert sent_options(filming)["region_polygon"] == [[83, 60], [243, 60], [243, 180], [83, 180]]


def test_a_region_that_was_removed_or_replaced_is_not_restored(filming: Page, films: dict[str, bytes]) -> None:
    words = filming.locator(".filming").get_by_role("status")
    for undone in ("removed", "masked"):
        drop(filming, {"film.webm": films["film.webm"]})
        draw_with_keys(filming, "ArrowRight")
        expect(words).to_have_text("Rectangle, 160 × 120 pixels at 80, 60.")
        if undone == "removed":
            filming.get_by_role("button", name="Remove the region").click()
        else:
            drop(filming, {"mask.png": films["moving.gif"]})
            expect(words).to_contain_text("mask.png")
        reload(filming)
        expect(filming.get_by_text("The region you drew on")).to_be_hidden()
        drop(filming, {"film.webm": films["film.webm"]})
        expect(words).to_contain_text("No region")


def test_a_region_of_another_frame_is_restored_on_that_frame(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    """Until the service has counted the frames, the first one is shown, without the region of the other."""
    seen = {**film_record(url, finished)["interpretation"], "given_frames": 6, "sample": []}
    filming.route("**/v1/inspect", lambda route: route.fulfill(json=seen))
    answer_with(filming, film_record(url, finished))
    drop(filming, {"film.webm": films["film.webm"]})
    expect(filming.get_by_text("How your files are interpreted")).to_be_visible()
    filming.get_by_role("button", name="Draw a region").click()
    slider = filming.get_by_role("slider", name="Frame to draw on")
    for _ in range(3):
        slider.press("ArrowRight")
    filming.get_by_role("application", name="Frame 3 of the film").focus()
    filming.keyboard.press("ArrowRight")
    filming.get_by_role("button", name="Use this region").click()
    restored = "Rectangle, 160 × 120 pixels at 80, 60. Drawn on frame 3. Restored: you drew it on this film before."

    filming.route("**/v1/inspect", lambda route: route.fulfill(status=503, json={}))
    reload(filming)
    drop(filming, {"film.webm": films["film.webm"]})
    expect(filming.locator(".filming").get_by_role("status")).to_have_text(restored)
    filming.get_by_role("img", name="First frame of the film").wait_for()
    assert colour_at_corner(filming)[0] > 150  # red, and not darkened
    filming.get_by_role("button", name="Draw a region").click()
    expect(filming.get_by_role("dialog").get_by_role("status")).to_contain_text("No region")
    filming.get_by_role("button", name="Cancel").click()

    filming.route("**/v1/inspect", lambda route: route.fulfill(json=seen))
    reload(filming)
    drop(filming, {"film.webm": films["film.webm"]})
    shown = filming.get_by_role("img", name="Frame 3 of the film")
    shown.wait_for()
    pixel = shown.evaluate("(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data]")
    assert 60 < pixel[2] < 140  # blue, and darkened
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert sent_options(filming)["region_frame"] == 3


def test_options_are_restored_after_a_reload_and_can_be_reset(filming: Page, films: dict[str, bytes]) -> None:
    def unfold(*groups: str) -> None:
        for group in groups:
            filming.locator(".folds summary", has_text=group).click()

    unfold("Frames and points", "Lens", "Files to write")
    note = filming.get_by_text("Options from before the page was reloaded")
    expect(note).to_be_hidden()
    filming.get_by_label("Use every n-th point").fill("3")
    filming.get_by_label("Camera model").select_option(label="perspective")
    filming.get_by_role("checkbox", name="OBJ").check()
    filming.get_by_label("Frame rate").fill("12")
    filming.get_by_label("Frame rate").press("Tab")
    reload(filming)
    names = "Files, Frame rate, Camera model, Use every n-th point"
    expect(note).to_have_text(f"Options from before the page was reloaded: {names}.")
    unfold("Frames and points", "Lens", "Files to write")
    expect(filming.get_by_text("(1 changed)")).to_have_count(2)
    expect(filming.get_by_text("(2 changed)")).to_have_count(1)
    expect(filming.get_by_label("Use every n-th point")).to_have_value("3")
    expect(filming.get_by_role("checkbox", name="OBJ")).to_be_checked()
    filming.get_by_role("button", name="Use the defaults").click()
    expect(note).to_be_hidden()
    expect(filming.get_by_label("Use every n-th point")).to_have_value("1")
    expect(filming.get_by_label("Frame rate")).to_have_value("25")
    expect(filming.locator(".folds summary").first).to_be_focused()
    reload(filming)
    expect(note).to_be_hidden()
    unfold("Frames and points")
    expect(filming.get_by_label("Use every n-th point")).to_have_value("1")


def test_the_default_frame_rate_chosen_for_a_film_is_restored(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    seen = {**film_record(url, finished)["interpretation"], "fps": 30.0, "sample": []}
    filming.route("**/v1/inspect", lambda route: route.fulfill(json=seen))
    answer_with(filming, film_record(url, finished))
    for again in (False, True):
        drop(filming, {"film.webm": films["film.webm"]})
        filming.locator(".folds summary", has_text="Files to write").click()
        rate = filming.get_by_label("Frame rate")
        expect(rate).to_have_attribute("placeholder", "30, the film's")
        if not again:
            rate.fill("25")
            rate.press("Tab")
            reload(filming)
            expect(filming.get_by_text("Options from before the page was reloaded: Frame rate.")).to_be_visible()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    assert sent_options(filming) == {"fps": 25}


def test_the_options_of_a_job_that_is_run_again_are_not_kept(filming: Page, url: str, finished: str) -> None:
    """After a reload the form asks for files, to which the options of that job need not apply."""
    filming.goto(f"{url}/#job={finished}")
    filming.get_by_role("button", name="Run again with other options").click()
    filming.locator(".folds summary", has_text="Frames and points").click()
    filming.get_by_label("Visible in at least").fill("4")
    filming.get_by_label("Visible in at least").press("Tab")
    filming.goto(url)
    reload(filming)
    filming.locator(".folds summary", has_text="Lens").click()
    expect(filming.get_by_text("Options from before the page was reloaded")).to_be_hidden()
    expect(filming.get_by_label("Camera model").locator("option:checked")).to_have_text("automatic")


def test_a_running_job_is_in_the_list_after_a_reload(filming: Page, url: str, finished: str) -> None:
    answer_with(filming, film_record(url, finished))
    filming.goto(url)
    filming.reload()
    filming.get_by_role("link", name="a film").click()
    expect(filming.get_by_text("Tracking the film; about 30 seconds left.")).to_be_visible()


def test_a_film_that_is_tracked_already_promises_no_points(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    record = film_record(url, finished)
    record["progress"]["stage"] = "cameras"
    answer_with(filming, record)
    drop(filming, {"film.webm": films["film.webm"]})
    filming.get_by_role("img", name="First frame of the film").wait_for()
    filming.get_by_role("button", name="Reconstruct").click()
    live = filming.locator(".live")
    expect(live).to_have_text("The film is tracked.")  # below its first frame
    filming.reload()
    expect(filming.get_by_text("Estimating the cameras; about 30 seconds left.")).to_be_visible()
    expect(live).to_be_hidden()


def test_leaving_the_page_with_a_recording_that_was_not_submitted_is_asked_about(
    filming: Page, url: str, films: dict[str, bytes], finished: str
) -> None:
    """It exists nowhere else, and cannot be chosen again."""
    asked: list[str] = []

    def stay(dialog: Dialog) -> None:
        asked.append(dialog.type)
        dialog.dismiss()

    def record_film() -> None:
        filming.get_by_role("button", name="Record with the camera").click()
        dialog = filming.get_by_role("dialog", name="Record a film")
        dialog.get_by_role("button", name="Record").click()
        dialog.get_by_role("button", name="Stop").click()
        filming.get_by_role("img", name="First frame of the film").wait_for()

    answer_with(filming, film_record(url, finished))
    filming.on("dialog", stay)
    record_film()
    filming.evaluate("setTimeout(() => location.reload())")
    heard(filming, lambda: asked == ["beforeunload"])
    drop(filming, {"film.webm": films["film.webm"]})  # instead of the recording
    expect(filming.get_by_label("Name (optional)")).to_have_value("film")
    reload(filming)
    record_film()
    filming.get_by_role("button", name="Reconstruct").click()
    expect(filming.get_by_text("Tracking the film")).to_be_visible()
    filming.goto(url)
    filming.remove_listener("dialog", stay)
    assert asked == ["beforeunload"]
