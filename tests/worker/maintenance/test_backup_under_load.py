"""A backup of an installation under load, restored on an empty machine: nothing is missing and every file is the same."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from pliant.client import PliantError
from pliant.schemas.job import Status
from pliant.solver.gallery import face
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc"),
    pytest.mark.slow,
]


def command(*arguments: object) -> dict[str, Any]:
    ran = subprocess.run(
        [sys.executable, "-m", "pliant.cli", *map(str, arguments), "--json"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ran.returncode == 0, ran.stderr
    return dict(json.loads(ran.stdout))


def digests(jobs: Jobs, id: str) -> dict[str, str]:
    found = {}
    for artifact in jobs.get(id).artifacts:
        _, blob = jobs.artifact(id, artifact.name)
        found[artifact.name] = hashlib.sha256(b"".join(blob.read())).hexdigest()
        assert found[artifact.name] == artifact.sha256
    return found


def test_a_backup_under_load_is_restored_completely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    house_of = import_module("benchmarks.installation.instance").Instance
    sequence, stop = face(4, 60), threading.Event()
    given = {"tracks": sequence.tracks.points, "rotations": sequence.rotations, "mesh": "none"}
    options = {"max_reweightings": 2, "outputs": [], "prior": "smooth", "camera": "scaled_orthographic"}
    with house_of(tmp_path / "before", workers=1) as house:

        def load() -> None:
            with house.client() as client:
                while not stop.is_set() and len(house.acknowledged) < 6:
                    try:
                        job = client.submit(**given, options=options)
                        house.acknowledged.append(job.id)
                    except PliantError:
                        continue

        with house.client() as client:
            early = [client.submit(**given, options=options).id for _ in range(2)]
        house.acknowledged += early
        for id in early:
            assert house.final(id).status is Status.SUCCEEDED
        sender = threading.Thread(target=load)
        sender.start()
        house.until(lambda: len(house.acknowledged) >= 4, "it is under load", seconds=60)
        made = command("backup", tmp_path / "backup", "--data", tmp_path / "before" / "data")
        stop.set()
        sender.join()
        assert made["jobs"] >= 4
        expected = {id: digests(house.jobs, id) for id in early}
    restored = command("restore", tmp_path / "backup", "--data", tmp_path / "after" / "data")
    assert restored["jobs"] == made["jobs"]
    with house_of(tmp_path / "after", workers=1) as after:
        listed = [job.id for job in after.jobs.page(limit=200).jobs]
        after.acknowledged += listed
        assert set(early) <= set(listed) <= set(house.acknowledged)
        for id in listed:
            assert after.final(id).status is Status.SUCCEEDED
        assert {id: digests(after.jobs, id) for id in early} == expected
        assert after.misfits() == []
    assert Settings(data=tmp_path / "after" / "data").blobs.startswith("file:")
