"""The supervisor, with small real processes; the embedded Valkey's locks, with real servers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from pliant.worker.errors import DataDirectoryInUse, InvalidSetting, ServerFailed, StoreUnavailable
from pliant.worker.paths import FOLDERS, LONGEST_SOCKET_PATH, make_data_directory, socket_path, valkey_directory
from pliant.worker.processes import valkey as valkey_module
from pliant.worker.processes.preflight import open_data_directory
from pliant.worker.processes.supervisor import FIRST_PAUSE, Child, Supervisor, worker_children
from pliant.worker.processes.valkey import Valkey, find_binary
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect, reachable
from serving import until

from benchmarks.installation.instance import running


def python(name: str, code: str, **more: object) -> Child:
    return Child(name=name, argv=[sys.executable, "-S", "-c", code], **more)  # type: ignore[arg-type]


SLEEP = "import time; time.sleep(600)"


def test_the_log_of_a_child_that_ended_is_quoted(caplog: pytest.LogCaptureFixture) -> None:
    ended = python("short", "raise SystemExit(3)", log_tail=lambda: "Short write", cause=lambda: "The disk is full.")
    supervisor = Supervisor([ended])
    supervisor.start()
    until(lambda: supervisor.look() or caplog.records, seconds=15)
    words = "short ended with code 3. Its log ends with: Short write. The disk is full. Starting it again in"
    assert words in caplog.records[-1].getMessage()
    supervisor.stop()


def test_ended_children_are_restarted_with_growing_pauses(tmp_path: Path) -> None:
    log = tmp_path / "starts"
    code = f"import time; open({str(log)!r}, 'a').write(f'{{time.monotonic()}}\\n')"
    supervisor = Supervisor([python("flappy", code), python("steady", SLEEP)])
    supervisor.start()
    steady = supervisor.pids()["steady"]

    def starts() -> list[float]:
        supervisor.look()
        return [float(line) for line in log.read_text().split()] if log.exists() else []

    until(lambda: len(starts()) >= 4, seconds=15)
    first, second, third, fourth = starts()[:4]
    # Each pause is twice the one before; starting the process takes extra time, more on a busy machine.
    for number, gap in enumerate((second - first, third - second, fourth - third), start=1):
        assert gap >= 2**number * FIRST_PAUSE
    assert fourth - first < 2 * 14 * FIRST_PAUSE + 10
    assert supervisor.pids()["steady"] == steady
    supervisor.stop()
    assert supervisor.pids() == {}
    assert not running(steady)


def test_a_child_that_cannot_be_started_again_is_tried_later_and_leaves_the_others_running(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    supervisor = Supervisor([python("short", "raise SystemExit(3)"), python("steady", SLEEP)])
    supervisor.start()
    start, steady = subprocess.Popen, supervisor.pids()["steady"]

    def no_process(*_: object, **__: object) -> None:
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", no_process)
    until(lambda: supervisor.look() or "cannot be started" in caplog.text, seconds=15)
    assert "short cannot be started: Resource temporarily unavailable. Trying again in 0.8 s" in caplog.text
    assert running(steady)
    monkeypatch.setattr(subprocess, "Popen", start)
    until(lambda: supervisor.look() or "short" in supervisor.pids(), seconds=15)
    supervisor.stop()


def test_an_unexpected_error_stops_the_children(monkeypatch: pytest.MonkeyPatch) -> None:
    supervisor, started = Supervisor([python("steady", SLEEP)]), dict[str, int]()

    def fail() -> None:
        started.update(supervisor.pids())
        raise ValueError("a fault of the supervisor")

    monkeypatch.setattr(supervisor, "look", fail)
    with pytest.raises(ValueError, match="a fault"):
        supervisor.run()
    assert not running(started["steady"])


def test_children_stop_before_foundations_and_are_killed_after_their_grace(tmp_path: Path) -> None:
    log = tmp_path / "ends"
    polite = (
        "import signal, sys, time\n"
        "def end(*_):\n"
        f"    open({str(log)!r}, 'a').write(sys.argv[1] + '\\n'); sys.exit()\n"
        "signal.signal(signal.SIGTERM, end)\n"
        f"open({str(tmp_path)!r} + '/' + sys.argv[1], 'w')\n"
        "time.sleep(600)"
    )
    stubborn = polite.replace("signal.signal(signal.SIGTERM, end)", "signal.signal(signal.SIGTERM, signal.SIG_IGN)")
    children = [
        Child(name=name, argv=[sys.executable, "-S", "-c", code, name], foundation=foundation, grace=grace)
        for name, code, foundation, grace in (
            ("ground", polite, True, 5.0),
            ("house", polite, False, 5.0),
            ("mule", stubborn, False, 0.5),
        )
    ]
    supervisor = Supervisor(children)
    supervisor.start()
    until(lambda: all((tmp_path / child.name).exists() for child in children), seconds=15)
    mule = supervisor.pids()["mule"]
    supervisor.stop()
    assert log.read_text().split() == ["house", "ground"]
    assert not running(mule)


def test_a_child_that_never_becomes_ready_stops_the_rest() -> None:
    def fail(process: subprocess.Popen[bytes]) -> None:
        raise ServerFailed("It does not start.", log="")

    supervisor = Supervisor([python("first", SLEEP), python("second", SLEEP, ready=fail)])
    with pytest.raises(ServerFailed, match="does not start"):
        supervisor.start()
    assert supervisor.pids() == {}


SUPERVISED = """
import sys
from pliant.worker.processes.supervisor import Child, Supervisor
supervisor = Supervisor([Child(name="c", argv=[sys.executable, "-S", "-c", {code!r}], grace=60.0)])
supervisor.run(on_started=lambda: print(supervisor.pids()["c"], flush=True))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_everything(number: signal.Signals) -> None:
    process = subprocess.Popen([sys.executable, "-c", SUPERVISED.format(code=SLEEP)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    process.send_signal(number)
    assert process.wait(10) == 0
    process.stdout.close()
    assert not running(child)


def test_a_second_signal_kills_children_without_waiting() -> None:
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", SUPERVISED.format(code=deaf)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = {process.stdout.readline().strip() for _ in range(2)}
    child = int(max(lines))
    process.send_signal(signal.SIGTERM)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.5)
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    process.stdout.close()
    assert not running(child)


def test_a_signal_during_start_stops_the_started_children() -> None:
    waiting = SUPERVISED.replace(
        "grace=60.0", "grace=60.0, ready=lambda c: (print(c.pid, flush=True), time.sleep(600))"
    )
    code = "import time\n" + waiting.format(code=SLEEP)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    process.terminate()
    assert process.wait(10) == 0
    process.stdout.close()
    assert not running(child)


class Fake:
    """A child process that runs until it is asked to end."""

    pid, ended = 1, False

    def poll(self) -> int | None:
        return 0 if self.ended else None

    def send_signal(self, number: int) -> None:
        self.ended = True


@pytest.mark.parametrize("moment", ["launch", "last launch", "ready"])
def test_a_signal_is_not_lost_at_any_moment_of_the_start(monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    """Python ignores an exception of a signal handler that runs in a hook of `fork`; here, whoever starts the process swallows it."""
    launched, waited, announced = list[Fake](), list[str](), list[bool]()

    def stop() -> None:
        with suppress(BaseException):
            signal.raise_signal(signal.SIGTERM)

    def launch(argv: list[str], **_: object) -> Fake:
        launched.append(Fake())
        if moment == argv[0]:
            stop()
        return launched[-1]

    def ready(_: object) -> None:
        waited.append("ready")
        if moment == "ready":
            stop()

    monkeypatch.setattr(subprocess, "Popen", launch)
    names = ("launch", "other", "last launch")
    supervisor = Supervisor([Child(name=name, argv=[name], ready=ready) for name in names])
    supervisor.run(on_started=lambda: announced.append(True))
    assert len(launched) == (3 if moment == "last launch" else 1)
    assert len(waited) == {"launch": 0, "last launch": 2, "ready": 1}[moment]
    assert all(each.ended for each in launched)
    assert announced == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a child of its parent's end")
def test_children_end_with_a_killed_supervisor() -> None:
    process = subprocess.Popen([sys.executable, "-c", SUPERVISED.format(code=SLEEP)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    process.kill()
    process.wait(10)
    process.stdout.close()
    until(lambda: not running(child), seconds=5)


def test_an_already_ended_parent_is_detected() -> None:
    code = (
        "import signal; from pliant.worker.processes.containment import die_with_parent; "
        f"die_with_parent({os.getpid() + 10**6}, how=signal.SIGKILL); print('alive')"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (ran.returncode, ran.stdout) == (-signal.SIGKILL, b"")


def test_workers_receive_their_settings_and_threads(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, workers=2, threads=3)
    children = worker_children(settings)
    assert [child.name for child in children] == ["worker-1", "worker-2", "reconciler"]
    for child in children:
        assert child.env.items() >= settings.to_environment().items()
        assert child.env["OPENBLAS_NUM_THREADS"] == child.env["OMP_NUM_THREADS"] == "1"  # the solver has its own


def test_two_supervisors_on_one_directory_are_refused(tmp_path: Path) -> None:
    first = Valkey.claim(tmp_path)
    with pytest.raises(DataDirectoryInUse, match=rf"already used by another Pliant \(process {os.getpid()}\).*--data"):
        Valkey.claim(tmp_path)
    first.release()
    Valkey.claim(tmp_path).release()


def test_an_interruption_while_the_server_starts_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    def interrupted(_: Valkey, process: subprocess.Popen[bytes]) -> None:
        started.append(process)
        raise KeyboardInterrupt

    monkeypatch.setattr(Valkey, "wait", interrupted)
    claimed = Valkey.claim(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        claimed.start()
    assert started[0].wait(10) != 0
    claimed.release()


def test_an_orphaned_server_is_stopped_and_its_data_is_kept(tmp_path: Path) -> None:
    first = Valkey.claim(tmp_path)
    orphan = first.start()
    client = connect(Settings(data=tmp_path).redis, decode=True)
    client.set("kept", "yes")
    first.release()
    second = Valkey.claim(tmp_path)
    assert orphan.wait(10) == 0
    server = second.start()
    assert client.get("kept") == "yes"
    server.kill()
    server.wait()
    again = second.start()
    assert client.get("kept") == "yes", "not lost by kill -9 either"
    client.close()
    again.terminate()
    again.wait(10)
    second.release()


def test_a_server_that_does_not_stop_blocks_its_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(valkey_module, "STOPS_WITHIN", 0.3)
    first = Valkey.claim(tmp_path)
    holder = subprocess.Popen([sys.executable, "-S", "-c", SLEEP], pass_fds=(first.server_lock,))
    first.release()
    with pytest.raises(DataDirectoryInUse, match="a Valkey server that does not stop"):
        Valkey.claim(tmp_path)
    holder.kill()
    holder.wait()
    Valkey.claim(tmp_path).release()


def test_a_damaged_append_only_file_is_reported(tmp_path: Path) -> None:
    first = Valkey.claim(tmp_path)
    server = first.start()
    client = connect(Settings(data=tmp_path).redis, decode=True)
    for number in range(50):
        client.set(f"key-{number}", "x" * 100)
    client.close()
    server.terminate()
    server.wait(10)
    (log,) = (valkey_directory(tmp_path) / "appendonlydir").glob("*.incr.aof")
    held = bytearray(log.read_bytes())
    held[2000:2100] = bytes(100)  # random bytes are, rarely, a large length, which looks like an end that was cut off
    log.write_bytes(held)
    with pytest.raises(ServerFailed, match=r"ended with code 1\. Its log ends with: .*AOF"):
        first.start()
    first.release()


def test_a_server_that_never_answers_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(valkey_module, "STARTS_WITHIN", 0.2)
    valkey = Valkey.claim(tmp_path)
    mute = subprocess.Popen([sys.executable, "-S", "-c", SLEEP])
    with pytest.raises(ServerFailed, match=r"does not answer after 0\.2 s"):
        valkey.wait(mute)
    mute.kill()
    mute.wait()
    valkey.release()


def test_a_socket_directory_that_others_may_write_is_refused(tmp_path: Path) -> None:
    deep = tmp_path / "/".join(["deep"] * 30)
    directory = socket_path(deep).parent
    directory.mkdir(mode=0o700)
    try:
        directory.chmod(0o777)
        with pytest.raises(ServerFailed, match="is writable by other users"):
            Valkey.claim(deep)
        directory.chmod(0o700)
        valkey = Valkey.claim(deep)
        server = valkey.start()
        server.terminate()
        server.wait(10)
        valkey.release()
        assert not directory.exists()
    finally:
        if directory.exists():
            directory.rmdir()


def test_the_records_of_another_user_are_not_to_be_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the command is run with `sudo` alone: the socket's directory is that of the records."""
    Valkey.claim(tmp_path).release()
    own = os.getuid()
    monkeypatch.setattr("os.getuid", lambda: own + 1)
    with pytest.raises(
        ServerFailed, match=r"belongs to another user\. Run the command as the user that runs Pliant"
    ) as caught:
        Valkey.claim(tmp_path)
    assert "Remove" not in str(caught.value)


def test_a_long_socket_path_does_not_follow_tmpdir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command with another TMPDIR than the server's would not find it otherwise."""
    deep = tmp_path / "/".join(["deep"] * 30)
    found = socket_path(deep)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert socket_path(deep) == found
    assert len(str(found)) < LONGEST_SOCKET_PATH


def test_a_socket_directory_that_is_a_link_is_refused(tmp_path: Path) -> None:
    deep = tmp_path / "/".join(["deep"] * 30)
    directory = socket_path(deep).parent
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    directory.symlink_to(tmp_path / "elsewhere")
    try:
        with pytest.raises(ServerFailed, match="is writable by other users"):
            Valkey.claim(deep)
    finally:
        directory.unlink()


def test_a_folder_of_another_user_in_the_data_directory_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a command run with `sudo` alone: the service started, and called the blob store unavailable for two minutes."""
    make_data_directory(tmp_path)
    closed = tmp_path / "blobs"
    monkeypatch.setattr("os.access", lambda path, mode: path != closed)
    with pytest.raises(PermissionError) as caught:
        Valkey.claim(tmp_path)
    assert caught.value.filename == str(closed)
    with pytest.raises(
        InvalidSetting, match=rf"PLIANT_DATA: expected a folder that this user can .*'{closed}' \(Permission denied\)"
    ):
        open_data_directory(Settings(data=tmp_path))


def test_the_data_directory_is_private_to_its_owner(tmp_path: Path) -> None:
    data = tmp_path / "data"
    make_data_directory(data)
    shared = tmp_path / "shared"
    (shared / "blobs").mkdir(parents=True, mode=0o755)
    make_data_directory(shared)
    assert {path.name: path.stat().st_mode & 0o777 for path in (data, *data.iterdir())} == dict.fromkeys(
        ("data", *FOLDERS), 0o700
    )
    assert shared.stat().st_mode & 0o077, "a directory that was there may be anybody's"
    assert (shared / "blobs").stat().st_mode & 0o777 == 0o700


def test_without_a_binary_the_error_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_binary().is_file()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(ServerFailed, match="PLIANT_REDIS_URL"):
        find_binary()
    monkeypatch.setattr("shutil.which", lambda name: "/somewhere/redis-server" if name == "redis-server" else None)
    assert find_binary() == Path("/somewhere/redis-server")


def test_a_call_to_a_hanging_store_is_not_repeated() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:  # the kernel accepts for it
        client = connect(f"redis://127.0.0.1:{deaf.getsockname()[1]}", decode=True, retries=5, answer_within=0.3)
        with pytest.raises(StoreUnavailable, match="TimeoutError"), reachable():
            client.ping()
        client.close()
        deaf.setblocking(False)
        deaf.accept()[0].close()
        with pytest.raises(BlockingIOError):
            deaf.accept()


def test_an_unavailable_store_is_an_error() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    client = connect(f"redis://127.0.0.1:{port}", decode=True, retries=1)
    with pytest.raises(StoreUnavailable, match="try again"), reachable():
        client.ping()
