"""Malicious files sent to a real service over HTTP: rejected with a code; it stays alive, bounds its memory and keeps nothing.

`python tests/service/access/test_attacks.py` sends all of them and writes a table of the responses to build/attacks.md.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "support" / "files"))  # where pytest finds them too
sys.path.insert(0, str(Path(__file__).parents[2] / "support" / "processes"))

from attack_files import ATTACKS, OVER_HTTP, Attack
from crafting import CANARY, HONEST
from peaks import Watched, descendants, watched
from pliant.cli.demo import running
from pliant.worker.formats import Limits

ROOT = Path(__file__).parents[3]
DOCUMENT = ROOT / "build" / "attacks.md"
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory peaks are read from /proc")

GROWTH = 48 << 20
"""Largest allowed growth of the service's memory for one file, bytes."""

CHILD = 1 << 30
"""Largest allowed memory of a process that reads a file, bytes."""


@dataclass(frozen=True)
class House:
    http: httpx.Client
    service: int
    """Process id of the HTTP server."""
    incoming: Path


@dataclass(frozen=True)
class Outcome:
    sent: int
    status: int
    problem: dict[str, object]
    kind: str
    seconds: float
    grown: int
    memory: Watched


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    yield from opened(tmp_path_factory.mktemp("attacked"))


def opened(folder: Path) -> Iterator[House]:
    import os

    before = set(descendants(os.getpid()))
    with running(folder) as url, httpx.Client(base_url=url, timeout=120) as http:
        new = [pid for pid in descendants(os.getpid()) if pid not in before]
        service = next(pid for pid in new if b"pliant.service" in Path(f"/proc/{pid}/cmdline").read_bytes())
        quick = {"options": '{"method": "pseudo_inverse", "outputs": []}'}
        honest = send(
            House(http, service, folder / "data" / "incoming"), Attack("honest", "", lambda: HONEST, (), texts=quick)
        )
        assert honest.status == 202, honest.problem  # loads what reading needs before anything is measured
        yield House(http, service, folder / "data" / "incoming")


def send(house: House, attack: Attack) -> Outcome:
    content = attack.make()
    files = {attack.part: ("../../../etc/cron.d/x", content)}
    if attack.part not in ("tracks", "film"):
        files["tracks"] = ("tracks.npy", HONEST)
    began = time.perf_counter()
    with watched(house.service) as memory:
        before = resident(house.service)
        answer = house.http.post("/v1/jobs", files=files, data=dict(attack.texts))
        seconds = time.perf_counter() - began
    kind = answer.headers["content-type"]
    return Outcome(len(content), answer.status_code, answer.json(), kind, seconds, max(0, memory.own - before), memory)


def resident(pid: int) -> int:
    words = Path(f"/proc/{pid}/statm").read_text().split()
    return int(words[1]) * 4096


@pytest.mark.parametrize("attack", [each for each in ATTACKS if each.name in OVER_HTTP], ids=str)
@pytest.mark.slow
def test_a_crafted_file_is_rejected_without_side_effects(house: House, attack: Attack) -> None:
    jobs = len(house.http.get("/v1/jobs").json()["jobs"])
    outcome = send(house, attack)
    assert outcome.status in attack.statuses, outcome.problem
    assert outcome.kind == "application/problem+json"
    assert outcome.problem["code"] in attack.codes, outcome.problem
    assert outcome.problem["hint"]
    assert outcome.grown < GROWTH
    assert outcome.memory.children < CHILD
    assert not CANARY.exists()
    assert house.http.get("/healthz").status_code == 200
    assert Path(f"/proc/{house.service}").exists()
    assert descendants(house.service) == []
    assert [path for path in house.incoming.rglob("*") if path.is_file() and path.suffix != ".lock"] == []
    assert len(house.http.get("/v1/jobs").json()["jobs"]) == jobs


def table(house: House) -> str:
    rows = [
        "| attack | what it is | part | bytes | answer | code | seconds | service grew by | child's peak |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for attack in ATTACKS:
        if attack.limits != Limits():  # within those of a service
            continue
        got = send(house, attack)
        child = f"{got.memory.children / 1e6:.0f} MB" if got.memory.started else "–"
        rows.append(
            f"| {attack.name} | {attack.what} | {attack.part} | {got.sent:,} | {got.status} | `{got.problem['code']}` | "
            f"{got.seconds:.2f} | {got.grown / 1e6:.0f} MB | {child} |"
        )
        print(rows[-1], file=sys.stderr)
    return "\n".join(rows)


HEAD = """# Attacks tried

Each row is a file made by `tests/support/files/attack_files.py` and sent to a running service as a form: what it is, the
answer, the time, by how much the service's resident memory peaked above its value before, and the largest resident
memory of the process that read the file (– if none was started: the service refused before reading).

"""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for house in opened(Path(folder)):
            text = table(house)
    DOCUMENT.parent.mkdir(exist_ok=True)
    DOCUMENT.write_text(HEAD + text + "\n", encoding="utf-8")
    print(json.dumps({"attacks": text.count("\n") - 1}))


if __name__ == "__main__":
    main()
