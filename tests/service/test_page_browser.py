"""The page in a real browser against the whole service: API, queue, worker, embedded Valkey."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from browsing import Browsing, differing_pixels, why_not
from long_jobs import long_request
from playwright.sync_api import Browser, Locator, Page, Route, expect
from pliant.client import Client
from pliant.solver.gallery import corrupt, face, flag

pytestmark = [
    pytest.mark.chromium,
    pytest.mark.skipif(why_not() is not None and not os.environ.get("CI"), reason=str(why_not())),
]

TRACKS = "tracks.npz"
DONE = 180_000


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start everything as a user does, on a free port."""
    data = tmp_path_factory.mktemp("data")
    command = [
        sys.executable,
        "-m",
        "pliant.client.cli",
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
            said = ""
            while not said.endswith("}\n"):
                line = up.stdout.readline()
                assert line != "", "pliant up ended at once"
                said += line
            yield json.loads(said)["url"]
        finally:
            up.send_signal(signal.SIGINT)
            up.wait(30)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browsing() as browsing:
        yield browsing


@pytest.fixture
def page(browser: Browser, url: str) -> Iterator[Page]:
    """A page of its own on the front page; a script error or a blocked request fails the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, reduced_motion="reduce")
    context.add_init_script(
        "addEventListener('securitypolicyviolation', (event) => console.error('CSP blocked ' + event.blockedURI));"
    )
    page = context.new_page()
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda message: troubles.append(message.text) if "CSP" in message.text else None)
    page.goto(url)
    yield page
    context.close()
    for job in httpx.get(f"{url}/v1/jobs?status=queued&status=running&limit=100").json()["jobs"]:
        httpx.post(f"{url}/v1/jobs/{job['id']}/cancel")  # the next test wants the one worker
    assert troubles == []


def packed(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


@pytest.fixture(scope="module")
def small() -> dict[str, bytes]:
    """A flag of a few hundred points, which moves as a whole: a result within seconds."""
    sequence = corrupt(flag(10, 300), outliers=0.02)
    return {
        TRACKS: packed(tracks=sequence.tracks.points, visibility=sequence.tracks.visible > 0),
        "mesh.npz": packed(faces=sequence.mesh.faces),
        "truth.npz": packed(shapes=sequence.shapes),
    }


@pytest.fixture
def long_job(url: str) -> Iterator[Callable[[str], str]]:
    """Queue a job that only ever ends from outside; it is cancelled after the test."""
    queued: list[str] = []

    def submit(name: str) -> str:
        with Client(url) as client:
            queued.append(client.submit(**long_request(), name=name).id)
        return queued[-1]

    yield submit
    for id in queued:
        httpx.post(f"{url}/v1/jobs/{id}/cancel", timeout=60)


@pytest.fixture(scope="module")
def finished(url: str, small: dict[str, bytes]) -> str:
    """The id of a finished job with ground truth."""
    answer = httpx.post(
        f"{url}/v1/jobs",
        files={"tracks": small[TRACKS], "mesh": small["mesh.npz"], "ground_truth": small["truth.npz"]},
        data={"name": "a finished face"},
        timeout=60,
    )
    assert answer.status_code == 202, answer.text
    id = str(answer.json()["id"])
    while (job := httpx.get(f"{url}/v1/jobs/{id}", headers={"Prefer": "wait=20"}, timeout=60).json())["status"] in (
        "queued",
        "running",
    ):
        pass
    assert job["status"] == "succeeded", job["error"]
    return id


def choose(page: Page, files: dict[str, bytes]) -> None:
    for label, name in (("Tracks", TRACKS), ("Mesh", "mesh.npz"), ("Ground truth", "truth.npz")):
        if name in files:
            given = {"name": name, "mimeType": "application/octet-stream", "buffer": files[name]}
            page.get_by_label(label, exact=True).set_input_files(given)  # type: ignore[arg-type]


DROP = """([files]) => {
  const held = new DataTransfer();
  for (const [name, text] of files) held.items.add(new File([Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0))], name));
  const zone = document.querySelector(".zone");
  for (const type of ["dragover", "drop"]) {
    zone.dispatchEvent(new DragEvent(type, { dataTransfer: held, bubbles: true, cancelable: true }));
  }
}"""


def drop(page: Page, files: dict[str, bytes]) -> None:
    page.evaluate(DROP, [[[name, base64.b64encode(content).decode()] for name, content in files.items()]])


def until(holds: Callable[[], bool], seconds: float = 30) -> None:
    """Wait in Python: the browser's own way to wait evaluates strings, which the page's policy forbids."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def steps_of(chart: Locator) -> int:
    found = re.search(r"in (\d+) steps", chart.get_attribute("aria-label") or "")
    return int(found[1]) if found else 0


def seek(page: Page, frame: float) -> None:
    page.get_by_role("slider", name="Frame").evaluate(
        "(it, at) => { it.value = at; it.dispatchEvent(new Event('input')); }", frame
    )
    page.wait_for_timeout(300)


def test_from_an_upload_to_a_playing_mesh(page: Page, url: str, small: dict[str, bytes]) -> None:
    choose(page, small)
    expect(page.locator("[data-part=tracks]")).to_contain_text("tracks 10 × 300 × 2 float64")
    seen = page.get_by_role("region", name="How your files are understood")
    expect(seen).to_contain_text("10 frames of 300 points")
    expect(seen).to_contain_text("tracks (F, P, 2), y down")
    expect(seen).to_contain_text("given; errors are measured against it")
    expect(seen.get_by_role("img", name="Some of the tracks")).to_be_visible()
    painted = "(it) => it.getContext('2d').getImageData(0, 0, it.width, it.height).data.filter((v, i) => i % 4 === 3 && v > 0).length"
    assert seen.get_by_role("img", name="Some of the tracks").evaluate(painted) > 200 * 9  # a dot each of 200 points
    page.get_by_label("Preset").select_option(label="automatic")
    page.get_by_label("name (optional)").fill("my flag")
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("heading", name="my flag")).to_be_focused()
    expect(page.get_by_role("article").get_by_text("10 frames of 300 points")).to_be_visible()
    canvas = page.locator(".view canvas")
    canvas.wait_for(timeout=DONE)
    expect(page.get_by_role("article").get_by_text("Done", exact=True)).to_be_visible()

    seek(page, 0)
    first, again = canvas.screenshot(), canvas.screenshot()
    assert differing_pixels(page, first, again) == 0
    later = []
    for frame in range(1, 10, 2):
        seek(page, frame)
        later.append(differing_pixels(page, first, canvas.screenshot()))
    assert min(later) > 0.001
    assert max(later) > 0.02

    page.get_by_role("button", name="Play").click()
    shown = page.get_by_role("slider", name="Frame").input_value()
    until(lambda: page.get_by_role("slider", name="Frame").input_value() != shown)
    page.get_by_role("button", name="Pause").click()

    id = re.search(r"job=(\w+)", page.url)
    assert id is not None
    job = httpx.get(f"{url}/v1/jobs/{id[1]}").json()
    rows = page.locator("tbody tr")
    assert rows.count() == len(job["metrics"])
    for name, value in job["metrics"].items():
        text = rows.filter(has=page.get_by_text(name, exact=True)).locator("td").inner_text()
        assert float(text) == pytest.approx(value, rel=0.01, abs=1e-9)
    names = {artifact["name"] for artifact in job["artifacts"]}
    assert {"shapes.npz", "shapes.glb", "report.json", "preview.bin"} <= names
    assert set(page.get_by_role("region", name="Files").get_by_role("link").all_inner_texts()) == names
    with page.expect_download() as download:
        page.get_by_role("link", name="report.json").click()
    assert json.loads(Path(download.value.path()).read_text())["metrics"] == job["metrics"]


def test_every_view_of_a_result_shows_something_else(page: Page, url: str, finished: str) -> None:
    page.goto(f"{url}/#job={finished}")
    canvas = page.locator(".view canvas")
    canvas.wait_for(timeout=DONE)
    page.get_by_role("checkbox", name="Wireframe").wait_for()
    seek(page, 3)
    plain = canvas.screenshot()
    for colour in ("displacement", "residual", "3-D error"):
        page.get_by_label("Colour", exact=True).select_option(label=colour)
        expect(page.locator(".legend")).to_be_visible()
        page.wait_for_timeout(200)
        assert differing_pixels(page, plain, canvas.screenshot()) > 0.02, colour
    page.get_by_label("Colour", exact=True).select_option("plain")
    expect(page.locator(".legend")).to_be_hidden()
    for name in ("Wireframe", "Input tracks", "Ground truth", "Flip depth"):
        page.get_by_role("checkbox", name=name).click()
        page.wait_for_timeout(300)
        assert differing_pixels(page, plain, canvas.screenshot()) > 0.005, name
        page.get_by_role("checkbox", name=name).click()
        page.wait_for_timeout(300)
        assert differing_pixels(page, plain, canvas.screenshot()) == 0, name
    page.get_by_role("checkbox", name="Camera's view").check()
    page.wait_for_timeout(300)
    assert differing_pixels(page, plain, canvas.screenshot()) > 0.01
    page.get_by_role("button", name="Reset view").click()
    page.wait_for_timeout(300)
    assert differing_pixels(page, plain, canvas.screenshot()) == 0


def test_the_animation_stops_loops_or_turns_back_at_the_speed_asked_for(page: Page, url: str, finished: str) -> None:
    page.goto(f"{url}/#job={finished}")
    page.locator(".view canvas").wait_for(timeout=DONE)
    slider = page.get_by_role("slider", name="Frame")

    def watched(seconds: float) -> list[float]:
        end, seen = time.monotonic() + seconds, [0.0]
        while time.monotonic() < end:
            seen.append(float(slider.input_value()))
        return seen

    page.get_by_label("Speed").select_option(label="4 ×")
    page.get_by_label("At the end").select_option(label="stop")
    page.get_by_role("button", name="Play").click()
    expect(page.get_by_role("button", name="Play")).to_be_visible(timeout=20_000)
    expect(slider).to_have_value("9")

    seek(page, 0)
    page.get_by_label("Speed").select_option(label="¼ ×")
    page.get_by_label("At the end").select_option(label="loop")
    page.get_by_role("button", name="Play").click()
    steps = np.diff(watched(4))
    assert steps.min() < -5  # from the last frame to the first

    page.get_by_label("At the end").select_option(label="back and forth")
    steps = np.diff(watched(4))
    assert -5 < steps.min() < 0 < steps.max()


def test_a_refusal_is_shown_as_the_services_own_sentence(page: Page, url: str) -> None:
    said = httpx.post(f"{url}/v1/jobs", files={"tracks": ("tracks.npz", b"hello, I am not tracks")}).json()
    choose(page, {TRACKS: b"hello, I am not tracks"})
    page.get_by_role("button", name="Reconstruct").click()
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text(said["detail"])
    expect(alert).to_contain_text(said["code"])
    assert "#job" not in page.url
    choose(page, {TRACKS: packed(tracks=np.zeros((2, 50, 2)))})
    page.get_by_role("button", name="Reconstruct").click()
    expect(alert).to_contain_text("too_few_frames")


def test_dropped_files_find_their_places_and_say_what_they_are(page: Page, url: str, small: dict[str, bytes]) -> None:
    jobs = len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"])
    drop(page, small)
    for part, name in (("tracks", TRACKS), ("mesh", "mesh.npz"), ("ground_truth", "truth.npz")):
        expect(page.locator(f"[data-part={part}]")).to_contain_text(name)
    expect(page.get_by_role("region", name="How your files are understood")).to_contain_text("10 frames of 300 points")
    page.get_by_role("button", name="Remove mesh").click()
    expect(page.get_by_role("region", name="How your files are understood")).to_contain_text("made by triangulating")
    page.get_by_label("or points on a grid").fill("15×20")
    page.get_by_label("or points on a grid").press("Tab")
    expect(page.get_by_role("region", name="How your files are understood")).to_contain_text("266 faces, from the grid")
    page.get_by_label("or points on a grid").fill("3x3")
    page.get_by_label("or points on a grid").press("Tab")
    expect(page.get_by_role("alert")).to_contain_text("vertex_count_mismatch")
    assert len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"]) == jobs


def test_a_reading_can_be_chosen_before_anything_is_made_of_it(page: Page, url: str) -> None:
    jobs = len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"])
    choose(page, {TRACKS: packed(W=np.random.default_rng(0).normal(size=(40, 50)))})
    page.get_by_role("button", name="W (2F, P), rows stacked").click()
    expect(page.get_by_role("region", name="How your files are understood")).to_contain_text("W (2F, P), rows stacked")
    expect(page.get_by_role("alert")).to_have_count(0)
    assert len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"]) == jobs


def test_sending_again_after_a_lost_answer_makes_no_second_job(page: Page, url: str, small: dict[str, bytes]) -> None:
    def lost(route: Route) -> None:
        route.fetch()
        route.abort()

    page.route("**/v1/jobs", lost, times=1)
    choose(page, small)
    page.get_by_label("name (optional)").fill("sent twice")
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("alert")).to_contain_text("The service does not answer.")
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("heading", name="sent twice")).to_be_focused()
    jobs = httpx.get(f"{url}/v1/jobs").json()["jobs"]
    assert len([job for job in jobs if job["name"] == "sent twice"]) == 1


def test_where_two_readings_fit_a_click_chooses_one(page: Page, url: str) -> None:
    noise = np.random.default_rng(0).normal(size=(40, 50))
    choose(page, {TRACKS: packed(W=noise)})
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("alert")).to_contain_text("ambiguous_layout")
    page.get_by_role("button", name="W (2F, P), rows stacked").click()
    expect(page.get_by_role("article").get_by_text("20 frames of 50 points")).to_be_visible()
    expect(page.get_by_role("article").get_by_text("W (2F, P), rows stacked")).to_be_visible()
    id = page.url.partition("job=")[2]
    assert httpx.get(f"{url}/v1/jobs/{id}").json()["options"]["rows"] == "stacked"


def test_sending_nothing_says_what_is_missing(page: Page) -> None:
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_text("Choose a track file first")).to_be_visible()
    expect(page.get_by_label("Tracks", exact=True)).to_be_focused()


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
    # The events of before the reload are told again: the curve is whole.
    objective.wait_for(timeout=10_000)
    until(lambda: steps_of(objective) >= 4, seconds=5)
    expect(page.get_by_text(re.compile(r"reweighting \d+ of at most 1000"))).to_be_visible()

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
    page.get_by_role("button", name="Delete it for good?").click()
    expect(page.get_by_role("link", name="a long job")).to_have_count(0)
    assert httpx.get(f"{url}/v1/jobs/{id}").status_code == 404
    assert httpx.get(f"{url}/v1/jobs/{waiting}").json()["status"] == "cancelled"


@pytest.mark.parametrize("language", ["Python", "Shell", "curl"])
def test_the_code_shown_makes_the_same_job(
    page: Page, url: str, small: dict[str, bytes], tmp_path: Path, language: str
) -> None:
    if language == "curl" and shutil.which("curl") is None:
        pytest.skip("no curl here")
    for name, content in small.items():
        (tmp_path / name).write_bytes(content)
    options = {"method": "spatio_temporal", "fps": 12.5, "refine_rotations": False}
    files = {"tracks": small[TRACKS], "mesh": small["mesh.npz"], "ground_truth": small["truth.npz"]}
    asked = httpx.post(
        f"{url}/v1/jobs", files=files, data={"name": "it's a face", "options": json.dumps(options)}, timeout=60
    )
    model = asked.json()
    page.goto(f"{url}/#job={model['id']}")
    page.get_by_role("button", name=language, exact=True).click()
    code = page.get_by_role("region", name="Do this from code").locator("code").inner_text()
    assert url in code
    before = {job["id"] for job in httpx.get(f"{url}/v1/jobs").json()["jobs"]}
    if language == "Python":
        command = [sys.executable, "-c", code]
    else:
        program = f'pliant() {{ {sys.executable} -m pliant.client.cli "$@"; }}\n' + code.split("\n\n")[0]
        command = ["bash", "-c", program]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=90, check=False)
    assert ran.returncode == 0, ran.stderr
    (made,) = [job for job in httpx.get(f"{url}/v1/jobs").json()["jobs"] if job["id"] not in before]
    for same in ("name", "options", "interpretation"):
        assert made[same] == model[same]
    if language == "Shell":
        assert (tmp_path / "result" / "shapes.npz").is_file()


def test_the_list_follows_a_running_job_that_is_not_shown(
    page: Page, url: str, finished: str, long_job: Callable[[str], str]
) -> None:
    page.goto(f"{url}/#job={finished}")
    long_job("a job beside it")
    row = page.get_by_role("link", name="a job beside it")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    expect(row).to_contain_text(re.compile(r"Running, \d+"), timeout=DONE)
    until(lambda: any(address.endswith("/events") for address in asked))
    # With the list itself kept away, it is the events that move the bar.
    page.route(re.compile(r"/v1/jobs\?"), lambda route: route.abort())
    before = float(row.get_by_role("progressbar", include_hidden=True).get_attribute("value") or 0)
    until(lambda: float(row.get_by_role("progressbar", include_hidden=True).evaluate("(it) => it.value")) > before)


def test_the_example_by_keyboard_alone(page: Page) -> None:
    def tab_to(name: str, most: int = 60) -> None:
        for _ in range(most):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement?.textContent || document.activeElement?.ariaLabel") == name:
                return
        pytest.fail(f"the Tab key does not reach {name!r}")

    tab_to("breathing sphere")
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Reconstruct")).to_be_focused()
    expect(page.locator("[data-part=tracks]")).to_contain_text("tracks 30 × 500 × 2 float32")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="breathing sphere")).to_be_focused()
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
    assert differing_pixels(page, before, canvas.screenshot()) > 0.01


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_no_accessibility_finding_and_nothing_wider_than_the_screen(
    page: Page, url: str, finished: str, scheme: str, width: int
) -> None:
    axe = Path(__file__).parents[2] / "service" / "web" / "node_modules" / "axe-core" / "axe.min.js"
    if not axe.is_file() and not os.environ.get("CI"):
        pytest.skip("axe-core is not installed; say `make page`")
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
    page.set_viewport_size({"width": width, "height": 844})
    for address, landmark in (("", "Point tracks in"), (f"#job={finished}", "a finished face"), ("docs", "Pliant API")):
        page.goto(f"{url}/{address}")
        page.get_by_role("heading", name=landmark).wait_for()
        if "#" in address:
            page.locator(".view canvas").wait_for(timeout=DONE)
        if address == "":
            page.get_by_text("More options").click()
        page.evaluate(axe.read_text())
        found = page.evaluate("axe.run().then((found) => found.violations)")
        said = [f"{one['id']} ({one['impact']}): {[node['html'] for node in one['nodes']][:3]}" for one in found]
        assert said == [], address
        assert page.evaluate("document.documentElement.scrollWidth") <= width, address


def test_no_request_leaves_the_host(page: Page, url: str, finished: str) -> None:
    asked: list[str] = []
    page.context.on("request", lambda request: asked.append(request.url))
    for address in (f"#job={finished}", "docs"):
        answer = page.goto(f"{url}/{address}")
        page.reload()
        page.wait_for_timeout(1500)
        assert answer is None or answer.headers["content-security-policy"].startswith("default-src 'self';")
    assert len(asked) > 10
    assert [address for address in asked if not address.startswith(f"{url}/")] == []


def test_a_service_that_is_away_is_said_and_its_return_noticed(page: Page, url: str, finished: str) -> None:
    page.route("**/v1/**", lambda route: route.abort())
    page.goto(f"{url}/#job={finished}")
    page.reload()
    expect(page.get_by_role("alert").first).to_contain_text("The service does not answer.")
    page.unroute_all()
    page.locator(".view canvas").wait_for(timeout=30_000)
    expect(page.get_by_role("alert")).to_have_count(0, timeout=15_000)


def test_a_token_is_asked_for_and_then_sent_with_everything(page: Page, url: str, finished: str) -> None:
    def guarded(route: Route) -> None:
        if route.request.headers.get("authorization") == "Bearer a-token":
            route.continue_()
        else:
            problem = {"title": "Unauthorised", "status": 401, "detail": "Send a token.", "code": "unauthorised"}
            route.fulfill(status=401, content_type="application/problem+json", body=json.dumps(problem))

    page.route("**/v1/**", guarded)
    page.goto(f"{url}/#job={finished}")
    page.reload()
    expect(page.get_by_role("alert").first).to_contain_text("Send a token.")
    page.get_by_label("Token").fill("a-token")
    page.get_by_role("button", name="Use it").click()
    page.locator(".view canvas").wait_for(timeout=30_000)
    expect(page.get_by_role("alert")).to_have_count(0)
    with page.expect_download() as download:
        page.get_by_role("link", name="report.json").click()
    assert "metrics" in json.loads(Path(download.value.path()).read_text())


def test_a_dense_result_plays_within_time_and_memory(page: Page, tmp_path: Path) -> None:
    """99 frames of 29,000 points on the whole road, with known cameras and the method that takes seconds."""
    sequence = face(99, 29_000)
    for part, label, arrays in (
        ("tracks", "Tracks", {"tracks": sequence.tracks.points.astype(np.float32)}),
        ("mesh", "Mesh", {"faces": sequence.mesh.faces}),
        ("cameras", "Cameras", {"rotations": sequence.rotations}),
    ):
        np.savez(tmp_path / f"{part}.npz", **arrays)
        page.get_by_label(label, exact=True).set_input_files(tmp_path / f"{part}.npz")
    seen = page.get_by_role("region", name="How your files are understood")
    expect(seen).to_contain_text("99 frames of 29,000 points", timeout=30_000)
    page.get_by_label("Method").select_option(label="pseudo-inverse")
    page.get_by_text("More options").click()
    page.get_by_label("Refine rotations").uncheck()
    page.get_by_role("button", name="Reconstruct").click()
    page.locator(".view canvas").wait_for(timeout=DONE)
    expect(page.locator(".clock")).to_have_text("1 / 99")
    first = page.locator(".view canvas").screenshot()
    began = time.monotonic()
    page.get_by_role("button", name="Play").click()
    until(lambda: float(page.get_by_role("slider", name="Frame").input_value()) > 20)
    page.get_by_role("button", name="Pause").click()
    assert time.monotonic() - began < 20
    assert differing_pixels(page, first, page.locator(".view canvas").screenshot()) > 0.001
    megabytes = page.evaluate("performance.memory.usedJSHeapSize") / 1e6
    positions = 99 * 29_000 * 6 / 1e6
    assert positions < megabytes < 6 * positions
