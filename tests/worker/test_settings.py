from __future__ import annotations

import os
from pathlib import Path

import pytest
from pliant.worker.errors import InvalidSetting
from pliant.worker.paths import LONGEST_SOCKET_PATH, socket_path
from pliant.worker.settings import VARIABLES, Settings, usable_cores


def test_an_empty_environment_gives_the_defaults() -> None:
    assert Settings.from_environment({"PLIANT_WORKERS": "", "HOME": "/x"}) == Settings()


def test_the_environment_round_trips() -> None:
    settings = Settings(
        data=Path("/some/where"), redis_url="redis://h/1", blob_url="s3://b/p", queue="q", workers=3, threads=2,
        time_limit=1.5, memory_limit=10, cancel_grace=2, stop_grace=3, lost_after=4, max_attempts=5, retention=0, disk_quota=7,
        upload_expiry=8, max_running=9, webhook_networks="10.0.0.0/8,::1/128",
    )  # fmt: skip
    assert Settings.from_environment(settings.to_environment()) == settings
    assert len(settings.to_environment()) == len(VARIABLES) == len(Settings.__dataclass_fields__)


@pytest.mark.parametrize(
    ("variable", "text"),
    [
        ("PLIANT_WORKERS", "0"), ("PLIANT_WORKERS", "many"), ("PLIANT_TIME_LIMIT", "-1"), ("PLIANT_TIME_LIMIT", "nan"),
        ("PLIANT_RETENTION", "inf"), ("PLIANT_LOST_AFTER", "0.5"), ("PLIANT_DISK_QUOTA", "1.5"),
    ],
)  # fmt: skip
def test_a_wrong_value_names_the_variable_and_both_sides(variable: str, text: str) -> None:
    with pytest.raises(InvalidSetting, match=f"{variable}: expected a .*, at least .*, got '{text}'"):
        Settings.from_environment({variable: text})


def test_networks_are_networks() -> None:
    given = Settings.from_environment({"PLIANT_WEBHOOK_NETWORKS": " 10.0.0.0/8, ::1 ,"})
    assert given.webhook_networks == "10.0.0.0/8,::1/128"
    for wrong in ("10.0.0.1/8", "localhost", "10/8/8"):
        with pytest.raises(InvalidSetting, match="PLIANT_WEBHOOK_NETWORKS: expected networks"):
            Settings.from_environment({"PLIANT_WEBHOOK_NETWORKS": wrong})


def test_urls_default_to_the_data_directory() -> None:
    settings = Settings(data=Path("/data dir"))
    assert settings.redis == "unix:///data%20dir/valkey/valkey.sock"
    assert settings.blobs == "file:///data%20dir/blobs"
    assert Settings(redis_url="redis://h", blob_url="s3://b").redis == "redis://h"


def test_a_deep_data_directory_gets_a_short_socket() -> None:
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
def test_a_container_s_share_bounds_the_cores(
    text: str | None, cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(99)))
    file = tmp_path / "cpu.max"
    if text is not None:
        file.write_text(text)
    assert usable_cores(file) == cores
