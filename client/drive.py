"""The two shells around the flows: one blocks, one awaits. They do what a flow wishes and decide nothing."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, AsyncIterator, Generator, Iterator
from contextlib import AsyncExitStack, ExitStack
from typing import Any, Self, TypeVar

import httpx
from pliant.client.flow import Do, Emit, Flow, Head, Open, Pause, Pull, Wish
from pliant.client.request import request_for

T = TypeVar("T")


def run(http: httpx.Client, flow: Flow[T]) -> T:
    """Drive a flow to its end and return what it returns."""
    steps = iterate(http, flow)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            value: T = done.value
            return value


def iterate(http: httpx.Client, flow: Flow[T]) -> Generator[Any, None, T]:
    """Drive a flow, handing on what it emits."""
    with Wire(http) as wire:
        try:
            wish = next(flow)
            while True:
                if isinstance(wish, Emit):
                    yield wish.value
                    wish = flow.send(None)
                    continue
                try:
                    reply = wire.act(wish)
                except httpx.TransportError as lost:
                    wish = flow.throw(lost)
                else:
                    wish = flow.send(reply)
        except StopIteration as done:
            value: T = done.value
            return value
        finally:
            flow.close()


class Wire:
    """Carries out wishes by blocking calls."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http
        self._answer = ExitStack()
        self._chunks: Iterator[bytes] = iter(())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._answer.close()

    def act(self, wish: Wish) -> Any:
        """Do one thing and return what came of it."""
        match wish:
            case Open(call, timeout):
                self._answer.close()
                with ExitStack() as sending:
                    request = request_for(self._http, call, timeout, sending)
                    response = self._http.send(request, stream=True)
                self._answer.callback(response.close)
                self._chunks = response.iter_bytes()
                return Head(response.status_code, response.headers)
            case Pull():
                return next(self._chunks, b"")
            case Pause(seconds):
                return time.sleep(seconds)
            case Do(function):
                return function()
            case _:
                raise TypeError(f"not a wish: {wish!r}")


async def arun(http: httpx.AsyncClient, flow: Flow[T]) -> T:
    """Drive a flow to its end and return what it returns."""
    async with AsyncWire(http) as wire:
        try:
            wish = next(flow)
            while True:
                try:
                    reply = await wire.act(wish)
                except httpx.TransportError as lost:
                    wish = flow.throw(lost)
                else:
                    wish = flow.send(reply)
        except StopIteration as done:
            value: T = done.value
            return value
        finally:
            flow.close()


async def aiterate(http: httpx.AsyncClient, flow: Flow[Any]) -> AsyncGenerator[Any, None]:
    """Drive a flow, handing on what it emits; an asynchronous generator cannot return a value, so the flow's own is lost."""
    async with AsyncWire(http) as wire:
        try:
            wish = next(flow)
            while True:
                if isinstance(wish, Emit):
                    yield wish.value
                    wish = flow.send(None)
                    continue
                try:
                    reply = await wire.act(wish)
                except httpx.TransportError as lost:
                    wish = flow.throw(lost)
                else:
                    wish = flow.send(reply)
        except StopIteration:
            return
        finally:
            flow.close()


class AsyncWire:
    """Carries out wishes by awaiting."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http
        self._answer = AsyncExitStack()
        self._chunks: AsyncIterator[bytes] | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._answer.aclose()

    async def act(self, wish: Wish) -> Any:
        """Do one thing and return what came of it."""
        match wish:
            case Open(call, timeout):
                await self._answer.aclose()
                with ExitStack() as sending:
                    request = request_for(self._http, call, timeout, sending)
                    response = await self._http.send(request, stream=True)
                self._answer.push_async_callback(response.aclose)
                self._chunks = response.aiter_bytes()
                return Head(response.status_code, response.headers)
            case Pull():
                return b"" if self._chunks is None else await anext(self._chunks, b"")
            case Pause(seconds):
                return await asyncio.sleep(seconds)
            case Do(function):
                return await asyncio.to_thread(function)
            case _:
                raise TypeError(f"not a wish: {wish!r}")
