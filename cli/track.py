"""`pliant track`: a film in, dense tracks out, without a service."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pliant.cli.extras import require_opencv
from pliant.cli.paths import input_file, output_file, write_aside
from pliant.cli.session import LINE_EVERY, Force, Json, one_numerical_thread
from pliant.cli.show import err, out, print_json, show_warnings

if TYPE_CHECKING:
    from pliant.tracking import OnStep, TrackedFilm, TrackingStep
    from rich.console import Console


Film = Annotated[
    Path,
    typer.Argument(
        help="mp4, mov, webm, mkv or avi film, animated GIF, zip or folder of pictures.", show_default=False
    ),
]


def track(
    film: Film,
    output: Annotated[Path, typer.Option("--output", "-o", help="tracks.npz to write.", show_default=False)],
    region: Annotated[
        Path | None, typer.Option("--region", help="Mask picture of the film's size: white is tracked.")
    ] = None,
    region_frame: Annotated[int, typer.Option("--region-frame", help="Frame that the mask was drawn on.", min=0)] = 0,
    template_frame: Annotated[
        int | None,
        typer.Option(
            "--template-frame",
            help="Frame whose points are followed; by default the mask's if it lies in the middle third, else a sharp one there.",
            min=0,
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option("--frames", help="Maximum number of frames, or start:stop:step, e.g. 0:300:2.")
    ] = None,
    grid_step: Annotated[
        float | None, typer.Option("--grid-step", help="Distance of neighbouring points in pixels.")
    ] = None,
    preview: Annotated[
        Path | None, typer.Option("--preview", help="Picture to write: the tracks over some frames (JPEG or PNG).")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Track the surface that a film shows. Needs OpenCV, which the extra `film` installs."""
    one_numerical_thread()
    input_file(region, "--region")
    others = [film, region]
    for path, name, suffixes in ((output, "--output", (".npz",)), (preview, "--preview", (".jpg", ".jpeg", ".png"))):
        output_file(path, name, force=force, suffixes=suffixes, others=others)
        others.append(path)
    _preview_outside(film, preview)
    require_opencv("pliant track")
    from pliant.tracking import track_film

    shown = 0
    with _bars() as (on_step, screen):

        def on_warnings(warnings: list[str]) -> None:
            nonlocal shown
            if not as_json:
                show_warnings(warnings[shown:], screen)
                shown = len(warnings)

        tracked = track_film(
            film, region=region, region_frame=region_frame, template_frame=template_frame, frames=frames,
            grid_step=grid_step, on_step=on_step, on_warnings=on_warnings,
        )  # fmt: skip
    with write_aside(output) as aside:
        tracked.save_npz(aside)
    if preview is not None:
        with write_aside(preview) as aside:
            aside.write_bytes(tracked.contact_sheet(png=preview.suffix.lower() == ".png"))
    if as_json:
        _print_json(tracked, output, preview)
        return
    show_warnings(tracked.warnings[shown:])
    count, points = tracked.visibility.shape
    seen = f"visible in {tracked.visibility.mean():.0%}"
    out().print(f"{output}: {points} points in {count} frames, {seen}.")
    if preview is not None:
        out().print(f"{preview}: the tracks over {len(tracked.thumbnails)} of the frames.")


def _preview_outside(film: Path, preview: Path | None) -> None:
    """Check that the preview does not become a frame of a film that is a folder of pictures.

    Raises
    ------
    BadArgument
        It would be written into that folder.
    """
    from pliant.client.errors import BadArgument

    if preview is not None and film.is_dir() and preview.parent.resolve() == film.resolve():
        raise BadArgument(
            f"--preview: expected a file outside the film's folder, got {preview}, which would be a frame. Choose another folder."
        )


@contextmanager
def _bars() -> Iterator[tuple[OnStep, Console]]:
    """Show one bar for each stage on a terminal, print a line every `LINE_EVERY` seconds elsewhere.

    The console prints above the bars.
    """
    from contextlib import nullcontext

    from pliant.client.progress import printed_lines
    from rich.progress import Progress, TaskID

    screen, latest = err(), "waiting"
    lines = nullcontext() if screen.is_terminal else printed_lines(lambda: latest, screen, seconds=LINE_EVERY)
    with Progress(console=screen, disable=not screen.is_terminal) as progress, lines:
        tasks: dict[str, TaskID] = {}

        def on_step(step: TrackingStep) -> None:
            nonlocal latest
            latest = f"{step.stage} " + (f"{step.done / step.total:.0%}" if step.total else f"{step.done} frames")
            if step.stage not in tasks:
                tasks[step.stage] = progress.add_task(step.stage, total=step.total)
            progress.update(tasks[step.stage], completed=step.done, total=step.total)

        yield on_step, screen


def _print_json(tracked: TrackedFilm, output: Path, preview: Path | None) -> None:
    count, points = tracked.visibility.shape
    print_json(
        {
            "file": str(output), "preview": None if preview is None else str(preview), "frames": count, "points": points,
            "visible": float(tracked.visibility.mean()), "template_frame": int(tracked.film.frame_indices[tracked.template]),
            "warnings": list(tracked.warnings),
        }
    )  # fmt: skip
