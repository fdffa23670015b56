"""An installation with tokens: `pliant token`, `pliant up`, command line and page."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import Browsing, why_not
from commands import CLEAN
from long_jobs import long_request
from pliant.cli.demo import read_address
from pliant.cli.exits import Exit
from pliant.client import AsyncClient, Client, NotAuthorized, NotFound
from pliant.client.webhooks import new_secret, verified

pytestmark = pytest.mark.slow

PLIANT = [sys.executable, "-m", "pliant.cli"]
QUICK = {"camera": "orthographic", "surface": "free", "prior": "smooth", "refine_rotations": False}
"""Options of a short job: the default takes ten times as long, and the result does not matter here."""

QUICKLY = [text for name, value in QUICK.items() for text in ("-O", f"{name}={str(value).lower()}")]


def pliant(*arguments: object, token: str = "", **env: str) -> subprocess.CompletedProcess[str]:
    given = {"PLIANT_TOKEN": token} if token else {}
    return subprocess.run(
        [*PLIANT, *map(str, arguments)],
        env=CLEAN | given | env,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def made(data: Path, *arguments: str) -> dict[str, Any]:
    ran = pliant("token", "create", *arguments, "--data", data, "--json")
    assert ran.returncode == 0, ran.stderr
    token: dict[str, Any] = json.loads(ran.stdout)
    return token


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("house") / "data"


@pytest.fixture(scope="module")
def first(data: Path) -> dict[str, Any]:
    """The first token, created before the service first runs."""
    return made(data, "first")


@pytest.fixture(scope="module")
def url(data: Path, first: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    log = tmp_path_factory.mktemp("log") / "up.log"
    command = [*PLIANT, "up", "--port", "0", "--auth", "required", "--data", str(data), "--json"]
    with log.open("wb") as errors:
        env = CLEAN | {"PLIANT_WEBHOOK_NETWORKS": "127.0.0.0/8"}
        up = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=env, text=True)
    assert up.stdout is not None
    address = read_address(up.stdout)
    assert address is not None, log.read_text()
    yield address
    up.send_signal(signal.SIGTERM)
    assert up.wait(60) == 0
    up.stdout.close()
    assert "uvicorn" not in log.read_text()
    assert first["token"] not in log.read_text()


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    path = tmp_path / "tracks.npz"
    np.savez(path, tracks=np.random.default_rng(0).normal(size=(5, 12, 2)))
    return path


def test_a_service_that_requires_tokens_does_not_start_without_one(tmp_path: Path) -> None:
    ran = pliant("up", "--port", 0, "--auth", "required", "--data", tmp_path / "empty")
    assert ran.returncode == Exit.UNREACHABLE
    assert "pliant token create NAME" in ran.stderr
    assert "PLIANT_AUTH=off" in ran.stderr


@pytest.mark.long
def test_the_command_line_requires_a_valid_token(url: str, first: dict[str, Any], tracks: Path) -> None:
    sent = pliant("submit", tracks, *QUICKLY, "--id", "mine", "--url", url, token=first["token"])
    assert sent.returncode == 0, sent.stderr
    seen = pliant("watch", "mine", "--url", url, "--json", token=first["token"])
    assert json.loads(seen.stdout)["status"] == "succeeded", seen.stderr
    refused = pliant("status", "mine", "--url", url, token="nonsense")
    assert refused.returncode == Exit.NOT_NOW
    assert "token" in refused.stderr


def test_the_webhook_of_a_job_is_signed_and_the_sdk_verifies_it(url: str, first: dict[str, Any], tracks: Path) -> None:
    got: list[tuple[dict[str, str], bytes]] = []

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            got.append((dict(self.headers.items()), self.rfile.read(int(self.headers["content-length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    secret = new_secret()
    with ThreadingHTTPServer(("127.0.0.1", 0), Receiver) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        hook = ["--webhook", f"http://127.0.0.1:{server.server_address[1]}/hook"]
        where = ["--id", "hooked", "--url", url]
        unsigned = pliant("submit", tracks, *hook, *where, token=first["token"])
        assert unsigned.returncode == Exit.REFUSED
        assert "webhook_secret" in unsigned.stderr
        sent = pliant("submit", tracks, *hook, *where, *QUICKLY, token=first["token"], PLIANT_WEBHOOK_SECRET=secret)
        assert sent.returncode == 0, sent.stderr
        deadline = time.monotonic() + 60
        while not got and time.monotonic() < deadline:
            time.sleep(0.05)
        server.shutdown()
    ((headers, body),) = got
    job = verified(headers, body, secret=secret)
    assert (job.id, job.status) == ("hooked", "succeeded")
    assert [each.name for each in job.artifacts]


def test_tokens_are_created_and_revoked_while_the_service_runs(
    url: str, data: Path, first: dict[str, Any], tracks: Path
) -> None:
    second = made(data, "second", "--scope", "read", "--expires", "1h")
    listed = pliant("token", "list", "--data", data)
    assert "second" in listed.stdout
    assert second["token"] not in listed.stdout
    assert second["token"].split("_", 2)[2] not in pliant("token", "list", "--data", data, "--json").stdout
    with Client(url, token=first["token"]) as owner, Client(url, token=second["token"]) as client:
        job = owner.submit(tracks, options=QUICK)
        assert list(client.list()) == []
        with pytest.raises(NotFound):
            client.get(job.id)
        with pytest.raises(NotAuthorized, match="scope submit"):
            client.cancel(job.id)
        assert pliant("token", "revoke", second["id"], "--data", data).returncode == 0
        with pytest.raises(NotAuthorized, match="token"):
            list(client.list())
    assert pliant("token", "revoke", second["id"], "--data", data).returncode == Exit.NOT_FOUND


def test_an_invalid_token_name_is_rejected_with_a_message(url: str, data: Path) -> None:
    del url
    ran = pliant("token", "create", "  ", "--data", data)
    assert ran.returncode == Exit.REFUSED
    assert "printable characters" in ran.stderr


def test_both_clients_require_a_valid_token(url: str, first: dict[str, Any], tracks: Path) -> None:
    async def asked(token: str | None) -> tuple[int, ...]:
        async with AsyncClient(url, token=token) as client:
            return (await (await client.submit(tracks, options=QUICK)).wait(timeout=60)).shapes.shape

    with Client(url, token=first["token"]) as client:
        assert client.inspect(tracks).num_points == 12
        job = client.submit(tracks, options=QUICK)
        assert [now.status for now in job.events(timeout=60)][-1] == "succeeded"
        assert job.wait(timeout=60).shapes.shape == (5, 12, 3)
    assert asyncio.run(asked(first["token"])) == (5, 12, 3)
    for wrong in (None, "nonsense"):
        with Client(url, token=wrong) as stranger, pytest.raises(NotAuthorized, match="token") as caught:
            stranger.get(job.id)
        assert caught.value.status == 401
        with pytest.raises(NotAuthorized):
            asyncio.run(asked(wrong))


@pytest.mark.chromium
@pytest.mark.skipif(why_not() is not None and not os.environ.get("CI"), reason=str(why_not()))
def test_the_page_asks_for_the_token_and_shows_its_jobs(url: str, first: dict[str, Any], tracks: Path) -> None:
    from playwright.sync_api import expect

    with Client(url, token=first["token"]) as client:
        client.submit(tracks, options=QUICK, job_id="paged", name="seen in the page").wait(timeout=60, load=False)
    with Browsing() as browser:
        page = browser.new_page()
        page.goto(f"{url}/#job=paged")
        expect(page.get_by_role("alert").first).to_contain_text("This service needs a token", timeout=20_000)
        page.get_by_label("Token").fill("nonsense")
        page.get_by_role("button", name="Use", exact=True).click()
        expect(page.get_by_role("alert").first).to_contain_text("not known")
        page.get_by_label("Token").fill(first["token"])
        page.get_by_role("button", name="Use", exact=True).click()
        expect(page.get_by_role("alert")).to_have_count(0, timeout=20_000)
        expect(page.get_by_text("seen in the page").first).to_be_visible(timeout=20_000)
        page.locator(".view canvas").wait_for(timeout=20_000)
        with page.expect_download() as download:
            page.get_by_role("link", name="report.json").click()
        assert "metrics" in json.loads(Path(download.value.path()).read_text())
        page.get_by_text("New reconstruction").click()
        page.get_by_role("button", name="waving flag").click()
        expect(page.get_by_role("region", name="How your files are interpreted")).to_contain_text(
            "30 frames", timeout=20_000
        )
        with Client(url, token=first["token"]) as client:
            before_it = client.submit(**long_request())  # occupies the only worker: the next job waits to be cancelled
            page.get_by_role("button", name="Reconstruct").click()
            expect(page.get_by_role("heading", name="waving flag")).to_be_visible(timeout=20_000)
            page.get_by_role("button", name="Cancel").click()
            expect(page.get_by_role("article").get_by_text("Cancelled", exact=True)).to_be_visible(timeout=30_000)
            before_it.cancel()
