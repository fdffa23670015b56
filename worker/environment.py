"""Read settings records: from the environment first, then `.env` in the working directory, then the folder of secret files.

A record is a frozen Pydantic dataclass. Field NAME is read from the variable PLIANT_NAME; its default, bounds and description are
defined only in the record. `pliant.worker.settings` and `pliant.service.settings` are both read this way.
"""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from pliant.schemas.suggestions import closest
from pliant.schemas.validation import alternatives
from pliant.worker.errors import InvalidSetting
from pydantic import BaseModel, ValidationError, create_model, model_validator
from pydantic.dataclasses import is_pydantic_dataclass
from pydantic.fields import FieldInfo

T = TypeVar("T")

PREFIX = "PLIANT_"

SECRETS = "/run/secrets"
"""Folder of secret files, as Docker and Kubernetes mount them, unless PLIANT_SECRETS_DIR names another one."""

OTHER_VARIABLES = frozenset(
    f"{PREFIX}{name}"
    for name in (
        "SECRETS_DIR",
        *("URL", "TOKEN", "WEBHOOK_SECRET"),  # of the client and the command line
        *("DOMAIN", "REDIS_PASSWORD"),  # of the Compose files
        "PAGE",  # of the installation
        "WORKER_PROCESS",  # set by a worker for its jobs
        *("CHROMIUM", "EXAMPLES", "SCREENSHOTS"),  # of the tests
    )
)
"""Variables with our prefix that are no settings of service and workers; they are not reported as unknown."""

_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}

_BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}


def variable_of(name: str) -> str:
    """Return the name of a field's environment variable."""
    return f"{PREFIX}{name.upper()}"


def fields_of(record: type[Any]) -> dict[str, FieldInfo]:
    """Return the fields of a settings record with their types, defaults and bounds."""
    assert is_pydantic_dataclass(record), record
    return dict(record.__pydantic_fields__)


def expected_of(field: FieldInfo) -> str:
    """Return a text for the valid values of a field: its description, or its type and bounds."""
    if field.description is not None:
        return field.description
    kinds = [kind for kind in get_args(field.annotation) if kind is not type(None)] or [field.annotation]
    if get_origin(field.annotation) is Literal:
        return alternatives(map(repr, kinds))
    bounds = [
        f", {word} {getattr(each, sign)}" for each in field.metadata for sign, word in _BOUNDS.items() if hasattr(each, sign)
    ]  # fmt: skip
    return _KINDS.get(kinds[0], "text") + "".join(bounds)


def read(record: type[T]) -> T:
    """Read a settings record from the environment, `.env` and the secret files; an empty variable counts as unset.

    Raises
    ------
    InvalidSetting
        A variable does not parse or is out of its range.
    """
    found = _found(record)
    return record(**{field.name: getattr(found, field.name) for field in fields(record)})  # type: ignore[arg-type]


def given(record: type[Any]) -> frozenset[str]:
    """Return the names of the fields set by the environment, `.env` or the secret files. Raises the same errors as `read`."""
    return frozenset(_found(record).model_fields_set)


def unknown(*records: type[Any]) -> dict[str, str | None]:
    """Return the variables of the environment and of `.env` that no record reads, in upper case, and for each the one probably meant.

    Empty ones do not count. Secret files are not listed, because their folder may be shared with other programs.
    """
    from pydantic_settings import BaseSettings, DotEnvSettingsSource

    known = {variable_of(name) for record in records for name in fields_of(record)} | OTHER_VARIABLES
    filed = DotEnvSettingsSource(BaseSettings, env_file=_dotenv(), env_file_encoding="utf-8").env_vars
    values = {name.upper(): value for each in (filed, os.environ) for name, value in each.items()}
    names = {name.removeprefix(PREFIX).lower() for name in known}
    found = sorted(name for name, value in values.items() if value and name.startswith(PREFIX) and name not in known)
    meant = {name: closest(name.removeprefix(PREFIX), names) for name in found}
    return {name: None if near is None else variable_of(near) for name, near in meant.items()}


def warnings_of_unknown(*records: type[Any]) -> list[str]:
    """Return a sentence for each of the `unknown` variables."""
    return [
        f"{name} is no setting of Pliant and has no effect." + ("" if meant is None else f" Did you mean {meant}?")
        for name, meant in unknown(*records).items()
    ]


def _found(record: type[Any]) -> BaseModel:
    # Imported here because the SDK works without the extra `server`; only services and workers read settings.
    from pydantic_settings import BaseSettings, SettingsConfigDict

    known = fields_of(record)

    class Environment(BaseSettings):
        model_config = SettingsConfigDict(
            env_prefix=PREFIX,
            env_ignore_empty=True,
            env_file=_dotenv(),
            env_file_encoding="utf-8",
            enable_decoding=False,
            extra="ignore",
            secrets_dir=_secrets(),
        )

        @model_validator(mode="before")
        @classmethod
        def drop_empty(cls, given: dict[str, Any]) -> dict[str, Any]:
            return {name: value for name, value in given.items() if value != ""}  # empty secret files

    secrets = {variable_of(name).lower() for name in known}
    for file in Path(folder).iterdir() if (folder := _secrets()) is not None else ():
        if file.name.lower() in secrets and file.is_file():
            _check_readable(file)
    spelled: dict[str, Any] = {name: (field.annotation, field) for name, field in known.items()}
    try:
        return create_model("Environment", __base__=Environment, **spelled)()
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        raise InvalidSetting(variable_of(name), expected=expected_of(known[name]), got=repr(first["input"])) from None


def _dotenv() -> str | None:
    """Return `.env`; None in a directory that this user may not enter, such as the home of whoever calls `sudo -u`.

    Raises
    ------
    InvalidSetting
        There is such a file, but this user cannot read it, or it is not UTF-8.
    """
    if not os.access(".", os.X_OK):
        return None
    if Path(".env").is_file():
        _check_readable(Path(".env"))
    return ".env"


def _check_readable(file: Path) -> None:
    try:
        file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as fault:
        got = fault.strerror if isinstance(fault, OSError) else "other bytes"
        hint = "Let the user that runs Pliant read the file, or correct its encoding."
        raise InvalidSetting(
            str(file), expected="a file in UTF-8 that this user can read", got=str(got), hint=hint
        ) from None


def _secrets() -> str | None:
    given = os.environ.get(f"{PREFIX}SECRETS_DIR")
    if given and not Path(given).is_dir():
        raise InvalidSetting(f"{PREFIX}SECRETS_DIR", expected="a folder", got=repr(given))
    folder = given or SECRETS
    return folder if Path(folder).is_dir() else None
