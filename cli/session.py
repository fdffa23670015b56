"""Shared options of the commands, and the client that they use."""

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
    float | None, typer.Option("--timeout", help="Stop waiting after this many seconds; the job continues.", min=0.1)
]
JobId = Annotated[
    str, typer.Argument(help="Id of the job, its first characters, or @last for the newest job.", show_default=False)
]
OptionPairs = Annotated[
    list[str] | None,
    typer.Option("--option", "-O", help="An option, e.g. -O loss=huber; may be repeated.", metavar="NAME=VALUE"),
]
Tracks = Annotated[
    Path,
    typer.Argument(
        help="Track file, in any format `pliant inspect` reads; or a film.", show_default=False, readable=False
    ),
]
Region = Annotated[
    Path | None, typer.Option("--region", help="Of a film: mask picture of its size; white is tracked.", readable=False)
]
"""Paths are checked by the commands: one exit code and one form of message for every wrong path."""
Mesh = Annotated[
    str | None, typer.Option("--mesh", "-m", help="Mesh file, or the size of a grid such as 12x20.", metavar="FILE|RxC")
]
GroundTruth = Annotated[
    Path | None,
    typer.Option("--ground-truth", "-g", help="True shapes; the result then has error metrics.", readable=False),
]
Rotations = Annotated[Path | None, typer.Option("--rotations", "-r", help="Known cameras.", readable=False)]

Name = Annotated[
    str,
    typer.Option("--name", "-n", help="Label of the job and name of the object in its files; by default the file's."),
]

LINE_EVERY = 30.0
"""Without a terminal, waiting commands print a line this often, seconds."""

Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]

HOME = "http://127.0.0.1:8000"


@dataclass
class Session:
    """One run of the command line."""

    json: bool = False
    transport: httpx.BaseTransport | None = None
    """Replaces the network in tests."""
    url: str | None = None
    """Address of the service that the command talks to; it explains the errors of its answers."""
    following: str | None = None
    """Id of the job that the command waits for; Ctrl-C prints how to return to it."""
    others: int = 0
    """Further jobs that the command has submitted and not yet seen to the end."""

    def client(self, url: str, *, as_json: bool, first_contact: float | None = None) -> Client:
        """Return a client; the token comes from PLIANT_TOKEN, so that it never appears in a list of processes."""
        from pliant.client import Client
        from pliant.client.retry import Retry

        self.json, self.url = as_json, url
        retries = Retry() if first_contact is None else Retry(first_contact=first_contact)
        return Client(url, transport=self.transport, retries=retries)


def name_of(given: str, file: Path) -> str:
    """Return the name of a job: the one given, or that of its file without the ending, as far as a service takes it."""
    from pliant.client.multipart import job_name

    return given or job_name(file.resolve().name if file.is_dir() else file.stem)


def parse_options(pairs: list[str] | None) -> dict[str, Any]:
    """Read NAME=VALUE pairs; a value that is not JSON is text.

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


def one_numerical_thread() -> None:
    """Limit the numerical libraries to one thread: solver and tracker have threads of their own.

    The libraries read these variables when they are imported, so call it before anything that imports NumPy.
    """
    from pliant.worker.settings import NUMERICAL_THREADS

    os.environ.update(dict.fromkeys(NUMERICAL_THREADS, "1"))
