"""`pliant token`: manage access tokens. The commands access the store directly, so they are for operators, not for users."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pliant.cli.extras import require_server
from pliant.cli.paths import installation
from pliant.cli.session import Json
from pliant.cli.show import err, out, print_json
from pliant.cli.up import Data, read_settings

if TYPE_CHECKING:
    from pliant.worker.tokens import Token, Tokens
    from rich.table import Table

MB = 2**20

app = typer.Typer(name="token", help="Create, list and revoke the tokens of a service.", no_args_is_help=True)

Scopes = Annotated[
    list[str] | None,
    typer.Option("--scope", help="read, submit or admin; may be repeated.", show_default="read and submit"),
]
Lifetime = Annotated[
    str | None, typer.Option("--expires", help="Lifetime, e.g. 12h, 90d, 52w.", show_default="never expires")
]
Sharing = Annotated[
    str | None,
    typer.Option("--sharing", help="Id of a token whose jobs the new one shares, e.g. to replace it.", metavar="ID"),
]
Registered = Annotated[
    Path | None,
    typer.Option(
        "--from",
        help="File with a token to register, in place of a new one. Does nothing if it is registered or was revoked.",
        metavar="FILE",
    ),
]
TokenId = Annotated[str, typer.Argument(help="Id of the token, from `pliant token list`.", show_default=False)]


def limit(help: str) -> Any:  # noqa: A002
    """Return the option for a limit of the new token."""
    return typer.Option(help=help, min=1, show_default="the service's")


@app.command()
def create(
    name: Annotated[str, typer.Argument(help="Name of its user or purpose.", show_default=False)],
    scope: Scopes = None,
    expires: Lifetime = None,
    sharing: Sharing = None,
    max_body_mb: Annotated[int | None, limit("Largest body of one request.")] = None,
    max_queued: Annotated[int | None, limit("Most queued jobs.")] = None,
    max_running: Annotated[int | None, limit("Most running jobs.")] = None,
    requests_per_minute: Annotated[int | None, limit("Requests per minute.")] = None,
    source: Registered = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Create a token and print it. It cannot be shown again: the service stores only its SHA-256."""
    from pliant.cli.paths import input_file
    from pliant.worker.tokens import parse_duration

    input_file(source, "--from")

    lasting, scopes = None if expires is None else parse_duration(expires), scopes_of(scope or ["read", "submit"])
    with store(data, new=True) as tokens:
        token, text = tokens.create(
            name,
            scopes=scopes,
            expires=lasting,
            sharing=sharing,
            max_body_bytes=None if max_body_mb is None else max_body_mb * MB,
            max_queued=max_queued,
            max_running=max_running,
            requests_per_minute=requests_per_minute,
            text=None if source is None else source.read_text(encoding="utf-8").strip(),
        )
    if source is not None and not as_json:
        state = "was revoked and stays so; put another one into the file" if token.revoked else "is registered"
        err().print(f"Token {token.id} for {token.name} {state}.")
        return
    if as_json:
        print_json({**dump_token(token), "token": text})
    else:
        _show_once(token, text)


def _show_once(token: Token, text: str) -> None:
    print(text)
    until = "never expires" if token.expires_at is None else f"expires {token.expires_at:%Y-%m-%d %H:%M} UTC"
    err().print(
        f"Token {token.id} for {token.name}: {', '.join(token.scopes)}; {until}. It is shown only once; "
        "its user sets PLIANT_TOKEN to it.",
    )


@app.command(name="list")
def list_tokens(data: Data = None, as_json: Json = False) -> None:
    """List ids and names of the tokens, never the tokens themselves."""
    with store(data) as tokens:
        found = tokens.all()
    if as_json:
        print_json([dump_token(token) for token in found])
        return
    out().print(table_of(found))


def table_of(tokens: Sequence[Token]) -> Table:
    """Return the table of tokens; ids, which other commands take, stay complete on narrow terminals."""
    from rich.table import Column, Table

    now, longest = datetime.now(UTC), max((len(token.id) for token in tokens), default=0)
    limits = [limits_of(token) for token in tokens]
    table = Table(
        Column("id", no_wrap=True, min_width=longest),
        "name",
        "scopes",
        Column("created", overflow="fold"),
        Column("expires", overflow="fold"),
        Column("jobs of", no_wrap=True),
        *(["limits"] if any(limits) else []),
    )
    for token, own in zip(tokens, limits, strict=True):
        expires = "never" if token.expires_at is None else f"{token.expires_at:%Y-%m-%d %H:%M}"
        table.add_row(
            token.id,
            token.name,
            ", ".join(token.scopes),
            f"{token.created_at:%Y-%m-%d %H:%M}",
            f"{expires} (expired)" if token.expired(now) else expires,
            "all" if token.sees_all else token.owner,
            *([own] if any(limits) else []),
        )
    return table


def limits_of(token: Token) -> str:
    """Return the limits that a token has instead of the service's; empty if none."""
    each = {
        "{} queued": token.max_queued,
        "{} running": token.max_running,
        "{:g} MB a body": None if token.max_body_bytes is None else token.max_body_bytes / MB,
        "{} requests a minute": token.requests_per_minute,
    }
    return ", ".join(words.format(most) for words, most in each.items() if most is not None)


@app.command()
def revoke(id: TokenId, data: Data = None, as_json: Json = False) -> None:  # noqa: A002
    """Revoke a token, effective from the next request. Its jobs remain visible to `admin` and to tokens that share them."""
    with store(data) as tokens:
        token = tokens.revoke(id)
    if as_json:
        print_json(dump_token(token))
    else:
        err().print(f"Token {token.id} ({token.name}) is revoked.")


def dump_token(token: Token) -> dict[str, Any]:
    """Return a token's record without its hash, for JSON output."""
    return token.model_dump(
        mode="json", exclude={"sha256"} if token.revoked else {"sha256", "revoked"}, exclude_none=True
    )


def scopes_of(words: list[str]) -> list[Any]:
    """Parse the scopes.

    Raises
    ------
    BadArgument
        A word is not a scope.
    """
    from pliant.client.errors import BadArgument
    from pliant.schemas.validation import alternatives
    from pliant.worker.tokens import Scope

    unknown = [word for word in words if word not in set(Scope)]
    if unknown:
        raise BadArgument(f"--scope: expected {alternatives(Scope)}, got {unknown[0]!r}.")
    return [Scope(word) for word in words]


@contextmanager
def store(data: Path | None, *, new: bool = False) -> Iterator[Tokens]:
    """Open the tokens of an installation, whether or not its service is running.

    With `new` the installation need not exist yet, because the first token is created before the service starts.

    Raises
    ------
    BadArgument
        There is no installation, and `new` is False.
    """
    require_server("pliant token")
    from pliant.worker.processes.valkey import attended
    from pliant.worker.tokens import Tokens

    settings = read_settings(data, None)
    if not new:
        installation(settings)
    with attended(settings):
        yield Tokens.open(settings)
