"""Answers that arrive after the user has moved on: to another job, another comparison, or a switch turned off again."""

from __future__ import annotations

import contextlib
import re
from typing import Any

import httpx
from browsing import NEEDS_CHROMIUM, differing_pixels, heard
from paging import DONE, record, until
from playwright.sync_api import Error, Page, Route, expect

pytestmark = NEEDS_CHROMIUM

OTHER = "f" * 32


def release(held: list[Route]) -> None:
    """Let held requests continue; the page may have given them up."""
    for route in held:
        with contextlib.suppress(Error):
            route.continue_()


def only(page: Page, job: dict[str, Any]) -> None:
    """Answer with this record of a job, also in the list, which is the job's only one."""
    page.route(f"**/v1/jobs/{job['id']}", lambda route: route.fulfill(json=job))
    page.route(re.compile(r"/v1/jobs\?"), lambda route: route.fulfill(json={"jobs": [job], "next": None}))


def test_a_job_left_while_its_film_loads_opens_no_viewer(page: Page, url: str, finished: str) -> None:
    own = record(url, finished)
    film = {**own["artifacts"][0], "name": "film_frames.bin"}
    held: list[Route] = []
    own["artifacts"].append(film)
    only(page, own)
    page.route("**/film_frames.bin", lambda route: held.append(route))
    page.goto(f"{url}/#job={finished}")
    heard(page, lambda: held != [])
    page.wait_for_timeout(1000)  # until the mesh has arrived
    page.evaluate("""() => {
      const { getContext } = HTMLCanvasElement.prototype;
      HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        if (kind.startsWith("webgl")) document.body.dataset.opened = kind;
        return getContext.call(this, kind, ...rest);
      };
      location.hash = "";
    }""")
    expect(page.get_by_role("article")).to_have_count(0)
    page.wait_for_timeout(500)
    assert page.evaluate("document.body.dataset.opened ?? null") is None


def test_a_long_name_of_another_job_does_not_widen_the_controls(page: Page, url: str, finished: str) -> None:
    fake = record(url, finished, id=OTHER, name="x" * 200)
    page.route(re.compile(r"/v1/jobs\?"), lambda route: route.fulfill(json={"jobs": [fake], "next": None}))
    page.goto(f"{url}/#job={finished}")
    compare = page.get_by_label("Compare with")
    expect(compare.locator("option")).to_have_count(2, timeout=DONE)
    right = "(it) => it.getBoundingClientRect().right"
    assert compare.evaluate(right) <= page.locator(".tools").evaluate(right)


def test_only_what_is_still_wanted_is_added_to_the_viewer(page: Page, url: str, finished: str) -> None:
    fake = record(url, finished, id=OTHER, name="the other")
    page.route(re.compile(r"/v1/jobs\?"), lambda route: route.fulfill(json={"jobs": [fake], "next": None}))
    its_preview = re.compile(rf"/{OTHER}/artifacts/preview.bin")
    raw = httpx.get(f"{url}/v1/jobs/{finished}/artifacts/preview.bin").content
    held: list[Route] = []
    page.route(its_preview, lambda route: held.append(route))
    page.goto(f"{url}/#job={finished}")
    page.locator(".view canvas").wait_for(timeout=DONE)
    compare = page.get_by_label("Compare with")
    compare.select_option(label="the other")
    heard(page, lambda: held != [])
    compare.select_option("")
    page.unroute(its_preview)
    page.route(its_preview, lambda route: route.fulfill(body=raw))
    for route in held:
        with contextlib.suppress(Error):
            route.fulfill(body=raw)
    page.wait_for_timeout(700)
    expect(page.locator(".view.other")).to_have_count(0)

    held.clear()
    own_preview = f"**/{finished}/artifacts/preview.bin"
    page.route(own_preview, lambda route: held.append(route))
    beside = page.get_by_role("checkbox", name="Tracks beside")
    beside.check()
    heard(page, lambda: held != [])
    beside.uncheck()
    page.unroute(own_preview)
    release(held)
    page.wait_for_timeout(500)
    expect(page.locator(".view.film")).to_have_count(0)

    wires = page.get_by_role("checkbox", name="Wireframe")
    wires.check()
    compare.select_option(label="the other")
    other = page.locator(".view.other canvas")
    expect(page.get_by_text("The colours show where this job's error is larger")).to_be_visible()
    page.wait_for_timeout(300)
    wired = other.screenshot()
    wires.uncheck()
    until(lambda: differing_pixels(wired, other.screenshot()) > 0.005)


def test_the_answer_to_a_deletion_does_not_leave_a_job_opened_since(page: Page, url: str, finished: str) -> None:
    held: list[Route] = []

    def answer(route: Route) -> None:
        if route.request.method == "DELETE":
            held.append(route)
        else:
            route.continue_()

    page.route(f"**/v1/jobs/{finished}", answer)
    for leaves in (True, False):
        page.goto(f"{url}/#job={finished}")
        page.get_by_role("button", name="Delete").click()
        page.get_by_role("button", name="Delete permanently?").click()
        heard(page, lambda: held != [])
        if leaves:
            page.evaluate("(id) => (location.hash = `job=${id}`)", OTHER)
            expect(page.get_by_role("heading", name="This job does not exist")).to_be_visible()
        held.pop().fulfill(status=204)
        if leaves:
            page.wait_for_timeout(300)
            assert page.url.endswith(OTHER)
    expect(page.get_by_role("article")).to_have_count(0)
    expect(page.locator("summary", has_text="New reconstruction")).to_be_focused()


def test_a_job_tried_again_is_opened_and_has_the_same_files(page: Page, url: str, finished: str) -> None:
    again = record(url, finished, id=OTHER, status="queued", name="again")
    only(page, record(url, finished, status="cancelled"))
    page.route(f"**/v1/jobs/{finished}/retry", lambda route: route.fulfill(status=202, json=again))
    page.route(f"**/v1/jobs/{OTHER}", lambda route: route.fulfill(json=again))
    page.goto(url)
    page.evaluate(
        "(id) => sessionStorage.setItem('pliant-sent', JSON.stringify({ [id]: { tracks: 'walk.npz' } }))", finished
    )
    page.evaluate("(id) => (location.hash = `job=${id}`)", finished)
    page.get_by_role("button", name="Try again").click()
    expect(page.get_by_role("heading", name="again")).to_be_visible()
    assert page.url.endswith(OTHER)
    assert page.evaluate("(id) => JSON.parse(sessionStorage.getItem('pliant-sent'))[id].tracks", OTHER) == "walk.npz"


def test_a_status_read_aloud_does_not_count_seconds(page: Page, url: str, finished: str) -> None:
    progress = {"stage": "finish", "fraction": 0.5, "updated_at": "2026-05-04T09:30:00Z", "seconds_left": 40.0}
    running = record(url, finished, status="running", artifacts=[], progress=progress)
    only(page, running)
    page.route(f"**/v1/jobs/{finished}/events", lambda route: route.fulfill(status=404, json={}))
    page.goto(f"{url}/#job={finished}")
    expect(page.locator(".standing")).to_have_text(re.compile(r"Finishing; about \d+ seconds left\."))
    expect(page.locator(".standing").get_by_role("status")).to_have_text("Finishing")
