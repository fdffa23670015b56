"""A headless Chromium for tests, and how to tell two pictures apart."""

from __future__ import annotations

import base64
import os
import shutil
from pathlib import Path
from types import TracebackType

from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright

ROOT = Path(__file__).parents[3]
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def executable() -> str | None:
    """Return the path of a browser of the Chromium family."""
    given = os.environ.get("PLIANT_CHROMIUM")
    return given or next((found for name in NAMES if (found := shutil.which(name))), None)


def why_not() -> str | None:
    """Return why the page cannot be tested here, or None."""
    if executable() is None:
        return "no Chromium found; install it, or set PLIANT_CHROMIUM to its path"
    if not (ROOT / "service" / "web" / "dist" / "index.html").is_file():
        return "the page is not built; say `make page`"
    return None


expect.set_options(timeout=20_000)  # milliseconds; a busy machine may need more than the usual five seconds


class Browsing:
    """Context manager around a browser that draws WebGL in software."""

    def __init__(self) -> None:
        self._playwright: Playwright | None = None
        self._browser: Browser | None = None

    def __enter__(self) -> Browser:
        self._playwright = sync_playwright().start()
        flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--enable-precise-memory-info"]
        # A made-up camera that shows a moving pattern, and no question whether the page may use it.
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


COMPARE = """async ([one, other]) => {
  const read = async (text) => {
    const raw = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const picture = await createImageBitmap(new Blob([raw]));
    const canvas = new OffscreenCanvas(picture.width, picture.height).getContext("2d");
    canvas.drawImage(picture, 0, 0);
    return canvas.getImageData(0, 0, picture.width, picture.height).data;
  };
  const [a, b] = [await read(one), await read(other)];
  if (a.length !== b.length) return 1;
  let different = 0;
  for (let i = 0; i < a.length; i += 4) {
    const change = Math.max(Math.abs(a[i] - b[i]), Math.abs(a[i + 1] - b[i + 1]), Math.abs(a[i + 2] - b[i + 2]));
    if (change > 8) different += 1;
  }
  return (4 * different) / a.length;
}"""


def differing_pixels(page: Page, one: bytes, other: bytes) -> float:
    """Return the share of the pixels of two PNGs of one size that differ visibly; the page's browser decodes them."""
    pictures = [base64.b64encode(picture).decode() for picture in (one, other)]
    return float(page.evaluate(COMPARE, pictures))
