"""The table of error codes: complete, explained by the service, and linked from every problem."""

from __future__ import annotations

import ast
import gc
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from pliant.schemas.job import Problem
from pliant.schemas.problems import ProblemCode, explanations, find_code
from pliant.service.problems import Refusal

ROOT = Path(__file__).parents[2]
FOLDERS = ("schemas", "solver", "tracking", "worker", "service", "client", "cli")


Sources = list[tuple[Path, list[ast.AST]]]
"""Every module with its nodes. They are not kept: half a million objects slow down each garbage collection of later tests."""


def read_sources() -> Sources:
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    return [(path, list(ast.walk(ast.parse(path.read_text())))) for path in paths if "testing" not in path.parts]


def code_parameters(sources: Sources) -> dict[str, int]:
    """Return, by qualified name, the position of the parameter `code` of every function and class that has one."""
    found = {"pliant.schemas.invalid.Invalid": 0}
    heirs: dict[str, list[str]] = {}
    for path, nodes in sources:
        module = "pliant." + ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in nodes:
            if isinstance(node, ast.ClassDef):
                if not any(isinstance(each, ast.FunctionDef) and each.name == "__init__" for each in node.body):
                    heirs[f"{module}.{node.name}"] = [ast.unparse(base) for base in node.bases]
                for method in node.body:
                    if isinstance(method, ast.FunctionDef) and method.name == "__init__":
                        names = [arg.arg for arg in method.args.args]
                        if "code" in names:
                            found[f"{module}.{node.name}"] = names.index("code") - 1
            elif isinstance(node, ast.FunctionDef):
                names = [arg.arg for arg in node.args.args]
                if "code" in names and names[0] not in ("self", "cls"):
                    found[f"{module}.{node.name}"] = names.index("code")
    for _ in range(3):  # a class without its own constructor inherits its base's
        at = {name.rsplit(".", 1)[1]: position for name, position in found.items()}
        for name, bases in heirs.items():
            if bases and bases[0] in at:
                found.setdefault(name, at[bases[0]])
    return found


def is_name(node: ast.expr) -> bool:
    """Return True for a string that can be a code; a sentence cannot."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier()


def is_attribute(node: ast.expr, of: str, name: str | None = None) -> bool:
    """Return True for `of.name`, for any attribute of `of` if no name is given."""
    return (
        isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == of
        and name in (None, node.attr)
    )


def literals(node: ast.expr) -> Iterator[str]:
    """Yield the literal codes that an expression can evaluate to."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from literals(node.body)
        yield from literals(node.orelse)
    elif isinstance(node, ast.JoinedStr):
        raise AssertionError(f"a code is put together in line {node.lineno}; name it whole, so that it can be found")


def raised_codes() -> dict[str, str]:
    """Return every code that the sources use, with one place for each."""
    sources = read_sources()
    parameters = code_parameters(sources)
    short = {name.rsplit(".", 1)[1] for name in parameters}
    found: dict[str, str] = {}
    for path, nodes in sources:
        module = "pliant." + ".".join(path.relative_to(ROOT).with_suffix("").parts)
        names = {name.rsplit(".", 1)[1]: name for name in parameters if name.startswith(f"{module}.")}
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                for alias in node.names:
                    if alias.name in short:
                        same = [name for name in parameters if name.rsplit(".", 1)[1] == alias.name]
                        # From the module itself, or from a package that exports it.
                        origin = [name for name in same if name.startswith(f"{node.module}.")]
                        if origin:
                            names[alias.asname or alias.name] = origin[0]
        for node in nodes:
            codes: list[ast.expr] = []
            if isinstance(node, ast.Call):
                called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                codes += [keyword.value for keyword in node.keywords if keyword.arg == "code"]
                position = 0 if is_attribute(node.func, "Problem", "of") else parameters.get(names.get(called, ""))
                if position is not None and len(node.args) > position:
                    codes.append(node.args[position])
                if called == "__init__" and node.args and is_name(node.args[0]):
                    codes.append(node.args[0])
            elif isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                if any(isinstance(each, ast.Name) and each.id == "code" for each in targets):
                    codes.append(node.value)
            elif isinstance(node, ast.FunctionDef):
                defaults = dict(zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True))
                codes += [value for arg, value in defaults.items() if arg.arg == "code" and value is not None]
            elif isinstance(node, ast.Attribute) and is_attribute(node, "ProblemCode") and node.attr.isupper():
                found.setdefault(ProblemCode[node.attr].value, f"{path}:{node.lineno}")
            for each in codes:
                for code in literals(each):
                    found.setdefault(code, f"{path}:{each.lineno}")
    return found


@pytest.fixture
def without_collector() -> Iterator[None]:
    """The trees of all modules have no garbage, and a collector that looks for it takes three quarters of the time."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("without_collector")
def test_the_table_has_exactly_the_codes_that_the_sources_use() -> None:
    raised = raised_codes()
    assert len(raised) > 90
    assert {code: place for code, place in raised.items() if find_code(code) is None} == {}, "not in the table"
    assert {code.value for code in ProblemCode} - set(raised) == set(), "in the table, but never raised"


def test_the_table_explains_every_code_and_no_other() -> None:
    assert list(explanations()) == [code.value for code in ProblemCode]


@pytest.mark.parametrize("code", ProblemCode)
def test_every_entry_is_complete(code: ProblemCode) -> None:
    assert code.name == code.value.upper()
    assert code.cause.endswith(".")
    assert code.remedy.endswith(".")
    assert code.cause != code.remedy
    assert code.heading[0].isupper()
    assert code.status is None or 400 <= code.status < 600


def test_the_type_of_a_problem_resolves_to_its_explanation(http: httpx.Client) -> None:
    answer = http.get("/v1/jobs/nobody").json()
    assert (answer["type"], answer["title"]) == ("/errors/unknown_job", "Unknown job")
    found = http.get(answer["type"])
    assert found.json() == {
        "code": "unknown_job",
        "status": 404,
        "title": "Unknown job",
        "cause": ProblemCode.UNKNOWN_JOB.cause,
        "remedy": ProblemCode.UNKNOWN_JOB.remedy,
        "retryable": False,
    }
    page = http.get(answer["type"], headers={"Accept": "text/html,*/*"})
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert "`" not in page.text
    assert "<p>List your jobs; check <code>expires_at</code>.</p>" in page.text
    assert '<a href="../guide">' in page.text
    assert "<script" not in page.text
    assert "style" not in page.text
    assert {each["code"] for each in http.get("/errors").json()} == {code.value for code in ProblemCode}


def test_an_unknown_code_has_no_explanation(http: httpx.Client) -> None:
    answer = http.get("/errors/<b>")
    assert (answer.status_code, answer.json()["code"], answer.json()["got"]) == (404, "no_such_address", "<b>")


def test_problems_accept_codes_of_newer_versions() -> None:
    made = Problem.of("from_the_future", 418, detail="Something new. Update.")
    assert (made.title, made.type, made.retryable) == ("I'm a Teapot", "/errors/from_the_future", False)
    assert Problem(title="T", status=500, detail="D.", code="out_of_memory").type == "/errors/out_of_memory"


def test_an_error_defaults_to_the_status_of_its_code() -> None:
    assert Refusal(ProblemCode.BODY_STALLED, detail="D.").status == 408
    assert Refusal(ProblemCode.UNKNOWN_UPLOAD, detail="D.", status=422).status == 422
    assert Refusal(ProblemCode.HTTP_ERROR, detail="D.").status == 500
