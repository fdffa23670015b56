"""`pliant solve` and `pliant inspect`: files in, files out, in this process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pliant.cli.films import SHEET_TEST, inspect_film, is_film, refuse_parts_of_tracks, solve_film
from pliant.cli.paths import check_inputs, results_folder
from pliant.cli.session import (
    LINE_EVERY,
    Force,
    GroundTruth,
    Json,
    Mesh,
    Name,
    OptionPairs,
    Region,
    Rotations,
    Tracks,
    name_of,
    one_numerical_thread,
    parse_options,
)
from pliant.cli.show import (
    describe_inputs,
    dump_interpretation,
    metrics_table,
    out,
    print_json,
    show_warnings,
    verdict_lines,
)

if TYPE_CHECKING:
    from pliant.schemas.job import Interpretation
    from pliant.schemas.options import Options
    from pliant.worker.jobs.finished import Finished

Threads = Annotated[int | None, typer.Option("--threads", help="Threads to use; all cores if not given.", min=1)]


def solve(
    tracks: Tracks,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the files.", show_default=False)],
    mesh: Mesh = None,
    ground_truth: GroundTruth = None,
    rotations: Rotations = None,
    region: Region = None,
    option: OptionPairs = None,
    name: Name = "",
    threads: Threads = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Reconstruct tracks or a film in this process, without a service. It writes the same files as a job."""
    one_numerical_thread()  # the first check of a path imports NumPy
    check_inputs(tracks, mesh=mesh, ground_truth=ground_truth, rotations=rotations, region=region)
    options, name, film = parse_options(option), name_of(name, tracks), is_film(tracks, region)
    with results_folder(output, force=force, files=() if force else files_of(options, film=film)):
        if film:
            refuse_parts_of_tracks(mesh=mesh, ground_truth=ground_truth, rotations=rotations)
            done = solve_film(
                tracks, output, region=region, options=options, name=name, threads=threads, as_json=as_json
            )
        else:
            parts = {"tracks": tracks, "mesh": file_or_word(mesh), "ground_truth": ground_truth, "rotations": rotations}
            done = solve_tracks(parts, output, options=options, name=name, threads=threads, as_json=as_json)
    show_finished(replace(done, warnings=(*done.warnings, *warnings_of_others(output, done))), output, as_json=as_json)


def warnings_of_others(output: Path, done: Finished) -> list[str]:
    """Return a warning if a folder also contains files of another result, which this one does not replace."""
    from pliant.worker.artifacts.kinds import KINDS
    from pliant.worker.execution.film import FILES

    written = {artifact.name for artifact in done.artifacts} | {"tracks.npz"}  # which may be the input
    names = [*(kind.name for kind in KINDS), *FILES]
    others = [name for name in names if name not in written and (output / name).exists()]
    return [f"{output} also contains {', '.join(others)}, not written by this command."] if others else []


def files_of(options: dict[str, Any], *, film: bool) -> list[str]:
    """Return the names of the files that a result with these options may contain.

    Raises
    ------
    BadArgument
        An option is unknown or invalid.
    """
    from pliant.client.multipart import checked_options
    from pliant.worker.artifacts.kinds import KINDS
    from pliant.worker.execution.film import FILES

    outputs = checked_options(options).outputs
    own = [kind.name for kind in KINDS if kind.output is None or kind.output in outputs]
    return [*own, "report.json", *(FILES if film else ())]


def solve_tracks(
    parts: dict[str, Any], output: Path, *, options: dict[str, Any], name: str, threads: int | None, as_json: bool
) -> Finished:
    """Read and reconstruct tracks; `parts` are the inputs by their names in `read_inputs`.

    Raises
    ------
    InvalidInput
        An input or an option cannot be used.
    """
    from pliant.client.multipart import checked_options
    from pliant.client.progress import progress_bar
    from pliant.solver import threads_limited
    from pliant.worker.execution.pipeline import reconstruct
    from pliant.worker.formats import read_inputs
    from pliant.worker.formats.tracks.film_tracks import tracks_options

    checked = checked_options(options)
    inputs = read_inputs(**parts, options=checked)
    checked = tracks_options(checked, inputs.interpretation)
    if not as_json:
        show_inputs(inputs.interpretation)
    with progress_bar(line_every=LINE_EVERY) as bar, threads_limited(threads):
        return reconstruct(inputs, checked, output, name=name, on_progress=bar.on_step)


def inspect(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(help="Track file, or a film.", show_default=False, readable=False)],
    mesh: Mesh = None,
    ground_truth: GroundTruth = None,
    rotations: Rotations = None,
    region: Region = None,
    option: OptionPairs = None,
    url: Annotated[
        str, typer.Option("--url", help="Use this service instead of this installation.", metavar="URL")
    ] = "",
    as_json: Json = False,
) -> None:
    """Show how a track file is interpreted, or a film's properties, with estimates of time and memory, without solving."""
    check_inputs(file, mesh=mesh, ground_truth=ground_truth, rotations=rotations, region=region)
    options = parse_options(option)
    if url == "" and is_film(file, region):
        refuse_parts_of_tracks(mesh=mesh, ground_truth=ground_truth, rotations=rotations)
        inspect_film(file, region=region, options=options, as_json=as_json)
        return
    from pliant.client.multipart import checked_options

    checked = checked_options(options)
    if url == "":
        from pliant.worker.formats import read_inputs

        faces = file_or_word(mesh)
        interpretation = read_inputs(
            tracks=file, mesh=faces, ground_truth=ground_truth, rotations=rotations, options=checked
        ).interpretation
    else:
        with ctx.obj.client(url) as client:
            interpretation = client.inspect(
                **{"film" if is_film(file, region) else "tracks": file}, region=region, mesh=mesh,
                ground_truth=ground_truth, rotations=rotations, options=options,
            )  # fmt: skip
    if as_json:
        print_json(dump_interpretation(interpretation))
    else:
        show_inputs(interpretation, *([("note", SHEET_TEST)] if tests_for_sheet(interpretation, checked) else []))


def show_finished(done: Finished, output: Path, *, as_json: bool) -> None:
    """Print the outcome of a reconstruction and the paths of its files."""
    if as_json:
        print_json(
            {
                "verdict": done.verdict, "verdict_reasons": list(done.verdict_reasons), "trust_sentence": done.trust_sentence,
                "camera_sentence": done.camera_sentence,
                "outcome": done.outcome, "sentence": done.sentence, "metrics": done.metrics, "warnings": list(done.warnings),
                "files": {artifact.name: str(output / artifact.name) for artifact in done.artifacts},
            }
        )  # fmt: skip
        return
    from rich.text import Text

    screen = out()
    show_warnings(done.warnings)
    screen.print(metrics_table(done.metrics))
    for artifact in done.artifacts:
        screen.print(f"{output / artifact.name}  {artifact.bytes / 1e6:.2f} MB")
    if done.camera_sentence is not None:
        screen.print(done.camera_sentence)
    for line in verdict_lines(done) or [Text(done.sentence)]:
        screen.print(line)


def file_or_word(mesh: str | None) -> Path | str | None:
    """Return the path of a mesh file, or the text unchanged if it is a grid size or `none`."""
    return Path(mesh) if mesh is not None and Path(mesh).is_file() else mesh


def tests_for_sheet(interpretation: Interpretation, options: Options) -> bool:
    """Return whether tracks are tested for a sheet before they are solved as a free surface."""
    from pliant.solver.reconstruction.surface import tries_isometry
    from pliant.worker.formats.solver_settings import solver_settings
    from pliant.worker.formats.tracks.film_tracks import tracks_options

    if interpretation.num_points == 0 or interpretation.has_rotations or options.surface != "auto":
        return False
    return tries_isometry(None, solver_settings(tracks_options(options, interpretation)))


def show_inputs(interpretation: Interpretation, *further: tuple[str, str]) -> None:
    """Print the interpretation of the inputs, and further pairs of label and text."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for name, words in [*describe_inputs(interpretation), *further]:
        table.add_row(Text(name, "dim"), Text(words))
    out().print(table)
