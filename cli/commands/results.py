"""Commands on finished results: view, share, rerun."""

from __future__ import annotations

import secrets
import socket
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from pliant.cli.extras import require_server
from pliant.cli.ids import find_job
from pliant.cli.session import HOME, JobId, Json, OptionPairs, Url, parse_options
from pliant.cli.show import err, out, print_json, show_job


def view(
    result: Annotated[
        Path, typer.Argument(help="Folder of a result, or a file in it.", show_default=False, readable=False)
    ],
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the address in a browser.")] = True,
    port: Annotated[int, typer.Option("--port", help="TCP port; 0 takes a free one.", min=0, max=65535)] = 0,
    as_json: Json = False,
) -> None:
    """Show a result folder in the web viewer, without a service or a queue. Ctrl-C stops it."""
    require_server("pliant view")
    import uvicorn
    from pliant.client.errors import BadArgument
    from pliant.service.local_result import create_viewer

    if not result.exists():
        raise BadArgument(f"result: {result} does not exist. Name the folder that `pliant solve -o` wrote.")
    token = secrets.token_urlsafe(16)
    app = create_viewer(result if result.is_dir() else result.parent, token)
    with socket.socket() as listening:
        try:
            listening.bind(("127.0.0.1", port))
        except OSError as fault:
            raise BadArgument(f"--port: cannot listen on {port}: {fault.strerror}. Choose another, or 0.") from None
        listening.listen()  # a browser that is faster than the server waits instead of being refused
        url = f"http://127.0.0.1:{listening.getsockname()[1]}/{token}/#view=local"
        if as_json:
            print_json({"url": url})
        else:
            out().print(url)
            err().print("Ctrl-C ends it.")
        if browser:
            webbrowser.open(url)
        with suppress(KeyboardInterrupt):
            uvicorn.Server(uvicorn.Config(app, log_config=None, server_header=False)).run(sockets=[listening])
    if not as_json:
        err().print("Stopped.")


def share(
    ctx: typer.Context,
    job: JobId,
    days: Annotated[float, typer.Option("--days", help="How long the link is valid.")] = 7,
    revoke: Annotated[
        str | None, typer.Option("--revoke", help="Revoke the link with this id.", metavar="LINK")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="Print the valid links, without their secrets.")] = False,
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """Create and print a read-only link to a finished job's result. Anyone with the link sees this result and nothing else."""
    with ctx.obj.client(url) as client:
        found = find_job(client, job).id
        if revoke is not None:
            client.revoke_share(found, revoke)
            if as_json:
                print_json({"revoked": revoke})
            else:
                err().print(f"Revoked: {revoke}")
            return
        if listed:
            shares = client.shares(found)
            if as_json:
                print_json([each.model_dump(mode="json") for each in shares])
            for each in () if as_json else shares:
                out().print(f"{each.id}  valid until {each.expires_at:%Y-%m-%d %H:%M} UTC")
            return
        made = client.share(found, days=days)
        address = f"{client.url}/{made.path}"
    if as_json:
        print_json({**made.model_dump(mode="json"), "url": address})
    else:
        out().print(address)
        err().print(f"Link {made.id}, valid until {made.expires_at:%Y-%m-%d %H:%M} UTC.")


def rerun(
    ctx: typer.Context,
    job: JobId,
    option: OptionPairs = None,
    name: Annotated[str, typer.Option("--name", "-n", help="Label of the new job; by default the old one's.")] = "",
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """Submit a job's stored inputs with other options, without uploading them again, and print the new job.

    A film is tracked again with the same region, frames, grid and selection of points, unless options change them. All other options
    start from their defaults.
    """
    options = parse_options(option)
    with ctx.obj.client(url) as client:
        again = find_job(client, job).run_again(options, name=name)
        show_job(again.record, as_json=as_json)
        if not as_json:
            err().print(f"Follow it with: pliant watch {again.id}")
