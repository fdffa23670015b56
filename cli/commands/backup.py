"""`pliant backup` and `pliant restore`: a copy of an installation, made while it runs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pliant.cli.extras import require_server
from pliant.cli.paths import installation
from pliant.cli.session import Json
from pliant.cli.show import err, print_json
from pliant.cli.up import Data, read_settings

if TYPE_CHECKING:
    from pliant.worker.maintenance.backup import Summary


def backup(
    target: Annotated[
        Path, typer.Argument(help="Directory of the backup; an earlier one there is updated.", show_default=False)
    ],
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Copy all jobs, files and tokens of an installation, which may be running, into a directory."""
    require_server("pliant backup")
    from pliant.worker.maintenance.backup import write_backup
    from pliant.worker.processes.valkey import attended

    settings = read_settings(data, None)
    installation(settings)
    with attended(settings):
        try:
            summary = write_backup(settings, target)
        except OSError as fault:
            if fault.filename is None:  # as of a full disk, which may be that of the installation or of the backup
                fault.filename = str(target)
            raise
    _show("Backed up", summary, target, as_json=as_json)


def restore(
    source: Annotated[Path, typer.Argument(help="Directory that `pliant backup` wrote.", show_default=False)],
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Restore a backup into an installation without jobs and tokens; jobs that had not ended are queued again."""
    require_server("pliant restore")
    from pliant.worker.maintenance.backup import read_manifest, restore_backup
    from pliant.worker.processes.valkey import attended

    read_manifest(source)  # before a new installation is created for it
    settings = read_settings(data, None)
    with attended(settings):
        summary = restore_backup(settings, source)
    _show("Restored", summary, source, as_json=as_json)


def _show(verb: str, summary: Summary, folder: Path, *, as_json: bool) -> None:
    if as_json:
        print_json({**asdict(summary), "folder": str(folder)})
        return
    size = f"{summary.bytes / 1e6:,.1f} MB"
    err().print(f"{verb} {summary.jobs} jobs with {summary.blobs} files ({size}, {summary.copied} copied): {folder}")
