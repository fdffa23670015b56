"""Copy docs/ to a folder, replace each marker ``<!-- generated: NAME -->`` by text generated from the code, and clean code fences.

    python docs/generate.py build/docs

Markers: `options` (JSON schema of the job options), `settings` (environment variables), `cli` (the commands' help), `rest`, `job`
and `answers` (OpenAPI document), `records` (the SDK's records), `errors` (table of error codes). A fence such as
``bash not-run: REASON`` becomes ``bash``, because Markdown renderers other than GitHub's treat a longer info string as text. The
strict build that follows in `make docs` checks pages, links and anchors.
"""

from __future__ import annotations

import ast
import inspect
import json
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby, pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

DOCS = Path(__file__).resolve().parent
MARKER = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
ERROR_GROUPS = {
    "Failed jobs": "Codes of a job's `error`. Any code of an input error below can appear there, too.",
    "Meaning of the input": "The solver raises the same codes as `InvalidInput`.",
    "Command line and start-up": "These end a command or stop the start of a process.",
}
"""Introductory sentences of groups of error codes."""

OPTION_GROUPS = {
    "Method": (
        "method", "preset", "prior", "loss", "laplacian", "refine_rotations", "basis_size", "max_reweightings", "tolerance",
        "precision", "seed", "time_limit",
    ),
    "Camera": ("camera", "focal", "field_of_view", "image_size", "principal_point"),
    "Surface and order": ("surface", "order"),
    "Weights": ("temporal_weight", "spatial_weight", "robust_scale", "temporal_order", "low_rank_weight"),
    "Reading": ("layout", "rows", "coordinates", "coordinate_order", "y_axis", "visibility"),
    "Selection": ("frames", "stride", "max_points", "min_seen"),
    "Film": ("template_frame", "grid_step", "longest_side", "region_frame", "region_polygon"),
    "Files": ("outputs", "fps", "normals", "colours", "axes", "glb_quantized", "glb_motion"),
}  # fmt: skip
"""Options by purpose, in the order of the page."""

JOB_RECORDS = ("Job", "Status", "Progress", "FollowedPoints", "Interpretation", "Estimate", "Artifact")
"""The record of a job, and those that it contains."""

ANSWER_RECORDS = (
    "JobPage", "Inspection", "Upload", "Share", "ServiceLimits", "ErrorCode", "Examples", "Example", "ExampleFile",
)  # fmt: skip
"""Records of the other answers."""

SDK_RECORDS = ("Job", "Interpretation", "Inspection", "Progress", "Artifact", "Problem", "Share", "ServiceLimits")
INNER = ("Estimate", "FollowedPoints")
"""Records of the SDK: exported by `pliant.client`, and contained in those."""

PAGES = {"Options": "options.md", "Problem": "errors.md", "ProblemCode": "errors.md"}
"""Where the REST page links for schemas that have no table of their own."""

SEVERAL = re.compile(r"^(boolean|integer|list|number|object|pair|string)\b")
"""Words for types that have a plural."""

BAR = re.compile(r"(`[^`]*`)|\|")
"""A code span, or a bar, which would end the cell of a table."""

NOTE = re.compile(r"^( *```\w+) not-run: .*$", re.MULTILINE)


def main(target: Path) -> None:
    """Write the site's sources to a folder, which is emptied first."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(DOCS, target, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for page in sorted(target.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        filled = NOTE.sub(r"\1", MARKER.sub(lambda found: GENERATORS[found[1]](), text))
        if filled != text:
            page.write_text(filled, encoding="utf-8")


def options() -> str:
    """Return a section for every job option, from the JSON schema, grouped by purpose."""
    from pliant.schemas.options import Options

    properties = Options.model_json_schema()["properties"]
    parts = []
    for group, names in OPTION_GROUPS.items():
        # The anchors #method and #camera belong to the options.
        parts += [
            f"## {group} {{ #{group.lower().replace(' ', '-')}-group }}",
            *(_option(name, properties[name]) for name in names),
        ]
    return "\n\n".join(parts)


def _option(name: str, field: dict[str, Any]) -> str:
    about = f"Type: {_type_of(field)}. Default: `{_plain(field.get('default'))}`."
    return f"### {name}\n\n{field.get('description', '')}\n\n{about}"


def settings() -> str:
    """Return a table of the environment variables of the workers, and one of those of the service."""
    from pliant.service import settings as of_service
    from pliant.worker import settings as of_worker

    worker, service = _settings_of(of_worker, "Settings"), _settings_of(of_service, "ServiceSettings")
    heads = ("variable", "default", "meaning")
    return f"## Storage and work\n\n{_table(heads, worker)}\n\n## Access control and rate limits\n\n{_table(heads, service)}"


def _settings_of(module: ModuleType, record: str) -> list[tuple[str, str, str]]:
    """Return a row for every setting of a record: variable, default, and meaning with the expected values."""
    from pliant.worker.environment import expected_of, fields_of, variable_of

    notes, fields = _field_notes(module, record), fields_of(getattr(module, record))
    for name in fields:  # the page names variables, the class names fields
        notes = {each: note.replace(f"`{name}`", f"`{variable_of(name)}`") for each, note in notes.items()}
    return [
        (f"`{variable_of(name)}`", _default(field.default), f"{notes[name]} Expected: {expected_of(field)}.")
        for name, field in fields.items()
    ]


def errors() -> str:
    """Return a section for every error code, grouped by the sections of the table."""
    from pliant.schemas.problems import ProblemCode

    parts = []
    for section, codes in groupby(ProblemCode, key=lambda code: code.section):
        parts.append(f"## {section}")
        parts += [ERROR_GROUPS[section]] if section in ERROR_GROUPS else []
        parts += [_error(code) for code in codes]
    return "\n\n".join(parts)


def _error(code: Any) -> str:
    status = "" if code.status is None else f"**Status {code.status}**{', retryable' if code.retryable else ''}. "
    return f"### {code.value}\n\n{status}{code.cause}\n\n**Remedy:** {code.remedy}"


def cli() -> str:
    """Return the help of every command, as Markdown."""
    import typer
    from pliant.cli import app

    return "\n\n".join(_command(typer.main.get_command(app), "pliant"))


def rest() -> str:
    """Return every operation of the OpenAPI document: scope, parameters, responses."""
    document = openapi()
    parts = []
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            parts.append(_operation(method.upper(), path, operation))
    return "\n\n".join(parts)


def job() -> str:
    """Return a table of fields for the record of a job and for each record in it."""
    return _tables(JOB_RECORDS)


def answers() -> str:
    """Return a table of fields for each record of the other answers."""
    return _tables(ANSWER_RECORDS)


def _tables(names: tuple[str, ...]) -> str:
    """Return a section for each schema of the OpenAPI document."""
    schemas, parts = openapi()["components"]["schemas"], []
    for name in names:
        schema = schemas[name]
        known = schemas["Interpretation"]["properties"] if name == "Inspection" else {}
        rows = [
            (f"`{field}`", _linked(_type_of(each)), each.get("description", ""))
            for field, each in schema.get("properties", {}).items()
            if field not in known
        ]
        table = _table(("member", "type", "meaning"), rows) if rows else f"One of {_type_of(schema)}."
        more = "The members of [Interpretation](#interpretation), and:\n\n" if known else ""
        parts.append(f"### {name}\n\n{schema['description']}\n\n{more}{table}")
    return "\n\n".join(parts)


def _linked(words: str) -> str:
    """Turn the names of schemas, in the words of a type, into links."""
    return re.sub(r"`([A-Z]\w+)`", lambda found: f"[{found[1]}]({PAGES.get(found[1], f'#{found[1].lower()}')})", words)


def records() -> str:
    """Return an entry for each record of the SDK, with a table of its fields."""
    from pliant import client
    from pliant.schemas import job as of_job

    parts = []
    for home in (*(f"pliant.client.{name}" for name in SDK_RECORDS), *(f"pliant.schemas.job.{name}" for name in INNER)):
        model = getattr(of_job if "schemas" in home else client, home.rpartition(".")[2])
        rows = [
            (f"`{name}`", f"`{model.__annotations__[name]}`", (field.description or "").replace("null", "None"))
            for name, field in model.model_fields.items()
            if name in model.__annotations__  # without those of its base class, which has its own entry
        ]
        parts.append(f"::: {home}\n    options:\n      members: false\n\n{_table(('field', 'type', 'meaning'), rows)}")
    return "\n\n".join(parts)


def openapi() -> dict[str, Any]:
    """Return the OpenAPI document of a service that was never started."""
    from pliant.service.app import create_app
    from pliant.service.settings import ServiceSettings
    from pliant.worker.jobs.service import Jobs
    from pliant.worker.settings import Settings
    from pliant.worker.tokens import Tokens

    of_worker = Settings(blob_url="memory:///")
    app = create_app(Jobs.open(of_worker), ServiceSettings(), tokens=Tokens.open(of_worker))
    found: dict[str, Any] = app.openapi()
    return found


def _operation(method: str, path: str, operation: dict[str, Any]) -> str:
    from pliant.service.middleware.auth import is_public, needed

    scope = needed(method, path)
    summary = operation.get("summary", "")
    summary += "" if summary.endswith(("?", ".")) else "."
    lines = [f"### {method} {path}", f"{summary} Scope: {_scope(is_public(path), scope)}."]
    about = inspect.cleandoc(operation.get("description", "")).partition("\n\nParameters")[0].partition("\n\nRaises")[0]
    if about:
        lines.append(about)
    parameters = [
        (f"`{each['name']}`", each["in"], "yes" if each.get("required") else "no", _schema_note(each))
        for each in operation.get("parameters", [])
        if each["name"] != "id" or each["in"] != "path"
    ]
    if parameters:
        lines.append(_table(("parameter", "in", "required", "meaning"), parameters))
    statuses = sorted(operation["responses"])
    good = [status for status in statuses if int(status) < 400]
    answered = ", ".join(f"{status}{_body(operation['responses'][status])}" for status in good)
    lines.append(f"Answers: {answered}. Errors: {', '.join(status for status in statuses if status not in good)}.")
    return "\n\n".join(lines)


def _body(response: dict[str, Any]) -> str:
    """Return the type of an answer's body in brackets: a record, or the media types; nothing without a body."""
    content = response.get("content", {})
    words = _linked(_type_of(content.get("application/json", {}).get("schema", {})))
    kinds = words if "](" in words else ", ".join(f"`{media}`" for media in content)
    return f" ({kinds})" if kinds else ""


def _scope(public: bool, scope: Any) -> str:
    return "none" if public else "any" if scope is None else f"`{scope.value}`"


def _schema_note(parameter: dict[str, Any]) -> str:
    schema = parameter.get("schema", {})
    return f"{parameter.get('description', schema.get('description', ''))} ({_linked(_type_of(schema))})"


def _command(command: Any, path: str) -> Iterator[str]:
    import click

    if hasattr(command, "commands"):
        if path != "pliant":
            yield f"### {path}\n\n{inspect.cleandoc(command.help or '')}"
        for name, each in command.commands.items():
            yield from _command(each, f"{path} {name}")
        return
    context = click.Context(command, info_name=path)
    usage = " ".join(command.collect_usage_pieces(context))
    parts = [f"### {path}", inspect.cleandoc(command.help or ""), f"```text\n{path} {usage}\n```"]
    rows = []
    for parameter in command.params:
        if parameter.name == "help" or getattr(parameter, "hidden", False):
            continue
        named = parameter.param_type_name == "argument"
        shown = str(parameter.name).upper() if named else ", ".join([*parameter.opts, *parameter.secondary_opts])
        rows.append((f"`{shown}`", _click_default(parameter), getattr(parameter, "help", "") or ""))
    if rows:
        parts.append(_table(("parameter", "default", "meaning"), rows))
    yield "\n\n".join(part for part in parts if part)


def _click_default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    shown = getattr(parameter, "show_default", None)
    if isinstance(shown, str):
        return shown
    value = parameter.default
    if value is True:
        return f"`{parameter.opts[0]}`"
    return "" if value is None or value is False or callable(value) or value in ((), [], "") else f"`{value}`"


def _field_notes(module: Any, name: str) -> dict[str, str]:
    """Return the docstring of each field of a class, which Python does not keep."""
    tree = ast.parse(inspect.getsource(module))
    body = next(node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    notes = {}
    for field, note in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(note, ast.Expr):
            text = " ".join(inspect.cleandoc(ast.literal_eval(note.value)).split())
            notes[field.target.id] = text.replace("None:", "not set:")
    return notes


def _type_of(schema: dict[str, Any]) -> str:
    """Return a JSON schema's type, choices and bounds in words."""
    if "anyOf" in schema:
        return " or ".join(_type_of(each) for each in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{each}`" for each in schema["enum"])
    if "$ref" in schema:
        return f"`{schema['$ref'].rpartition('/')[2]}`"
    if "prefixItems" in schema:
        return f"pair of {_type_of({'type': schema['prefixItems'][0]['type']})}s"
    if schema.get("type") == "array":
        return "list of " + SEVERAL.sub(r"\1s", _type_of(schema.get("items", {})))
    bounds = [
        f"{sign} {_number(schema[key])}"
        for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in schema
    ]
    pattern = [f"pattern `{schema['pattern']}`"] if "pattern" in schema else []
    kind = "time (ISO 8601)" if schema.get("format") == "date-time" else str(schema.get("type", "any"))
    return ", ".join([kind, *bounds, *pattern])


def _number(value: float) -> str:
    """Return a number with separators; a large power of two as such."""
    power = round(math.log2(value)) if value > 2**53 else 0
    return f"2^{power}" if power and value == 2**power else f"{value:,.10g}".replace("e-0", "e-")


def _default(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if value is None or value == () or value == "":
        return "none"
    return f"{value:.0f}" if isinstance(value, float) and value.is_integer() else f"{value}"


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(value)
    return value if isinstance(value, str) else json.dumps(value)


def _table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [" | ".join(heads), " | ".join("---" for _ in heads)]
    lines += [" | ".join(_cell(each) for each in row) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)


def _cell(text: str) -> str:
    """Return a cell on one line, in which a bar outside code does not end it."""
    return BAR.sub(lambda found: found[1] or r"\|", " ".join(text.split()))


GENERATORS: dict[str, Callable[[], str]] = {
    "options": options,
    "settings": settings,
    "cli": cli,
    "rest": rest,
    "job": job,
    "answers": answers,
    "records": records,
    "errors": errors,
}

if __name__ == "__main__":
    main(Path(sys.argv[1]))
