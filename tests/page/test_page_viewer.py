"""The viewer of a finished job: points, timeline, colourings, panes, comparison, and the files that it saves."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import results
from browsing import AXE, NEEDS_CHROMIUM, differing_pixels
from paging import DONE, QUICK, TRACKS, packed, seek, until
from PIL import Image
from playwright.sync_api import Browser, Locator, Page, expect
from pliant.solver import KnownCamera, Solution, solve
from pliant.solver.gallery import Sequence, corrupt, flag
from pliant.worker.formats.texture import Texture
from pliant.worker.formats.tracks.frame_times import mean_rate

pytestmark = NEEDS_CHROMIUM

FRAMES, POINTS = 10, 300
HALF_TURN = 24
"""Presses of an arrow key that turn the view by 180°."""


@pytest.fixture(scope="module")
def jobs(url: str) -> tuple[str, str]:
    """Two finished jobs on the same points: one with hidden points and outliers, one clean."""
    ids = []
    for name, sequence in (
        ("spoiled flag", corrupt(flag(FRAMES, POINTS), outliers=0.03, hidden=0.15, seed=5)),
        ("clean flag", flag(FRAMES, POINTS)),
    ):
        tracks = packed(tracks=sequence.tracks.points, visibility=sequence.tracks.visible > 0)
        files = {"tracks": (TRACKS, tracks), "mesh": ("mesh.npz", packed(faces=sequence.mesh.faces))}
        files["rotations"] = ("cameras.npz", packed(rotations=sequence.rotations))
        answer = httpx.post(f"{url}/v1/jobs", files=files, data={"name": name, "options": QUICK}, timeout=60)
        ids.append(str(answer.json()["id"]))
    for id in ids:
        while httpx.get(f"{url}/v1/jobs/{id}", headers={"Prefer": "wait=20"}, timeout=60).json()["status"] in (
            "queued",
            "running",
        ):
            pass
    return ids[0], ids[1]


@pytest.fixture(scope="module")
def shared(browser: Browser, url: str, jobs: tuple[str, str]) -> Iterator[Page]:
    """One page for all tests of this module: opening a viewer takes seconds without a graphics card."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
    page = context.new_page()
    page.goto(f"{url}/#job={jobs[0]}")
    page.locator(".view canvas").wait_for(timeout=DONE)
    yield page
    context.close()


@pytest.fixture
def viewer(shared: Page) -> Page:
    """The shared page, reset to the view it opens with."""
    shared.get_by_label("Colour", exact=True).select_option("plain")
    shared.get_by_role("button", name="Front").click()
    seek(shared, 3)
    shared.evaluate("scrollTo(0, 0)")
    return shared


def canvas(page: Page) -> Locator:
    return page.get_by_role("application", name=re.compile("^3-D view"))


def facts(page: Page) -> dict[str, str]:
    read = "(it) => [...it.querySelectorAll('dt')].map((term) => [term.innerText, term.nextSibling.innerText])"
    return dict(page.locator(".probe dl").evaluate(read))


def test_picture_and_tools_are_visible_without_scrolling(viewer: Page) -> None:
    for part in (canvas(viewer), viewer.locator(".tools"), viewer.get_by_role("slider", name="Frame")):
        box = part.bounding_box()
        assert box is not None
        assert box["y"] >= 0
        assert box["y"] + box["height"] <= 800
    picture, tools = canvas(viewer).bounding_box(), viewer.locator(".tools").bounding_box()
    assert picture is not None
    assert tools is not None
    assert tools["x"] >= picture["x"] + picture["width"]
    viewer.set_viewport_size({"width": 390, "height": 844})
    picture, tools = canvas(viewer).bounding_box(), viewer.locator(".tools").bounding_box()
    assert picture is not None
    assert tools is not None
    assert tools["y"] >= picture["y"] + picture["height"]
    buttons = viewer.get_by_role("button", name="Help").bounding_box()
    assert buttons is not None
    assert buttons["y"] + buttons["height"] <= picture["y"]
    sizes = viewer.locator("button:visible, select:visible, .chip:visible, input[type=number]:visible").evaluate_all(
        """(all) => all.map((one) => {
          const box = one.getBoundingClientRect();
          return [one.textContent || one.ariaLabel, box.height, box.width];
        })"""
    )
    assert [one for one in sizes if min(one[1:]) < 24] == []
    viewer.set_viewport_size({"width": 1280, "height": 800})


def test_view_keys_rotate_the_mesh_and_the_fit_key_resets_the_zoom(viewer: Page) -> None:
    canvas(viewer).press("1")  # the focused canvas is outlined
    viewer.wait_for_timeout(200)
    front = canvas(viewer).screenshot()

    def changed() -> float:
        return differing_pixels(front, canvas(viewer).screenshot())

    for key in ("2", "3"):
        canvas(viewer).press(key)
        until(lambda: changed() > 0.02)
        canvas(viewer).press("1")
        until(lambda: changed() == 0)
    for _ in range(6):
        canvas(viewer).press("+")
    until(lambda: changed() > 0.02)
    canvas(viewer).press("0")
    until(lambda: changed() == 0)


def test_a_point_is_chosen_by_click_by_key_and_by_number(viewer: Page, url: str, jobs: tuple[str, str]) -> None:
    box = canvas(viewer).bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    number = viewer.get_by_role("spinbutton", name="Point")
    viewer.mouse.click(*middle)
    until(lambda: "In this frame" in facts(viewer))
    clicked = number.input_value()
    viewer.get_by_role("button", name="Clear").click()
    expect(number).to_be_focused()
    canvas(viewer).press("Enter")
    expect(number).to_have_value(clicked)
    raw = httpx.get(f"{url}/v1/jobs/{jobs[0]}/artifacts/shapes.npz").content
    with np.load(io.BytesIO(raw)) as arrays:
        shapes, weights, spread = arrays["shapes"], arrays["weights"], arrays["shapes_std"]
    size = np.sqrt(np.square(shapes - shapes.mean(axis=1, keepdims=True)).sum(axis=2).mean())
    hidden = int(np.flatnonzero(weights[3] == 0)[0])
    for point in (int(clicked), hidden):
        number.fill("")
        expect(viewer.locator(".probe dt")).to_have_count(0)
        number.fill(str(point))
        until(lambda point=point: "In this frame" in facts(viewer))  # type: ignore[misc]
        shown = facts(viewer)
        position = [float(each) for each in shown["Position"].removesuffix(" (tracks' unit)").split(", ")]
        np.testing.assert_allclose(position, shapes[3, point], atol=2e-3 * size)
        assert float(shown["Expected error"].split("\u00a0%")[0]) == pytest.approx(
            100 * spread[3, point] / size, rel=0.06
        )
        assert re.match(rf"\d+ of {FRAMES} frames", shown["Visible in"])
    assert facts(viewer)["In this frame"].startswith(("hidden", "rejected"))
    number.fill("")


def test_the_timeline_responds_to_keys_and_describes_each_frame(viewer: Page) -> None:
    slider = viewer.get_by_role("slider", name="Frame")
    slider.focus()
    texts = set()
    for key, frame in (("Home", 1), ("ArrowRight", 2), ("End", FRAMES), ("ArrowLeft", FRAMES - 1)):
        viewer.keyboard.press(key)
        expect(viewer.locator(".clock")).to_have_text(f"{frame} / {FRAMES}")
        texts.add(slider.get_attribute("aria-valuetext"))
    assert len(texts) == 4
    found = r"frame \d+ of 10, expected error [\d.]+\u00a0% of the size, [\d.]+\u00a0% of the points hidden"
    assert all(re.fullmatch(found, str(text)) for text in texts)
    values = viewer.locator(".probe dl")
    for action, announced in (("Play", "off"), ("Pause", "polite")):
        viewer.get_by_role("button", name=action).click()
        expect(values).to_have_attribute("aria-live", announced)
    chart = viewer.locator(".frames-chart svg").bounding_box()
    assert chart is not None
    viewer.mouse.click(chart["x"] + chart["width"] / 3, chart["y"] + 10)
    expect(viewer.locator(".clock")).to_have_text(f"4 / {FRAMES}")


def test_the_legend_states_units_and_the_meaning_of_grey(viewer: Page) -> None:
    viewer.get_by_label("Colour", exact=True).select_option("expected")
    legend = viewer.locator(".legend")
    expect(legend).to_contain_text("% of the size")
    expect(legend).to_contain_text("grey: hidden")
    viewer.get_by_label("Colour", exact=True).select_option("seen")
    expect(legend).to_contain_text(f"{FRAMES} of {FRAMES} frames")
    viewer.get_by_label("Colour", exact=True).select_option("residual")
    expect(legend).to_contain_text("(tracks' unit)")
    top = float(re.findall(r"([\d.e-]+) \(tracks' unit\)", legend.inner_text())[0])
    assert top < 1  # the outliers are tens of units away and rejected


def test_tracks_are_shown_beside_the_mesh_and_can_be_overlaid_with_it(viewer: Page) -> None:
    viewer.get_by_role("checkbox", name="Tracks beside").check()
    tracks = viewer.get_by_role("img", name="The tracks at the same moment")
    until(lambda: tracks.evaluate("(it) => it.width") > 100)
    viewer.wait_for_timeout(200)
    before = tracks.screenshot()
    seek(viewer, 8)
    until(lambda: differing_pixels(before, tracks.screenshot()) > 0.005)
    seek(viewer, 3)
    viewer.get_by_role("checkbox", name="Mesh over it").check()
    until(lambda: differing_pixels(before, tracks.screenshot()) > 0.02)
    viewer.get_by_role("checkbox", name="Tracks beside").uncheck()
    expect(viewer.get_by_role("checkbox", name="Mesh over it")).not_to_be_checked()
    expect(tracks).to_have_count(0)


def test_another_job_is_compared_side_by_side(viewer: Page) -> None:
    viewer.get_by_label("Compare with").select_option(label="clean flag")
    other = viewer.get_by_role("img", name="The other job's result, from the same side")
    other.wait_for()
    expect(
        viewer.get_by_text(re.compile(r"Expected error: this job [\d.]+\s% of the size, clean flag"))
    ).to_be_visible()
    expect(viewer.locator(".legend")).to_contain_text("Expected error, “spoiled flag” minus “clean flag”")
    expect(viewer.locator(".legend")).to_contain_text("grey: hidden in one of the two")
    expect(viewer.locator(".view-name")).to_have_text(["spoiled flag (this job)", "clean flag"])
    viewer.wait_for_timeout(300)
    before = other.screenshot()
    canvas(viewer).press("2")
    until(lambda: differing_pixels(before, other.screenshot()) > 0.02)
    viewer.get_by_label("Compare with").select_option("")
    expect(other).to_have_count(0)


@pytest.fixture(scope="module")
def solved() -> tuple[Sequence, Solution]:
    """The clean flag and its solution."""
    sequence = flag(FRAMES, POINTS)
    cameras = KnownCamera.from_arrays(sequence.rotations, sequence.scales)
    return sequence, solve(sequence.tracks, sequence.mesh, cameras=cameras)


def preview_of(solved: tuple[Sequence, Solution], **given: Any) -> bytes:
    sequence, solution = solved
    return results.preview_of(sequence.tracks, solution, mesh=sequence.mesh, **given)


def painted(solved: tuple[Sequence, Solution]) -> bytes:
    """A preview of a flag textured red on the left and blue on the right; its depth has the wrong sign."""
    first = solved[0].tracks.points[0]
    places = (first - first.min(axis=0)) / np.ptp(first, axis=0)
    halves = np.zeros((64, 64, 3), dtype=np.uint8)
    halves[:, :32, 0] = halves[:, 32:, 2] = 230
    return preview_of(solved, truth=solved[1].shapes * (1, 1, -1), texture=Texture.from_tracked(halves, places))


def test_a_film_of_uneven_frame_rate_plays_at_its_own_times(
    page: Page, url: str, jobs: tuple[str, str], solved: tuple[Sequence, Solution]
) -> None:
    seconds = np.r_[
        np.arange(FRAMES - 1) / 20, 600.0
    ]  # at the mean rate the second frame would be shown after a minute
    preview = preview_of(solved, frame_times=seconds, fps=mean_rate(seconds))
    page.route(f"**/{jobs[0]}/**/preview.bin", lambda route: route.fulfill(body=preview))
    page.goto(f"{url}/#job={jobs[0]}")
    canvas(page).wait_for(timeout=DONE)
    seek(page, 0)
    page.get_by_role("button", name="Play", exact=True).click()
    slider = page.get_by_role("slider", name="Frame")
    until(lambda: float(slider.input_value()) >= FRAMES - 2)
    page.get_by_role("button", name="Pause", exact=True).click()
    assert FRAMES - 2 <= float(slider.input_value()) < FRAMES - 1.5


def test_film_texture_is_the_default_and_returns_after_a_comparison(
    page: Page, url: str, jobs: tuple[str, str], solved: tuple[Sequence, Solution]
) -> None:
    preview = painted(solved)
    page.route(f"**/{jobs[0]}/**/preview.bin", lambda route: route.fulfill(body=preview))
    page.goto(f"{url}/#job={jobs[0]}")
    colour = page.get_by_label("Colour", exact=True)
    colour.wait_for(timeout=DONE)
    assert colour.input_value() == "film"
    seek(page, 0)

    def halves() -> tuple[float, float]:
        """Share of red pixels in the left half of the view, and of blue ones in the right half."""
        with Image.open(io.BytesIO(canvas(page).screenshot())) as shot:
            pixels = np.asarray(shot.convert("RGB"), dtype=float)
        middle = pixels.shape[1] // 2
        red, blue = pixels[..., 0] - pixels[..., 2] > 80, pixels[..., 2] - pixels[..., 0] > 80
        return float(red[:, :middle].mean()), float(blue[:, middle:].mean())

    until(lambda: min(halves()) > 0.1)
    flip, why = (
        page.get_by_role("checkbox", name="Flip depth"),
        page.get_by_text("Depth is mirrored to match the ground truth; the files are not."),
    )
    expect(flip).to_be_checked()
    expect(why).to_be_visible()
    flip.uncheck()
    expect(why).to_be_hidden()
    flip.check()
    colour.select_option("plain")
    until(lambda: max(halves()) == 0)
    page.get_by_label("Compare with").select_option(label="clean flag")
    until(lambda: colour.input_value() == "difference")
    page.get_by_label("Compare with").select_option("")
    until(lambda: min(halves()) > 0.1)


def test_back_faces_are_darker_and_f_toggles_full_screen(viewer: Page) -> None:
    def brightness() -> float:
        """Median brightness of the picture's centre, which the mesh covers."""
        with Image.open(io.BytesIO(canvas(viewer).screenshot())) as shot:
            pixels = np.asarray(shot.convert("L"), dtype=float)
        (height, width), tenth = pixels.shape, min(pixels.shape) // 10
        middle = pixels[height // 2 - tenth : height // 2 + tenth, width // 2 - tenth : width // 2 + tenth]
        return float(np.median(middle))

    seen = brightness()
    for _ in range(HALF_TURN):
        canvas(viewer).press("ArrowRight")
    until(lambda: brightness() < 0.85 * seen)
    viewer.get_by_role("button", name="Front").click()
    until(lambda: brightness() == pytest.approx(seen, abs=2))
    for filling in (True, False):
        canvas(viewer).press("f")
        until(lambda filling=filling: viewer.evaluate("document.fullscreenElement !== null") == filling)  # type: ignore[misc]


def test_help_opens_and_closes_by_keyboard(viewer: Page) -> None:
    canvas(viewer).press("?")
    help_ = viewer.get_by_role("dialog", name="Keys and gestures")
    expect(help_).to_contain_text("Camera's view".lower())
    viewer.keyboard.press("Escape")
    expect(help_).to_have_count(0)
    viewer.set_viewport_size({"width": 640, "height": 450})  # 1280 × 900 at 200 %
    canvas(viewer).press("?")
    expect(help_.get_by_text("Drag, arrow keys")).to_be_in_viewport()
    viewer.keyboard.press("Escape")
    expect(help_).to_have_count(0)


def test_picture_video_and_offline_page_can_be_saved(viewer: Page, tmp_path: Path) -> None:
    saved = {}
    for name in ("Picture", "HTML page", "Camera's film"):
        with viewer.expect_download() as download:
            viewer.get_by_role("button", name=name).click()
        target = tmp_path / download.value.suggested_filename
        download.value.save_as(target)
        saved[name] = target
    assert saved["Picture"].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert saved["Camera's film"].suffix in (".mp4", ".webm")
    assert saved["Camera's film"].stat().st_size > 2000
    context = viewer.context.browser.new_context(reduced_motion="reduce", offline=True)  # type: ignore[union-attr]
    alone = context.new_page()
    asked: list[str] = []
    alone.on("request", lambda request: asked.append(request.url))
    alone.goto(saved["HTML page"].as_uri())
    canvas(alone).wait_for()
    seek(alone, 3)
    assert [address for address in asked if not address.startswith(("file:", "blob:", "data:"))] == []
    before = canvas(alone).screenshot()
    alone.get_by_role("button", name="Side").click()
    until(lambda: differing_pixels(before, canvas(alone).screenshot()) > 0.02)
    context.close()


def test_turntable_recording_rotates_the_mesh_and_can_be_stopped(viewer: Page) -> None:
    canvas(viewer).focus()
    before = canvas(viewer).screenshot()
    viewer.get_by_role("button", name="Turntable").click()
    until(lambda: differing_pixels(before, canvas(viewer).screenshot()) > 0.02)
    viewer.get_by_role("button", name="Stop recording").click()
    expect(viewer.get_by_text("Stopped. Nothing was saved.")).to_be_visible()
    canvas(viewer).focus()
    until(lambda: differing_pixels(before, canvas(viewer).screenshot()) == 0)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_accessibility_finding_with_every_part_open(viewer: Page, scheme: str) -> None:
    if not AXE.is_file() and not os.environ.get("CI"):
        pytest.skip("axe-core is not installed; say `make page`")
    viewer.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
    viewer.get_by_role("spinbutton", name="Point").fill("7")
    viewer.get_by_role("checkbox", name="Tracks beside").check()
    viewer.get_by_label("Compare with").select_option(label="clean flag")
    viewer.locator(".view.other canvas").wait_for()
    viewer.evaluate(AXE.read_text())
    for width in (1280, 390):
        viewer.set_viewport_size({"width": width, "height": 844})
        for state in ("compare", "help"):
            if state == "help":
                viewer.get_by_role("button", name="Help").click()
            found = viewer.evaluate("axe.run().then((found) => found.violations)")
            assert [(one["id"], [node["html"] for node in one["nodes"]][:3]) for one in found] == [], (width, state)
            assert viewer.evaluate("document.documentElement.scrollWidth") <= width
            if folder := os.environ.get("PLIANT_SCREENSHOTS"):
                viewer.screenshot(path=f"{folder}/{state}-{width}-{scheme}.png")
        viewer.keyboard.press("Escape")
    viewer.set_viewport_size({"width": 1280, "height": 800})
    viewer.get_by_label("Compare with").select_option("")
    viewer.get_by_role("checkbox", name="Tracks beside").uncheck()
    viewer.get_by_role("spinbutton", name="Point").fill("")
