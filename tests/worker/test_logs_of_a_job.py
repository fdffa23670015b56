"""Log lines of one job from API, worker and job process can be found by its id."""

from __future__ import annotations

import ast
import json
import os
import secrets
import subprocess
import sys
from pathlib import Path

import httpx
import pliant.worker
import pytest
from pliant.schemas.job import Status
from pliant.worker.settings import Settings
from serving import form, free_port, until


@pytest.mark.slow
def test_every_process_logs_the_job_by_its_id(settings: Settings, tmp_path: Path) -> None:
    port, key = free_port(), secrets.token_hex(4)
    env = {
        **os.environ, **settings.to_environment(), "PLIANT_PORT": str(port), "PLIANT_LOG_FORMAT": "json", "PLIANT_LOG_LEVEL": "info",
        "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
    }  # fmt: skip
    logs = {name: tmp_path / f"{name}.log" for name in ("service", "worker")}
    commands = {"service": ["-m", "pliant.service"], "worker": ["-m", "pliant.worker", "work"]}
    processes = []
    for name, command in commands.items():
        with logs[name].open("wb") as log:
            processes.append(subprocess.Popen([sys.executable, *command], env=env, stderr=log))
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=20) as http:

            def up() -> bool:
                try:
                    return http.get("/readyz").status_code == 200
                except httpx.TransportError:
                    return False

            until(up, seconds=60)
            options = '{"method": "pseudo_inverse", "outputs": []}'
            job = http.post("/v1/jobs", files=form(mesh="none", options=options), headers={"X-Request-ID": key}).json()
            until(lambda: Status(http.get(f"/v1/jobs/{job['id']}").json()["status"]).final, seconds=60)
    finally:
        for each in processes:
            each.terminate()
            each.wait(20)
    lines = {name: [json.loads(line) for line in log.read_text().splitlines()] for name, log in logs.items()}
    ours = {name: [line for line in found if line.get("job") == job["id"]] for name, found in lines.items()}
    posted = next(line for line in ours["service"] if line["method"] == "POST")
    assert (posted["request_id"], posted["status"]) == (key, 202)
    messages = [line["message"] for line in ours["worker"]]
    assert [message.split(": ")[1] for message in messages] == ["attempt 1 began", "attempt 1 ended"]
    assert {line["attempt"] for line in ours["worker"]} == {1}
    assert ours["worker"][-1]["outcome"] == "succeeded"


def test_every_line_about_a_job_has_the_field_job() -> None:
    """Those of lost workers and webhooks, too."""
    worker = Path(pliant.worker.__file__).parent
    found, without = 0, []
    for source in sorted(worker.rglob("*.py")):
        for node in ast.walk(ast.parse(source.read_text())):
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func).startswith("logger.")
                and any(f"{each} %s" in ast.unparse(node.args[0]) for each in ("job", "attempt", "delivery"))
            ):
                found += 1
                if not any(each.arg == "extra" for each in node.keywords):
                    without.append(f"{source.name}:{node.lineno}")
    assert found >= 9
    assert without == []
