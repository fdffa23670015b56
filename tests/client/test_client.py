"""Construction of clients: environment variables, headers, hooks, certificates."""

from __future__ import annotations

import asyncio
import copy
import pickle
import ssl
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pliant.client import AsyncClient, BadArgument, Client, NotLoaded, Result, Retry, Unreachable
from pliant.service.testing import InMemoryService


def sent(client: Client) -> httpx.Request:
    """Return the request that the client sends to read the options."""
    client.options()
    return SEEN[-1]


SEEN: list[httpx.Request] = []


def answer(request: httpx.Request) -> httpx.Response:
    SEEN.append(request)
    return httpx.Response(200, json={})


ECHO = httpx.MockTransport(answer)


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PLIANT_URL", "PLIANT_TOKEN"):
        monkeypatch.delenv(name, raising=False)


def test_address_and_token_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLIANT_URL", "https://pliant.example/base/")
    monkeypatch.setenv("PLIANT_TOKEN", "pliant_1_x")
    request = sent(Client(transport=ECHO))
    assert str(request.url) == "https://pliant.example/base/v1/options"
    assert request.headers["authorization"] == "Bearer pliant_1_x"
    request = sent(Client("http://other.example", token="mine", transport=ECHO))
    assert (request.url.host, request.headers["authorization"]) == ("other.example", "Bearer mine")


def test_an_empty_variable_counts_as_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLIANT_URL", "")
    monkeypatch.setenv("PLIANT_TOKEN", "")
    client = Client(transport=ECHO)
    assert repr(client) == "<Client http://127.0.0.1:8000>"
    assert "authorization" not in sent(client).headers
    with pytest.raises(BadArgument, match="Expected the address of a service"):
        Client("")


@pytest.mark.parametrize("url", ["http://pliant.example?x=1", "pliant.example", "ftp://pliant.example", 5])
def test_what_is_no_address_is_refused(url: Any) -> None:
    with pytest.raises(BadArgument, match="Expected the address of a service"):
        Client(url)


def test_a_password_in_the_address_is_sent_and_not_shown() -> None:
    client = Client(httpx.URL("http://me:secret@pliant.example/base/"), transport=ECHO)  # type: ignore[arg-type]
    assert sent(client).headers["authorization"].startswith("Basic ")
    assert (client.url, repr(client)) == ("http://pliant.example/base", "<Client http://pliant.example/base>")
    with pytest.raises(Unreachable) as caught:
        Client("http://me:secret@127.0.0.1:1", retries=Retry(first_contact=0)).limits()
    assert "secret" not in str(caught.value)


def test_headers_and_event_hooks_apply_to_every_request() -> None:
    hooked: list[str] = []
    client = Client(
        headers={"X-Team": "capture"},
        event_hooks={"request": [lambda request: hooked.append(request.url.path)]},
        transport=ECHO,
    )
    request = sent(client)
    assert request.headers["x-team"] == "capture"
    assert request.headers["user-agent"].startswith("pliant-client/")
    assert hooked == ["/v1/options"]


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        ({"X-Team": "Bühne"}, "printable ASCII .* for X-Team, got another value. Encode"),
        ({"X-Team": "a\nb"}, "printable ASCII .* for X-Team"),
        ({"X-Team": " a"}, "without spaces around it, for X-Team"),
        ({"X-Team": 5}, "expected a str .* for X-Team"),
        ({"Bühne": "a"}, "expected names of ASCII .* got 'Bühne'"),
        ({"X Team": "a"}, "expected names of ASCII .* got 'X Team'"),
        ({5: "a"}, "expected names of ASCII .* got 5"),
        ([("X-Team", "a")], "expected a mapping of str to str, got a value of type list"),
    ],
)
def test_headers_that_http_does_not_allow_are_refused_in_words(headers: Any, words: str) -> None:
    with pytest.raises(BadArgument, match=f"headers: .*{words}"):
        Client(headers=headers, transport=ECHO)
    assert sent(Client(headers={"X-Team": "", "x_1.~": "a b;c"}, transport=ECHO)).headers["x_1.~"] == "a b;c"


def test_the_asynchronous_client_takes_asynchronous_hooks() -> None:
    hooked: list[str] = []

    async def hook(request: httpx.Request) -> None:
        hooked.append(request.url.path)

    async def use() -> None:
        async with AsyncClient(event_hooks={"request": [hook]}, transport=ECHO) as client:
            await client.options()

    asyncio.run(use())
    assert hooked == ["/v1/options"]


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("HTTP_PROXY", "ftp://proxy.example", "Unknown scheme for proxy URL"),
        ("ALL_PROXY", "socks5://proxy.example:1080", "SOCKS proxy"),
        ("SSL_CERT_FILE", "/missing/certificates.pem", "No such file"),
    ],
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_variables_that_httpx_cannot_use_are_named(
    monkeypatch: pytest.MonkeyPatch, kind: type[Client], variable: str, value: str, words: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(BadArgument, match=f"connections cannot be set up: .*{words}.* {variable}"):
        kind("http://pliant.example")


def test_the_error_about_an_unreachable_service_names_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "all_proxy", "ALL_PROXY", "no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:1")
    for excepted, named in (("", True), ("127.0.0.1", False)):
        monkeypatch.setenv("NO_PROXY", excepted)
        with pytest.raises(Unreachable, match="`pliant up` is running there") as caught:
            Client("http://127.0.0.1:1", retries=Retry(first_contact=0)).limits()
        assert ("NO_PROXY" in str(caught.value)) is named


def test_verify_reaches_httpx(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, Any]] = []
    monkeypatch.setattr(httpx, "Client", lambda **settings: given.append(settings))
    context = ssl.create_default_context()
    for verify in (True, False, context):
        Client(verify=verify)
    assert [settings["verify"] for settings in given] == [True, False, context]
    assert {settings["limits"].max_connections for settings in given} == {None}, "many waits need many connections"


POINTS = np.random.default_rng(0).normal(size=(6, 16, 2)) * 100


@pytest.mark.parametrize("given", [True, False], ids=["a folder of its own", "a temporary folder"])
def test_a_pickled_result_has_arrays_and_report_but_neither_client_nor_token(given: bool, tmp_path: Path) -> None:
    service = InMemoryService(auth="required")
    token = service.create_token()
    client = Client("http://pliant.test", token=token, transport=service)
    result = client.submit(POINTS).wait(folder=tmp_path / "own" if given else None, timeout=60)
    shapes, report = result.shapes.copy(), dict(result.report)
    sent = pickle.dumps(result)
    assert token.encode() not in sent
    del result
    again = pickle.loads(sent)
    assert isinstance(again, Result)
    np.testing.assert_array_equal(again.shapes, shapes)
    assert again.report == report
    assert (again.folder == tmp_path / "own") is given
    with pytest.raises(BadArgument, match=f"has no client. Download with `client.download\\('{again.job.id}'"):
        again.save_glb(tmp_path / "moving.glb")
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(again)).shapes, shapes)


def test_a_result_without_files_is_pickled_without_arrays() -> None:
    client = Client("http://pliant.test", transport=InMemoryService())
    again = pickle.loads(pickle.dumps(client.submit(POINTS).wait(load=False, timeout=60)))
    with pytest.raises(NotLoaded):
        _ = again.shapes


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy])
def test_copies_of_a_result_share_its_client_and_folder(duplicate: object, tmp_path: Path) -> None:
    assert callable(duplicate)
    job = Client("http://pliant.test", transport=InMemoryService()).submit(POINTS)
    result = job.wait(timeout=60)
    shapes = result.shapes.copy()
    twin = duplicate(result)
    assert (twin.shapes is result.shapes) is (duplicate is copy.copy)
    del result
    assert twin.save_glb(tmp_path / "moving.glb").stat().st_size > 0
    np.testing.assert_array_equal(twin.shapes, shapes)
    assert duplicate(job).wait(timeout=60).job == twin.job


def test_a_client_cannot_be_pickled_and_says_what_to_do() -> None:
    with pytest.raises(
        TypeError, match=r"A Client has connections and a token and cannot be pickled. Create one in each"
    ):
        pickle.dumps(Client(transport=ECHO))
