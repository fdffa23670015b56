"""Write all result files of a job. Each is written under a temporary name and renamed, so readers see complete files only."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

from pliant.schemas.digests import sha256
from pliant.schemas.job import Artifact
from pliant.schemas.options import Options
from pliant.solver import Solution
from pliant.worker.artifacts.frames_zip import OnProgress
from pliant.worker.artifacts.kinds import Kind, kinds_for
from pliant.worker.artifacts.result import Result
from pliant.worker.formats import Inputs

REPORT = "How the result was computed: options, choices with reasons, metrics, trace, timings, versions."


def write_artifacts(
    inputs: Inputs, solution: Solution, options: Options, report: dict[str, Any], directory: Path, *, name: str = "",
    on_progress: OnProgress | None = None,
) -> list[Artifact]:  # fmt: skip
    """Write the result files that a job's options request into an existing directory; return them in the order written.

    The report of an earlier result in the directory is removed first.

    The report is written last, with `artifacts` and `seconds.exporting` added; its `artifacts` may list files written earlier. `name` is
    the job's, from which the objects in the files are named. `on_progress` gets the completed share, in [0, 1].

    Raises
    ------
    InvalidInput
        A requested file cannot be written in this installation.
    """
    began = time.perf_counter()
    result = Result(inputs, solution, options, name)
    report_share: OnProgress = on_progress or (lambda _: None)
    kinds = kinds_for(options, textured=result.texture is not None)
    (directory / "report.json").unlink(missing_ok=True)  # after an error, it must not describe files of another result
    written, entries = write_kinds(result, kinds, directory, on_progress=report_share)
    seconds = {**report.get("seconds", {}), "exporting": time.perf_counter() - began}
    listed = {**report.get("artifacts", {}), **entries}
    written.append(write_report({**report, "seconds": seconds, "artifacts": listed}, directory))
    report_share(1.0)
    return written


def write_kinds(
    result: Result, kinds: Sequence[Kind], directory: Path, *, on_progress: OnProgress
) -> tuple[list[Artifact], dict[str, Any]]:
    """Write files of the given kinds, as `write_artifacts` does; return them in the order of `kinds`, and their report entries."""
    written: list[Artifact] = []
    entries: dict[str, Any] = {}
    done, total = 0.0, sum(kind.share for kind in kinds)
    for kind in kinds:
        with _complete(directory / kind.name) as file:
            extra = kind.write(result, file, partial(_report_share, on_progress, done / total, kind.share / total))
        artifact = described(directory / kind.name, kind.media_type, kind.description)
        written.append(artifact)
        entries[kind.name] = {"bytes": artifact.bytes, "sha256": artifact.sha256, **extra}
        done += kind.share
    return written, entries


def write_report(report: dict[str, Any], directory: Path) -> Artifact:
    """Write `report.json` and return its record."""
    text = json.dumps(report, indent=2, allow_nan=False).encode()
    with _complete(directory / "report.json") as file:
        file.write(text)
    return described(directory / "report.json", "application/json", REPORT)


@contextmanager
def _complete(target: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file for writing, and rename it to `target` at the end; after an error, `target` is unchanged."""
    aside = target.with_name(f".{target.name}.part")
    try:
        with aside.open("wb") as file:
            yield file
        aside.replace(target)
    finally:
        aside.unlink(missing_ok=True)


def _report_share(on_progress: OnProgress, start: float, share: float, part: float) -> None:
    on_progress(start + share * part)


def described(file: Path, media_type: str, description: str) -> Artifact:
    """Return the record of a complete result file."""
    return Artifact(
        name=file.name, media_type=media_type, bytes=file.stat().st_size, sha256=sha256(file), description=description
    )
