from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from pliant.service.settings import ServiceSettings
from pliant.worker.control_group import group_files
from pliant.worker.environment import OTHER_VARIABLES, expected_of, fields_of, unknown, variable_of, warnings_of_unknown
from pliant.worker.errors import InvalidSetting
from pliant.worker.paths import LONGEST_SOCKET_PATH, socket_path
from pliant.worker.settings import Settings, usable_cores


@pytest.fixture
def set_variables(monkeypatch: pytest.MonkeyPatch, no_variables: None) -> Callable[..., None]:
    """Set variables of Pliant and no others; the working directory is empty."""

    def assign(**variables: str) -> None:
        for name, value in variables.items():
            monkeypatch.setenv(f"PLIANT_{name}", value)

    return assign


def test_empty_variables_give_the_defaults(set_variables: Callable[..., None]) -> None:
    names = [variable_of(name).removeprefix("PLIANT_") for name in (*fields_of(Settings), *fields_of(ServiceSettings))]
    set_variables(**dict.fromkeys(names, ""))
    assert Settings.from_environment() == Settings()
    assert ServiceSettings.from_environment() == ServiceSettings()


def test_the_environment_round_trips(set_variables: Callable[..., None]) -> None:
    settings = Settings(
        data=Path("/some/where"), redis_url="redis://h/1", blob_url="s3://b/p", queue="q", workers=3, threads=2,
        time_limit=1.5, memory_limit=10, cancel_grace=2, stop_grace=3, lost_after=4, max_attempts=5, retention=0, disk_quota=7,
        upload_expiry=8, max_running=9, webhook_networks="10.0.0.0/8,::1/128", read_memory=1 << 31,
    )  # fmt: skip
    variables = settings.to_environment()
    set_variables(**{name.removeprefix("PLIANT_"): value for name, value in variables.items()})
    assert Settings.from_environment() == settings
    assert set(variables) == {variable_of(name) for name in fields_of(Settings)}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("WORKERS", "0"), ("WORKERS", "many"), ("TIME_LIMIT", "-1"), ("TIME_LIMIT", "nan"),
        ("RETENTION", "inf"), ("LOST_AFTER", "0.5"), ("DISK_QUOTA", "1.5"),
    ],
)  # fmt: skip
def test_errors_name_the_variable_the_expected_and_the_given_value(
    set_variables: Callable[..., None], name: str, text: str
) -> None:
    set_variables(**{name: text})
    with pytest.raises(InvalidSetting, match=f"PLIANT_{name}: expected a .*, at least .*, got '{text}'") as caught:
        Settings.from_environment()
    assert (caught.value.code, caught.value.field) == ("invalid_setting", f"PLIANT_{name}")


def test_webhook_networks_are_validated_and_normalised(set_variables: Callable[..., None]) -> None:
    set_variables(WEBHOOK_NETWORKS=" 10.0.0.0/8, ::1 ,")
    assert Settings.from_environment().webhook_networks == "10.0.0.0/8,::1/128"
    for wrong in ("10.0.0.1/8", "localhost", "10/8/8"):
        set_variables(WEBHOOK_NETWORKS=wrong)
        with pytest.raises(InvalidSetting, match="PLIANT_WEBHOOK_NETWORKS: expected networks"):
            Settings.from_environment()


def test_environment_overrides_env_file_which_overrides_secret_files(
    set_variables: Callable[..., None], tmp_path: Path
) -> None:
    (tmp_path / ".env").write_text("PLIANT_WORKERS=2\nPLIANT_QUEUE=filed\nPLIANT_PORT=7000\nOTHER=1\nPLIANT_DATA=\n")
    secrets = tmp_path / "secrets"
    secrets.mkdir()
    (secrets / "pliant_redis_url").write_text("redis://:secret@h/1\n")
    (secrets / "PLIANT_QUEUE").write_text("secret")
    (secrets / "pliant_blob_url").write_text("\n")
    set_variables(WORKERS="4", SECRETS_DIR=str(secrets))
    found = Settings.from_environment()
    assert (found.workers, found.queue, found.redis_url) == (4, "filed", "redis://:secret@h/1")
    assert (found.data, found.blob_url) == (Settings().data, None)
    assert ServiceSettings.from_environment().port == 7000


def test_a_directory_that_may_not_be_entered_has_no_env_file(
    set_variables: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`sudo -u pliant` in a private home: there, even looking for a file is an error."""
    (tmp_path / ".env").write_text("PLIANT_WORKERS=7\n")
    set_variables()
    assert Settings.from_environment().workers == 7
    monkeypatch.setattr(os, "access", lambda path, mode: not (path == "." and mode == os.X_OK))
    assert Settings.from_environment().workers == Settings().workers


@pytest.mark.parametrize("file", [".env", "secrets/PLIANT_QUEUE"])
@pytest.mark.parametrize(
    ("fault", "got"),
    [
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "other bytes"),
    ],
)
def test_a_file_of_settings_that_cannot_be_read_is_named(
    set_variables: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    fault: Exception,
    got: str,
) -> None:
    (tmp_path / "secrets").mkdir()
    (tmp_path / file).write_text("PLIANT_WORKERS=2\n")
    set_variables(SECRETS_DIR=str(tmp_path / "secrets"))
    Settings.from_environment()

    def refused(*_: object, **__: object) -> str:
        raise fault

    monkeypatch.setattr(Path, "read_text", refused)
    sentence = f"{re.escape(file)}: expected a file in UTF-8 that this user can read, got {got}"
    with pytest.raises(InvalidSetting, match=sentence):
        Settings.from_environment()


def test_a_missing_secrets_folder_is_an_error(set_variables: Callable[..., None], tmp_path: Path) -> None:
    set_variables(SECRETS_DIR=str(tmp_path / "none"))
    with pytest.raises(InvalidSetting, match="PLIANT_SECRETS_DIR: expected a folder"):
        Settings.from_environment()


def test_expected_values_are_described_by_type_and_bounds() -> None:
    known = fields_of(Settings) | fields_of(ServiceSettings)
    assert expected_of(known["port"]) == "a whole number, at least 0, at most 65535"
    assert expected_of(known["stall_seconds"]) == "a number, more than 0"
    assert expected_of(known["log_level"]) == "'debug', 'info', 'warning' or 'error'"
    assert expected_of(known["retention"]) == "a number of seconds, at least 0"


def test_a_worker_needs_no_fastapi_and_the_base_install_no_pydantic_settings() -> None:
    code = """
import sys
for name in {absent}: sys.modules[name] = None
import {module}
from pliant.worker.settings import Settings
Settings{read}
"""
    worker = code.format(
        absent=("fastapi", "starlette", "uvicorn"), module="pliant.worker.__main__", read=".from_environment()"
    )
    base = code.format(absent=("pydantic_settings", "fastapi", "rq", "redis"), module="pliant.cli", read="()")
    for text in (worker, base):
        ran = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr


def test_urls_default_to_the_data_directory() -> None:
    settings = Settings(data=Path("/data dir"))
    assert settings.redis == "unix:///data%20dir/valkey/valkey.sock"
    assert settings.blobs == "file:///data%20dir/blobs"
    assert Settings(redis_url="redis://h", blob_url="s3://b").redis == "redis://h"


def test_a_deep_data_directory_gets_a_short_socket_path() -> None:
    deep = Path("/") / "/".join(["deep"] * 40)
    assert len(str(socket_path(deep))) <= LONGEST_SOCKET_PATH
    assert socket_path(deep) == socket_path(deep)
    assert socket_path(deep) != socket_path(deep / "er")


def test_cores_are_shared_among_the_workers() -> None:
    assert Settings(workers=1000).threads_per_job == 1
    assert Settings(threads=3, workers=2).threads_per_job == 3


@pytest.mark.parametrize(
    ("text", "cores"), [("150000 100000\n", 2), ("20000 100000\n", 1), ("max 100000\n", 99), (None, 99)]
)
def test_a_containers_cpu_quota_limits_the_cores(
    text: str | None, cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(99)))
    file = tmp_path / "cpu.max"
    if text is not None:
        file.write_text(text)
    assert usable_cores([file]) == cores
    (around := tmp_path / "around.max").write_text("100000 100000\n")
    assert usable_cores([file, around]) == 1


def test_limits_are_read_from_the_own_control_group_and_those_around_it(tmp_path: Path) -> None:
    membership, root = tmp_path / "cgroup", tmp_path / "mounted"
    membership.write_text("4:memory:/elsewhere\n0::/system.slice/pliant.service\n")
    found = group_files("memory.max", root=root, membership=membership)
    assert [str(file.relative_to(root)) for file in found] == [
        "system.slice/pliant.service/memory.max",
        "system.slice/memory.max",
        "memory.max",
    ]
    membership.write_text("0::/\n")  # a container sees itself as the root
    assert group_files("cpu.max", root=root, membership=membership) == [root / "cpu.max"]
    assert group_files("cpu.max", root=root, membership=tmp_path / "none") == []


def test_unknown_variables_are_named_with_the_one_that_was_meant(
    set_variables: Callable[..., None], tmp_path: Path
) -> None:
    set_variables(
        WORKRES="2", workers="2", Redis_Ulr="redis://h", ELSEWHERE_ENTIRELY="x", RETENSION="", TOKEN="t", URL="u", PORT="1",
        SECRETS_DIR="", LOG_LEVEL="info", QUEU="unset in the environment",
    )  # fmt: skip
    (tmp_path / ".env").write_text("PLIANT_DOMAIN=a.example\nPLIANT_LOG_LEVLE=debug\nOTHER=1\nPLIANT_REDIS_ULR=twice\n")
    assert unknown(Settings, ServiceSettings) == {
        "PLIANT_ELSEWHERE_ENTIRELY": None,
        "PLIANT_LOG_LEVLE": "PLIANT_LOG_LEVEL",
        "PLIANT_QUEU": "PLIANT_QUEUE",
        "PLIANT_REDIS_ULR": "PLIANT_REDIS_URL",
        "PLIANT_WORKRES": "PLIANT_WORKERS",
    }
    first, second, *_ = warnings_of_unknown(Settings, ServiceSettings)
    assert first == "PLIANT_ELSEWHERE_ENTIRELY is no setting of Pliant and has no effect."
    assert second == "PLIANT_LOG_LEVLE is no setting of Pliant and has no effect. Did you mean PLIANT_LOG_LEVEL?"


def test_no_variable_that_is_read_anywhere_is_unknown() -> None:
    root = Path(__file__).parent.parent.parent
    texts = [
        (root / name).read_text()
        for name in ("docker-compose.yml", "Dockerfile", "docs/reference/settings.md", "build_page.py")
    ]
    texts += [
        file.read_text()
        for file in (root / "deploy").rglob("*")
        if file.suffix in (".yml", ".yaml", ".env", ".service")
    ]
    read = {name for text in texts for name in re.findall(r"\bPLIANT_[A-Z_]*[A-Z]\b", text)}
    code = [
        file
        for name in ("cli", "client", "service", "worker", "tracking", "tests")
        for file in (root / name).rglob("*.py")
    ]
    reading = re.compile(r"(?:environ\.get\(|environ\[|envvar=)\"(PLIANT_[A-Z_]+)\"")
    read |= {name for file in code for name in reading.findall(file.read_text())}
    known = {
        variable_of(name) for record in (Settings, ServiceSettings) for name in fields_of(record)
    } | OTHER_VARIABLES
    assert len(read) > 20
    assert read - known <= {"PLIANT_NAME"}, "a placeholder"
