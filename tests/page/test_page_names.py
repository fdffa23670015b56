"""What a visitor sees of one result: names of object and points, when a share link ends, and AR where it plays."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import httpx
import numpy as np
import pytest
from browsing import AXE, NEEDS_CHROMIUM
from paging import DONE, seek, until
from PIL import Image
from playwright.sync_api import Browser, Locator, Page, expect
from pliant.tracking.contact_sheet import small_jpeg
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.films.frame_strip import packed
from results import make_result, preview_of
from scipy.spatial.transform import Rotation

pytestmark = NEEDS_CHROMIUM

POINT_NAMES = tuple(f"Lid {number} ü" for number in range(21 * 31))
GREYS = (20, 50, 80, 110, 140, 170, 200)
"""Grey level of each film frame."""
GREEN = (0, 255, 0)
EDGE = 6
"""Pixels at the edge of a pane that may show what is around it, or the outline of the focus."""
QUICK_LOOK = """const supports = DOMTokenList.prototype.supports;
DOMTokenList.prototype.supports = function (word) { return word === "ar" || supports.call(this, word); };"""


@pytest.fixture(scope="module")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address that `pliant view` prints for the result of a film with named points."""
    folder: Path = tmp_path_factory.mktemp("a-folder")
    inputs, solution, options = make_result(rows=21, columns=31, texture=True, outputs="glb,usd")
    inputs = replace(inputs, point_names=POINT_NAMES)
    report = build_report(inputs, solution, options, metrics={}, name="Take 3/Büro")
    greys = [small_jpeg(np.full((180, 320, 3), level, np.uint8), longest_side=320, quality=90) for level in GREYS]
    (folder / "film_frames.bin").write_bytes(packed(greys, (320, 180)))
    report["artifacts"] = {"film_frames.bin": {}}
    write_artifacts(inputs, solution, options, report, folder, name="Take 3/Büro")
    command = [sys.executable, "-m", "pliant.cli", "view", str(folder), "--no-browser", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewing:
        assert viewing.stdout is not None
        text = ""
        while not text.endswith("}\n"):
            text += viewing.stdout.readline()
        try:
            yield str(json.loads(text)["url"])
        finally:
            viewing.send_signal(signal.SIGINT)
            viewing.wait(30)


def visitor(browser: Browser, **more: str) -> Page:
    context = browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce", **more)  # type: ignore[arg-type]
    return context.new_page()


def test_a_local_result_shows_its_object_and_point_names(browser: Browser, viewed: str) -> None:
    page = visitor(browser)
    page.goto(viewed)
    expect(page.get_by_role("heading", name="Take 3/Büro")).to_be_visible()
    page.locator(".view canvas").first.wait_for(timeout=DONE)
    number = page.get_by_role("spinbutton", name="Point")
    for point in (7, 640):
        number.fill(str(point))
        expect(page.locator(".probe dt").first).to_have_text("Name")
        expect(page.locator(".probe dd").first).to_have_text(POINT_NAMES[point])
    number.fill("")
    canvas = page.get_by_role("application", name=re.compile("^3-D view"))
    canvas.press("Enter")  # selects the point in the middle, like a click there
    expect(page.locator(".probe dd").first).to_have_text(re.compile(r"^Lid \d+ ü$"))
    expect(page.get_by_text("Use from code")).to_be_hidden()  # there is no service to use
    expect(page.get_by_label("Compare with")).to_have_count(0)
    expect(page.get_by_text("Not Found")).to_have_count(0)
    expect(page.get_by_role("link", name="View in AR (USDZ)")).to_have_count(0)  # no Quick Look here
    expect(page.get_by_role("link", name="shapes.usdz", exact=True)).to_be_visible()
    page.context.close()


def test_ar_is_offered_where_quick_look_is_supported(browser: Browser, viewed: str) -> None:
    page = visitor(browser)
    page.add_init_script(QUICK_LOOK)
    page.goto(viewed)
    link = page.get_by_role("link", name="View in AR (USDZ)")
    expect(link).to_be_visible(timeout=DONE)
    # Safari requires rel="ar", an image as the only child, and no download attribute.
    assert link.evaluate("(it) => [it.rel, it.children.length, it.firstChild.tagName, it.hasAttribute('download')]") == [
        "ar", 1, "IMG", False,
    ]  # fmt: skip
    assert httpx.get(link.evaluate("(it) => it.href")).content[:2] == b"PK"
    page.context.close()


def test_the_film_plays_in_step_beside_the_mesh(browser: Browser, viewed: str) -> None:
    page = visitor(browser)
    page.goto(viewed)
    film = page.get_by_role("img", name="The film at the same moment, with its tracks")
    film.wait_for(timeout=DONE)
    expect(page.get_by_role("checkbox", name="Film beside")).to_be_checked()
    following = page.get_by_role("checkbox", name="Camera's view")
    expect(following).to_be_checked()
    following.uncheck()
    expect(following).not_to_be_checked()
    corner = """(it) => {
      const [across, down] = [it.width / 2, it.height / 2];
      const shown = Math.min(it.width / 320, it.height / 180);
      return it.getContext('2d').getImageData(Math.round(across + 150 * shown), Math.round(down + 80 * shown), 1, 1).data[0];
    }"""
    for frame in (1, 5):
        seek(page, frame)
        until(lambda frame=frame: abs(film.evaluate(corner) - GREYS[frame]) < 8)  # type: ignore[misc]
    boxes = "() => [...document.querySelectorAll('.panes > .view')].map((it) => it.getBoundingClientRect().toJSON())"
    # At 1000, the stage is as wide as beside the list of jobs at 1280.
    for width, is_stacked in ((1600, False), (1000, True), (390, True)):
        page.set_viewport_size({"width": width, "height": 900})
        of_film, of_mesh = page.evaluate(boxes)
        assert (of_film["bottom"] <= of_mesh["top"]) == is_stacked
        if is_stacked:
            assert of_film["width"] > 0.95 * page.locator(".panes").evaluate("(it) => it.clientWidth")
            assert of_film["height"] < of_film["width"]
        else:
            assert of_film["height"] == pytest.approx(max(320, of_film["width"] * 180 / 320), rel=0.05)
    if AXE.is_file() or os.environ.get("CI"):
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 844})
            page.evaluate(AXE.read_text())
            found = page.evaluate(
                "axe.run({rules: {'target-size': {enabled: true}}}).then((found) => found.violations)"
            )
            assert [(one["id"], [node["html"][:200] for node in one["nodes"]][:3]) for one in found] == [], width
            assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.context.close()


def off_centre_close_up() -> bytes:
    """The preview of the sheet seen from nearby by turning cameras, left of the middle of the picture of 320×180 pixels."""
    inputs, solution, _ = make_result(rows=21, columns=31, texture=True)
    turned = Rotation.from_rotvec(np.linspace(-0.7, 0.7, len(GREYS))[:, None] * (0.2, 1, 0)).as_matrix()
    camera = replace(
        solution.camera, rotations=turned, scales=np.full(len(GREYS), 0.4), translations=np.full((len(GREYS), 2), (110.0, 100.0)),
        focal=150.0, principal_point=np.array([159.5, 89.5]),
    )  # fmt: skip
    solution = replace(solution, camera=camera)
    tracks = replace(inputs.tracks, points=camera.project(solution.shapes))
    return preview_of(tracks, solution, mesh=inputs.mesh, texture=inputs.texture)


def drawn_part(pane: Locator, *backgrounds: tuple[int, int, int]) -> np.ndarray:
    """Return left, top, right and bottom of what is drawn in a pane over its backgrounds, and the pane's size, pixels."""
    pixels = np.asarray(Image.open(io.BytesIO(pane.screenshot())).convert("RGB"), dtype=int)
    pixels = pixels[EDGE:-EDGE, EDGE:-EDGE]
    drawn = np.all([np.abs(pixels - background).max(axis=2) > 40 for background in backgrounds], axis=0)
    rows, columns = np.nonzero(drawn)
    return np.array([columns.min(), rows.min(), columns.max(), rows.max(), pixels.shape[1], pixels.shape[0]])


@pytest.mark.parametrize("width", [1280, 390])
def test_the_camera_shows_the_mesh_where_the_film_shows_the_object(browser: Browser, viewed: str, width: int) -> None:
    page = visitor(browser)
    page.set_viewport_size({"width": width, "height": 900})
    preview = off_centre_close_up()
    page.route("**/preview.bin", lambda route: route.fulfill(body=preview))
    page.goto(viewed)
    film = page.locator(".panes > .view").first.locator("canvas")
    mesh = page.get_by_role("application", name=re.compile("^3-D view"))
    page.get_by_role("checkbox", name="Mesh over it").check(timeout=DONE)
    page.get_by_label("Colour", exact=True).select_option("plain")
    plain = f"border: 0; border-radius: 0; background: rgb{GREEN}"
    page.evaluate("(style) => document.querySelectorAll('.view').forEach((it) => { it.style.cssText = style; })", plain)
    page.evaluate("document.querySelector('.corner').style.visibility = 'hidden'")
    for frame in (0, 3, 6):
        seek(page, frame)
        grey = (GREYS[frame],) * 3

        def apart(grey: tuple[int, int, int] = grey) -> float:
            drawn = drawn_part(film, grey, GREEN), drawn_part(mesh, GREEN)
            return float(np.abs(drawn[0] - drawn[1]).max())

        until(lambda: apart() <= 2)
    for _ in range(3):
        mesh.press("ArrowRight")
    expect(page.get_by_role("checkbox", name="Camera's view")).not_to_be_checked()
    until(lambda: apart() > 10)
    page.context.close()


def share(url: str, job: str, **body: int) -> tuple[str, datetime]:
    made = httpx.post(f"{url}/v1/jobs/{job}/shares", json=body).json()
    return f"{url}/{made['path']}", datetime.fromisoformat(made["expires_at"])


@pytest.mark.parametrize(
    ("locale", "words"),
    [("de-DE", "%-d. November %Y um 17:00"), pytest.param("en-US", "%B %-d, %Y at 7:00 AM", marks=pytest.mark.long)],
)
def test_share_link_expiry_is_in_local_time(browser: Browser, url: str, finished: str, locale: str, words: str) -> None:
    link, _ = share(url, finished, expires_in=86400)
    zone = {"de-DE": "Europe/Athens", "en-US": "America/Los_Angeles"}[locale]
    page = visitor(browser, locale=locale, timezone_id=zone)
    page.route("**/shares", lambda route: route.fulfill(json=[{"id": "a", "expires_at": "2031-11-20T15:00:00Z"}]))
    page.goto(link)
    until = page.locator(".until")
    expect(until).to_contain_text(datetime(2031, 11, 20).strftime(words))
    expect(until).to_contain_text("The link is valid until")
    page.context.close()


def test_a_share_link_that_expires_while_open_says_so(browser: Browser, url: str, finished: str) -> None:
    link, _ = share(url, finished, expires_in=3600)
    page = visitor(browser, locale="en-GB")
    page.clock.install()
    page.goto(link)
    expect(page.locator(".until")).to_contain_text("The link is valid until")
    expect(page.get_by_role("heading", name="a finished face")).to_be_visible()
    page.clock.fast_forward("01:00:30")
    expect(page.locator(".until")).to_contain_text("This result stays visible until you close or reload the page.")
    expect(page.get_by_role("heading", name="a finished face")).to_be_visible()
    page.context.close()


def test_an_expired_share_link_shows_when_it_expired_and_no_controls(browser: Browser, url: str, finished: str) -> None:
    link, _ = share(url, finished)
    page = visitor(browser, locale="en-GB", timezone_id="Europe/London")
    problem = {
        "title": "Expired share link", "status": 401, "code": "expired_share", "got": "2024-03-05T09:30:00+00:00",
        "detail": "This share link has expired. Ask its sender for a new one.",
    }  # fmt: skip
    page.route("**/v1/**", lambda route: route.fulfill(status=401, json=problem))
    page.goto(link)
    expect(page.get_by_role("heading", name="This result is no longer available")).to_be_visible()
    expect(page.get_by_text("The link expired on 5 March 2024 at 09:30. Ask its sender for a new one.")).to_be_visible()
    for role in ("alert", "textbox", "button"):
        expect(page.get_by_role(role)).to_have_count(0)  # type: ignore[arg-type]
    page.context.close()
