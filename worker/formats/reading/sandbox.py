"""Parse a stranger's file in a process of its own, which can be lost without harm.

Everything but plain .npy and .npz goes through here. The child starts with two open files, the input and the output; it then gives up
the right to open another descriptor (RLIMIT_NOFILE = 0), so it can reach no other file and no network, whatever the parser is talked
into; memory, processor time and the size of its output are bounded; its environment and its working directory are empty; it dies with
its parent. It answers with an npz, which the parent reads as it reads anybody's npz, or with a refusal as JSON.
"""

from __future__ import annotations

import codecs
import contextlib
import ctypes
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO

from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged, refusal
from pliant.worker.formats.records import Arrays, Limits

DONE, REFUSED = 0, 3
MAX_ANSWER = 1 << 16
PR_SET_PDEATHSIG = 1


def parse_in_child(parser: str, path: Path, *, field: str, limits: Limits) -> Arrays:
    """Run a parser of `parsers.PARSERS` on a file, contained.

    Raises
    ------
    InvalidInput
        What the parser refuses; too_large beyond the memory, too_slow beyond the time, damaged_file when it crashed the parser.
    """
    from pliant.worker.formats.reading.arrays import read_file

    with tempfile.TemporaryDirectory(prefix="pliant-parse-") as empty, tempfile.NamedTemporaryFile() as answer:
        with path.open("rb") as given:
            code = _run(parser, given, answer, field=field, limits=limits, directory=empty)
        if code == DONE:
            return read_file(Path(answer.name), field=field, limits=limits)
        if code == REFUSED:
            raise _told(Path(answer.name), field)
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            raise refusal(
                "too_slow", field, expected=f"a file that is read within {limits.parse_seconds:g} s", got="one that takes longer",
                hint="Convert it to npz: numpy.savez('tracks.npz', tracks=points).",
            )  # fmt: skip
        raise damaged(
            field, f"a file that stops its reader (signal {-code})" if code < 0 else "a file that stops its reader"
        )


def _run(parser: str, given: IO[bytes], answer: IO[bytes], *, field: str, limits: Limits, directory: str) -> int:
    settings = [parser, field, str(given.fileno()), str(answer.fileno()), str(os.getpid())]
    bounds: dict[str, float] = {
        "max_bytes": limits.max_bytes,
        "max_points": limits.max_points,
        "max_faces": limits.max_faces,
    }
    bounds |= {"parse_seconds": limits.parse_seconds, "parse_memory": limits.parse_memory}
    process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-I", "-m", "pliant.worker.formats.reading.sandbox", *settings, json.dumps(bounds)],
        pass_fds=(given.fileno(), answer.fileno()), cwd=directory, env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        return process.wait(timeout=2 * limits.parse_seconds + 30)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
    except BaseException:
        process.kill()
        process.wait()
        raise


def _told(answer: Path, field: str) -> InvalidInput:
    with answer.open("rb") as file:
        text = file.read(MAX_ANSWER)
    try:
        said = json.loads(text)
        return InvalidInput(
            str(said["code"]), **{name: str(said[name]) for name in ("field", "expected", "got", "hint")}
        )
    except (ValueError, KeyError, TypeError):
        return damaged(field, "a file that confuses its reader")


def main() -> int:
    """Parse the file of the given descriptor under the given limits; the child's whole life."""
    parser, field, given, answer, parent, bounds = sys.argv[1:]
    die_with(int(parent))
    import numpy as np
    import numpy.ma  # np.unique loads it when first used, which is too late once no file can be opened
    from pliant.worker.formats.reading.parsers import PARSERS, parse

    read = PARSERS[parser].load()

    limits = Limits(**json.loads(bounds))
    with os.fdopen(int(given), "rb") as source, os.fdopen(int(answer), "wb") as target:
        for codec in ("cp437", "utf-8-sig", "latin-1", "ascii"):  # codecs are files too, read on first use
            codecs.lookup(codec)
        _shut_the_door(limits)
        try:
            arrays = parse(read, source, field=field, limits=limits)
            np.savez(target, allow_pickle=False, **arrays)
        except InvalidInput as error:
            target.seek(0)
            target.truncate()
            said = {name: getattr(error, name) for name in ("code", "field", "expected", "got", "hint")}
            target.write(json.dumps(said).encode()[:MAX_ANSWER])
            return REFUSED
    return DONE


def die_with(parent: int) -> None:
    """Let the kernel kill this process with its parent; Linux only, elsewhere the processor limit ends it."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def _shut_the_door(limits: Limits) -> None:
    seconds = max(1, round(limits.parse_seconds))
    for name, bound in (
        (resource.RLIMIT_AS, limits.parse_memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, limits.max_bytes + (1 << 20)),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # macOS does not know an address-space limit
            resource.setrlimit(name, (bound, bound))


if __name__ == "__main__":
    sys.exit(main())
