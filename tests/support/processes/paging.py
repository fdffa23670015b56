"""Common steps of the page's tests: give it files, wait, read a chart, move to a frame."""

from __future__ import annotations

import base64
import io
import json
import re
import time
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Locator, Page

TRACKS = "tracks.npz"
DONE = 180_000
QUICK = json.dumps({"camera": "orthographic", "surface": "free"})
"""Options of a job whose result is only shown; with its cameras given, it takes a tenth of the default's time."""

PAUSES = """{
  const [set, pauses] = [window.setTimeout, new Map()];
  window.setTimeout = (then, after, ...given) => {
    const end = () => (pauses.delete(timer), then(...given));
    const timer = set(end, after);
    if (after === 2000 || after === 8000) pauses.set(timer, end);
    return timer;
  };
  window.endPauses = () => [...pauses].map(([timer, end]) => (clearTimeout(timer), end())).length;
}"""
"""A script that lets tests end the pauses between refreshes of the list of jobs."""

BOTH_WIDTHS_AND_THEMES = [
    (1280, "light"),
    (390, "dark"),
    *(pytest.param(*other, marks=pytest.mark.long) for other in ((1280, "dark"), (390, "light"))),
]
"""Widths of a window and colour schemes, each once; the other pairs are left to `make test-long`."""


def packed(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def choose(page: Page, files: dict[str, bytes]) -> None:
    for label, name in (
        ("Tracks", TRACKS),
        ("Mesh", "mesh.npz"),
        ("Cameras", "cameras.npz"),
        ("Ground truth", "truth.npz"),
    ):
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


def record(url: str, of: str, **changes: Any) -> dict[str, Any]:
    """Return the record of a job, with changes."""
    return {**httpx.get(f"{url}/v1/jobs/{of}").json(), **changes}


def until(holds: Callable[[], bool], seconds: float = 30) -> None:
    """Wait in Python: Playwright's own wait evaluates strings, which the content security policy forbids."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def refresh(page: Page) -> None:
    """Let the list of jobs be refreshed now instead of after its pause of two seconds, or of eight if no job is unfinished."""
    until(lambda: page.evaluate("endPauses()") > 0)


def steps_of(chart: Locator) -> int:
    found = re.search(r"in (\d+) steps", chart.get_attribute("aria-label") or "")
    return int(found[1]) if found else 0


def seek(page: Page, frame: float) -> None:
    page.get_by_role("slider", name="Frame").evaluate(
        "(it, at) => { it.value = at; it.dispatchEvent(new Event('input')); }", frame
    )
    page.wait_for_timeout(300)
