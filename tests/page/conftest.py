"""The page in a real browser against the whole service, started once: API, queue, worker, embedded Valkey."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from browsing import Browsing
from filming import KEEP_SENT, film_record, films_in, with_film_options
from long_jobs import long_request
from paging import PAUSES, QUICK, TRACKS, packed
from playwright.sync_api import Browser, Page, ViewportSize
from pliant.client import Client
from pliant.solver.gallery import corrupt, flag

WHOLE: ViewportSize = {"width": 1280, "height": 900}
BLANK = "/blank"
"""A path that the browser answers itself. An address of the service keeps the process that has drawn the page, which draws it again in
two thirds of the time; about:blank ends it."""


@pytest.fixture(scope="session")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start everything as a user does, on a free port."""
    data = tmp_path_factory.mktemp("data")
    command = [
        sys.executable,
        "-m",
        "pliant.cli",
        "up",
        "--port",
        "0",
        "--workers",
        "1",
        "--json",
        "--data",
        str(data),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as up:
        assert up.stdout is not None
        try:
            output = ""
            while not output.endswith("}\n"):
                line = up.stdout.readline()
                assert line != "", "pliant up ended at once"
                output += line
            yield json.loads(output)["url"]
        finally:
            up.send_signal(signal.SIGINT)
            up.wait(30)


OPEN: list[tuple[Browsing, Browser]] = []
"""The browser that consecutive modules share: starting one takes as long as a short test of the page."""


@pytest.fixture(scope="module")
def browser() -> Browser:
    if OPEN and not OPEN[0][1].is_connected():
        close_browser()
    if not OPEN:
        browsing = Browsing()
        OPEN.append((browsing, browsing.__enter__()))
    return OPEN[0][1]


def close_browser() -> None:
    while OPEN:
        OPEN.pop()[0].__exit__(None, None, None)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(nextitem: pytest.Item | None) -> Generator[None, object, object]:
    """Close the browser before a test that needs none: while Playwright runs, no other test may run an event loop."""
    try:
        return (yield)
    finally:
        here = nextitem is not None and Path(__file__).parent in nextitem.path.parents
        if not here or nextitem.get_closest_marker("chromium") is None:
            close_browser()


@dataclass
class Window:
    """The page of a module's tests, and the script errors and blocked requests since the current test began."""

    page: Page
    troubles: list[str]


@pytest.fixture(scope="module")
def window(browser: Browser) -> Iterator[Window]:
    """One page for all tests of a module: a process that has drawn the page before draws it in half the time."""
    context = browser.new_context(viewport=WHOLE, reduced_motion="reduce")
    context.add_init_script(
        "addEventListener('securitypolicyviolation', (event) => console.error('CSP blocked ' + event.blockedURI));"
    )
    context.add_init_script(PAUSES)
    window = Window(context.new_page(), [])
    window.page.on("pageerror", lambda error: window.troubles.append(str(error)))
    window.page.on("console", lambda message: window.troubles.append(message.text) if "CSP" in message.text else None)
    yield window
    context.close()


@pytest.fixture
def page(window: Window, url: str) -> Iterator[Page]:
    """A blank page that remembers nothing; script errors and blocked requests fail the test."""
    page = window.page
    window.troubles.clear()
    yield page
    page.unroute_all(behavior="ignoreErrors")  # a request may be in flight when the test ends
    if page.url.startswith(url):
        page.evaluate("sessionStorage.clear()")
        page.route(url + BLANK, lambda route: route.fulfill(body="", content_type="text/html"))
        page.goto(url + BLANK)
        page.unroute_all()
    else:
        page.goto("about:blank")
    page.set_viewport_size(WHOLE)
    page.emulate_media(color_scheme="light", reduced_motion="reduce")
    for job in httpx.get(f"{url}/v1/jobs?status=queued&status=running&limit=100").json()["jobs"]:
        httpx.post(f"{url}/v1/jobs/{job['id']}/cancel")  # the next test needs the only worker
    assert window.troubles == []


@pytest.fixture
def front(page: Page, url: str) -> None:
    """Open the front page; tests that show another page do without, which saves drawing one."""
    page.goto(url)


@pytest.fixture(scope="session")
def small() -> dict[str, bytes]:
    """A flag of a few hundred points, all of them moving; with its cameras given, it is solved within seconds."""
    sequence = corrupt(flag(10, 300), outliers=0.02)
    return {
        TRACKS: packed(tracks=sequence.tracks.points, visibility=sequence.tracks.visible > 0),
        "mesh.npz": packed(faces=sequence.mesh.faces),
        "cameras.npz": packed(rotations=sequence.rotations),
        "truth.npz": packed(shapes=sequence.shapes),
    }


@pytest.fixture
def long_job(url: str) -> Iterator[Callable[[str], str]]:
    """Submit a job that runs until it is cancelled, at the latest after the test."""
    queued: list[str] = []

    def submit(name: str) -> str:
        with Client(url) as client:
            queued.append(client.submit(**long_request(), name=name).id)
        return queued[-1]

    yield submit
    for id in queued:
        httpx.post(f"{url}/v1/jobs/{id}/cancel", timeout=60)


@pytest.fixture(scope="session")
def finished(url: str, small: dict[str, bytes]) -> str:
    """The id of a finished job with ground truth."""
    files = {"tracks": small[TRACKS], "mesh": small["mesh.npz"], "rotations": small["cameras.npz"]}
    files["ground_truth"] = small["truth.npz"]
    sent = {"name": "a finished face", "options": QUICK}
    answer = httpx.post(f"{url}/v1/jobs", files=files, data=sent, timeout=60)
    assert answer.status_code == 202, answer.text
    id = str(answer.json()["id"])
    while (job := httpx.get(f"{url}/v1/jobs/{id}", headers={"Prefer": "wait=20"}, timeout=60).json())["status"] in (
        "queued",
        "running",
    ):
        pass
    assert job["status"] == "succeeded", job["error"]
    return id


@pytest.fixture(scope="session")
def films(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Films of six frames, the first of them red, the others blue; an mp4 in a codec that browsers do not decode."""
    return films_in(tmp_path_factory.mktemp("films"))


@pytest.fixture
def filming(page: Page, url: str, finished: str) -> Page:
    """The front page of a service that tracks films; its answers are prepared, and no job is created."""
    page.route("**/v1/options", with_film_options)
    page.route("**/v1/inspect", lambda route: route.fulfill(json=film_record(url, finished)["interpretation"]))
    page.goto(url)
    page.evaluate(KEEP_SENT)
    page.get_by_text("Drop a film here").wait_for()
    return page
