"""Submitting from the page: chosen or dropped files, their interpretation, and errors."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import httpx
import numpy as np
import pytest
from browsing import NEEDS_CHROMIUM, differing_pixels, heard
from paging import DONE, TRACKS, choose, drop, packed, seek, until
from playwright.sync_api import Page, Route, expect

pytestmark = [*NEEDS_CHROMIUM, pytest.mark.usefixtures("front")]


def test_files_are_submitted_and_the_result_plays(page: Page, url: str, small: dict[str, bytes]) -> None:
    choose(page, small)
    expect(page.locator("[data-part=tracks]")).to_contain_text("tracks 10 × 300 × 2 float64")
    seen = page.get_by_role("region", name="How your files are interpreted")
    expect(seen).to_contain_text("10 frames of 300 points")
    expect(seen).to_contain_text("tracks (F, P, 2), y down")
    expect(seen).to_contain_text("given; errors are measured against it")
    expect(seen.get_by_role("img", name="Sample of the tracks")).to_be_visible()
    painted = "(it) => it.getContext('2d').getImageData(0, 0, it.width, it.height).data.filter((v, i) => i % 4 === 3 && v > 0).length"
    assert seen.get_by_role("img", name="Sample of the tracks").evaluate(painted) > 200 * 9  # a dot each of 200 points
    page.get_by_text("Advanced").click()
    page.get_by_label("Preset").select_option(label="as published")
    page.get_by_label("name (optional)").fill("my flag")
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("heading", name="my flag")).to_be_focused()
    expect(page.get_by_role("article").get_by_text("10 frames of 300 points")).to_be_visible()
    canvas = page.locator(".view canvas")
    canvas.wait_for(timeout=DONE)
    expect(page.get_by_role("article").get_by_text("Done", exact=True)).to_be_visible()
    for step in ("More files", "Share", "Run again with other options"):
        expect(page.get_by_role("button", name=step, exact=True)).to_be_visible()

    seek(page, 0)
    first, again = canvas.screenshot(), canvas.screenshot()
    assert differing_pixels(first, again) == 0
    later = []
    for frame in range(1, 10, 2):
        seek(page, frame)
        later.append(differing_pixels(first, canvas.screenshot()))
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


def test_an_error_is_shown_with_the_services_message(page: Page, url: str) -> None:
    problem = httpx.post(f"{url}/v1/jobs", files={"tracks": ("tracks.npz", b"hello, I am not tracks")}).json()
    choose(page, {TRACKS: b"hello, I am not tracks"})
    page.get_by_role("button", name="Reconstruct").click()
    alert = page.locator("[data-part=tracks]").get_by_role("alert")
    sentence = problem["detail"].removeprefix("tracks: ").removesuffix(problem["hint"]).strip()
    expect(alert).to_contain_text(sentence[0].upper() + sentence[1:])
    expect(alert).to_contain_text("Choose a file of one of these kinds; the guide shows an example of each.")
    expect(alert.get_by_role("link", name="What files can I send?")).to_have_attribute("href", "guide#tracks")
    expect(alert.get_by_role("link", name="About this error")).to_have_attribute("href", f"errors/{problem['code']}")
    expect(page.get_by_text("Not submitted: see “Tracks” above.")).to_be_visible()
    expect(alert).to_contain_text(problem["code"])
    assert "#job" not in page.url
    choose(page, {TRACKS: packed(tracks=np.zeros((2, 50, 2)))})
    page.get_by_role("button", name="Reconstruct").click()
    expect(alert).to_contain_text("too_few_frames")


def test_dropped_files_are_assigned_to_their_parts(page: Page, url: str, small: dict[str, bytes]) -> None:
    jobs = len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"])
    drop(page, small)
    assigned = {"tracks": TRACKS, "mesh": "mesh.npz", "rotations": "cameras.npz", "ground_truth": "truth.npz"}
    for part, name in assigned.items():
        expect(page.locator(f"[data-part={part}]")).to_contain_text(name)
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text("10 frames of 300 points")
    page.get_by_role("button", name="Remove mesh").click()
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text("triangulated in")
    page.get_by_label("or points on a grid").fill("15×20")
    page.get_by_label("or points on a grid").press("Tab")
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text(
        "266 faces, from the grid"
    )
    page.get_by_label("or points on a grid").fill("3x3")
    page.get_by_label("or points on a grid").press("Tab")
    expect(page.get_by_role("alert")).to_contain_text("vertex_count_mismatch")
    assert len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"]) == jobs


def test_a_dropped_folder_is_left_out_and_the_files_beside_it_are_taken(
    page: Page, small: dict[str, bytes], tmp_path: Path
) -> None:
    folder, tracks = tmp_path / "shots", tmp_path / TRACKS
    folder.mkdir()
    tracks.write_bytes(small[TRACKS])
    page.locator("[data-part=film]").wait_for()
    session = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(folder), str(tracks)], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 200, "y": 300, "data": data})
    session.detach()
    expect(page.get_by_text("Left out: shots. A folder cannot be read: zip its pictures first.")).to_be_visible()
    expect(page.locator("[data-part=tracks]")).to_contain_text("tracks 10 × 300 × 2 float64")


def test_an_interpretation_can_be_chosen_before_submitting(page: Page, url: str) -> None:
    jobs = len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"])
    choose(page, {TRACKS: packed(W=np.random.default_rng(0).normal(size=(40, 50)))})
    page.get_by_role("button", name="W (2F, P), rows stacked").click()
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text("W (2F, P), rows stacked")
    expect(page.get_by_role("alert")).to_have_count(0)
    assert len(httpx.get(f"{url}/v1/jobs?limit=100").json()["jobs"]) == jobs


def test_resubmitting_after_a_lost_response_creates_no_second_job(
    page: Page, url: str, small: dict[str, bytes]
) -> None:
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


def test_a_file_that_is_still_being_read_is_submitted(page: Page, small: dict[str, bytes]) -> None:
    page.evaluate("""() => {
      const read = Blob.prototype.arrayBuffer;
      let waits = 900; // milliseconds: the first file takes longer than the second
      Blob.prototype.arrayBuffer = async function () {
        await new Promise((resolve) => setTimeout(resolve, waits));
        waits = 100;
        return read.call(this);
      };
      const send = XMLHttpRequest.prototype.send;
      window.sent = [];
      XMLHttpRequest.prototype.send = function (form) {
        window.sent.push(form.get("tracks").name);
        return send.call(this, form);
      };
    }""")
    keys: list[str | None] = []

    def lost(route: Route) -> None:
        keys.append(route.request.headers.get("idempotency-key"))
        route.abort()

    page.route("**/v1/jobs", lost)
    for name in ("first.npz", "second.npz"):
        file = {"name": name, "mimeType": "application/octet-stream", "buffer": small[TRACKS]}
        page.get_by_label("Tracks", exact=True).set_input_files(file)  # type: ignore[arg-type]
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("alert")).to_contain_text("then press Reconstruct again; no job is created twice.")
    page.get_by_label("name (optional)").fill("another")
    page.get_by_label("name (optional)").fill("second")
    page.get_by_role("button", name="Reconstruct").click()
    heard(page, lambda: len(keys) == 2)
    assert page.evaluate("window.sent") == ["second.npz", "second.npz"]
    assert keys[0] == keys[1]


def test_a_file_changed_since_it_was_chosen_is_named(page: Page, small: dict[str, bytes], tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    path.write_bytes(small[TRACKS])
    page.get_by_label("Tracks", exact=True).set_input_files(path)
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text("10 frames of 300 points")
    path.write_bytes(small["mesh.npz"])
    os.utime(path, (1, 1))
    page.get_by_role("button", name="Reconstruct").click()
    words = "Not submitted. Changed or deleted since you chose it: mine.npz. Choose it again."
    expect(page.get_by_text(words)).to_be_visible()
    path.write_bytes(small[TRACKS])
    page.get_by_label("Tracks", exact=True).set_input_files(path)
    expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text("10 frames of 300 points")
    expect(page.get_by_text(words)).to_be_hidden()


def test_an_ambiguous_input_is_resolved_by_a_click(page: Page, url: str) -> None:
    noise = np.random.default_rng(0).normal(size=(40, 50))
    choose(page, {TRACKS: packed(W=noise)})
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("alert")).to_contain_text("ambiguous_layout")
    page.get_by_role("button", name="W (2F, P), rows stacked").click()
    expect(page.get_by_role("article").get_by_text("20 frames of 50 points")).to_be_visible()
    expect(page.get_by_role("article").get_by_text("W (2F, P), rows stacked")).to_be_visible()
    id = page.url.partition("job=")[2]
    assert httpx.get(f"{url}/v1/jobs/{id}").json()["options"]["rows"] == "stacked"


def test_submitting_nothing_names_the_missing_part(page: Page) -> None:
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_text("Choose a film or track file first, or try an example. What can I send?")).to_be_visible()
    expect(page.get_by_role("link", name="What can I send?")).to_have_attribute("href", "guide#start")
    expect(page.get_by_label("Tracks", exact=True)).to_be_focused()
