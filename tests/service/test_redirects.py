"""Downloads redirect to presigned S3 URLs; clients that cannot follow them get the file from the service."""

from __future__ import annotations

import secrets
from hashlib import sha256
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from pliant.client import Client
from pliant.worker.store.blobs import Blobs
from pliant.worker.tokens import Scope
from serving import Running, Serve, finish, free_port, submit

CONTENT = bytes(range(256)) * 2000
DIGEST = sha256(CONTENT).hexdigest()


@pytest.fixture(scope="module")
def on_s3(serve: Serve, s3_url: str) -> Running:
    return serve(blob_url=f"{s3_url}-{secrets.token_hex(3)}", auth="required")


def finished(running: Running, http: httpx.Client) -> str:
    id = submit(http).id
    finish(running, id, CONTENT)
    return id


@pytest.mark.s3
def test_downloads_redirect_to_s3_if_the_client_opts_in(on_s3: Running) -> None:
    with on_s3.client() as http:
        path = f"/v1/jobs/{finished(on_s3, http)}/artifacts/shapes.npz"
        answer = http.get(path, params={"redirect": "true"})
        assert (answer.status_code, answer.content) == (307, b"")
        assert answer.headers["etag"] == f'"{DIGEST}"'
        assert answer.headers["cache-control"] == "private, no-store", "the URL is a key to the file"
        link = answer.headers["location"]
        assert "X-Amz-Expires=300" in link
        assert urlsplit(link).netloc != urlsplit(on_s3.url).netloc
        whole = httpx.get(link)
        assert (whole.status_code, whole.content) == (200, CONTENT)
        assert whole.headers["content-disposition"] == 'attachment; filename="shapes.npz"'
        assert whole.headers["content-type"] == "application/octet-stream"
        part = http.get(path, params={"redirect": "true"}, headers={"Range": "bytes=100-199"})
        assert part.status_code == 307
        rest = httpx.get(part.headers["location"], headers={"Range": "bytes=100-199"})
        assert (rest.status_code, rest.content) == (206, CONTENT[100:200])
        for headers, status in (
            ({"If-None-Match": f'"{DIGEST}"'}, 304),
            ({"If-Match": '"other"'}, 412),
            ({"Range": "bytes=9999999-"}, 416),
            ({"Range": "bytes=5-9", "If-Range": '"other"'}, 200),
        ):
            assert http.get(path, params={"redirect": "true"}, headers=headers).status_code == status
        assert http.head(path, params={"redirect": "true"}).status_code == 200
        assert http.get(path).content == CONTENT, "a page or an older client does not ask for it"


@pytest.mark.s3
def test_the_sdk_resumes_from_s3_without_sending_credentials(on_s3: Running, tmp_path: Path) -> None:
    seen: list[httpx.Request] = []
    _, token = on_s3.tokens.create("sdk", scopes=(Scope.READ, Scope.SUBMIT))
    with (
        httpx.Client(base_url=on_s3.url, headers={"Authorization": f"Bearer {token}"}) as http,
        Client(on_s3.url, token=token, headers={"X-Mine": "secret"}, event_hooks={"request": [seen.append]}) as client,
    ):
        job = finished(on_s3, http)
        (tmp_path / f".shapes.npz.{DIGEST[:16]}.part").write_bytes(CONTENT[:1000])
        assert client.download(job, tmp_path)["shapes.npz"].read_bytes() == CONTENT
    asked, fetched = seen[-2:]
    assert asked.headers["authorization"] == f"Bearer {token}"
    assert asked.url.params["redirect"] == "true"
    assert fetched.url.netloc != asked.url.netloc
    assert not {"authorization", "x-mine", "cookie", "if-range"} & set(fetched.headers)
    assert fetched.headers["range"] == "bytes=1000-"


@pytest.mark.s3
@pytest.mark.parametrize("link", ["unreachable", "refused"])
def test_the_sdk_downloads_from_the_service_if_the_redirect_fails(
    on_s3: Running, link: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = f"http://127.0.0.1:{free_port()}/x" if link == "unreachable" else f"{on_s3.url}/healthz/nothing"
    monkeypatch.setattr(Blobs, "link", lambda *_, **__: wrong)
    seen: list[httpx.Request] = []
    _, token = on_s3.tokens.create("sdk", scopes=(Scope.READ, Scope.SUBMIT))
    with (
        httpx.Client(base_url=on_s3.url, headers={"Authorization": f"Bearer {token}"}) as http,
        Client(on_s3.url, token=token, event_hooks={"request": [seen.append]}) as client,
    ):
        job = finished(on_s3, http)
        assert client.download(job, tmp_path / "a")["shapes.npz"].read_bytes() == CONTENT
        assert client.download(job, tmp_path / "b")["shapes.npz"].read_bytes() == CONTENT
    assert sum("redirect" in each.url.params for each in seen) == 1, "it remembers that the store is out of reach"


@pytest.mark.s3
def test_redirects_can_be_turned_off(serve: Serve, s3_url: str) -> None:
    running = serve(blob_url=f"{s3_url}-{secrets.token_hex(3)}", presigned_redirects=False)
    with httpx.Client(base_url=running.url) as http:
        answer = http.get(f"/v1/jobs/{finished(running, http)}/artifacts/shapes.npz", params={"redirect": "true"})
    assert (answer.status_code, answer.content) == (200, CONTENT)


def test_directory_and_memory_stores_never_redirect(running: Running, http: httpx.Client) -> None:
    answer = http.get(f"/v1/jobs/{finished(running, http)}/artifacts/shapes.npz", params={"redirect": "true"})
    assert (answer.status_code, answer.content) == (200, CONTENT)
    assert Blobs.open("memory:///").link("k", seconds=1) is None
