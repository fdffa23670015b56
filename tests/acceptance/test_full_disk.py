"""A disk that fills while `pliant up` runs on it, with its own Valkey: requests are refused, and nothing is lost or half-written."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

import httpx
import pytest
from long_jobs import LONG, long_sequence
from pliant.schemas.job import Status
from serving import form, npz

from benchmarks.installation.instance import Instance

pytestmark = [pytest.mark.skipif(sys.platform != "linux", reason="mounts a file system"), pytest.mark.slow]


def test_a_full_disk_refuses_work_until_there_is_space(small_disk: Path) -> None:
    with (
        Instance(small_disk, workers=1) as instance,
        httpx.Client(base_url=instance.url, timeout=20) as http,
    ):

        def accepted(**parts: object) -> str:
            answer = http.post("/v1/jobs", files=form(**parts))
            if answer.status_code == 202:
                instance.acknowledged.append(answer.json()["id"])
                return instance.acknowledged[-1]
            assert answer.json()["code"] in ("storage_full", "store_unavailable"), answer.text
            assert answer.json()["retryable"]
            return ""

        sequence = long_sequence()
        running = accepted(
            body=npz(tracks=sequence.tracks.points.astype("float32")), mesh="none",
            rotations=npz(rotations=sequence.rotations), options={**LONG, "outputs": []},
        )  # fmt: skip
        instance.midst(running, "reweight")
        filler = small_disk / "filler"
        with filler.open("wb", buffering=0) as out, contextlib.suppress(OSError):
            while out.write(bytes(4096)):
                pass
        instance.until(lambda: not accepted(), "it refuses jobs")
        answer = http.get("/readyz")
        assert answer.status_code == 503
        assert "No space left on device" in answer.json()["detail"]
        instance.until(lambda: http.get(f"/v1/jobs/{running}").status_code == 200, "it answers between its restarts")
        filler.unlink()
        instance.until(lambda: accepted(options={"method": "pseudo_inverse"}), "it accepts jobs")
        waiting = instance.acknowledged[-1]
        job = instance.jobs.get(running)
        if not job.status.final:
            http.post(f"/v1/jobs/{running}/cancel")
            assert instance.final(running).status is Status.CANCELLED
        else:  # its own progress could not be written when the disk was full
            assert job.error is not None
            assert job.error.code in ("storage_failed", "worker_lost")
        assert instance.final(waiting).status is Status.SUCCEEDED
        # A request without an answer may have been carried out.
        assert [each for each in instance.misfits() if "never acknowledged" not in each] == []
        assert "Traceback" not in (small_disk / "log").read_text()
