"""A ready-made progress display for scripts and the command line; needs rich."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pliant.schemas.job import Job, Progress, Status

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress


class Bar:
    """The display of one job; its methods are callbacks for `submit`, `wait` and `download`."""

    def __init__(self, bars: RichProgress) -> None:
        self._bars = bars
        self._task = bars.add_task("", total=1.0, note="")
        self.label = ""
        """Text shown next to the progress, for example the name of the file."""
        self.latest = ""
        """The display as one line of text."""

    def on_upload(self, done: int, total: int) -> None:
        """Show an upload."""
        self._show("sending", done / max(total, 1), f"{done / 1e6:.1f} of {total / 1e6:.1f} MB")

    def on_download(self, done: int, total: int) -> None:
        """Show a download."""
        self._show("fetching", done / max(total, 1), f"{done / 1e6:.1f} of {total / 1e6:.1f} MB")

    def on_progress(self, job: Job) -> None:
        """Show the status and progress of a job."""
        if job.status is Status.QUEUED:
            ahead = job.place_in_queue
            note = "" if ahead is None else "next" if ahead == 0 else f"{ahead} ahead"
            self._show("queued", 0.0, note)
        elif job.progress is not None and not job.status.final:
            self.on_step(job.progress)
        else:
            self._show(job.status, 1.0 if job.status.final else 0.0, "")

    def on_step(self, progress: Progress) -> None:
        """Show the progress of the solver."""
        self._show(progress.stage, progress.fraction, describe(progress))

    def _show(self, stage: str, fraction: float, note: str) -> None:
        note = ", ".join(each for each in (self.label, note) if each)
        self.latest = f"{stage} {fraction:.0%}" + (f", {note}" if note else "")
        self._bars.update(self._task, description=stage, completed=fraction, note=note)


def describe(progress: Progress) -> str:
    """Summarise progress in a few words."""
    words = []
    if progress.reweighting > 0:
        words.append(f"reweighting {progress.reweighting}")
    if progress.residual is not None:
        words.append(f"residual {progress.residual:.3g}")
    if progress.seconds_left is not None:
        words.append(f"{math.ceil(progress.seconds_left)} s left")  # rounded up: 0 is shown at the end only
    return ", ".join(words)


@contextmanager
def progress_bar(console: Console | None = None, *, line_every: float | None = None) -> Iterator[Bar]:
    """Show a progress bar on a terminal.

    Parameters
    ----------
    console : rich.console.Console, optional
        Defaults to standard error.
    line_every : float, optional
        Seconds between printed lines if there is no terminal; by default nothing is printed.

    Yields
    ------
    Bar
        The display; its methods are callbacks.

    Examples
    --------
    ``with progress_bar() as bar: client.submit(points, on_upload=bar.on_upload).wait(on_progress=bar.on_progress)``
    """
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    screen = console if console is not None else RichConsole(stderr=True)
    columns = (
        TextColumn("{task.description:<10}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", style="dim", markup=False),  # a file's name may contain brackets
    )
    with Bars(*columns, console=screen, disable=not screen.is_terminal) as bars:
        bar = Bar(bars)
        if screen.is_terminal or line_every is None:
            yield bar
            return
        with printed_lines(lambda: bar.latest or "waiting", screen, seconds=line_every):
            yield bar


@contextmanager
def printed_lines(latest: Callable[[], str], screen: Console, *, seconds: float) -> Iterator[None]:
    """Print a line with the elapsed time and the latest state every `seconds`.

    A thread prints it, because callbacks may be further apart.
    """
    finished, began = threading.Event(), time.monotonic()

    def print_lines() -> None:
        while not finished.wait(seconds):
            elapsed = time.monotonic() - began
            screen.print(f"{elapsed:.0f} s: {latest()}", markup=False, highlight=False, soft_wrap=True)

    thread = threading.Thread(target=print_lines, name="pliant-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
