"""`pliant demo`: a complete run, from a rendered film with ground truth to a textured moving mesh."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer
from pliant.cli.exits import Exit
from pliant.cli.extras import require_server
from pliant.cli.paths import RESULT_FILES, different_files, output_folder
from pliant.cli.session import LINE_EVERY, Force, Json
from pliant.cli.show import METRIC_MEANINGS, err, out, print_json, show_warnings, verdict_lines

if TYPE_CHECKING:
    from pliant.schemas.job import Job
    from pliant.tracking.rendering import RenderedFilm


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Parameters of the demonstration film."""

    frames: int
    size: tuple[int, int]
    """Width and height in pixels."""

    points: int
    """Maximum number of reconstructed points."""

    @property
    def template(self) -> int:
        """Frame on which the region is drawn: the middle frame, in which the face looks at the camera."""
        return self.frames // 2


FULL = Scene(frames=30, size=(240, 180), points=800)
SMALL = Scene(frames=8, size=(160, 120), points=300)

MODEL_POINTS = 3000
"""Vertices of the rendered face, which makes its facets about one pixel wide in the full film."""

DEGREES, DISTANCE = 30.0, 5.0
"""Largest rotation of the face to either side, degrees, and its distance from the camera in half heights of the face: about
one and a half arm's lengths."""

GOOD: Mapping[str, float] = {"e3d_frame_scaled": 0.08, "track_median": 0.7, "track_p95": 3.0}
"""Largest errors with which the demonstration succeeds: relative 3-D error, pixels, pixels."""

MEANINGS: Mapping[str, str] = {
    "e3d_frame_scaled": METRIC_MEANINGS["e3d_frame_scaled"],
    "track_median": "error of the tracks in pixels, median",
    "track_p95": "error of the tracks in pixels, 95 % are below",
    "visibility_precision": "share of points marked visible that are visible",
    "visibility_recall": "share of the visible points called visible",
}

DEMO_OUTPUT = Path("demo-output")
DEMO_FILES = ("film.mp4", "region.png", "tracks.npz", *RESULT_FILES, "shapes.glb")
"""Files that must not exist in the folder given with `--output`, unless `--force` is given. Checked before rendering."""

STOPS_WITHIN = 60.0


def demo(
    ctx: typer.Context,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder for the results; by default demo-output, whose files are replaced."
        ),
    ] = None,
    small: Annotated[bool, typer.Option("--small", help="A shorter and smaller film: faster.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the service and its page running until Ctrl-C.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Turn a rendered film of a face into a moving mesh, using the real service, queue and worker.

    Compares the tracks and the mesh with the ground truth. The exit code is 0 only if the errors are small.
    """
    require_server("pliant demo")
    force = force or output is None
    output = DEMO_OUTPUT if output is None else output
    output_folder(output, force=force, files=DEMO_FILES)
    scene = SMALL if small else FULL
    if not as_json:
        width, height = scene.size
        out().print(f"Rendering a film of a talking face: {scene.frames} frames of {width}×{height} pixels …")
    film = render(scene, output)
    with tempfile.TemporaryDirectory(prefix="pliant-demo-") as folder, running(Path(folder)) as url:
        from pliant.client.progress import progress_bar

        with ctx.obj.client(url) as client, progress_bar(line_every=LINE_EVERY) as bar:
            job = client.submit(
                film=output / "film.mp4",
                region=output / "region.png",
                name="demo",
                options={"region_frame": scene.template, "max_points": scene.points},
                on_upload=bar.on_upload,
            )
            result = job.wait(on_progress=bar.on_progress, load=False)
            output_folder(output, force=force, files=different_files(result.job, output))
            paths = result.download(output, on_download=bar.on_download)
        metrics = compare(film, paths)
        good = judge(metrics)
        report(result.job, metrics, paths, good=good, url=url if keep else None, as_json=as_json)
        if keep:
            wait_for_interrupt()
    if not good:
        raise typer.Exit(Exit.FAILED)


def render(scene: Scene, folder: Path) -> RenderedFilm:
    """Render the film and write `film.mp4` and `region.png` into a folder."""
    from PIL import Image
    from pliant.solver.gallery import face
    from pliant.tracking.rendering import face_paint, render_film

    sequence = face(scene.frames, MODEL_POINTS, degrees=DEGREES)
    film = render_film(sequence, size=scene.size, distance=DISTANCE, paint=face_paint(MODEL_POINTS))
    film.write(folder / "film.mp4")
    Image.fromarray(film.region(scene.template)).save(folder / "region.png")
    return film


def compare(film: RenderedFilm, paths: Mapping[str, Path]) -> dict[str, float]:
    """Compare the downloaded tracks and shapes with the film's ground truth."""
    import numpy as np
    from pliant.tracking.rendering import Truth

    with np.load(paths["tracks.npz"]) as held, np.load(paths["shapes.npz"]) as reconstructed:
        tracks, visibility, template = held["tracks"], held["visibility"], int(held["template"])
        truth = Truth.of(film, tracks, template, held["frame_indices"])
        accuracy = truth.track_accuracy(tracks, visibility)
        points = reconstructed.get("source_points")
        return {
            "e3d_frame_scaled": truth.shape_error(reconstructed["shapes"], points),
            "track_median": accuracy.median,
            "track_p95": accuracy.p95,
            "visibility_precision": accuracy.precision,
            "visibility_recall": accuracy.recall,
        }


def judge(metrics: Mapping[str, float]) -> bool:
    """Return True if every error in `GOOD` is present and below its bound."""
    return all(metrics.get(name, float("inf")) <= bound for name, bound in GOOD.items())


def report(
    job: Job, metrics: Mapping[str, float], paths: Mapping[str, Path], *, good: bool, url: str | None, as_json: bool
) -> None:
    """Print the errors and the paths of the files."""
    if as_json:
        files = {name: str(path) for name, path in paths.items()}
        print_json({"good": good, "metrics": metrics, "files": files, "url": url, "job": job.model_dump(mode="json")})
        return
    from rich.table import Table
    from rich.text import Text

    table = Table()
    for heading in ("metric", "value", "good below", "meaning"):
        table.add_column(heading, justify="left" if heading in ("metric", "meaning") else "right")
    for name, value in metrics.items():
        bound = GOOD.get(name)
        colour = "" if bound is None else "green" if value <= bound else "red"
        table.add_row(name, Text(f"{value:.4g}", colour), "" if bound is None else f"{bound:g}", MEANINGS[name])
    screen = out()
    screen.print(table)
    show_warnings(job.warnings)
    if not good:
        advice = " Please report this with the output of `pliant doctor`."
        err().print(Text.assemble(("The errors are too large.", "bold red"), advice))
    for path in paths.values():
        screen.print(f"  {path}  {path.stat().st_size / 1e6:.2f} MB")
    for line in verdict_lines(job):
        screen.print(line)
    glb = paths.get("shapes.glb")
    screen.print(f"Open {glb} in Blender or any glTF viewer: it plays." if glb is not None else "")
    if url is None:
        screen.print("To see it in the browser: pliant demo --keep. For your own films: pliant up.")
    else:
        screen.print(Text.assemble(("The page:", "bold"), f" {url}  ", ("(Ctrl-C stops it)", "dim")))


@contextmanager
def running(folder: Path) -> Iterator[str]:
    """Run `pliant up` on a free port, with data and log in a folder that is created; yield its address, then stop it.

    Raises
    ------
    Unreachable
        The service did not start; the message contains its last lines.
    """
    from pliant.client.errors import Unreachable

    log = folder / "service.log"
    data = str(folder.absolute() / "data")
    command = [sys.executable, "-m", "pliant.cli", "up", "--port", "0", "--data", data, "--json"]
    elsewhere = ("PLIANT_REDIS_URL", "PLIANT_BLOB_URL", "PLIANT_HOST", "PLIANT_AUTH", "PLIANT_TOKEN")
    environment = {name: value for name, value in os.environ.items() if name not in elsewhere}
    folder.mkdir(parents=True, exist_ok=True)
    # Started in its own folder: a `.env` file in the current folder configures another installation.
    with log.open("wb") as errors:
        process = subprocess.Popen(  # noqa: S603 - our own program
            command, stdout=subprocess.PIPE, stderr=errors, env=environment, cwd=folder, start_new_session=True, text=True
        )  # fmt: skip
        try:
            assert process.stdout is not None
            url = read_address(process.stdout)
            if url is None:
                process.wait(STOPS_WITHIN)
                raise Unreachable(
                    f"The service did not start (code {process.returncode}): {why(log.read_text(errors='replace'))}"
                )
            yield url
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            process.wait(STOPS_WITHIN)
            if process.stdout is not None:
                process.stdout.close()


def why(log: str) -> str:
    """Return the message of an error that `pliant up --json` printed, else its last lines."""
    try:
        return str(json.loads(log)["detail"])
    except (ValueError, LookupError, TypeError):
        return " / ".join(log.splitlines()[-6:])


def read_address(stream: IO[str]) -> str | None:
    """Read the address from the output of `pliant up --json`; None if it ends without one."""
    text = ""
    for line in stream:
        text += line
        if line.rstrip() == "}":
            url: str = json.loads(text)["url"]
            return url
    return None


def wait_for_interrupt() -> None:
    """Sleep until Ctrl-C, SIGTERM or SIGHUP."""
    try:
        signal.pause()
    except KeyboardInterrupt:
        return
