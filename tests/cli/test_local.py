"""Commands without a service: ports, addresses, verdicts, findings."""

from __future__ import annotations

import importlib
import io
import json
import re
import socket
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
import redis
from pliant.cli import app
from pliant.cli.demo import GOOD, judge, read_address, why
from pliant.cli.exits import Exit
from pliant.cli.films import SHEET_TEST
from pliant.cli.session import Session, name_of, parse_options
from pliant.cli.solve import file_or_word
from pliant.client import BadArgument, Unreachable
from pliant.schemas.job import LONGEST_NAME
from pliant.service.settings import ServiceSettings
from pliant.service.testing import InMemoryService
from pliant.solver.gallery import face
from pliant.worker.errors import ServerFailed, StoreUnavailable
from pliant.worker.processes.containment import NUMERICAL_THREADS
from pliant.worker.processes.valkey import find_binary
from pliant.worker.settings import Settings
from serving import free_port, until
from typer.testing import CliRunner

doctor = importlib.import_module("pliant.cli.doctor")  # the package attribute of this name is the command
up = importlib.import_module("pliant.cli.up")


def test_options_are_parsed_as_json_where_possible() -> None:
    given = ["loss=l1", "fps=12.5", "basis_size=null", "refine_rotations=false", " seed = 3", "a=b=c"]
    expected = {"loss": "l1", "fps": 12.5, "basis_size": None, "refine_rotations": False, "seed": 3, "a": "b=c"}
    assert parse_options(given) == expected
    assert parse_options(None) == {}


def test_a_mesh_argument_is_a_path_if_the_file_exists(tmp_path: Path) -> None:
    (tmp_path / "3x4").write_text("")
    assert file_or_word(str(tmp_path / "3x4")) == tmp_path / "3x4"
    assert file_or_word("3x4") == "3x4"
    assert file_or_word(None) is None


def test_a_job_is_named_after_its_file(tmp_path: Path) -> None:
    assert name_of("", Path("takes/my face.v2.npz")) == "my face.v2"
    assert name_of("mine", Path("face.npz")) == "mine"
    assert name_of("", tmp_path / ".") == tmp_path.name
    assert name_of("", Path("b\udcff.npz")) == "b?"
    assert name_of("", Path("x" * 250)) == "x" * LONGEST_NAME


def test_an_occupied_port_is_rejected_and_0_finds_a_free_one() -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        with pytest.raises(BadArgument, match=rf"Cannot listen on 127\.0\.0\.1 port {port}.*--port 0"):
            up.free_port("127.0.0.1", port)
        assert 0 < up.free_port("127.0.0.1", 0) != port
    with pytest.raises(BadArgument, match=r"Cannot listen on 192\.0\.2\.1"):
        up.free_port("192.0.2.1", 8000)


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:80"),
        ("0.0.0.0", "http://127.0.0.1:80"),
        ("::", "http://[::1]:80"),
        ("::1", "http://[::1]:80"),
        ("host.example", "http://host.example:80"),
    ],
)
def test_the_address_is_reachable_from_this_machine(host: str, url: str) -> None:
    assert up.address(host, 80) == url


def test_the_command_line_takes_precedence_over_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLIANT_WORKERS", "3")
    monkeypatch.setenv("PLIANT_DATA", "there")
    assert (up.read_settings(None, None).workers, up.read_settings(None, None).data) == (3, Path("there"))
    assert (up.read_settings(Path("here"), 5).workers, up.read_settings(Path("here"), 5).data) == (5, Path("here"))


def test_the_service_logs_warnings_unless_a_level_is_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def level() -> str | None:
        """Return the level that `pliant up` sets, or None if the service reads it from its configuration."""
        return up.service_child(Settings(), "127.0.0.1", 80, "http://127.0.0.1:80", auth="off").env.get(
            "PLIANT_LOG_LEVEL"
        )

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PLIANT_SECRETS_DIR", str(tmp_path))
    monkeypatch.setenv("PLIANT_LOG_LEVEL", "")
    assert level() == "warning"
    for file in (tmp_path / ".env", tmp_path / "pliant_log_level"):
        file.write_text("PLIANT_LOG_LEVEL=info\n" if file.name == ".env" else "info\n")
        assert (level(), ServiceSettings.from_environment().log_level) == (None, "info")
        file.unlink()
    assert level() == "warning"
    monkeypatch.setenv("PLIANT_LOG_LEVEL", "debug")
    assert (level(), ServiceSettings.from_environment().log_level) == (None, "debug")


def test_a_service_that_exits_during_startup_is_reported() -> None:
    process = subprocess.Popen([sys.executable, "-c", "raise SystemExit(7)"])
    process.wait()
    with pytest.raises(ServerFailed, match="ended with code 7; the lines above state why"):
        up.until_ready("http://127.0.0.1:9")(process)


def test_a_service_that_never_becomes_ready_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(up, "READY_WITHIN", 2)
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        with pytest.raises(Unreachable, match=r"not ready after 2 s: .*Connection refused"):
            up.until_ready("http://127.0.0.1:9")(process)
    finally:
        process.kill()
        process.wait()


def test_a_service_that_is_not_ready_in_time_gives_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    class Starting(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = b'{"detail": "No worker has started yet."}' if self.path == "/readyz" else b"{}"
            self.send_response(503)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    monkeypatch.setattr(up, "READY_WITHIN", 0.3)
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    with ThreadingHTTPServer(("127.0.0.1", 0), Starting) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with pytest.raises(Unreachable, match=r"not ready after 0\.3 s: No worker has started yet\."):
                up.until_ready(up.address("127.0.0.1", server.server_address[1]))(process)
        finally:
            server.shutdown()
            process.kill()
            process.wait()


def test_up_does_not_import_the_libraries_of_its_child_processes() -> None:
    code = "import sys, pliant.cli.up, pliant.service.settings, pliant.worker.processes.supervisor; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"fastapi", "httpx", "numpy", "redis", "rq"} & set(ran.stdout.split())


def test_the_demonstration_succeeds_only_if_all_errors_are_small() -> None:
    assert judge(GOOD)
    assert judge({**GOOD, "reprojection_rms": 1e9})
    assert not judge({})
    for name, bound in GOOD.items():
        assert not judge({**GOOD, name: 1.01 * bound})
        assert not judge({**GOOD, name: float("nan")})


def test_the_address_is_read_from_the_output_of_up() -> None:
    assert read_address(io.StringIO('{\n  "url": "http://x",\n  "data": "d"\n}\n')) == "http://x"
    assert read_address(io.StringIO("")) is None


def test_a_service_that_does_not_start_gives_its_message_or_its_last_lines() -> None:
    assert why('{\n  "title": "Refused",\n  "detail": "PLIANT_PORT: expected a number."\n}\n') == (
        "PLIANT_PORT: expected a number."
    )
    assert why("one\n" * 9 + "[1]\nlast") == "one / one / one / one / [1] / last"
    assert why('["a list"]') == '["a list"]'


def verdicts(findings: object) -> dict[str, str]:
    return {finding.what: finding.verdict for finding in findings}  # type: ignore[attr-defined]


def test_doctor_reports_missing_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(*absent: str):
        def find(name: str) -> str:
            if name in absent:
                raise PackageNotFoundError(name)
            return version(name)

        return find

    assert verdicts(doctor.check_packages())["packages"] == "good"
    broken = list(doctor.check_packages(without("scipy", "clarabel", "matplotlib")))
    assert verdicts(broken) == {"packages": "bad", "server": "good", "matplotlib": "note"}
    assert broken[0].found == "missing: clarabel, scipy"
    server = next(each for each in doctor.check_packages(without("uvloop")) if each.what == "server")
    assert f"rq {version('rq')}, uvicorn {version('uvicorn')}" in server.found, "without uvloop, which Windows lacks"
    monkeypatch.setattr(doctor, "OLDEST_PYTHON", (4, 0))
    assert verdicts(doctor.check_python()) == {"Python": "bad"}


def test_doctor_measures_speed_and_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NUMERICAL_THREADS:
        monkeypatch.delenv(name, raising=False)
    (blas,) = doctor.check_blas()
    assert re.search(r"\d+ Gflop/s, \d+\.\d threads active \(no variable limits them\)", blas.found)
    monkeypatch.setenv("OMP_NUM_THREADS", "1000")
    (blas,) = doctor.check_blas()
    assert blas.verdict == "note"
    assert "OMP_NUM_THREADS=1000" in blas.found
    assert "lower the variable" in blas.advice
    monkeypatch.delenv("PLIANT_WORKERS", raising=False)
    assert verdicts(doctor.check_cores()) == {"cores": "good"}
    monkeypatch.setenv("PLIANT_THREADS", "1000")
    assert verdicts(doctor.check_cores()) == {"cores": "note"}


def test_doctor_checks_the_storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "LITTLE_SPACE", 1)
    assert verdicts(doctor.check_storage(tmp_path / "not" / "yet")) == {"storage": "good"}
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(doctor, "LITTLE_SPACE", 1 << 60)
    assert verdicts(doctor.check_storage(tmp_path)) == {"storage": "note"}
    (tmp_path / "file").write_text("")
    assert verdicts(doctor.check_storage(tmp_path / "file" / "data")) == {"storage": "bad"}


def test_doctor_checks_the_queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PLIANT_REDIS_URL", raising=False)
    assert verdicts(doctor.check_valkey()) == {"queue": "good"}
    port = free_port()
    server = subprocess.Popen(
        [str(find_binary()), "--port", str(port), "--bind", "127.0.0.1", "--requirepass", "secret", "--save", ""],
        stdout=subprocess.DEVNULL, cwd=tmp_path,
    )  # fmt: skip
    try:
        monkeypatch.setenv("PLIANT_REDIS_URL", f"redis://:secret@127.0.0.1:{port}/0")
        until(lambda: verdicts(doctor.check_valkey()) == {"queue": "good"})
        (found,) = doctor.check_valkey()
        assert "secret" not in found.found
        assert verdicts(doctor.check_port(port)) == {"port": "note"}
        for wrong in (
            f"redis://:wrong@127.0.0.1:{port}/0",
            f"redis://127.0.0.1:{port}/0",
            "http://nothing",
            "unix:///no/socket",
        ):
            monkeypatch.setenv("PLIANT_REDIS_URL", wrong)
            (found,) = doctor.check_valkey()
            assert found.verdict == "bad", wrong
            assert "wrong" not in found.found
        monkeypatch.setenv("PLIANT_REDIS_URL", f"redis://127.0.0.1:{port}/0")
        (found,) = doctor.check_valkey()
        assert found.found == f"redis://127.0.0.1:{port} cannot be used (it refuses the password)"
        assert "password in PLIANT_REDIS_URL" in found.advice
        client = redis.Redis(port=port, password="secret")
        client.config_set("maxmemory-policy", "allkeys-lru")
        client.close()
        monkeypatch.setenv("PLIANT_REDIS_URL", f"redis://:secret@127.0.0.1:{port}/0")
        (found,) = doctor.check_valkey()
        assert (found.verdict, "noeviction" in found.advice) == ("bad", True)
    finally:
        server.terminate()
        server.wait(10)
    monkeypatch.setenv("PLIANT_REDIS_URL", f"unix://{tmp_path}/none.sock")
    assert verdicts(doctor.check_valkey()) == {"queue": "bad"}
    monkeypatch.delenv("PLIANT_REDIS_URL")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert verdicts(doctor.check_valkey()) == {"queue": "bad"}


def test_doctor_checks_the_blob_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PLIANT_BLOB_URL", raising=False)
    assert list(doctor.check_blobs()) == []
    monkeypatch.setenv("PLIANT_BLOB_URL", (tmp_path / "blobs").as_uri())
    assert verdicts(doctor.check_blobs()) == {"blobs": "good"}
    assert list((tmp_path / "blobs").rglob("*")) == []
    with monkeypatch.context() as refusing:  # as credentials that may list the bucket, but not write to it

        def refused(*_: object) -> None:
            raise StoreUnavailable("The blob store", reason="PermissionDeniedError")

        refusing.setattr("pliant.worker.store.blobs.Blobs.write", refused)
        (found,) = doctor.check_blobs()
        assert (found.verdict, "cannot be used (PermissionDeniedError)" in found.found) == ("bad", True)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PLIANT_BLOB_URL", "bucket")
    (found,) = doctor.check_blobs()
    assert found.verdict == "bad"
    assert "PLIANT_BLOB_URL" in found.found
    monkeypatch.setenv("PLIANT_BLOB_URL", (tmp_path / "file" / "below").as_uri())
    (found,) = doctor.check_blobs()
    assert found.verdict == "bad"
    assert "AWS_" in found.advice


def test_long_paths_are_folded_and_not_cut_off(capsys: pytest.CaptureFixture[str]) -> None:
    """As in the mail of a daily `pliant fsck`."""
    path = "jobs/" + "0123456789" * 12 + "/artifacts/shapes.npz"
    doctor.show([doctor.Finding("stored", "bad", f"File {path} belongs to no job.", "Report it.")])
    assert path in "".join(capsys.readouterr().out.split())


def test_doctor_and_fsck_read_env_and_secret_files_as_the_service_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_variables: None
) -> None:
    monkeypatch.setenv("PLIANT_SECRETS_DIR", str(tmp_path))
    (tmp_path / "there" / "valkey").mkdir(parents=True)
    port = free_port()
    (tmp_path / ".env").write_text(f"PLIANT_DATA=there\nPLIANT_PORT={port}\n")
    (tmp_path / "pliant_blob_url").write_text((tmp_path / "bucket").as_uri())

    def found(*command: str) -> dict[str, str]:
        ran = CliRunner().invoke(app, [*command, "--json"], obj=Session(transport=InMemoryService()))
        return {finding["what"]: finding["found"] for finding in json.loads(ran.stdout)}

    findings = found("doctor")
    assert findings["storage"].startswith(f"{tmp_path / 'there'}, ")
    assert findings["port"] == f"{port} is free"
    assert findings["blobs"] == f"{(tmp_path / 'bucket').as_uri()} answers"
    assert found("doctor", "--data", "here")["storage"].startswith(f"{tmp_path / 'here'}, ")
    assert "job store" in found("fsck")["stored"], "the directory is an installation, whose queue is not running"


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("PLIANT_AUTH", "on", "'auto', 'required' or 'off'"),
        ("PLIANT_PORT", "abc", "a whole number, at least 0, at most 65535"),
        ("PLIANT_WORKERS", "0", "a whole number, at least 1"),
    ],
)
def test_a_setting_that_is_also_an_option_is_refused_like_every_setting(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, expected: str
) -> None:
    monkeypatch.setenv(name, value)
    ran = CliRunner().invoke(app, ["up", "--json"], obj=Session())
    words = f"{name}: expected {expected}, got {value!r}. Correct the variable or leave it unset."
    assert (ran.exit_code, json.loads(ran.stderr)["detail"]) == (Exit.REFUSED, words)


@pytest.mark.parametrize("missing", [True, False])
def test_a_wrong_option_is_a_usage_error(monkeypatch: pytest.MonkeyPatch, *, missing: bool) -> None:
    if missing:  # without the extra, the variable is reported as the value of the option
        monkeypatch.setitem(sys.modules, "pliant.service.settings", None)
        monkeypatch.setenv("PLIANT_AUTH", "on")
    ran = CliRunner().invoke(app, ["up", "--json", *([] if missing else ["--auth", "on"])], obj=Session())
    assert ran.exit_code == Exit.USAGE
    assert json.loads(ran.stderr)["detail"].endswith("'on' is not one of 'auto', 'required', 'off'.")
    assert "Value error" not in ran.stderr


def test_doctor_checks_the_service() -> None:
    session = Session(transport=InMemoryService())
    assert verdicts(doctor.check_service(session, "http://pliant.test")) == {"service": "good"}
    (found,) = doctor.check_service(Session(), "http://127.0.0.1:9")
    assert found.verdict == "note"
    assert "pliant up" in found.advice


def test_doctor_says_how_to_install_a_missing_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "redis", None)
    findings = {finding.what: finding for finding in doctor.check_packages()}
    assert (findings["packages"].verdict, findings["server"].verdict) == ("good", "note")
    assert "pip install '.[server]'" in findings["server"].advice
    monkeypatch.delenv("PLIANT_REDIS_URL", raising=False)
    assert list(doctor.check_valkey()) == []


def test_doctor_checks_that_films_can_be_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    (good,) = doctor.check_films()
    assert (good.what, good.verdict, good.found) == ("films", "good", f"OpenCV {cv2.__version__}")
    with monkeypatch.context() as patch:
        patch.setattr(cv2.videoio_registry, "getStreamBackends", tuple)
        (without,) = doctor.check_films()
    assert without.verdict == "note"
    assert without.found.endswith("built without FFmpeg")
    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.delitem(sys.modules, "pliant.tracking.decoding.film")
    (absent,) = doctor.check_films()
    assert absent.verdict == "note"
    assert "pip install '.[film]'" in absent.advice


def test_inspect_of_tracks_names_the_test_for_a_sheet_where_it_is_possible(tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=face(10, 100).tracks.points)

    def words(*options: str) -> str:
        given = [part for each in options for part in ("-O", each)]
        return CliRunner().invoke(app, ["inspect", str(tmp_path / "tracks.npz"), *given], env={"COLUMNS": "400"}).stdout

    for possible in ("image_size=640x480", "focal=1000"):
        assert SHEET_TEST in words(possible)
        assert SHEET_TEST not in words(possible, "surface=free")
        assert SHEET_TEST not in words(possible, "camera=orthographic")
    assert SHEET_TEST not in words()
