"""The sandbox: parse an untrusted file in a restricted process.

Every format but plain .npy and .npz is parsed here. The process starts with two open files, the input and the output, and then gives up
the right to open another descriptor (RLIMIT_NOFILE = 0), so a parser that is taken over reaches no other file and no network. Its
memory, processor time and output size are limited; its environment and working directory are empty. It writes an npz, which the
parent reads with the same checks as an uploaded npz, and the names of its arrays, which may be any text, as JSON; or an error as JSON.
"""

from __future__ import annotations

import codecs
import json
import os
import signal
import sys
import tempfile
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

from pliant.solver.errors import InvalidInput
from pliant.worker.formats.errors import damaged, refusal_in
from pliant.worker.formats.records import Arrays, Limits
from pliant.worker.processes.contained import DONE, REFUSED, Ended, limit_process, run_contained, serve

MODULE = "pliant.worker.formats.reading.sandbox"


def parse_in_sandbox(parser: str, path: Path, *, field: str, limits: Limits) -> Arrays:
    """Run a parser of `parsers.PARSERS` on a file in a sandbox.

    Raises
    ------
    InvalidInput
        The parser's error; too_large above the memory limit, too_slow above the time limit, damaged_file after a crash.
    """
    if find_spec("resource") is None:  # Windows
        raise InvalidInput(
            "unsupported_feature", field=field, expected="a .npz or .npy file on this system",
            got="a format that is parsed in a sandbox, which needs Linux or macOS",
            hint="Convert it, e.g. numpy.savez('tracks.npz', tracks=points), or send it to a service.",
        )  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="pliant-parse-") as empty, tempfile.NamedTemporaryFile() as output:
        with path.open("rb") as given:
            ended = _run(parser, given, output, field=field, limits=limits, directory=empty)
        if ended.code == DONE:
            return _received(ended, Path(output.name), field=field, limits=limits)
    raise _fault(ended, field=field, limits=limits)


def _run(parser: str, given: IO[bytes], output: IO[bytes], *, field: str, limits: Limits, directory: str) -> Ended:
    descriptors = (given.fileno(), output.fileno())
    request = {"parser": parser, "field": field, "descriptors": descriptors, "limits": asdict(limits)}
    return run_contained(
        MODULE, request, seconds=2 * limits.parse_seconds + 30, directory=directory, descriptors=descriptors
    )


def _received(ended: Ended, output: Path, *, field: str, limits: Limits) -> Arrays:
    """Return the arrays of the sandbox under the names that it answered."""
    from pliant.worker.formats.reading.arrays import read_file

    try:
        names = [str(name) for name in json.loads(ended.answer)]
    except (ValueError, TypeError, RecursionError):
        names = []
    arrays = read_file(output, field=field, limits=replace(limits, max_members=len(names)))
    if len(arrays) != len(names):
        raise damaged(field, "a file that its reader cannot process")
    return dict(zip(names, arrays.values(), strict=True))


def _fault(ended: Ended, *, field: str, limits: Limits) -> InvalidInput:
    if ended.code == REFUSED:
        return refusal_in(ended.answer) or damaged(field, "a file that its reader cannot process")
    if ended.overdue or ended.code in (-signal.SIGXCPU, -signal.SIGKILL):
        return InvalidInput(
            "too_slow", field=field, expected=f"a file that is read within {limits.parse_seconds:g} s", got="one that takes longer",
            hint="Convert it to npz: numpy.savez('tracks.npz', tracks=points).",
        )  # fmt: skip
    crash = f" (signal {-ended.code})" if ended.code < 0 else ""
    return damaged(field, f"a file that stops its reader{crash}")


def main() -> int:
    """Parse the file of the given descriptor under the given limits."""
    return serve(_parse)


def _parse(request: dict[str, Any]) -> str:
    import resource

    import numpy as np
    import numpy.ma  # np.unique loads it when first used, which is too late once no file can be opened
    from pliant.worker.formats.reading.parsers import PARSERS, parse

    read = PARSERS[request["parser"]].load()
    limits = Limits(**request["limits"])
    given, output = request["descriptors"]
    with os.fdopen(given, "rb") as source, os.fdopen(output, "wb") as target:
        # Codecs are files, too, read on first use.
        for codec in ("cp437", "utf-8-sig", "latin-1", "ascii", "raw-unicode-escape"):
            codecs.lookup(codec)
        limit_process(
            {
                resource.RLIMIT_AS: limits.parse_memory,
                resource.RLIMIT_CPU: max(1, round(limits.parse_seconds)),
                resource.RLIMIT_FSIZE: limits.max_bytes + (1 << 20),
                resource.RLIMIT_CORE: 0,
                resource.RLIMIT_NOFILE: 0,
            }
        )
        arrays = parse(read, source, field=request["field"], limits=limits)
        np.savez(target, *arrays.values(), allow_pickle=False)
    return json.dumps(list(arrays))


if __name__ == "__main__":
    sys.exit(main())
