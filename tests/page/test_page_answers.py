"""Answers of a proxy, answers cut off, and refusals: what the page shows, keeps and requests again."""

from __future__ import annotations

import json
import re
import time
from typing import Any

import httpx
import pytest
from browsing import NEEDS_CHROMIUM, heard
from paging import TRACKS, choose, record, refresh, until
from playwright.sync_api import Dialog, Page, Route, expect

pytestmark = NEEDS_CHROMIUM

LIST = re.compile(r"/v1/jobs\?")
HTML = {"content_type": "text/html", "body": "<html><h1>Bad gateway</h1></html>"}


def problem(status: int, code: str, **rest: Any) -> dict[str, Any]:
    return {
        "status": status,
        "json": {"title": "Refused", "status": status, "detail": "It is so.", "code": code, **rest},
    }


def test_a_job_is_followed_through_unreadable_answers(page: Page, url: str, finished: str) -> None:
    answers: list[dict[str, Any]] = [{"status": 200, **HTML}, {"status": 502, **HTML}, {"body": '{"id": "cut o'}]

    def answer(route: Route) -> None:
        if answers:
            route.fulfill(**answers.pop(0))
        else:
            route.continue_()

    page.route(f"**/v1/jobs/{finished}", answer)
    page.goto(f"{url}/#job={finished}")
    expect(page.get_by_role("article").get_by_role("alert")).to_contain_text("cannot be read")
    expect(page.get_by_role("heading", name="a finished face")).to_be_visible()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_the_token_form_appears_after_other_errors_and_keeps_a_half_typed_token(
    page: Page, url: str, finished: str
) -> None:
    # With an unfinished job, the list is refreshed every two seconds.
    waiting = {"jobs": [record(url, finished, status="queued")], "next": None}
    sent: list[str | None] = []
    answers: dict[str, dict[str, Any]] = {
        "fine": {"json": waiting},
        "unreadable": {"status": 200, **HTML},
        "locked": problem(401, "unauthorized"),
        "rejected": problem(401, "invalid_token", field="Authorization"),
        "busy": problem(503, "queue_unavailable", retryable=True),
    }
    now = "fine"

    def answer(route: Route) -> None:
        sent.append(route.request.headers.get("authorization"))
        route.fulfill(**answers[now])

    page.route(LIST, answer)
    page.goto(url)
    expect(page.locator(".jobs li")).to_have_count(1)
    alert, token = page.locator("#trouble").get_by_role("alert"), page.get_by_label("Token")
    now = "unreadable"
    refresh(page)
    expect(alert).to_contain_text("cannot be read")
    now = "locked"
    refresh(page)
    expect(alert).to_contain_text("needs a token")
    alert.evaluate("(it) => (it.dataset.seen = 'yes')")
    token.fill("half")
    before = len(sent)
    for _ in range(2):
        refresh(page)
    heard(page, lambda: len(sent) > before + 1)
    expect(alert).to_have_attribute("data-seen", "yes")  # announced once
    now = "rejected"
    refresh(page)
    expect(alert).to_contain_text("invalid_token")
    expect(alert).not_to_contain_text("Authorization")
    now = "busy"
    refresh(page)
    expect(alert).to_contain_text("queue_unavailable")
    expect(token).to_have_value("half")
    expect(token).to_be_focused()
    now = "locked"
    page.get_by_role("button", name="Use", exact=True).click()
    forget = page.get_by_role("button", name="Forget the rejected token")
    forget.click()
    expect(forget).to_have_count(0)
    expect(token).to_be_visible()
    heard(page, lambda: sent[-1] is None)
    assert "Bearer half" in sent
    now = "fine"
    refresh(page)
    expect(token).to_have_count(0)
    expect(alert).to_have_count(0)


def test_a_job_in_the_list_is_followed_again_after_a_refusal(page: Page, url: str, finished: str) -> None:
    running = record(url, finished, status="running")
    asked: list[str] = []

    def answer(route: Route) -> None:
        asked.append(route.request.url)
        route.fulfill(**problem(403, "forbidden"))

    page.route(LIST, lambda route: route.fulfill(json={"jobs": [running], "next": None}))
    page.route(f"**/v1/jobs/{finished}", answer)
    page.goto(url)
    heard(page, lambda: len(asked) > 0)
    refresh(page)
    heard(page, lambda: len(asked) > 1)


def test_older_jobs_can_be_listed_while_an_old_job_is_shown(page: Page, url: str, finished: str) -> None:
    newest = record(url, finished, id="a" * 32, name="newest", created_at="2099-02-01T00:00:00Z")
    middle = record(url, finished, id="b" * 32, name="middle", created_at="2099-01-01T00:00:00Z")
    refused = [True]

    def answer(route: Route) -> None:
        if "cursor" not in route.request.url:
            route.fulfill(json={"jobs": [newest], "next": "more"})
        elif refused.pop() if refused else False:
            route.fulfill(**problem(503, "queue_unavailable"))
        else:
            route.fulfill(json={"jobs": [middle], "next": None})

    page.route(LIST, answer)
    page.goto(f"{url}/#job={finished}")
    expect(page.locator(".job-name")).to_have_text(["newest", "a finished face"])
    older = page.get_by_role("button", name="Older jobs")
    older.click()
    expect(page.locator("#side").get_by_role("alert")).to_contain_text("It is so.")
    older.click()
    expect(page.locator(".job-name")).to_have_text(["newest", "middle", "a finished face"])
    expect(older).to_be_hidden()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_refused_download_is_explained_beside_its_link(page: Page, url: str, finished: str) -> None:
    usdz = {"name": "shapes.usdz", "bytes": 1, "sha256": "0", "description": "", "media_type": "model/vnd.usdz+zip"}
    own = record(url, finished)
    own["artifacts"].append(usdz)
    page.route(f"**/v1/jobs/{finished}", lambda route: route.fulfill(json=own))
    page.route(LIST, lambda route: route.fulfill(json={"jobs": [own], "next": None}))
    page.goto(url)
    page.evaluate("() => { DOMTokenList.prototype.supports = (word) => word === 'ar'; }")
    page.evaluate("(id) => (location.hash = `job=${id}`)", finished)
    link = page.get_by_role("link", name="View in AR (USDZ)")
    link.wait_for(timeout=40_000)
    until(lambda: link.get_by_role("img").evaluate("(it) => it.naturalWidth > 0"))
    page.evaluate("sessionStorage.setItem('pliant-token', 'any')")
    page.route("**/artifacts/**", lambda route: route.fulfill(**problem(410, "expired")))
    for refused in (link, page.get_by_role("link", name="report.json")):
        for _ in range(2):
            refused.click()
            expect(refused.locator("xpath=following-sibling::*[@role='alert']")).to_have_count(1)


def test_a_repeated_submission_keeps_its_key_until_the_service_has_answered(
    page: Page, url: str, small: dict[str, bytes]
) -> None:
    keys: list[str] = []
    answers = [None, {"status": 504, **HTML}, problem(422, "invalid_option"), problem(422, "invalid_option")]

    def answer(route: Route) -> None:
        keys.append(route.request.headers["idempotency-key"])
        if (given := answers[len(keys) - 1]) is not None:
            route.fulfill(**given)

    page.goto(url)
    page.evaluate("""() => {
      const send = XMLHttpRequest.prototype.send;
      XMLHttpRequest.prototype.send = function (body) {
        send.call(this, body);
        this.upload.dispatchEvent(new ProgressEvent("progress", { lengthComputable: true, loaded: 1, total: 1 }));
      };
    }""")
    page.route("**/v1/jobs", answer)
    choose(page, {TRACKS: small[TRACKS]})
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text("frames of")
    send = page.get_by_role("button", name="Reconstruct")
    send.click()
    expect(page.get_by_text("Sent; the service is reading the files…")).to_be_visible()
    page.get_by_role("button", name="Stop").click()
    words = "Stopped. The service already has the files; the job may appear in the list."
    expect(page.get_by_text(words)).to_be_visible()
    for count in (2, 3, 4):
        send.click()
        heard(page, lambda count=count: len(keys) == count)
        expect(send).to_be_enabled()
        advice = page.get_by_text(
            "status 504 and no explanation. It may be starting, ending or busy: try again in a moment."
        )
        expect(advice).to_have_count(1 if count == 2 else 0)
    assert keys[0] == keys[1] == keys[2] != keys[3]


def test_leaving_the_page_while_files_are_sent_is_asked_about(page: Page, url: str, small: dict[str, bytes]) -> None:
    page.goto(url)
    page.route("**/v1/jobs", lambda route: None)
    choose(page, {TRACKS: small[TRACKS]})
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("button", name="Stop")).to_be_visible()
    asked: list[str] = []

    def stay(dialog: Dialog) -> None:
        asked.append(dialog.type)
        dialog.dismiss()

    page.on("dialog", stay)
    page.evaluate("setTimeout(() => location.reload())")
    heard(page, lambda: asked == ["beforeunload"])
    page.get_by_role("button", name="Stop").click()
    expect(page.get_by_text("Stopped. Nothing was submitted.")).to_be_visible()
    page.reload()
    assert asked == ["beforeunload"], "nothing is lost any more"
    page.remove_listener("dialog", stay)


def positions(url: str, id: str) -> tuple[int, int, int, bytes]:
    """Return where the positions begin and end in a job's preview, the size of one frame, and the file."""
    raw = httpx.get(f"{url}/v1/jobs/{id}/artifacts/preview.bin").content
    header = json.loads(raw[16 : 16 + int.from_bytes(raw[12:16], "little")])
    section = header["sections"]["positions"]
    return section["offset"], section["offset"] + section["bytes"], 6 * header["num_points"], raw


@pytest.mark.parametrize("frames", [0, 3])
def test_a_mesh_that_does_not_arrive_is_reported(page: Page, url: str, finished: str, frames: int) -> None:
    start, end, size, raw = positions(url, finished)
    parts = [b"", raw[start : start + frames * size + 5]] if frames else []
    asked: list[float] = []

    def answer(route: Route) -> None:
        at = int(route.request.headers["range"].removeprefix("bytes=").split("-")[0])
        if not start <= at < end:
            return route.continue_()
        asked.append(time.monotonic())
        if parts:
            return route.fulfill(status=206, body=parts.pop(0))
        return route.fulfill(**problem(410, "expired"))

    page.route(f"**/{finished}/artifacts/preview.bin", answer)
    page.goto(f"{url}/#job={finished}")
    words = f"Only {frames} of 10 frames could be loaded. Reload the page to try again."
    expect(page.get_by_text(words if frames else "The mesh cannot be displayed here (It is so.)")).to_be_visible()
    if frames:
        assert asked[1] - asked[0] > 0.9
