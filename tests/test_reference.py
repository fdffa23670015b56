"""The reference pages are complete: every code, warning, metric, option, setting, command, operation and exit code, and no others."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
import tomllib
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import get_args

import pytest
from pliant import client
from pliant.cli import app, jobs
from pliant.cli.exits import Exit
from pliant.schemas.job import Job
from pliant.schemas.options import Options, Output
from pliant.schemas.problems import ProblemCode
from pliant.service import metrics
from pliant.service.settings import ServiceSettings
from pliant.service.submission import FILES, TEXTS, UPLOADS
from pliant.solver.evaluation import metrics as errors_of_shapes
from pliant.worker.environment import fields_of, variable_of
from pliant.worker.settings import Settings

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "docs" / "reference"


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    """The script `docs/generate.py`, loaded as a module."""
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def headings(page: str) -> list[str]:
    return re.findall(r"^### (.+)$", (REFERENCE / page).read_text(encoding="utf-8"), re.MULTILINE)


def test_every_error_code_is_generated_with_cause_and_remedy(generate: ModuleType) -> None:
    sections = re.split(r"^### ", generate.errors(), flags=re.MULTILINE)
    assert sections[0].strip() == "## Requests"
    assert [text.partition("\n")[0] for text in sections[1:]] == [code.value for code in ProblemCode]
    for code, text in zip(ProblemCode, sections[1:], strict=True):
        assert code.cause in text
        assert f"**Remedy:** {code.remedy}" in text


def test_each_group_of_error_codes_has_its_introduction(generate: ModuleType) -> None:
    text = generate.errors()
    assert {
        title for title in generate.ERROR_GROUPS if f"## {title}\n\n{generate.ERROR_GROUPS[title]}" not in text
    } == set()
    assert "### timed_out\n\n**Status 504**, retryable. " in text


def test_exactly_the_warnings_in_the_source_are_documented() -> None:
    assert {normal(text) for text in headings("warnings.md")} == {normal(text) for text in warnings_in_source()}


def normal(sentence: str) -> str:
    return re.sub(r"\{[^}]*\}", "…", sentence)


def warnings_in_source() -> set[str]:
    """Return sentences of functions named after warnings and of `without_effect`, with values as `…`."""
    found = set()
    for path in (*(ROOT / "solver").rglob("*.py"), *(ROOT / "worker" / "artifacts").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and ("warning" in node.name or node.name == "without_effect"):
                body = [each for each in node.body if each is not documentation(node)]
                found |= {text for each in body for text in sentences(each)}
    return found


def documentation(node: ast.FunctionDef) -> ast.stmt | None:
    return None if ast.get_docstring(node) is None else node.body[0]


def sentences(node: ast.AST) -> set[str]:
    if isinstance(node, ast.JoinedStr):
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
        return {text} if text.endswith(".") else set()
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return {node.value} if node.value.endswith(".") else set()
    return {text for child in ast.iter_child_nodes(node) for text in sentences(child)}


def test_exactly_the_evaluation_metrics_are_documented() -> None:
    tree = ast.parse(Path(errors_of_shapes.__file__).read_text(encoding="utf-8"))
    evaluate = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "evaluate")
    names = set()
    for node in ast.walk(evaluate):
        if isinstance(node, ast.Dict):
            names |= {key.value for key in node.keys if isinstance(key, ast.Constant)}
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
            names.add(node.slice.value)
    assert len(names) > 5
    assert set(headings("metrics.md")) == names


def test_every_exit_code_is_documented() -> None:
    text = (REFERENCE / "cli.md").read_text(encoding="utf-8")
    assert [int(code) for code in re.findall(r"^\| (\d+) \|", text, re.MULTILINE)] == [int(code) for code in Exit]


def test_every_command_is_generated_with_its_parameters(generate: ModuleType) -> None:
    text = generate.cli()
    names = {command.name for command in app.registered_commands}
    assert names <= set(re.findall(r"^### pliant (\w+)$", text, re.MULTILINE))
    assert "### pliant token create" in text
    assert "| `--ground-truth, -g` |" in text
    assert "| `--browser, --no-browser` | `--browser` |" in text


def test_no_help_has_words_in_brackets() -> None:
    """The terminal takes them for markup and drops them."""
    import typer

    commands, texts = [typer.main.get_command(app)], []
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        texts += [command.help, *(getattr(parameter, "help", None) for parameter in command.params)]
    assert len(texts) > 150
    assert [text for text in texts if text and re.search(r"\[[a-z]", text)] == []


def test_every_option_is_generated_with_its_default(generate: ModuleType) -> None:
    text = generate.options()
    assert sorted(re.findall(r"^### (\w+)$", text, re.MULTILINE)) == sorted(Options.model_fields)
    assert "Type: number, > 0, ≤ 1,000. Default: `25.0`." in text
    assert "Type: number, ≥ 1e-9, ≤ 1,000 or null." in text
    assert "Type: boolean. Default: `true`." in text
    assert "Type: list of pairs of numbers or null." in text


def test_every_output_is_documented_and_offered() -> None:
    table = (REFERENCE / "artifacts.md").read_text(encoding="utf-8").partition("\n## ")[0]
    assert sorted(re.findall(r"^\| `(\w+)`(?: \(default\))? \| `", table, re.MULTILINE)) == sorted(get_args(Output))
    more_files = (ROOT / "service" / "web" / "src" / "afterwards.ts").read_text(encoding="utf-8")
    assert sorted(re.findall(r'^  \["(\w+)", "', more_files, re.MULTILINE)) == sorted(get_args(Output))
    for text in (inspect.getsource(jobs.result), client.Client.make_outputs.__doc__ or ""):
        assert [name for name in get_args(Output) if re.search(rf"\b{name}\b", text) is None] == []


def test_groups_of_options_leave_the_anchors_to_the_options(generate: ModuleType) -> None:
    groups = re.findall(r"^## (.+) \{ #(.+) \}$", generate.options(), re.MULTILINE)
    assert [name for name, _ in groups] == list(generate.OPTION_GROUPS)
    assert {anchor for _, anchor in groups}.isdisjoint(Options.model_fields)


def test_every_setting_is_documented(generate: ModuleType) -> None:
    listed = re.findall(r"^\| `(PLIANT_\w+)` \|", generate.settings(), re.MULTILINE)
    known = [variable_of(name) for record in (Settings, ServiceSettings) for name in fields_of(record)]
    assert listed == known
    assert len(known) == len(set(known))
    assert f"| `PLIANT_PORT` | {ServiceSettings().port} |" in generate.settings()
    assert "| `PLIANT_RETENTION` | 2592000 |" in generate.settings()
    assert "| `PLIANT_PRESIGNED_REDIRECTS` | true |" in generate.settings()


def test_every_operation_is_generated_with_its_scope(generate: ModuleType) -> None:
    text, document = generate.rest(), generate.openapi()
    real = [f"{method.upper()} {path}" for path, methods in document["paths"].items() for method in methods]
    assert re.findall(r"^### (.+)$", text, re.MULTILINE) == real
    assert text.count(" Scope: ") == len(real)
    assert "### GET /healthz\n\nLiveness: the process answers. Scope: none." in text
    assert re.search(r"### GET /metrics\n\n.*Scope: `admin`\.", text)


def test_every_record_of_an_answer_is_documented(generate: ModuleType) -> None:
    text = generate.job() + "\n\n" + generate.answers()
    linked = set(re.findall(r"\]\(#(\w+)\)", text + generate.rest()))
    assert linked == {name.lower() for name in (*generate.JOB_RECORDS, *generate.ANSWER_RECORDS)}
    assert [row for row in text.splitlines() if row.endswith("|  |")] == [], "a member without a meaning"
    assert "One of `queued`, `running`, `cancelling`, `succeeded`, `failed`, `cancelled`." in text
    for name in Job.model_fields:
        assert f"| `{name}` |" in text


def test_every_public_name_of_the_sdk_has_an_entry(generate: ModuleType) -> None:
    text = (REFERENCE / "sdk.md").read_text(encoding="utf-8") + generate.records()
    entries = re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    assert {f"pliant.client.{name}" for name in client.__all__} <= set(entries)
    assert len(entries) == len(set(entries))
    assert "| `finished_at` | `datetime | None` | When the status became final; None until then. |" in text


@pytest.mark.parametrize("folder", ["schemas", "solver", "tracking", "worker", "service", "client", "cli"])
def test_docstrings_have_an_entry_for_each_parameter(folder: str) -> None:
    """The reference gives all names of one entry the type of the first."""
    grouped = []
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                for part in re.split(r"\n\n(?=\w[\w ]*\n-{3,}\n)", ast.get_docstring(node) or "")[1:]:
                    title, _, *lines = part.splitlines()
                    names = [
                        line for line in lines if title != "Raises" and re.match(r"\**\w+, ?\**\w+[\w, ]*( :|$)", line)
                    ]
                    grouped += [f"{path.relative_to(ROOT)}: {name}" for name in names]
    assert grouped == []


def test_every_part_of_a_submission_is_documented() -> None:
    table = (REFERENCE / "rest.md").read_text(encoding="utf-8").partition("## Submit")[2].partition("## Wait")[0]
    parts = (FILES | TEXTS) - set(UPLOADS) | {"tracks_upload"}
    assert {part for part in parts if f"`{part}`" not in table} == set()


def test_every_prometheus_metric_is_documented() -> None:
    made = set(re.findall(r'"(pliant_\w+)"', Path(metrics.__file__).read_text(encoding="utf-8")))
    text = (ROOT / "docs" / "how-to" / "monitor.md").read_text(encoding="utf-8")
    assert len(made) > 10
    assert set(re.findall(r"^\| `(pliant_\w+)` \|", text, re.MULTILINE)) == made


def test_markers_are_replaced_and_pages_copied(generate: ModuleType, tmp_path: Path) -> None:
    generate.main(tmp_path / "site")
    made = tmp_path / "site" / "reference" / "options.md"
    assert "### method" in made.read_text(encoding="utf-8")
    pages = sorted((tmp_path / "site").rglob("*.md"))
    assert len(pages) == len(list((ROOT / "docs").rglob("*.md")))
    assert [page for page in pages if "<!-- generated" in page.read_text(encoding="utf-8")] == []
    fences = [line for page in pages for line in page.read_text(encoding="utf-8").splitlines() if "```" in line]
    assert len(fences) > 100
    assert [line for line in fences if not re.fullmatch(r" *```\w*", line)] == []
    assert not (tmp_path / "site" / "generate.py").exists()
    assert [page.name for page in pages if skips_a_level(page.read_text(encoding="utf-8"))] == []


def skips_a_level(text: str) -> bool:
    outside = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    levels = [len(marks) for marks in re.findall(r"^(#+) ", outside, re.MULTILINE)]
    return any(after > before + 1 for before, after in pairwise(levels))


def test_every_page_is_in_the_navigation() -> None:
    import tomllib

    def pages(nav: object) -> list[str]:
        if isinstance(nav, str):
            return [nav]
        parts = nav.values() if isinstance(nav, dict) else nav
        return [page for part in parts for page in pages(part)]  # type: ignore[union-attr]

    config = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))
    named = pages(config["project"]["nav"])
    assert sorted(named) == sorted(path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md"))


def test_the_readme_lists_exactly_the_dependencies() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    wanted = {re.split(r"[<>=;\[ ]", each)[0].lower() for group in groups for each in group} - {"pliant"}
    table = (ROOT / "README.md").read_text(encoding="utf-8").split("## Dependencies")[1].split("\n## ")[0]
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \|", table, re.MULTILINE)
    named = {name.strip().lower() for names, part in rows if part.strip() != "page" for name in names.split(",")}
    assert named - {"package", "---", "openapi-python-client", "uv"} == wanted  # the last two are not in any extra
