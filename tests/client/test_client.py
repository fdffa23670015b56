"""Construction of clients: environment variables, headers, hooks, certificates."""

from __future__ import annotations

import asyncio
import ssl

import httpx
import pytest
from pliant.client import AsyncClient, BadArgument, Client


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


def test_the_asynchronous_client_takes_asynchronous_hooks() -> None:
    hooked: list[str] = []

    async def hook(request: httpx.Request) -> None:
        hooked.append(request.url.path)

    async def use() -> None:
        async with AsyncClient(event_hooks={"request": [hook]}, transport=ECHO) as client:
            await client.options()

    asyncio.run(use())
    assert hooked == ["/v1/options"]


def test_verify_reaches_httpx(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []
    monkeypatch.setattr(httpx, "Client", lambda **settings: given.append(settings["verify"]))
    context = ssl.create_default_context()
    for verify in (True, False, context):
        Client(verify=verify)
    assert given == [True, False, context]
