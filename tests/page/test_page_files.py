"""How the built page is served: caching, revalidation, and the response while there is no page."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from pliant.service.middleware.security_headers import SecurityHeaders
from pliant.service.page import mount_page
from starlette.middleware import Middleware

SCRIPT = "export const answer = 42;\n"


def served(folder: Path) -> TestClient:
    """The page of a folder, with the headers that the service adds to every response."""
    app = FastAPI(docs_url=None, middleware=[Middleware(SecurityHeaders)])
    mount_page(app, folder)
    return TestClient(app)


@pytest.fixture
def built(tmp_path: Path) -> TestClient:
    html = "<!doctype html><title>Pliant</title>"
    for name, text in (("index.html", html), ("docs.html", html), ("guide.html", html), ("main-ABC.js", SCRIPT)):
        (tmp_path / name).write_text(text)
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "notes.txt").write_text("not a part of the page")
    return served(tmp_path)


def test_the_page_is_revalidated_and_its_files_are_immutable(built: TestClient) -> None:
    for address in ("/", "/docs", "/guide"):
        index = built.get(address)
        assert index.status_code == 200
        assert index.headers["cache-control"] == "no-cache"
        assert index.headers["content-type"] == "text/html; charset=utf-8"
    script = built.get("/page/main-ABC.js")
    assert script.text == SCRIPT
    assert script.headers["cache-control"] == "public, max-age=31536000, immutable"
    assert script.headers["content-type"].startswith("text/javascript")


def test_the_content_security_policy_allows_only_this_host(built: TestClient) -> None:
    policy = built.get("/").headers["content-security-policy"]
    assert policy.startswith("default-src 'self';")
    assert "unsafe" not in policy
    assert "http" not in policy


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_an_unchanged_file_is_not_sent_twice(built: TestClient, encoding: str) -> None:
    asked = {"Accept-Encoding": encoding}
    first = built.get("/", headers=asked)
    assert first.headers.get("content-encoding", "identity") == encoding
    again = built.get("/", headers={**asked, "If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == first.headers["etag"]
    for name in ("content-security-policy", "cache-control", "vary", "referrer-policy"):
        assert again.headers[name] == first.headers[name], "a browser takes over the headers of a 304"


def test_compressed_and_plain_responses_have_different_etags(built: TestClient) -> None:
    plain, packed = (built.get("/", headers={"Accept-Encoding": name}) for name in ("identity", "gzip"))
    assert plain.text == packed.text
    assert plain.headers["etag"] != packed.headers["etag"]
    assert plain.headers["vary"] == packed.headers["vary"] == "Accept-Encoding"


@pytest.mark.parametrize("name", ["absent.js", "notes.txt", "..%2f..%2fpage.py", "main-ABC.js.gz"])
def test_nothing_but_the_page_is_served(built: TestClient, name: str) -> None:
    answer = built.get(f"/page/{name}")
    assert answer.status_code == 404


def test_head_returns_the_same_headers_without_a_body(built: TestClient) -> None:
    head = built.head("/page/main-ABC.js", headers={"Accept-Encoding": "identity"})
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-length"] == str(len(SCRIPT))


@pytest.mark.parametrize("address", ["/", "/docs", "/guide"])
def test_a_missing_page_returns_503_with_build_instructions(tmp_path: Path, address: str) -> None:
    answer = served(tmp_path / "absent").get(address)
    assert answer.status_code == 503
    assert "<code>make page</code>" in answer.text
    assert answer.headers["cache-control"] == "no-store"


def test_a_page_built_later_is_served_without_a_restart(tmp_path: Path) -> None:
    client = served(tmp_path)
    assert client.get("/").status_code == 503
    (tmp_path / "index.html").write_text("<!doctype html><title>Pliant</title>")
    assert client.get("/").text == "<!doctype html><title>Pliant</title>"


def test_the_page_is_not_in_the_openapi_document(built: TestClient) -> None:
    assert built.get("/openapi.json").json()["paths"] == {}
