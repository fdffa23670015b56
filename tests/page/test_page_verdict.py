"""The verdict in the page: above the viewer and in the list, absent for jobs without one."""

from __future__ import annotations

import os
import re
from typing import Any

import httpx
import pytest
from browsing import AXE, NEEDS_CHROMIUM
from paging import DONE
from playwright.sync_api import Page, Route, expect
from pliant.solver.evaluation.trust import Trust

pytestmark = NEEDS_CHROMIUM

TRUST = "Expected error about 3 % of the object's size; depth rests on 9° of turn."
REASONS = ["The camera turns by 9°. Turn by 30° or more.", "12 % of the observations are hidden."]


def judge(page: Page, url: str, id: str, **fields: Any) -> None:
    """Serve the job's record with these fields, so that not every verdict needs its own solve."""
    record = {**httpx.get(f"{url}/v1/jobs/{id}").json(), **fields}
    record = {name: value for name, value in record.items() if value is not ...}

    def listed(route: Route) -> None:
        # Not `route.fetch`, which fails once the page has navigated away.
        jobs = httpx.get(route.request.url).json()
        jobs["jobs"] = [record if job["id"] == id else job for job in jobs["jobs"]]
        route.fulfill(json=jobs)

    page.route(f"**/v1/jobs/{id}", lambda route: route.fulfill(json=record))
    page.route("**/v1/jobs?*", listed)
    page.route("**/v1/jobs", listed)


@pytest.mark.parametrize(
    ("verdict", "words"), [("good", "Good"), ("with_care", "Use with care"), ("do_not_use", "Do not use")]
)
def test_the_verdict_is_above_the_viewer_and_in_the_list(
    page: Page, url: str, finished: str, verdict: str, words: str
) -> None:
    reasons = [] if verdict == "good" else REASONS
    judge(page, url, finished, verdict=verdict, verdict_reasons=reasons, trust_sentence=TRUST, sentence="Converged.")
    report = httpx.get(f"{url}/v1/jobs/{finished}/artifacts/report.json").json()
    report |= {"expected_error": 0.03, "expected_error_interval": [0.02, 0.051], "turn_degrees": 62.7}
    report |= {"degrees_per_frame": 2.13, "deformation_per_frame": 0.0124, "held_out_error": 0.0004}
    page.route("**/report.json", lambda route: route.fulfill(json=report))
    page.goto(f"{url}/#job={finished}")
    box = page.get_by_role("region", name="Verdict")
    expect(box).to_contain_text(words)
    expect(box).to_contain_text(TRUST)
    expect(box).to_contain_text(
        "Likely range of the true error: 2.0 % to 5.1 % (correct in three of four test sequences; the error can be"
    )
    figures = {
        "Turn between the most different views": "63°",
        "Turn per frame (median)": "2.1°",
        "Change of shape per frame (median)": "1.2 % of the object's size",
        "Prediction error of held-out observations (median)": "below 0.1 % of the object's size",
    }
    box.get_by_text("Figures behind the verdict").click()
    expect(box.get_by_role("term")).to_have_text(list(figures))
    expect(box.get_by_role("definition")).to_have_text(list(figures.values()))
    expect(box.locator("svg")).to_be_visible()
    expect(box.get_by_role("listitem")).to_have_text(reasons)
    expect(box).to_contain_text("Solver: Converged.")
    expect(page.get_by_role("article").get_by_text("Converged.")).to_have_count(1)  # only beside the verdict
    expect(page.get_by_role("link", name=re.compile("a finished face(?!:)"))).to_contain_text(words)
    canvas = page.locator(".view canvas")
    canvas.wait_for(timeout=DONE)
    above, below = box.bounding_box(), canvas.bounding_box()
    assert above is not None
    assert below is not None
    assert above["y"] + above["height"] <= below["y"]


def test_a_good_verdict_without_an_error_estimate_does_not_read_like_a_plain_one(
    page: Page, url: str, finished: str
) -> None:
    sentence = Trust("good", (), None, None, turn_degrees=63, residual=0.001, hidden=0.1).sentence
    judge(page, url, finished, verdict="good", verdict_reasons=[], trust_sentence=sentence, sentence="Converged.")
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(f"{url}/#job={finished}")
    badge = page.get_by_role("region", name="Verdict").locator(".badge")
    expect(badge).to_have_text("Good, error not estimated")
    expect(page.get_by_role("region", name="Verdict")).to_contain_text("Depth rests on 63° of turn.")
    expect(page.get_by_role("region", name="Verdict")).not_to_contain_text("The error is not estimated")
    page.get_by_role("heading", name="Jobs").click()
    expect(page.locator(f'a[href="#job={finished}"]')).to_contain_text("Good, error not estimated")
    colour = "(it) => getComputedStyle(it).backgroundColor"
    unestimated = badge.evaluate(colour)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    if AXE.is_file() or os.environ.get("CI"):
        page.evaluate(AXE.read_text())
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
            found = page.evaluate("axe.run({include: ['.verdict', '.jobs']}).then((found) => found.violations)")
            assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found] == [], scheme
    page.emulate_media(color_scheme="light", reduced_motion="reduce")
    page.goto("about:blank")
    page.unroute_all()
    judge(page, url, finished, verdict="good", verdict_reasons=[], trust_sentence=TRUST)
    page.goto(f"{url}/#job={finished}")
    expect(badge).to_have_text("Good")
    assert badge.evaluate(colour) != unestimated


def test_a_job_without_a_verdict_shows_none(page: Page, url: str, finished: str) -> None:
    judge(page, url, finished, verdict=..., verdict_reasons=..., trust_sentence=..., sentence="Converged.")
    page.goto(f"{url}/#job={finished}")
    expect(page.get_by_text("Converged. The quality of this result was not assessed.")).to_be_visible()
    expect(page.get_by_role("region", name="Verdict")).to_have_count(0)
    link = page.locator(f'a[href="#job={finished}"]')  # a search by name would also match jobs derived from it
    expect(link).to_contain_text("Done")
    expect(link.locator(".badge")).to_have_count(0)


def test_verdict_badges_are_accessible_in_both_themes(page: Page, url: str, finished: str) -> None:
    if not AXE.is_file() and not os.environ.get("CI"):
        pytest.skip("axe-core is not installed; say `make page`")
    for width, verdict in ((1280, "good"), (390, "with_care"), (390, "do_not_use")):
        page.set_viewport_size({"width": width, "height": 844})
        page.goto("about:blank")
        page.unroute_all()
        judge(page, url, finished, verdict=verdict, verdict_reasons=REASONS, trust_sentence=TRUST)
        page.goto(f"{url}/#job={finished}")
        page.get_by_role("region", name="Verdict").wait_for()
        expect(page.locator(".verdict .badge")).to_be_in_viewport(ratio=1)
        if width == 390:
            page.get_by_role("heading", name="Jobs").click()
        page.evaluate(AXE.read_text())
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
            # The rest of the page is checked in test_page_states.py.
            found = page.evaluate("axe.run({include: ['.verdict', '.jobs']}).then((found) => found.violations)")
            assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found] == [], (verdict, scheme)
            if folder := os.environ.get("PLIANT_SCREENSHOTS"):
                page.screenshot(path=f"{folder}/verdict-{verdict}-{width}-{scheme}.png")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
