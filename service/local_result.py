"""The web viewer for a local result folder: read-only, without queue, store or worker."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.responses import FileResponse, JSONResponse, Response
from pliant.schemas.digests import sha256
from pliant.schemas.job import Artifact, Job, Status
from pliant.schemas.problems import ProblemCode
from pliant.service.middleware.security_headers import SecurityHeaders
from pliant.service.page import mount_page
from pliant.service.problems import answer
from pliant.worker.artifacts.kinds import KINDS
from pliant.worker.errors import InvalidRequest
from starlette.middleware.trustedhost import TrustedHostMiddleware

ID = "local"
REPORT, PREVIEW = "report.json", "preview.bin"
MEDIA_TYPES = {Path(kind.name).suffix: kind.media_type for kind in KINDS} | {
    ".json": "application/json",
    ".jpg": "image/jpeg",
}


def read_result(folder: Path) -> Job:
    """Return the record of a result that `pliant solve` or `pliant result` wrote into a folder.

    Raises
    ------
    InvalidRequest
        Code not_a_result: `report.json` or `preview.bin` is missing, or the report was not written by Pliant.
    """
    missing = [name for name in (REPORT, PREVIEW) if not (folder / name).is_file()]
    if missing:
        raise _not_a_result(folder, f"a folder without {' and '.join(missing)}")
    try:
        report: dict[str, Any] = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        stated = report.get("artifacts", {})
        known = {
            name: report[name] for name in ("options", "interpretation", "metrics", "outcome", "sentence", "warnings")
        }
        trust = {name: report.get(name) for name in ("verdict", "trust_sentence")}
        metrics = {name: value for name, value in known.pop("metrics").items() if value is not None}
        known["name"] = report.get("name") or folder.resolve().name
        written = datetime.fromtimestamp((folder / REPORT).stat().st_mtime, UTC)
        return Job.model_validate(
            {
                **known, **trust, "id": ID, "status": Status.SUCCEEDED, "metrics": metrics,
                "created_at": written, "finished_at": written, "verdict_reasons": report.get("verdict_reasons", []),
                "artifacts": [_artifact(path, stated) for path in sorted(folder.iterdir()) if _shown(path, stated)],
            }
        )  # fmt: skip
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _not_a_result(folder, f"a {REPORT} that Pliant did not write ({type(error).__name__})") from error


def create_viewer(folder: Path, token: str) -> FastAPI:
    """Return an application that shows the result in a folder at ``/{token}/#view=local``; every other path is unknown.

    Only loopback names are accepted as Host, so that no other site can reach the files through its own name.

    Raises
    ------
    InvalidRequest
        As `read_result`.
    """
    job = read_result(folder)
    names = {artifact.name for artifact in job.artifacts}
    page = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @page.api_route("/v1/jobs/{id}", methods=["GET", "HEAD"])
    def record(id: str) -> Response:
        return JSONResponse(job.model_dump(mode="json")) if id == ID else _unknown(id)

    @page.api_route("/v1/jobs/{id}/artifacts/{name}", methods=["GET", "HEAD"])
    def artifact(id: str, name: str) -> Response:
        if id != ID or name not in names:
            return _unknown(name)
        return FileResponse(folder / name, filename=name, headers={"Cache-Control": "no-store"})

    mount_page(page)
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=["127.0.0.1", "localhost"])
    app.mount(f"/{token}", page)
    return app


def _artifact(path: Path, stated: dict[str, Any]) -> Artifact:
    digest = stated.get(path.name, {}).get("sha256") or sha256(path)
    media_type = MEDIA_TYPES.get(path.suffix, "application/octet-stream")
    return Artifact(name=path.name, media_type=media_type, bytes=path.stat().st_size, sha256=digest)


def _shown(path: Path, stated: dict[str, Any]) -> bool:
    """Return True for files of the result; other files in the folder are not served."""
    return path.is_file() and not path.is_symlink() and (path.name in stated or path.name == REPORT)


def _unknown(what: str) -> Response:
    return answer(
        ProblemCode.UNKNOWN_ARTIFACT,
        detail=f"There is no {what[:80]!r} here. Open the address that `pliant view` printed.",
    )


def _not_a_result(folder: Path, got: str) -> InvalidRequest:
    return InvalidRequest(
        "not_a_result", field=str(folder), expected="the folder of a result, as `pliant solve -o` or `pliant result -o` writes it",
        got=got, hint="Name the folder that holds report.json and preview.bin.",
    )  # fmt: skip
