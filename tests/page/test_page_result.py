"""A result in the page: every view, the animation, dense results, and the code for the same job."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from browsing import NEEDS_CHROMIUM, differing_pixels
from paging import DONE, TRACKS, seek, until
from playwright.sync_api import Page, expect
from pliant.solver.gallery import face

pytestmark = NEEDS_CHROMIUM


def test_each_colouring_overlay_and_view_changes_the_picture(page: Page, url: str, finished: str) -> None:
    page.goto(f"{url}/#job={finished}")
    canvas = page.locator(".view canvas")
    canvas.wait_for(timeout=DONE)
    page.get_by_role("checkbox", name="Wireframe").wait_for()
    seek(page, 3)
    page.get_by_role("checkbox", name="Flip depth").click()  # scrolls to the controls, so that no later click does
    page.get_by_role("checkbox", name="Flip depth").click()
    plain = canvas.screenshot()

    def different() -> float:
        return differing_pixels(plain, canvas.screenshot())

    for colour in ("displacement", "residual", "3-D error", "expected error", "visibility"):
        page.get_by_label("Colour", exact=True).select_option(label=colour)
        expect(page.locator(".legend")).to_be_visible()
        until(lambda: different() > 0.02)
    page.get_by_label("Colour", exact=True).select_option("plain")
    expect(page.locator(".legend")).to_be_hidden()
    until(lambda: different() == 0)
    for name in ("Wireframe", "Input tracks", "Ground truth"):
        page.get_by_role("checkbox", name=name).click()
        until(lambda: different() > 0.005)
        page.get_by_role("checkbox", name=name).click()
        until(lambda: different() == 0)
    seek(page, 9)
    from_front = canvas.screenshot()
    page.get_by_role("checkbox", name="Camera's view").check()
    until(lambda: differing_pixels(from_front, canvas.screenshot()) > 0.01)
    seek(page, 3)
    for side in ("Side", "Top"):
        page.get_by_role("button", name=side).click()
        until(lambda: different() > 0.01)
    page.get_by_role("button", name="Front").click()
    until(lambda: different() == 0)


def test_the_animation_stops_loops_or_reverses_at_its_end(page: Page, url: str, finished: str) -> None:
    page.goto(f"{url}/#job={finished}")
    page.locator(".view canvas").wait_for(timeout=DONE)
    slider = page.get_by_role("slider", name="Frame")

    def steps_until(seen: Callable[[np.ndarray], bool]) -> np.ndarray:
        """Watch the frame number until `seen` holds, and return its changes."""
        frames = [float(slider.input_value())]

        def watched() -> bool:
            frames.append(float(slider.input_value()))
            return seen(np.diff(frames))

        until(watched)
        return np.diff(frames)

    page.get_by_label("Speed").select_option(label="4 ×")
    page.get_by_label("At the end").select_option(label="stop")
    page.get_by_role("button", name="Play").click()
    expect(page.get_by_role("button", name="Play")).to_be_visible(timeout=20_000)
    expect(slider).to_have_value("9")

    seek(page, 0)
    page.get_by_label("Speed").select_option(label="¼ ×")
    page.get_by_label("At the end").select_option(label="loop")
    page.get_by_role("button", name="Play").click()
    steps_until(lambda steps: steps.min() < -5)  # from the last frame to the first

    page.get_by_label("At the end").select_option(label="back and forth")

    def there_and_back(steps: np.ndarray) -> bool:
        """Forwards, backwards, and forwards again."""
        ways = np.sign(steps[steps != 0])
        return int((np.diff(ways) != 0).sum()) >= 2

    assert steps_until(there_and_back).min() > -5


@pytest.fixture(scope="module")
def model(url: str, small: dict[str, bytes]) -> dict[str, Any]:
    """The record of a job with options and a name that needs quoting."""
    options = {"method": "temporal", "camera": "orthographic", "basis_size": 2, "fps": 12.5, "refine_rotations": False}
    files = {"tracks": small[TRACKS], "mesh": small["mesh.npz"], "ground_truth": small["truth.npz"]}
    sent = {"name": "it's a face", "options": json.dumps(options)}
    record: dict[str, Any] = httpx.post(f"{url}/v1/jobs", files=files, data=sent, timeout=60).json()
    return record


@pytest.mark.parametrize("language", ["Python", pytest.param("Shell", marks=pytest.mark.long), "curl"])
def test_the_code_shown_submits_the_same_job(
    page: Page, url: str, small: dict[str, bytes], model: dict[str, Any], tmp_path: Path, language: str
) -> None:
    if language == "curl" and shutil.which("curl") is None:
        pytest.skip("no curl here")
    for name, content in small.items():
        (tmp_path / name).write_bytes(content)
    page.goto(f"{url}/#job={model['id']}")
    page.get_by_role("button", name=language, exact=True).click()
    shown = page.get_by_role("region", name="Use from code").locator("code")
    expect(shown).to_contain_text(url)
    code = shown.inner_text()
    before = {job["id"] for job in httpx.get(f"{url}/v1/jobs").json()["jobs"]}
    if language == "Python":
        command = [sys.executable, "-c", code]
    else:
        program = f'pliant() {{ {sys.executable} -m pliant.cli "$@"; }}\n' + code.split("\n\n")[0]
        command = ["bash", "-c", program]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=90, check=False)
    assert ran.returncode == 0, ran.stderr
    (made,) = [job for job in httpx.get(f"{url}/v1/jobs").json()["jobs"] if job["id"] not in before]
    for same in ("name", "options", "interpretation"):
        assert made[same] == model[same]
    if language == "Shell":
        assert (tmp_path / "result" / "shapes.npz").is_file()


@pytest.mark.parametrize(("output", "file"), [("glb", "shapes.glb"), ("csv", "shapes.npz")])
def test_the_code_shown_downloads_a_file_that_the_job_writes(
    page: Page, url: str, small: dict[str, bytes], output: str, file: str
) -> None:
    options = {"method": "pseudo_inverse", "outputs": [output]}
    sent = {"tracks": small[TRACKS]}
    job = httpx.post(f"{url}/v1/jobs", files=sent, data={"options": json.dumps(options)}, timeout=60).json()
    page.goto(f"{url}/#job={job['id']}")
    page.get_by_role("button", name="curl", exact=True).click()
    expect(page.get_by_role("region", name="Use from code").locator("code")).to_contain_text(f"artifacts/{file}")


@pytest.mark.long
@pytest.mark.usefixtures("front")
def test_a_dense_result_plays_within_time_and_memory(page: Page, tmp_path: Path) -> None:
    """99 frames of 29,000 points end to end, with known cameras and the method that takes seconds."""
    sequence = face(99, 29_000)
    for part, label, arrays in (
        ("tracks", "Tracks", {"tracks": sequence.tracks.points.astype(np.float32)}),
        ("mesh", "Mesh", {"faces": sequence.mesh.faces}),
        ("cameras", "Cameras", {"rotations": sequence.rotations}),
    ):
        np.savez(tmp_path / f"{part}.npz", **arrays)
        page.get_by_label(label, exact=True).set_input_files(tmp_path / f"{part}.npz")
    seen = page.get_by_role("region", name="How your files are interpreted")
    expect(seen).to_contain_text("99 frames of 29,000 points", timeout=30_000)
    page.get_by_text("Advanced").click()
    page.get_by_label("Method").select_option(label="pseudo-inverse")
    page.get_by_label("Refine cameras").uncheck()
    page.get_by_role("button", name="Reconstruct").click()
    page.locator(".view canvas").wait_for(timeout=DONE)
    seek(page, 0)
    expect(page.locator(".clock")).to_have_text("1 / 99")
    first = page.locator(".view canvas").screenshot()
    began = time.monotonic()
    page.get_by_role("button", name="Play").click()
    until(lambda: float(page.get_by_role("slider", name="Frame").input_value()) > 20)
    page.get_by_role("button", name="Pause").click()
    assert time.monotonic() - began < 20
    assert differing_pixels(first, page.locator(".view canvas").screenshot()) > 0.001
    megabytes = page.evaluate("performance.memory.usedJSHeapSize") / 1e6
    positions = 99 * 29_000 * 6 / 1e6
    assert positions < megabytes < 6 * positions
