"""Every error code that the source can raise, read from its syntax trees.

A code is a snake_case string that stands where a parameter named `code` is filled: in a call of a function or class that has
such a parameter, as the class attribute or parameter default `code = "…"`, as the keyword `code="…"`, or as the first of a
pair unpacked into `code, detail`. Codes that are put together at run time are listed by hand.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("schemas", "solver", "tracking", "worker", "service", "client", "cli")
LEFT_OUT = ("solver/gallery",)
"""The gallery's arguments are not user input."""

PUT_TOGETHER = frozenset({"unknown_option", "invalid_option", "invalid_request"})
"""`service.problems.from_validation` makes these from a prefix and the field's name."""

NOT_ANSWERED = frozenset({"worker_error"})
"""The base class's own code; nothing raises it."""

_CODE = re.compile(r"[a-z]+(_[a-z0-9]+)*")


def codes_in_source() -> set[str]:
    """Return every code that can reach a user."""
    files = [list(ast.walk(ast.parse(path.read_text(encoding="utf-8")))) for path in _sources()]
    local = [_makers(nodes) for nodes in files]
    everywhere = {name: at for makers in local for name, at in makers.items() if not name.startswith("_")}
    found: set[str] = set()
    for nodes, makers in zip(files, local, strict=True):
        known = everywhere | makers
        for node in nodes:
            found |= set(filter(_CODE.fullmatch, _codes_of(node, known)))
    return (found | PUT_TOGETHER) - NOT_ANSWERED


def _sources() -> Iterator[Path]:
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            if not path.relative_to(ROOT).as_posix().startswith(LEFT_OUT):
                yield path


def _makers(nodes: list[ast.AST]) -> dict[str, int]:
    """Return the functions and classes with a positional parameter `code`, and its place in a call."""
    found: dict[str, int] = {}
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            inner = [each for each in node.body if isinstance(each, ast.FunctionDef) and each.name == "__init__"]
            for each in inner:
                found |= _place_of_code(each, node.name, drop=1)
        elif isinstance(node, ast.FunctionDef):
            found |= _place_of_code(node, node.name, drop=0)
    for node in nodes:  # a class without an __init__ of its own takes its base's
        if isinstance(node, ast.ClassDef):
            for base in node.bases:
                if isinstance(base, ast.Name) and base.id in found and node.name not in found:
                    found[node.name] = found[base.id]
    return found


def _place_of_code(function: ast.FunctionDef, name: str, *, drop: int) -> dict[str, int]:
    names = [argument.arg for argument in function.args.args][drop:]
    return {name: names.index("code")} if "code" in names else {}


def _codes_of(node: ast.AST, makers: dict[str, int]) -> Iterator[str]:
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name == "__init__" and node.args:  # super().__init__("code", …)
            yield from _text(node.args[0])
        if name in makers and len(node.args) > makers[name]:
            yield from _text(node.args[makers[name]])
        for keyword in node.keywords:
            if keyword.arg == "code":
                yield from _text(keyword.value)
    elif isinstance(node, (ast.Assign, ast.AnnAssign)):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if any(isinstance(target, ast.Name) and target.id == "code" for target in targets) and node.value is not None:
            yield from _text(node.value)
    elif isinstance(node, ast.FunctionDef):
        for argument, default in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True):
            if argument.arg == "code" and default is not None:
                yield from _text(default)
    elif isinstance(node, ast.Dict):  # status code: (code, detail)
        for key, value in zip(node.keys, node.values, strict=True):
            by_status = isinstance(key, ast.Constant) and isinstance(key.value, int)
            if by_status and isinstance(value, ast.Tuple) and len(value.elts) == 2:
                yield from _text(value.elts[0])
    elif isinstance(node, ast.Tuple) and len(node.elts) == 2 and isinstance(node.elts[1], ast.JoinedStr):
        yield from (text for text in _text(node.elts[0]) if "_" in text)


def _text(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from _text(node.body)
        yield from _text(node.orelse)
