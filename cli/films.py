"""`pliant solve` for films: a separate process decodes the film, and this process solves it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pliant.cli.session import LINE_EVERY
from pliant.cli.show import err, in_gigabytes, out, show_warnings

if TYPE_CHECKING:
    from pliant.schemas.job import Estimate
    from pliant.schemas.options import Options
    from pliant.worker.films.tracker import FilmFacts
    from pliant.worker.jobs.finished import Finished

SHEET_TEST = (
    "The test for a sheet such as paper can take half a minute more; for a face or a body, -O surface=free omits it."
)
"""What the time estimate does not count, because only the tracks show whether the test is needed."""


def is_film(path: Path, region: Path | None) -> bool:
    """Return True if a command's input is a film, by its content and name or because a region was given."""
    from pliant.worker.films.sources import looks_like_film

    return region is not None or looks_like_film(path)


@contextmanager
def as_one_file(path: Path) -> Iterator[Path]:
    """Yield the file to send to a service: a folder of pictures is packed into a temporary zip."""
    from pliant.client.input_files import film_file

    with tempfile.TemporaryDirectory(prefix="pliant-pictures-") as scratch:
        yield film_file(path, Path(scratch)) if path.is_dir() else path


def refuse_parts_of_tracks(**parts: object) -> None:
    """Refuse inputs that are only valid with tracks, because a film was given.

    Raises
    ------
    BadArgument
        At least one of them was given.
    """
    from pliant.client.errors import BadArgument

    given = [f"--{name.replace('_', '-')}" for name, part in parts.items() if part is not None]
    if given:
        raise BadArgument(
            f"{', '.join(given)}: expected tracks, got a film. Leave it out: the mesh of a film is made from it; "
            "to use other inputs, run `pliant track` and solve its tracks.npz."
        )


def inspect_film(film: Path, *, region: Path | None, options: dict[str, Any], as_json: bool) -> None:
    """Print a film's properties, and estimates of its tracked points, and of the time and memory that it needs.

    Raises
    ------
    InvalidInput
        The film, the region or an option cannot be used.
    """
    from pliant.cli.show import dump_interpretation, print_json
    from pliant.client.multipart import checked_options
    from pliant.worker.films.sources import FilmSource
    from pliant.worker.films.tracker import read_film, with_estimate
    from pliant.worker.settings import usable_cores

    checked = checked_options(options)
    source = FilmSource(film, region)
    read = with_estimate(read_film(source, checked), source, threads=usable_cores())
    facts, warnings = read.facts, warnings_of_check(read.facts, region, checked)
    if as_json:
        film_itself = facts.model_dump(mode="json", exclude={"first_frame"})
        print_json({**dump_interpretation(read.interpretation), "film": film_itself, "warnings": warnings})
        return
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for name, words in film_rows(facts, checked, read.interpretation.estimate):
        table.add_row(Text(name, "dim"), Text(words))
    for note in read.interpretation.notes[1:]:  # the first one repeats the table
        table.add_row(Text("note", "dim"), Text(note))
    out().print(table)
    show_warnings(warnings)


def warnings_of_check(facts: FilmFacts, region: Path | None, options: Options) -> list[str]:
    """Return the tracker's warnings that are known from a film's check."""
    from pliant.tracking.advice import warnings_unread

    whole = region is None and options.region_polygon is None
    return warnings_unread(whole=whole, region_frame=options.region_frame, frames=facts.frames)


def film_rows(facts: FilmFacts, options: Options, estimate: Estimate | None) -> list[tuple[str, str]]:
    """Return a film's properties, and what tracking and reconstruction will need, as pairs of label and text."""
    from pliant.worker.films.tracker import notes_on_rate

    of_all = f" of {facts.stated_frames}" if facts.frames != facts.stated_frames else ""
    source = " by the file"
    if "fps" not in options.model_fields_set:
        # The times of all frames, which may be uneven, are known only once they are decoded.
        pictures = notes_on_rate(facts.container)
        source = (
            ", assumed: pictures state none" if pictures else f"{source}; the result has that of its tracked frames"
        )
    rows = [
        ("film", facts.container),
        ("size", f"{facts.width}×{facts.height} pixels"),
        ("frames", f"{facts.frames}{of_all}" if facts.frames else "not stated"),
        ("rate", f"{facts.fps:.4g} frames per second{source}"),
        ("duration", f"{facts.seconds:.1f} s" if facts.seconds else "not stated"),
        ("rotation", f"{facts.rotation}°, applied" if facts.rotation else "none"),
    ]
    if facts.pixel_aspect != 1:
        rows.append(
            ("pixels", f"{facts.pixel_aspect:.4g} times as wide as high; frames are stretched to the size above")
        )
    rows.append(("points", f"about {facts.points}" if facts.points else "none"))  # a note gives the reason
    if estimate is not None:
        tracking, solving = facts.track_seconds, estimate.seconds
        parts = f"tracking {tracking:,.0f} s, reconstruction {solving:,.0f} s on one core"
        rows += [("time", f"about {tracking + solving:,.0f} s: {parts}"), ("memory", f"about {in_gigabytes(estimate)}")]
        if options.surface == "auto":
            rows.append(("note", SHEET_TEST))
    return rows


def solve_film(
    film: Path, output: Path, *, region: Path | None, options: dict[str, Any], name: str, threads: int | None, as_json: bool
) -> Finished:  # fmt: skip
    """Track and reconstruct a film; also write `tracks.npz` and `contact_sheet.jpg`.

    Warnings about the film are printed as soon as they are known and left out of the returned ones, so that none is printed twice.

    Raises
    ------
    InvalidInput
        The film, the region or an option cannot be used.
    """
    from pliant.client.multipart import checked_options
    from pliant.client.progress import progress_bar
    from pliant.solver import threads_limited
    from pliant.worker.execution.film import reconstruct_film
    from pliant.worker.films.sources import FilmSource
    from pliant.worker.films.tracker import read_film
    from pliant.worker.settings import usable_cores

    checked = checked_options(options)
    source = FilmSource(film, region, own_rate="fps" in checked.model_fields_set)
    read = read_film(source, checked)
    printed: list[str] = []

    def on_warnings(warnings: Sequence[str]) -> None:
        if not as_json:
            new = [each for each in warnings if each not in printed]
            show_warnings(new, screen)
            printed.extend(new)

    screen = err()
    if not as_json:
        for note in read.interpretation.notes:
            out().print(note)
    on_warnings(warnings_of_check(read.facts, region, read.options))
    with (
        tempfile.TemporaryDirectory(prefix="pliant-film-") as scratch,
        progress_bar(screen, line_every=LINE_EVERY) as bar,
        threads_limited(threads),
    ):
        done = reconstruct_film(
            source, read.options, output, scratch=Path(scratch), name=name, threads=threads or usable_cores(),
            on_progress=bar.on_step, on_warnings=on_warnings,
        )  # fmt: skip
    return replace(done, warnings=tuple(each for each in done.warnings if each not in printed))
