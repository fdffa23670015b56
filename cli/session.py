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
    Path | None,
    typer.Option("--region", help="For a film: mask picture of the same size; white is tracked.", readable=False),
]
"""The commands check paths themselves, so that every invalid path has the same exit code and form of message."""
Mesh = Annotated[
    str | None,
    typer.Option("--mesh", "-m", help="Mesh file, the size of a grid such as 12x20, or none.", metavar="FILE|RxC"),
]
GroundTruth = Annotated[
    Path | None,
    typer.Option("--ground-truth", "-g", help="True shapes, from which errors are measured.", readable=False),
]
Rotations = Annotated[Path | None, typer.Option("--rotations", "-r", help="Known cameras.", readable=False)]

Name = Annotated[
    str,
    typer.Option("--name", "-n", help="Label of the job and name of the object in its files; by default the file's."),
]

LINE_EVERY = 30.0
"""Seconds between the lines that a waiting command prints without a terminal."""

Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]

HOME = "http://127.0.0.1:8000"


@dataclass
class Session:
    """One run of the command line."""

    transport: httpx.BaseTransport | None = None
    """Replaces the network in tests."""
    url: str | None = None
    """Address of the service that the command uses, which also serves explanations of its errors."""
    following: str | None = None
    """Id of the job that the command waits for; Ctrl-C prints how to return to it."""
    others: int = 0
    """Number of further jobs that the command has submitted and not yet waited for."""

    def client(self, url: str, *, first_contact: float | None = None) -> Client:
        """Return a client; the token comes from PLIANT_TOKEN, so that it never appears in process listings."""
        from pliant.client import Client
        from pliant.client.retry import Retry

        self.url = url
        retries = Retry() if first_contact is None else Retry(first_contact=first_contact)
        return Client(url, transport=self.transport, retries=retries)


def name_of(given: str, file: Path) -> str:
    """Return the name of a job: the given one, or its file's name without extension, truncated to the service's limit."""
    from pliant.client.input_files import job_name

    return given or job_name(file.resolve().name if file.is_dir() else file.stem)


def parse_options(pairs: list[str] | None) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is not valid JSON is a string.

    Raises
    ------
    BadArgument
        A pair has no ``=``.
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
    """Limit the numerical libraries to one thread, because solver and tracker run their own threads.

    Call it before NumPy is imported: the libraries read these variables on import.
    """
    from pliant.worker.processes.containment import NUMERICAL_THREADS

    os.environ.update(dict.fromkeys(NUMERICAL_THREADS, "1"))
