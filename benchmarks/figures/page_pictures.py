"""Take pictures of the web page in nine states, at 1280×800 and 390×844, light and dark, from a real local service.

    python -m benchmarks.figures.page_pictures FOLDER
    python -m benchmarks.figures.page_pictures FOLDER --only running,share --whole

Writes FOLDER/STATE-WIDTH-SCHEME.png, 36 pictures of the visible part of the window, or with `--whole` of the whole page. Needs a Chromium,
the built page (`python build_page.py`) and, for the film, the extra `film`.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, Page
from pliant.client import Client, NotAllowedNow
from pliant.solver.gallery import Sequence, corrupt, face, flag
from pliant.tracking.rendering import face_paint, render_film

from benchmarks.installation.page import ROOT, service

sys.path[:0] = [str(ROOT / "tests" / "support" / folder) for folder in ("page", "processes")]

from browsing import Browsing  # noqa: E402
from paging import drop, packed  # noqa: E402

VIEWS = ((1280, 800, 1), (390, 844, 2))
"""Width, height and density of the windows."""

PATIENCE = 600_000
"""Maximum time until a job's result is shown, ms."""


@dataclass(frozen=True, slots=True)
class Jobs:
    """Ids of the jobs that the states show; `shared` is the path of a share link."""

    good: str
    care: str
    other: str
    film: str
    running: str
    shared: str


@dataclass(frozen=True, slots=True)
class State:
    name: str
    show: Callable[[Page, str, Jobs], None]


def first_view(page: Page, url: str, _jobs: Jobs) -> None:
    page.goto(url)
    page.get_by_role("button", name="Try it with a synthetic face").wait_for()


def dropped_files(page: Page, url: str, jobs: Jobs) -> None:
    first_view(page, url, jobs)
    sequence = face(30, 400, degrees=40)
    drop(page, {"tracks.npz": packed(tracks=sequence.tracks.points), "mesh.npz": packed(faces=sequence.mesh.faces)})
    page.get_by_role("img", name="Sample of the tracks").wait_for()
    if page.viewport_size is not None and page.viewport_size["width"] < 800:  # narrow windows use the form
        page.get_by_role("region", name="How your files are interpreted").scroll_into_view_if_needed()


def refused_file(page: Page, url: str, jobs: Jobs) -> None:
    first_view(page, url, jobs)
    wrong = {
        "name": "holiday.npz",
        "mimeType": "application/octet-stream",
        "buffer": b"\0\0\0\x18ftypmp42" + bytes(600),
    }
    page.get_by_label("Tracks", exact=True).set_input_files(wrong)  # type: ignore[arg-type]
    page.locator("[data-part=tracks]").get_by_role("alert").wait_for()


def running(page: Page, url: str, _jobs: Jobs) -> None:
    with Client(url) as client:
        long = face(200, 3000, degrees=40)
        job = client.submit(long.tracks.points, mesh=long.mesh.faces, name="face, long")
    page.goto(f"{url}/#job={job.id}")
    page.get_by_text("left.").first.wait_for(timeout=PATIENCE)


def done(page: Page, url: str, id: str) -> None:
    page.goto(f"{url}/#job={id}")
    page.locator(".view canvas").first.wait_for(timeout=PATIENCE)
    page.get_by_role("region", name="Verdict").wait_for()
    at_frame(page, 12)


def at_frame(page: Page, frame: int) -> None:
    """Move the viewer to a frame and wait until it is drawn there."""
    slider = page.get_by_role("slider", name="Frame")
    slider.evaluate("(it, at) => { it.value = at; it.dispatchEvent(new Event('input')); }", frame)
    page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")


def compare(page: Page, url: str, jobs: Jobs) -> None:
    done(page, url, jobs.good)
    chosen = page.get_by_label("Compare with")
    chosen.focus()
    chosen.locator(f"option[value='{jobs.other}']").wait_for(state="attached")
    chosen.select_option(jobs.other)
    page.locator(".view-name").first.wait_for()
    page.locator(".view").first.scroll_into_view_if_needed()


def film_strip(page: Page, url: str, jobs: Jobs) -> None:
    done(page, url, jobs.film)
    page.get_by_role("img", name="The film at the same moment").wait_for()
    page.locator(".view").first.scroll_into_view_if_needed()


def share_link(page: Page, url: str, jobs: Jobs) -> None:
    page.goto("about:blank")  # otherwise only the URL's fragment changes
    page.goto(f"{url}/{jobs.shared.removeprefix('/')}")
    page.get_by_text("This is a shared, read-only result.").wait_for()
    page.locator(".view canvas").first.wait_for(timeout=PATIENCE)
    at_frame(page, 12)


STATES = (
    State("first-view", first_view),
    State("dropped-files", dropped_files),
    State("refused-file", refused_file),
    State("running", running),
    State("done-with-care", lambda page, url, jobs: done(page, url, jobs.care)),
    State("done-good", lambda page, url, jobs: done(page, url, jobs.good)),
    State("compare", compare),
    State("film-strip", film_strip),
    State("share-link", share_link),
)


def main() -> None:
    """Start a service, solve the jobs that the states show, and take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="names of states, separated by commas")
    parser.add_argument("--whole", action="store_true", help="the whole page instead of the window")
    given = parser.parse_args()
    wanted = [word for word in given.only.split(",") if word]
    states = [state for state in STATES if not wanted or state.name in wanted]
    given.folder.mkdir(parents=True, exist_ok=True)
    with service() as url, Browsing() as browser, Client(url) as client:
        jobs = submitted(client)
        for state in states:
            take(browser, url, jobs, state, given.folder, whole=given.whole)
        with contextlib.suppress(NotAllowedNow):  # it has ended meanwhile
            client.get(jobs.running).cancel()


def submitted(client: Client) -> Jobs:
    """Solve all jobs, and submit one that keeps running."""
    whole = face(30, 600, degrees=40)
    good = solved(client, whole, "face")
    other = solved(client, corrupt(whole, noise=0.02), "face, noisy")
    care = solved(client, flag(24, 300, degrees=40), "flag in the wind")
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "talking.webm"
        rest = face(24, 900, degrees=50)
        render_film(rest, size=(320, 240), paint=face_paint(900)).write(path)
        corners = [[160 + 62 * np.cos(turn), 120 + 82 * np.sin(turn)] for turn in np.linspace(0, 6, 24)]
        film = client.submit(film=path, name="talking", options={"region_polygon": corners, "region_frame": 12})
        film.wait(timeout=PATIENCE / 1000, load=False)
    shared = client.share(good).path
    long = face(200, 3000, degrees=40)
    running = client.submit(long.tracks.points, mesh=long.mesh.faces, name="face, long")
    return Jobs(good, care, other, film.id, running.id, shared)


def solved(client: Client, sequence: Sequence, name: str) -> str:
    """Return the id of a finished job with ground truth."""
    visible = np.asarray(sequence.tracks.visible) > 0
    job = client.submit(
        np.array(sequence.tracks.points), mesh=sequence.mesh.faces, visible=visible, ground_truth=sequence.shapes, name=name
    )  # fmt: skip
    job.wait(timeout=PATIENCE / 1000, load=False)
    return job.id


def take(browser: Browser, url: str, jobs: Jobs, state: State, folder: Path, *, whole: bool) -> None:
    """Take a state's pictures, each in a new browser context, as a first-time visitor sees it."""
    for width, height, density in VIEWS:
        for scheme in ("light", "dark"):
            context = browser.new_context(
                viewport={"width": width, "height": height}, color_scheme=scheme, device_scale_factor=density,
                reduced_motion="reduce",
            )  # fmt: skip
            page = context.new_page()
            state.show(page, url, jobs)
            path = folder / f"{state.name}-{width}-{scheme}.png"
            page.screenshot(path=path, full_page=whole)
            print(path, flush=True)
            context.close()


if __name__ == "__main__":
    main()
