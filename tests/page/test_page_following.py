"""Following jobs in the page: running, queued and other jobs; outages; tokens."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import httpx
from browsing import NEEDS_CHROMIUM, heard
from paging import DONE, refresh, steps_of, until
from playwright.sync_api import Page, Route, expect
from pliant.client import Client
from pliant.solver import gallery

pytestmark = NEEDS_CHROMIUM


def test_a_running_job_survives_a_reload_and_can_be_cancelled(
    page: Page, url: str, long_job: Callable[[str], str]
) -> None:
    id = long_job("a long job")
    waiting = long_job("a job behind it")
    page.goto(f"{url}/#job={id}")
    objective = page.get_by_role("img", name=re.compile("^Objective from"))
    objective.wait_for(timeout=DONE)
    until(lambda: steps_of(objective) >= 4)
    page.reload()
    # Events from before the reload are sent again, so the curve is complete.
    objective.wait_for()
    until(lambda: steps_of(objective) >= 4)
    expect(page.get_by_text(re.compile(r"reweighting \d+[;.]"))).to_be_visible()

    page.get_by_role("link", name="a job behind it").click()
    expect(page.get_by_text("Next in the queue.")).to_be_visible()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("article").get_by_text("Cancelled", exact=True)).to_be_visible()
    page.get_by_role("button", name="Try again").click()
    expect(page.get_by_text("Next in the queue.")).to_be_visible()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("article").get_by_text("Cancelled", exact=True)).to_be_visible()
    page.get_by_role("link", name="a long job").click()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("article").get_by_text("Cancelled", exact=True)).to_be_visible(timeout=30_000)
    assert httpx.get(f"{url}/v1/jobs/{id}").json()["status"] == "cancelled"

    page.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Delete permanently?").click()
    expect(page.get_by_role("link", name="a long job")).to_have_count(0)
    assert httpx.get(f"{url}/v1/jobs/{id}").status_code == 404
    assert httpx.get(f"{url}/v1/jobs/{waiting}").json()["status"] == "cancelled"


def test_the_list_follows_a_running_job_that_is_not_shown(
    page: Page, url: str, finished: str, long_job: Callable[[str], str]
) -> None:
    page.goto(f"{url}/#job={finished}")
    with page.expect_request(re.compile(r"/events$"), timeout=DONE):
        long_job("a job beside it")
        refresh(page)
    row = page.get_by_role("link", name="a job beside it")
    expect(row).to_contain_text(re.compile(r"Running, \d+"), timeout=DONE)
    # With requests for the list blocked, only events can move the bar.
    page.route(re.compile(r"/v1/jobs\?"), lambda route: route.abort())
    before = float(row.get_by_role("progressbar", include_hidden=True).get_attribute("value") or 0)
    until(lambda: float(row.get_by_role("progressbar", include_hidden=True).evaluate("(it) => it.value")) > before)


def test_a_job_that_is_deleted_elsewhere_is_called_deleted(page: Page, url: str) -> None:
    with Client(url) as client:
        job = client.submit(gallery.face(6, 40).tracks.points, name="a job to delete", options={"prior": "smooth"})
        job.wait(timeout=120, load=False)
        page.goto(f"{url}/#job={job.id}")
        page.locator(".view canvas").wait_for(timeout=30_000)
        job.delete()
    refresh(page)
    expect(page.get_by_role("alert")).to_contain_text("This job was deleted.", timeout=20_000)
    expect(page.get_by_role("link", name="a job to delete")).to_have_count(0)
    expect(page.get_by_role("article").get_by_role("button", name="Delete")).to_have_count(0)
    expect(page.locator(".view canvas")).to_be_visible()  # what was loaded stays


def test_an_outage_and_its_end_are_reported(page: Page, url: str, finished: str) -> None:
    page.route("**/v1/**", lambda route: route.abort())
    page.goto(f"{url}/#job={finished}")
    expect(page.get_by_role("alert").first).to_contain_text("The service does not answer.")
    page.unroute_all()
    refresh(page)
    page.locator(".view canvas").wait_for(timeout=30_000)
    expect(page.get_by_role("alert")).to_have_count(0, timeout=15_000)


def test_a_token_is_requested_once_and_sent_with_every_request(page: Page, url: str, finished: str) -> None:
    def guarded(route: Route) -> None:
        if route.request.headers.get("authorization") == "Bearer a-token":
            route.continue_()
        else:
            problem = {"title": "Token required", "status": 401, "detail": "Send a token.", "code": "unauthorized"}
            problem["field"] = "Authorization"
            route.fulfill(status=401, content_type="application/problem+json", body=json.dumps(problem))

    page.route("**/v1/**", guarded)
    page.goto(f"{url}/#job={finished}")
    expect(page.get_by_role("alert").first).to_contain_text("This service needs a token")
    for place in (page.get_by_role("region", name="Problems"), page.get_by_role("article")):
        expect(place.get_by_role("alert")).to_contain_text("Paste the token you were given;")
        expect(place.get_by_role("alert")).not_to_contain_text("Authorization")
    page.get_by_label("Token").fill("a-token")
    page.get_by_role("button", name="Use", exact=True).click()
    page.locator(".view canvas").wait_for(timeout=30_000)
    expect(page.get_by_role("alert")).to_have_count(0)
    with page.expect_download() as download:
        page.get_by_role("link", name="report.json").click()
    assert "metrics" in json.loads(Path(download.value.path()).read_text())


def test_a_token_can_be_replaced_and_one_that_no_header_carries_is_not_taken(page: Page, url: str) -> None:
    sent: list[str | None] = []

    def guarded(route: Route) -> None:
        sent.append(route.request.headers.get("authorization"))
        if sent[-1] in ("Bearer one", "Bearer two"):
            route.continue_()
            return
        problem = {"title": "Token required", "status": 401, "detail": "Send a token.", "code": "unauthorized"}
        route.fulfill(status=401, content_type="application/problem+json", body=json.dumps(problem))

    page.route("**/v1/**", guarded)
    page.goto(url)
    token, use = page.get_by_label("Token"), page.get_by_role("button", name="Use", exact=True)
    another = page.get_by_role("button", name="Token", exact=True)
    expect(another).to_be_hidden()
    token.fill("pliant_…")
    use.click()
    assert "only ASCII letters" in token.evaluate("(it) => it.validationMessage")
    token.fill("one")
    use.click()
    expect(token).to_have_count(0)
    another.click()
    expect(token).to_be_focused()
    refresh(page)
    heard(page, lambda: sent.count("Bearer one") > 3)  # answers do not close a form that a person opened
    token.fill("two")
    use.click()
    expect(token).to_have_count(0)
    heard(page, lambda: sent[-1] == "Bearer two")
    another.click()
    page.get_by_role("button", name="Forget the token").click()
    expect(page.get_by_role("alert").first).to_contain_text("This service needs a token")
    expect(another).to_be_hidden()
    assert set(sent) == {None, "Bearer one", "Bearer two"}
