"""A ready-made progress bar for scripts and the command line; needs rich."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pliant.schemas.job import Job, Progress, Status

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress


class Bar:
    """Shows what happens to one job; its methods are what `submit`, `wait` and `download` take as callbacks."""

    def __init__(self, bars: RichProgress) -> None:
        self._bars = bars
        self._task = bars.add_task("", total=1.0, note="")

    def on_upload(self, done: int, total: int) -> None:
        """Show bytes that are sent."""
        self._show("sending", done / max(total, 1), f"{done / 1e6:.1f} of {total / 1e6:.1f} MB")

    def on_download(self, done: int, total: int) -> None:
        """Show bytes that arrive."""
        self._show("fetching", done / max(total, 1), f"{done / 1e6:.1f} of {total / 1e6:.1f} MB")

    def on_progress(self, job: Job) -> None:
        """Show where a job stands."""
        if job.status is Status.QUEUED:
            ahead = job.place_in_queue
            note = "" if ahead is None else "next" if ahead == 0 else f"{ahead} ahead"
            self._show("queued", 0.0, note)
        elif job.progress is not None and not job.status.final:
            self.on_step(job.progress)
        else:
            self._show(job.status, 1.0 if job.status.final else 0.0, "")

    def on_step(self, progress: Progress) -> None:
        """Show what the solver does."""
        self._show(progress.stage, progress.fraction, describe(progress))

    def _show(self, stage: str, fraction: float, note: str) -> None:
        self._bars.update(self._task, description=stage, completed=fraction, note=note)


def describe(progress: Progress) -> str:
    """Say in a few words how far a job is."""
    said = []
    if progress.reweighting > 0:
        said.append(f"reweighting {progress.reweighting} of at most {progress.max_reweightings}")
    if progress.residual is not None:
        said.append(f"residual {progress.residual:.3g}")
    if progress.seconds_left is not None:
        said.append(f"{progress.seconds_left:.0f} s left")
    return ", ".join(said)


@contextmanager
def progress_bar(console: Console | None = None) -> Iterator[Bar]:
    """Show a bar on a terminal, on standard error unless told; nothing where there is no terminal.

    Examples
    --------
    ``with progress_bar() as bar: client.submit(points, on_upload=bar.on_upload).wait(on_progress=bar.on_progress)``
    """
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    screen = console if console is not None else RichConsole(stderr=True)
    columns = (
        TextColumn("{task.description:<10}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[note]}"),
    )
    with Bars(*columns, console=screen, disable=not screen.is_terminal) as bars:
        yield Bar(bars)
