"""Every code block of README.md and docs/ runs, and every file and test that they name exists.

Blocks run in a folder with the files that the documents mention (`tracks.npz`, `mesh.obj` …), against a real service in place of
`http://127.0.0.1:8000`. Blocks of one document run in order and share their names, like a reader's session. A block that cannot run
here states the reason after its language: ``bash not-run: needs Docker``.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet
from pliant.client import Client, NotAllowedNow, Status
from pliant.solver.gallery import face

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUN = {"python", "bash"}
READ = {"json"}
SHOWN = {"text", "mermaid", "http", "js"}
"""Languages that are run, parsed, or only shown."""

LONG = {
    "docs/how-to/camera.md", "docs/how-to/photographs.md", "docs/reference/artifacts.md", "docs/reference/cli.md",
    "docs/tutorials/blender.md",
}  # fmt: skip
"""Pages whose shell blocks take most of a minute, left to `make test-long`."""

ADDRESS = "http://127.0.0.1:8000"
SIZE = re.compile(r"\bface\(\d+, \d+\)")
"""Gallery sequences in the pages, run at a smaller size."""
KNOWN_COMMANDS = {"make", "docker", "pip", "git", "cd", "npm", "npx", "uv"}
"""First words of shell lines that are checked instead of run: they install, build or need what is not available here."""


@dataclass(frozen=True)
class Block:
    document: Path
    line: int
    language: str
    note: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.document.relative_to(ROOT)}:{self.line}"


def blocks_of(document: Path) -> list[Block]:
    found, lines = [], document.read_text(encoding="utf-8").splitlines()
    begin: int | None = None
    for number, line in enumerate(lines):
        if not line.lstrip().startswith("```"):
            continue
        if begin is None:
            begin = number
            continue
        language, _, note = lines[begin].strip().removeprefix("```").partition(" ")
        text = textwrap.dedent("\n".join(lines[begin + 1 : number])) + "\n"
        found.append(Block(document, begin + 1, language, note.strip(), text))
        begin = None
    assert begin is None, f"{document.name}:{begin}: a code block is not closed"
    return found


BLOCKS = [block for document in DOCUMENTS for block in blocks_of(document)]


TESTS = set(re.findall(r"def (test_\w+)\(", "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))))


def pages(language: str) -> list[ParameterSet]:
    """Return the documents with blocks to run in this language, long ones marked."""
    named = {path: path.relative_to(ROOT).as_posix() for path in DOCUMENTS}
    ran = [
        path for path in DOCUMENTS if any(b.document == path and b.language == language and not b.note for b in BLOCKS)
    ]

    return [
        pytest.param(path, id=named[path], marks=pytest.mark.long if language == "bash" and named[path] in LONG else ())
        for path in ran
    ]


def test_the_long_pages_exist() -> None:
    assert {path.relative_to(ROOT).as_posix() for path in DOCUMENTS} >= LONG


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `film.mp4` and `region.png`, drawn on frame 8: the film of the tutorial from a film to Blender."""
    from PIL import Image
    from pliant.tracking.rendering import face_paint, render_film

    path = tmp_path_factory.mktemp("film")
    rendered = render_film(face(16, 800, degrees=30), size=(160, 120), distance=5, paint=face_paint(800))
    rendered.write(path / "film.mp4")
    Image.fromarray(rendered.region(8)).save(path / "region.png")
    return path


@pytest.fixture
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """The files that the documents mention; a film only for the tutorial that uses one in a shell."""
    if "blender" in request.node.name and request.node.name.startswith("test_shell"):
        for file in request.getfixturevalue("film").iterdir():
            (tmp_path / file.name).symlink_to(file)
    sequence = face(6, 40)
    points = sequence.tracks.points
    np.savez(tmp_path / "tracks.npz", tracks=points)
    np.savez(tmp_path / "mesh.npz", faces=sequence.mesh.faces)
    np.savez(tmp_path / "truth.npz", shapes=sequence.shapes)
    np.savez(tmp_path / "cameras.npz", rotations=sequence.rotations)
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in sequence.shapes[0])
    faces = "".join("f " + " ".join(str(index + 1) for index in face) + "\n" for face in sequence.mesh.faces)
    (tmp_path / "mesh.obj").write_text(vertices + faces)
    return tmp_path


@pytest.fixture
def service(service_url: str) -> Iterator[str]:
    """Address of the service, whose jobs are cancelled after a page that does not wait for them."""
    yield service_url
    with Client(service_url) as client:
        for job in client.list(statuses=[Status.QUEUED, Status.RUNNING]):
            with suppress(NotAllowedNow):  # it has ended just now
                job.cancel()


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.place)
def test_every_code_block_has_a_language(block: Block) -> None:
    assert block.language in RUN | READ | SHOWN, (
        f"{block.place}: name the block's language, one of {RUN | READ | SHOWN}"
    )
    if block.note:
        reason = re.fullmatch(r"not-run: (.{8,})", block.note)
        assert reason is not None, f"{block.place}: expected 'not-run: REASON' behind the language, got {block.note!r}"
    if block.language in READ and not block.note:
        json.loads(block.text)


@pytest.mark.parametrize("document", pages("python"))
@pytest.mark.slow
def test_python_blocks_run(document: Path, service: str, folder: Path) -> None:
    blocks = [block for block in BLOCKS if block.document == document and block.language == "python" and not block.note]
    assert blocks
    lines: list[str] = []
    for block in blocks:  # padded to its own line, so that a traceback shows the document's
        lines += [""] * (block.line - len(lines)) + small(block.text.replace(ADDRESS, service)).splitlines()
    runner = "import sys; exec(compile(sys.stdin.read(), sys.argv[1], 'exec'))"
    ran = run([sys.executable, "-W", "error", "-c", runner, document.name], folder, service, given="\n".join(lines))
    assert ran.returncode == 0, f"{document.name}:\n{ran.stderr}"


def small(code: str) -> str:
    return SIZE.sub("face(6, 40)", code)


def test_the_readmes_first_program_is_five_lines() -> None:
    first = next(block for block in BLOCKS if block.document.name == "README.md" and block.language == "python")
    assert not first.note
    assert len([line for line in first.text.splitlines() if line.strip()]) == 5
    assert "from pliant import Client" in first.text


@pytest.mark.parametrize("document", pages("bash"))
@pytest.mark.slow
def test_shell_blocks_run(document: Path, service: str, folder: Path) -> None:
    (folder / "examples").symlink_to(ROOT / "examples")
    for block in BLOCKS:
        if block.document != document or block.language != "bash" or block.note:
            continue
        for command in commands_of(block):
            if command.split()[0] in KNOWN_COMMANDS:
                known(command, block)
                continue
            ran = run(["bash", "-ec", command.replace(ADDRESS, service)], folder, service)
            assert ran.returncode == 0, f"{block.place}: {command}\n{ran.stdout}\n{ran.stderr}"


def commands_of(block: Block) -> list[str]:
    """Split a block into commands, continued lines joined, comments and the prompt removed."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [line.removeprefix("$ ") for line in map(str.strip, lines) if line and not line.startswith("#")]


def known(command: str, block: Block) -> None:
    """Check that the Makefile has the targets; other tools are not run here."""
    words = shlex.split(command, comments=True)
    if words[0] == "make":
        targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
        wanted = {word for word in words[1:] if "=" not in word and not word.startswith("-")}
        assert wanted <= targets, f"{block.place}: the Makefile has no {wanted - targets}"


def run(command: list[str], folder: Path, url: str, *, given: str | None = None) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = {**os.environ, "PATH": path, "PLIANT_URL": url, "MPLCONFIGDIR": str(folder / ".matplotlib")}
    return subprocess.run(
        command, cwd=folder, env=env, input=given, capture_output=True, text=True, timeout=280, check=False
    )


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_file_and_test_that_is_named_exists(document: Path) -> None:
    text = document.read_text()
    for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#]+)", text):
        assert (document.parent / target).exists(), f"{document.name}: no file {target}"
    for name in re.findall(r"`(test_\w+\.py)`", text):
        assert list((ROOT / "tests").rglob(name)), f"{document.name}: no {name}"
    for name in re.findall(r"`(test_\w+)`", text):
        assert name in TESTS, f"{document.name}: no test {name}"
    for name in re.findall(
        r"`((?:schemas|client|cli|solver|worker|service|tests|examples|benchmarks|docs)/[\w/]*\w\.\w+)`", text
    ):
        assert (ROOT / name).exists(), f"{document.name}: no file {name}"
