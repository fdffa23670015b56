"""`pliant explain`: what an error code means, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from pliant.cli.session import Json
from pliant.cli.show import out, print_json

if TYPE_CHECKING:
    from pliant.schemas.problems import ProblemCode


def explain(
    code: Annotated[str, typer.Argument(help="Code of an error; all codes if not given.", show_default=False)] = "",
    as_json: Json = False,
) -> None:
    """Explain an error code: when the error occurs, and what to do. Error messages state their code."""
    from pliant.schemas.problems import ProblemCode

    codes = [parse_code(code)] if code else list(ProblemCode)
    if as_json:
        print_json([{"code": each, **_members(each)} for each in codes])
        return
    screen = out()
    for each in codes:
        if not code:
            screen.print(f"{each.value}  {each.heading}")
            continue
        status = "" if each.status is None else f" (HTTP status {each.status})"
        screen.print(f"{each.heading}: {each.value}{status}")
        screen.print(f"{each.cause}\nWhat to do: {each.remedy}")


def parse_code(text: str) -> ProblemCode:
    """Return the error code with this name.

    Raises
    ------
    BadArgument
        There is no such code.
    """
    from pliant.client.errors import BadArgument
    from pliant.schemas.problems import ProblemCode, find_code
    from pliant.schemas.suggestions import closest

    found = find_code(text)
    if found is None:
        close = closest(text, list(ProblemCode))
        meant = "" if close is None else f" Did you mean {close}?"
        raise BadArgument(f"CODE: there is no error code {text!r}.{meant} `pliant explain` lists all codes.")
    return found


def _members(code: ProblemCode) -> dict[str, str | int | None]:
    return {"status": code.status, "title": code.heading, "cause": code.cause, "remedy": code.remedy}
