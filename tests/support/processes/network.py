"""Hosts in network namespaces, joined by a switch. A cut cable drops packets without an error to either side."""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

_CLONE_NEWNET = 0x40000000


def reason_against() -> str | None:
    """Return why no network can be created here, or None."""
    if os.name != "posix" or not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "network namespaces need the program ip (Debian's package iproute2)"
    name = f"pl{secrets.token_hex(3)}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True)
    if made.returncode != 0:
        return f"no network namespace can be made here: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", name], check=True)
    return None


class Network:
    """Named hosts with the addresses 10.77.0.1, 10.77.0.2, …; nothing outside is reachable from them."""

    def __init__(self, names: Sequence[str]) -> None:
        self._tag = f"pl{secrets.token_hex(2)}"
        self.names = tuple(names)
        self.address = {name: f"10.77.0.{number}" for number, name in enumerate(names, 1)}

    def __enter__(self) -> Network:
        switch = self._space("switch")
        _ip("netns", "add", switch)
        _ip("-n", switch, "link", "add", "br0", "type", "bridge")
        _ip("-n", switch, "link", "set", "br0", "up")
        for number, name in enumerate(self.names, 1):
            space = self._space(name)
            _ip("netns", "add", space)
            _ip("-n", switch, "link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", space)
            _ip("-n", switch, "link", "set", name, "master", "br0", "up")
            _ip("-n", space, "link", "set", "eth0", "address", _mac(number), "up")
            _ip("-n", space, "link", "set", "lo", "up")
            _ip("-n", space, "addr", "add", f"{self.address[name]}/24", "dev", "eth0")
        for (
            name
        ) in self.names:  # fixed neighbours: with a cable pulled, packets are sent and lost, not refused as unroutable
            for number, other in enumerate(self.names, 1):
                if other != name:
                    _ip("-n", self._space(name), "neigh", "replace", self.address[other], "lladdr", _mac(number),
                        "dev", "eth0", "nud", "permanent")  # fmt: skip
        return self

    def __exit__(self, *_: object) -> None:
        for name in (*self.names, "switch"):
            subprocess.run(["ip", "netns", "del", self._space(name)], check=False)

    def command(self, name: str, argv: Sequence[str]) -> list[str]:
        """Return the command that runs another one on a host."""
        return ["ip", "netns", "exec", self._space(name), *argv]

    def pull(self, name: str) -> None:
        """Pull a host's cable."""
        _ip("-n", self._space("switch"), "link", "set", name, "down")

    def plug(self, name: str) -> None:
        """Put a host's cable back."""
        _ip("-n", self._space("switch"), "link", "set", name, "up")

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        """Run this thread, and the threads it starts, on a host."""
        libc = ctypes.CDLL(None, use_errno=True)
        home = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        there = os.open(f"/run/netns/{self._space(name)}", os.O_RDONLY)
        try:
            if libc.setns(there, _CLONE_NEWNET) != 0:
                raise OSError(ctypes.get_errno(), "setns")
            yield
        finally:
            libc.setns(home, _CLONE_NEWNET)
            os.close(home)
            os.close(there)

    def _space(self, name: str) -> str:
        return f"{self._tag}-{name}"


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


def _mac(number: int) -> str:
    return f"02:00:00:00:00:{number:02x}"


def clock_shift(seconds: float) -> dict[str, str] | None:
    """Return the variables under which a process sees another time of day, None if libfaketime is not installed."""
    import importlib.util

    spec = importlib.util.find_spec("libfaketime")
    if spec is None or spec.origin is None:
        return None
    library = Path(spec.origin).parent / "vendor" / "libfaketime" / "src" / "libfaketime.so.1"
    if not library.exists():
        return None
    return {"LD_PRELOAD": str(library), "FAKETIME": f"{seconds:+g}s", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
