"""A client that openapi-python-client generates from the OpenAPI document submits a job and fetches its result."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from serving import Running, finish, tracks, until

GENERATOR = Path(sys.prefix) / "generator" / "bin"
"""In its own environment, because it needs a different Typer than the command line."""

pytestmark = pytest.mark.slow

USE = """
import sys
from io import BytesIO
from pliant_generated.client import Client
from pliant_generated.api.jobs import get_job, submit_job
from pliant_generated.api.artifacts import get_artifact, list_artifacts
from pliant_generated.models import Job, Options, Problem, ProblemCode, SubmitJobBody
from pliant_generated.types import File

url, file = sys.argv[1:]
client = Client(base_url=url)
body = SubmitJobBody(tracks=File(BytesIO(open(file, "rb").read()), "tracks.npz"), options='{"method": "temporal"}', name="generated")
job = submit_job.sync(client=client, body=body)
assert isinstance(job, Job), job
assert job.name == "generated" and isinstance(job.options, Options)
print(job.id, flush=True)
sys.stdin.readline()
job = get_job.sync(job.id, client=client, prefer="wait=20")
assert job.status == "succeeded", job
(artifact,) = list_artifacts.sync(job.id, client=client)
print(get_artifact.sync(job.id, artifact.name, client=client).payload.read().decode())
refused = get_job.sync("nobody", client=client)
assert isinstance(refused, Problem) and refused.code is ProblemCode.UNKNOWN_JOB, refused
"""


def test_a_generated_client_submits_a_job_and_fetches_its_result(running: Running, tmp_path: Path) -> None:
    generator = shutil.which("openapi-python-client", path=f"{GENERATOR}{os.pathsep}{os.environ.get('PATH', '')}")
    if generator is None and not os.environ.get("CI"):
        pytest.skip("openapi-python-client is not installed; say `make .venv/generator`")
    assert generator is not None
    document = tmp_path / "openapi.json"
    document.write_text(json.dumps(running.app.openapi()))
    output = ["--path", str(document), "--output-path", str(tmp_path / "pliant_generated"), "--meta", "none"]
    made = subprocess.run([generator, "generate", *output], capture_output=True, text=True, timeout=120)
    assert made.returncode == 0, made.stdout + made.stderr
    assert "WARNING" not in made.stdout, made.stdout
    inputs = tmp_path / "tracks.npz"
    inputs.write_bytes(tracks())
    command = [sys.executable, "-c", USE, running.url, str(inputs)]
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    with subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as user:
        assert user.stdin is not None
        assert user.stdout is not None
        id = user.stdout.readline().strip()
        until(lambda: running.jobs.get(id).status == "queued")
        finish(running, id, b"the result")
        user.stdin.write("\n")
        user.stdin.flush()
        assert user.stdout.readline() == "the result\n"
        assert user.wait(30) == 0
