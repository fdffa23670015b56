"""The web page on a real service: time from `pliant up` to the first playing mesh, and the pictures in docs/images.

    python -m benchmarks.installation.page                      # times, as JSON
    python -m benchmarks.installation.page --film               # from a film dropped onto the page to its playing mesh
    python -m benchmarks.installation.page --pictures docs/images

Needs a Chromium, the built page (`make page`) and, for pictures, Pillow.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Page
from pliant.client import Client
from pliant.solver.gallery import face

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support" / "page"))

from browsing import Browsing  # noqa: E402

MOST_BYTES = 320_000


@contextmanager
def service() -> Iterator[str]:
    """Run `pliant up` on a free port and an empty directory; yield its address."""
    with tempfile.TemporaryDirectory(prefix="pliant-page-") as data:
        command = [sys.executable, "-m", "pliant.cli", "up", "--port", "0", "--json", "--data", data]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as up:
            assert up.stdout is not None
            output = ""
            while not output.endswith("}\n"):
                line = up.stdout.readline()
                assert line, "pliant up ended at once"
                output += line
            try:
                yield json.loads(output)["url"]
            finally:
                up.send_signal(signal.SIGINT)
                up.wait(30)


def frame(page: Page) -> float:
    return float(page.get_by_role("slider", name="Frame").input_value())


def play_example(page: Page) -> None:
    """Start the built-in example and wait until its mesh moves."""
    page.get_by_role("button", name="Try it with a synthetic face").click()
    page.locator(".view canvas").wait_for(timeout=300_000)
    while frame(page) == 0:
        time.sleep(0.02)


def first_mesh() -> dict[str, float]:
    """Return the seconds from starting `pliant up` until it is ready, the page is shown, and the built-in example plays."""
    began = time.perf_counter()
    with service() as url, Browsing() as browser:
        ready = time.perf_counter() - began
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.get_by_role("button", name="Try it with a synthetic face").wait_for()
        stands = time.perf_counter() - began
        play_example(page)
        plays = time.perf_counter() - began
    return {
        "ready_seconds": ready,
        "page_stands_seconds": stands,
        "mesh_plays_seconds": plays,
        "cores": os.cpu_count() or 0,
    }


DROP = """([name, data]) => {
  const given = new DataTransfer();
  given.items.add(new File([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))], name));
  document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: given, bubbles: true, cancelable: true }));
}"""


def dropped_film() -> dict[str, Any]:
    """Return the seconds from dropping the example film until its first frame shows, each stage begins, and its mesh plays."""
    with service() as url, Browsing() as browser:
        example = next(one for one in httpx.get(f"{url}/v1/examples").json()["examples"] if one["region_polygon"])
        film = httpx.get(f"{url}{example['files'][0]['url']}", timeout=120).content  # rendered on the first request
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.get_by_text("Drop a film here").wait_for()
        began = time.perf_counter()
        page.evaluate(DROP, [example["files"][0]["file"], base64.b64encode(film).decode()])
        page.get_by_role("img", name="First frame of the film").wait_for()
        shown = time.perf_counter() - began
        page.get_by_role("button", name="Reconstruct").click()
        stages = _stages(url, began)
        page.locator(".view canvas").wait_for(timeout=300_000)
        while frame(page) == 0:
            time.sleep(0.02)
        plays = time.perf_counter() - began
    return {"first_frame_seconds": shown, "stages": stages, "mesh_plays_seconds": plays, "cores": os.cpu_count() or 0}


def _stages(url: str, began: float) -> dict[str, float]:
    """Follow the only job to its end; return seconds from `began` to when each stage was first seen."""
    found: dict[str, float] = {}
    status = "queued"
    while status in ("queued", "running"):
        time.sleep(0.1)
        for job in httpx.get(f"{url}/v1/jobs", timeout=60).json()["jobs"]:
            status = job["status"]
            stage = (job["progress"] or {}).get("stage") if status == "running" else status
            found.setdefault(str(stage), time.perf_counter() - began)
    assert status == "succeeded", status
    return found


def talking_face(url: str) -> str:
    """Reconstruct a face; return the job's id. The tracks are clean, so the closed-form `temporal` method suffices and takes seconds."""
    sequence = face(40, 5000, degrees=50)
    client = Client(url)
    job = client.submit(
        sequence.tracks.points,
        mesh=sequence.mesh.faces,
        ground_truth=sequence.shapes,
        options={"method": "temporal"},
        name="talking face",
    )
    job.wait(timeout=300)
    return job.id


def pictures(folder: Path) -> None:
    """Take pictures of the page at widths of 1280 and 390 pixels, light and dark."""
    folder.mkdir(parents=True, exist_ok=True)
    with service() as url, Browsing() as browser:
        address = f"{url}/#job={talking_face(url)}"
        for width, height, density in ((1280, 900, 1), (390, 844, 2)):
            for scheme in ("light", "dark"):
                view = browser.new_context(
                    viewport={"width": width, "height": height},
                    color_scheme=scheme,
                    device_scale_factor=density,
                    reduced_motion="reduce",
                )
                page = view.new_page()
                page.goto(address)
                page.locator(".view canvas").wait_for(timeout=60_000)
                slider = page.get_by_role("slider", name="Frame")
                slider.evaluate("(it) => { it.value = 12; it.dispatchEvent(new Event('input')); }")
                if width > 1000:
                    page.get_by_role("checkbox", name="Ground truth").check()
                    page.get_by_label("Colour", exact=True).select_option("error")
                else:
                    page.locator(".detail").scroll_into_view_if_needed()
                    page.evaluate("document.querySelector('.detail').scrollIntoView()")
                page.wait_for_timeout(1500)
                save(page.screenshot(), folder / f"page-{width}-{scheme}.png")
                view.close()


def save(png: bytes, path: Path) -> None:
    """Write a picture, reduced to 256 colours if it exceeds `MOST_BYTES`."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.save(path, optimize=True)
    if path.stat().st_size > MOST_BYTES:
        picture.quantize(256, kmeans=4).save(path, optimize=True)
    print(path, path.stat().st_size)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, metavar="DIR")
    parser.add_argument("--film", action="store_true", help="drop the example film")
    given = parser.parse_args()
    if given.film:
        print(json.dumps(dropped_film(), indent=2))
    elif given.pictures is None:
        print(json.dumps(first_mesh(), indent=2))
    else:
        pictures(given.pictures)
