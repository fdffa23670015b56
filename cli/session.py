"""What the commands have in common: their shared options, and the client they talk through."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import httpx
    from pliant.client import Client

Url = Annotated[
    str, typer.Option("--url", envvar="PLIANT_URL", help="Address of the service.", show_default=True, metavar="URL")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, for scripts.")]
Timeout = Annotated[
    float | None, typer.Option("--timeout", help="Give up after this many seconds; the job goes on.", min=0.1)
]
JobId = Annotated[str, typer.Argument(help="Id of the job.", show_default=False)]
OptionPairs = Annotated[
    list[str] | None,
    typer.Option("--option", "-O", help="An option, e.g. -O loss=huber; again for more.", metavar="NAME=VALUE"),
]
Tracks = Annotated[Path, typer.Argument(help="Track file, in any format `pliant inspect` reads.", show_default=False)]
Mesh = Annotated[
    str | None, typer.Option("--mesh", "-m", help="Mesh file, or the size of a grid such as 12x20.", metavar="FILE|RxC")
]
GroundTruth = Annotated[
    Path | None, typer.Option("--ground-truth", "-g", help="True shapes; metrics come by themselves.")
]
Rotations = Annotated[Path | None, typer.Option("--rotations", "-r", help="Known cameras.")]

HOME = "http://127.0.0.1:8000"


@dataclass
class Session:
    """One run of the command line."""

    json: bool = False
    transport: httpx.BaseTransport | None = None
    """Instead of the network, in tests."""

    def client(self, url: str, *, as_json: bool, first_contact: float | None = None) -> Client:
        """Open a client; the token comes from PLIANT_TOKEN, so that it stands in no list of processes."""
        from pliant.client import Client
        from pliant.client.retry import Retry

        self.json = as_json
        retries = Retry() if first_contact is None else Retry(first_contact=first_contact)
        return Client(url, token=os.environ.get("PLIANT_TOKEN") or None, transport=self.transport, retries=retries)


def parse_options(pairs: list[str] | None) -> dict[str, Any]:
    """Read NAME=VALUE pairs; a value is JSON where it can be, else text.

    Raises
    ------
    BadArgument
        A pair without ``=``.
    """
    from pliant.client.errors import BadArgument

    options: dict[str, Any] = {}
    for pair in pairs or ():
        name, equals, value = pair.partition("=")
        if equals == "":
            raise BadArgument(f"--option: expected NAME=VALUE, got {pair!r}. `pliant options` lists every option.")
        try:
            options[name.strip()] = json.loads(value)
        except ValueError:
            options[name.strip()] = value
    return options
