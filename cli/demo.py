"""`pliant demo`: one complete run on a synthetic face with known true shapes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer
from pliant.cli.exits import Exit
from pliant.cli.extras import require_server
from pliant.cli.paths import output_folder
from pliant.cli.session import LINE_EVERY, Json, Session
from pliant.cli.show import err, out, print_json

if TYPE_CHECKING:
    from pliant.schemas.job import Job

FULL = (60, 5000)
SMALL = (12, 400)
"""Frames, points."""

GOOD: Mapping[str, float] = {"e3d_sequence": 0.05, "e3d_frame_similarity": 0.05}
"""Relative 3-D errors above which the demonstration counts as failed."""

STOPS_WITHIN = 60.0


def demo(
    ctx: typer.Context,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("demo-output"),
    small: Annotated[bool, typer.Option("--small", help="A few hundred points: faster.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the service and its page running until Ctrl-C.")] = False,
    as_json: Json = False,
) -> None:
    """Reconstruct a moving face with known true shapes, using the real service, queue and worker.

    Exit code 0 only if the errors are small.
    """
    session: Session = ctx.obj
    session.json = as_json
    require_server("pliant demo")
    output_folder(output, force=True)
    from pliant.solver.gallery import face

    num_frames, num_points = SMALL if small else FULL
    sequence = face(num_frames, num_points)
    frames, points, _ = sequence.shapes.shape
    if not as_json:
        out().print(f"A face: {frames} frames × {points} points, seen by a turning camera. Starting the service …")
    with tempfile.TemporaryDirectory(prefix="pliant-demo-") as folder, running(Path(folder)) as url:
        from pliant.client.progress import progress_bar

        with session.client(url, as_json=as_json) as client, progress_bar(line_every=LINE_EVERY) as bar:
            job = client.submit(
                sequence.tracks.points,
                visible=sequence.tracks.visible,
                mesh={"faces": sequence.mesh.faces} if sequence.mesh.grid is None else {"grid": sequence.mesh.grid},
                ground_truth={"shapes": sequence.shapes, "rotations": sequence.rotations},
                name=sequence.name,
                on_upload=bar.on_upload,
            )
            result = job.wait(on_progress=bar.on_progress, load=False)
            paths = result.download(output, on_download=bar.on_download)
        good = judge(result.metrics)
        report(result.job, paths, good=good, url=url if keep else None, as_json=as_json)
        if keep:
            wait_for_interrupt()
    if not good:
        raise typer.Exit(Exit.FAILED)


def judge(metrics: Mapping[str, float]) -> bool:
    """Return True if every error in `GOOD` is present and below its bound."""
    return all(metrics.get(name, float("inf")) <= bound for name, bound in GOOD.items())


def report(job: Job, paths: Mapping[str, Path], *, good: bool, url: str | None, as_json: bool) -> None:
    """Print the errors and the paths of the files."""
    metrics = job.metrics or {}
    if as_json:
        files = {name: str(path) for name, path in paths.items()}
        print_json({"good": good, "metrics": metrics, "files": files, "url": url, "job": job.model_dump(mode="json")})
        return
    from rich.table import Table
    from rich.text import Text

    table = Table(title=job.trust_sentence or job.sentence, title_justify="left")
    for heading in ("metric", "value", "good below"):
        table.add_column(heading, justify="left" if heading == "metric" else "right")
    for name, value in metrics.items():
        bound = GOOD.get(name)
        colour = "" if bound is None else "green" if value <= bound else "red"
        table.add_row(name, Text(f"{value:.4g}", colour), "" if bound is None else f"{bound:g}")
    screen = out()
    screen.print(table)
    for warning in job.warnings:
        err().print(f"[yellow]warning[/] {warning}")
    if not good:
        err().print("[bold red]The errors are too large.[/] Please report this with the output of `pliant doctor`.")
    for path in paths.values():
        screen.print(f"  {path}  {path.stat().st_size / 1e6:.2f} MB", markup=False)
    glb = paths.get("shapes.glb")
    screen.print(f"Open {glb} in Blender or any glTF viewer: it plays." if glb is not None else "", markup=False)
    if url is None:
        screen.print("To see it in the browser: pliant demo --keep. For your own files: pliant up.")
    else:
        screen.print(f"[bold]The page:[/] {url}  [dim](Ctrl-C stops it)[/]")


@contextmanager
def running(folder: Path, *, threads: int | None = None) -> Iterator[str]:
    """Run `pliant up` on a free port with its data in a folder, yield its address, and stop it afterwards.

    Parameters
    ----------
    folder : Path
        Created if missing; holds the data and the log.
    threads : int, optional
        Threads of the numerical libraries in one job.

    Raises
    ------
    Unreachable
        The service did not start; the message contains its last lines.
    """
    from pliant.client.errors import Unreachable

    log = folder / "service.log"
    command = [
        sys.executable,
        "-m",
        "pliant.cli",
        "up",
        "--port",
        "0",
        "--data",
        str(folder.absolute() / "data"),
        "--json",
    ]
    elsewhere = ("PLIANT_REDIS_URL", "PLIANT_BLOB_URL", "PLIANT_HOST", "PLIANT_AUTH", "PLIANT_TOKEN")
    environment = {name: value for name, value in os.environ.items() if name not in elsewhere}
    if threads is not None:
        environment["PLIANT_THREADS"] = str(threads)
    folder.mkdir(parents=True, exist_ok=True)
    # Started in its own folder, for a `.env` of the current one describes another installation.
    with log.open("wb") as errors:
        process = subprocess.Popen(  # noqa: S603 - our own program
            command,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
            cwd=folder,
            start_new_session=True,
            text=True,
        )
        try:
            assert process.stdout is not None
            url = announced(process.stdout)
            if url is None:
                process.wait(STOPS_WITHIN)
                last = " / ".join(log.read_text(errors="replace").splitlines()[-6:])
                raise Unreachable(f"The service did not start (code {process.returncode}): {last}")
            yield url
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            process.wait(STOPS_WITHIN)
            if process.stdout is not None:
                process.stdout.close()


def announced(stream: IO[str]) -> str | None:
    """Read the address from the output of `pliant up --json`; None if it ends without one."""
    text = ""
    for line in stream:
        text += line
        if line.rstrip() == "}":
            url: str = json.loads(text)["url"]
            return url
    return None


def wait_for_interrupt() -> None:
    """Sleep until Ctrl-C or SIGTERM."""
    try:
        signal.pause()
    except KeyboardInterrupt:
        return
