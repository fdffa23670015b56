"""A headless Chromium for tests, and the comparison of screenshots."""

from __future__ import annotations

import io
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright

ROOT = Path(__file__).parents[3]
AXE = ROOT / "service" / "web" / "node_modules" / "axe-core" / "axe.min.js"
NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def executable() -> str | None:
    """Return the path of a browser of the Chromium family, preferably one without windows, which takes three quarters of the time."""
    given = os.environ.get("PLIANT_CHROMIUM")
    return given or next((found for name in NAMES if (found := shutil.which(name))), None)


def why_not() -> str | None:
    """Return why the page cannot be tested here, or None."""
    if executable() is None:
        return "no Chromium found; install it, or set PLIANT_CHROMIUM to its path"
    if not (ROOT / "service" / "web" / "dist" / "index.html").is_file():
        return "the page is not built; say `make page`"
    return None


NEEDS_CHROMIUM = [
    pytest.mark.chromium,
    pytest.mark.skipif(why_not() is not None and not os.environ.get("CI"), reason=str(why_not())),
]
"""Marks of the tests that open the page."""

expect.set_options(timeout=20_000)  # milliseconds; a busy machine may need more than the usual five seconds


class Browsing:
    """Context manager around a browser that draws WebGL in software."""

    def __init__(self) -> None:
        self._playwright: Playwright | None = None
        self._browser: Browser | None = None

    def __enter__(self) -> Browser:
        self._playwright = sync_playwright().start()
        flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--enable-precise-memory-info"]
        # Without a graphics card, compositing on the CPU takes half the time.
        flags.append("--disable-gpu-compositing")
        # A fake camera that shows a moving pattern, without a permission prompt.
        flags += ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            flags.append("--no-sandbox")  # Chromium refuses to run as root with one
        self._browser = self._playwright.chromium.launch(executable_path=executable(), args=flags)
        return self._browser

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._browser is not None:
            self._browser.close()
        if self._playwright is not None:
            self._playwright.stop()


def heard(page: Page, holds: Callable[[], bool], seconds: float = 30) -> None:
    """Wait for what a route handler notes: Playwright runs handlers only within its own calls."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        page.wait_for_timeout(50)


def differing_pixels(one: bytes, other: bytes) -> float:
    """Return the share of the pixels of two PNGs that differ visibly, 1 if their sizes differ."""
    a, b = (np.asarray(Image.open(io.BytesIO(each)).convert("RGB"), dtype=np.int16) for each in (one, other))
    if a.shape != b.shape:
        return 1.0
    return float((np.abs(a - b).max(axis=2) > 8).mean())
