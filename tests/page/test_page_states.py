"""Accessibility, overflow and targets of 24 px in every state that a first-time user meets.

PLIANT_SCREENSHOTS=FOLDER also saves a screenshot of each state, in both widths and themes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection

import httpx
import pytest
from browsing import AXE, NEEDS_CHROMIUM
from paging import DONE, TRACKS, drop
from playwright.sync_api import Page, Route, expect

pytestmark = NEEDS_CHROMIUM

RUN = "axe.run({rules: {'target-size': {enabled: true}}}).then((found) => found.violations)"
"""Includes the WCAG 2.2 rule that axe disables by default: targets of 24 px, or as much space around them."""

VIEWS = ((390, "light"), (1280, "dark"))
MORE_VIEWS = ((390, "dark"), (1280, "light"))
ENLARGED = 195
"""Width of a phone's page at 200 %."""

Check = Callable[..., None]
VIDEO = b"\0\0\0\x18ftypmp42" + bytes(600)


@pytest.fixture
def check(page: Page) -> Check:
    if not AXE.is_file() and not os.environ.get("CI"):
        pytest.skip("axe-core is not installed; say `make page`")

    def checked(state: str, *, accepted: Collection[str] = (), enlarged: bool = True) -> None:
        page.evaluate(AXE.read_text())
        folder = os.environ.get("PLIANT_SCREENSHOTS")
        for width, scheme in (*VIEWS, *(MORE_VIEWS if folder else ())):
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
            page.set_viewport_size({"width": width, "height": 800 if width == 1280 else 844})
            if folder:
                page.screenshot(path=f"{folder}/{state}-{width}-{scheme}.png")
            found = page.evaluate(RUN)
            nodes = [
                (one["id"], [node["html"][:200] for node in one["nodes"]][:3])
                for one in found
                if one["id"] not in accepted
            ]
            assert nodes == [], (state, width, scheme)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, (state, width)
        if enlarged:
            page.set_viewport_size({"width": ENLARGED, "height": 422})
            assert page.evaluate("document.documentElement.scrollWidth") <= ENLARGED, (state, ENLARGED)

    return checked


@pytest.mark.usefixtures("front")
def test_the_submission_form_is_accessible(page: Page, url: str, small: dict[str, bytes], check: Check) -> None:
    page.get_by_role("button", name="breathing sphere").wait_for()
    page.get_by_text("Files to write", exact=True).click()
    read_out = page.locator("#side").aria_snapshot().splitlines()
    assert [line for line in read_out if line.endswith(("text: +", "text: –"))] == []
    check("first-view")
    drop(page, {name: small[name] for name in (TRACKS, "mesh.npz", "truth.npz")})
    expect(page.locator("[data-part=tracks]")).to_contain_text("tracks 10 × 300 × 2 float64")
    page.get_by_role("img", name="Sample of the tracks").wait_for()
    check("dropped-files")
    page.reload()
    page.get_by_role("button", name="breathing sphere").wait_for()
    page.get_by_label("Tracks", exact=True).set_input_files(
        {"name": "holiday.npz", "mimeType": "application/octet-stream", "buffer": VIDEO}
    )
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.locator("[data-part=tracks]").get_by_role("alert")).to_contain_text(
        "Expected point tracks, got a film (mp4 or mov).Choose it under Film instead; its points are tracked for you."
    )
    check("refused-video")


def test_unfinished_jobs_are_accessible(page: Page, url: str, long_job: Callable[[str], str], check: Check) -> None:
    id = long_job("running")
    behind = long_job("behind it")
    page.goto(f"{url}/#job={id}")
    page.get_by_text("left.").first.wait_for(timeout=DONE)
    check("running")
    page.goto(f"{url}/#job={behind}")
    expect(page.get_by_text("Next in the queue.")).to_be_visible()
    check("queued")
    page.get_by_role("button", name="Cancel").click()
    words = "This job was cancelled before it finished, so it has no result. “Try again” runs it with the same files."
    expect(page.get_by_text(words, exact=True)).to_be_visible()
    check("cancelled")


def test_finished_and_shared_jobs_are_accessible(page: Page, url: str, finished: str, check: Check) -> None:
    page.goto(f"{url}/#job={finished}")
    page.locator(".view canvas").wait_for(timeout=DONE)
    page.get_by_role("region", name="Verdict").wait_for()
    check("done")
    link = httpx.post(f"{url}/v1/jobs/{finished}/shares", json={}).json()["path"]
    page.goto("about:blank")  # otherwise only the part after # changes, and the page reloads itself
    page.goto(f"{url}/{link.removeprefix('/')}")
    page.get_by_text("This is a shared, read-only result.").wait_for()
    page.locator(".view canvas").wait_for(timeout=DONE)
    expect(page.get_by_label("Compare with")).to_have_count(0)
    expect(page.get_by_text("Use a token for anything else")).to_have_count(0)
    check("shared")


def test_missing_locked_and_expired_pages_are_accessible(page: Page, url: str, finished: str, check: Check) -> None:
    page.goto(f"{url}/#job=0123456789abcdef")
    expect(page.get_by_role("heading", name="This job does not exist")).to_be_visible()
    check("deleted-job")
    problem = {"title": "Token required", "status": 401, "detail": "Send a header.", "code": "unauthorized"}

    def guarded(route: Route) -> None:
        route.fulfill(status=401, content_type="application/problem+json", body=json.dumps(problem))

    page.route("**/v1/**", guarded)
    page.goto(url)
    expect(page.get_by_role("alert").first).to_contain_text("This service needs a token")
    check("token-gate")
    ended = problem | {"code": "expired_share", "got": "2024-03-05T09:30:00Z"}
    page.route("**/v1/**", lambda route: route.fulfill(status=401, json=ended))
    page.goto("about:blank")
    page.goto(f"{url}/#share=share.{finished}.secret")
    expect(page.get_by_role("heading", name="This result is no longer available")).to_be_visible()
    check("share-ended")


def test_the_guide_and_the_api_reference_are_accessible(page: Page, url: str, check: Check) -> None:
    page.goto(f"{url}/guide")
    check("guide")
    page.goto(f"{url}/docs")
    page.get_by_role("heading", name="Pliant 0").wait_for()
    # Swagger UI puts a link, one line of text high, inside the button of each operation.
    check("reference", accepted={"nested-interactive", "target-size"})


def test_the_api_reference_fits_a_phone(page: Page, url: str) -> None:
    """With an operation and its form open, also at 200 %, and with the dialog for a token."""

    def fits() -> None:
        for width in (390, ENLARGED):
            page.set_viewport_size({"width": width, "height": 844})
            assert page.evaluate("document.documentElement.scrollWidth") <= width

    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(f"{url}/docs")
    page.get_by_role("button", name="POST /v1/jobs Submit a job").click()
    page.get_by_role("button", name="Try it out").click()
    page.get_by_role("button", name="Execute").wait_for()
    expect(page.get_by_text("Unauthorized", exact=True)).to_be_visible()
    expect(page.get_by_text("No links").first).to_be_hidden()
    fits()
    page.get_by_role("button", name="Authorize").click()
    expect(page.get_by_text("Available authorizations")).to_be_visible()
    fits()
