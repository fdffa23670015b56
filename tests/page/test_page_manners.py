"""Keyboard use, no requests to other hosts, and the list of jobs."""

from __future__ import annotations

import re

import httpx
import pytest
from browsing import NEEDS_CHROMIUM, differing_pixels
from paging import DONE, until
from playwright.sync_api import Page, Request, Route, expect

pytestmark = NEEDS_CHROMIUM


@pytest.mark.usefixtures("front")
def test_an_example_is_run_with_the_keyboard_only(page: Page, url: str) -> None:
    called = """() => {
      const it = document.activeElement;
      return it.labels?.[0]?.innerText || it.innerText || it.ariaLabel || "";
    }"""

    def tab_to(name: str, key: str = "Tab", most: int = 60) -> None:
        for _ in range(most):
            page.keyboard.press(key)
            if page.evaluate(called).split("\n")[0].strip() == name:
                return
        pytest.fail(f"the {key} key does not reach {name!r}")

    page.get_by_role("button", name="breathing sphere").wait_for()  # the examples are loaded from the service
    tab_to("breathing sphere")
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Reconstruct")).to_be_focused()
    expect(page.locator("[data-part=tracks]")).to_contain_text("tracks 30 × 500 × 2 float32")
    tab_to("Advanced", "Shift+Tab")
    page.keyboard.press("Enter")
    tab_to("Method")
    page.keyboard.type("pseudo")  # this method with a given number of shapes takes seconds
    tab_to("Basis shapes")
    page.keyboard.type("2")
    tab_to("Reconstruct")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="breathing sphere")).to_be_focused()
    options = httpx.get(f"{url}/v1/jobs/{page.url.partition('job=')[2]}").json()["options"]
    assert (options["method"], options["basis_size"]) == ("pseudo_inverse", 2)
    canvas = page.locator(".view canvas")
    canvas.wait_for(timeout=DONE)
    tab_to("Play")
    page.keyboard.press("Space")
    until(lambda: float(page.get_by_role("slider", name="Frame").input_value()) > 1)
    page.keyboard.press("Space")
    page.keyboard.press("Shift+Tab")
    before = canvas.screenshot()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    page.wait_for_timeout(300)
    assert differing_pixels(before, canvas.screenshot()) > 0.01


def test_the_focus_ring_of_a_jobs_heading_covers_nothing(page: Page, url: str, finished: str) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(url)
    page.get_by_role("heading", name="Jobs").wait_for()
    page.keyboard.press("Tab")
    page.evaluate("(id) => (location.hash = `job=${id}`)", finished)
    heading = page.get_by_role("heading", name="a finished face")
    expect(heading).to_be_focused()
    expect(page.locator(".detail-head .status")).to_have_text("Done")
    ring, chip = page.evaluate("""() => {
      const [heading, chip] = ['.detail-head h2', '.detail-head .status'].map((it) => document.querySelector(it));
      const { outlineOffset, outlineWidth } = getComputedStyle(heading);
      const ring = heading.getBoundingClientRect().bottom + parseFloat(outlineOffset) + parseFloat(outlineWidth);
      return [ring, chip.getBoundingClientRect().top];
    }""")
    assert heading.evaluate("(it) => it.matches(':focus-visible')")
    assert ring <= chip


def test_no_request_leaves_the_host(page: Page, url: str, finished: str) -> None:
    asked: list[str] = []

    def note(request: Request) -> None:
        asked.append(request.url)

    page.context.on("request", note)
    for address in (f"#job={finished}", "docs"):
        answer = page.goto(f"{url}/{address}")
        if address == "docs":
            page.get_by_text("/v1/jobs", exact=True).first.wait_for()
        page.wait_for_timeout(1500)
        assert answer is not None
        assert answer.headers["content-security-policy"].startswith("default-src 'self';")
    page.context.remove_listener("request", note)
    assert len(asked) > 10
    assert [address for address in asked if not address.startswith(f"{url}/")] == []


def test_the_list_scrolls_to_the_job_that_is_shown(page: Page, url: str, finished: str) -> None:
    answer = httpx.get(f"{url}/v1/jobs").json()
    own = next(job for job in answer["jobs"] if job["id"] == finished)
    listed = {"jobs": [*({**own, "id": f"{number:032x}"} for number in range(30)), own], "next": None}
    waiting: list[Route] = []
    page.route(re.compile(r"/v1/jobs(\?.*)?$"), lambda route: waiting.append(route))
    page.goto(f"{url}/#job={finished}")
    shown = page.locator(".jobs a[aria-current]")
    expect(shown).to_be_in_viewport()  # alone, before the list arrives
    page.route(re.compile(r"/v1/jobs(\?.*)?$"), lambda route: route.fulfill(json=listed))
    for route in waiting:
        route.fulfill(json=listed)
    expect(page.locator(".jobs li")).to_have_count(31)
    expect(shown).to_be_in_viewport(ratio=0.9)
