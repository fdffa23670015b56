"""`pliant submit` of several files: a job each, found again when the command is repeated, and a table of how they ended."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pliant.cli.exits import Exit
from pliant.cli.films import is_film
from pliant.cli.paths import different_files, made_folder, output_folder
from pliant.cli.session import LINE_EVERY, Session, name_of
from pliant.cli.show import COLOURS, VERDICTS, details_of, err, explained_at, out, print_json

if TYPE_CHECKING:
    from pliant.client import Client, RemoteJob
    from pliant.client.progress import Bar
    from pliant.schemas.job import Job
    from rich.text import Text

ENDINGS = frozenset({".npz", ".npy", ".mat", ".h5", ".hdf5", ".csv", ".txt"})
"""Names that are taken for track files in a folder."""


def expanded(given: list[Path], region: Path | None) -> list[Path]:
    """Return the files that folders and patterns stand for, in the order of their names; a folder of pictures is a film.

    Raises
    ------
    BadArgument
        A folder has no track file; a pattern finds nothing or has two asterisks in a row.
    """
    from pliant.client.errors import BadArgument

    found: list[Path] = []
    for path in given:
        inside = track_files(path)
        if inside:
            found += inside
        elif path.is_dir() and region is None and not any(path.iterdir()):
            raise BadArgument(
                f"{path}: expected track files ({', '.join(sorted(ENDINGS))}), got an empty folder. Name the files."
            )
        elif not path.exists() and any(sign in path.name for sign in "*?["):
            if "**" in path.name:  # Python before 3.13 raises ValueError, later ones take it for one asterisk
                raise BadArgument(
                    f"{path}: expected a pattern of one folder's files, got **. Write a single * for any characters."
                )
            matching = sorted(path.parent.glob(path.name))
            if not matching:
                raise BadArgument(f"{path}: expected files that match, got none. Check the pattern and its quotes.")
            found += matching
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def track_files(folder: Path) -> list[Path]:
    """Return the track files of a folder by name, none if it is no folder or has pictures of a film instead."""
    if not folder.is_dir():
        return []
    return sorted(each for each in folder.iterdir() if each.suffix.lower() in ENDINGS and each.is_file())


def judged(job: Job | None) -> Text:
    """Return a job's verdict in words, with the first of its reasons; nothing where it was not judged."""
    from rich.text import Text

    if job is None or job.verdict is None:
        return Text()
    words, colour = VERDICTS.get(job.verdict, (job.verdict, "yellow"))
    return Text.assemble((words, colour), *(f"\n{reason}" for reason in job.verdict_reasons[:1]))


@dataclass(slots=True)
class Row:
    """A file, and what became of it."""

    file: Path
    job: Job | None = None
    error: Exception | None = None


@dataclass(slots=True, kw_only=True)
class Batch:
    """Several files with the same options."""

    files: list[Path]
    shared: dict[str, Any]
    """Further parameters of `Client.submit`."""
    options: dict[str, Any]
    key: str
    """Distinguishes the batch from others of the same files."""
    priority: str
    timeout: float | None
    output: Path | None
    force: bool
    """Whether files of other content in the output folders are replaced; else they refuse the download."""
    wait: bool
    url: str
    """Address of the service."""
    session: Session
    """Its `following` and `others` name the jobs that continue after Ctrl-C."""
    rows: list[Row] = field(default_factory=list)

    def check(self, *, name: str, job_id: str | None, region: Path | None) -> None:
        """Refuse options that belong to a single job, and make the output folders.

        Raises
        ------
        BadArgument
            One was given, two files have the same name, or a folder cannot be written.
        """
        from pliant.client.errors import BadArgument
        from pliant.client.multipart import existing_file

        given = [word for word, value in (("--name", name), ("--id", job_id), ("--region", region)) if value]
        if given:
            raise BadArgument(
                f"{', '.join(given)}: expected one file, got {len(self.files)}. Leave it out, or submit them singly."
            )
        for file in self.files:
            existing_file(file, "tracks")
        if self.output is None:
            return
        names = [file.stem for file in self.files]
        twice = next((each for each in names if names.count(each) > 1), None)
        if twice is not None:
            raise BadArgument(
                f"--output: several files are named {twice}, and would share a folder. Submit them separately."
            )
        for each in names:
            made_folder(self.output / each, "--output")

    def run(self, client: Client) -> None:
        """Submit all, and wait for them if that is wanted. What fails has a row of its own and stops nothing."""
        from pliant.client.progress import progress_bar

        with progress_bar(line_every=LINE_EVERY) as bar:
            submitted = self._submit(client, bar)
            for index, (row, job) in enumerate(submitted if self.wait else ()):
                self.session.following, self.session.others = job.id, len(submitted) - index - 1
                bar.label = str(row.file)
                self._follow(row, job, bar)
                row.job = client.get(job.id).record
                err().print(f"{row.file}: {row.job.status}", highlight=False, markup=False)

    def _submit(self, client: Client, bar: Bar) -> list[tuple[Row, RemoteJob]]:
        """Submit each file and print the id of its job at once, so that an interruption loses none.

        Raises
        ------
        NotAuthorized
            The token is missing or lacks a scope: every other file would be refused, too.
        """
        from pliant.client.errors import APIStatusError, NotAuthorized

        submitted: list[tuple[Row, RemoteJob]] = []
        secret = os.environ.get("PLIANT_WEBHOOK_SECRET") if self.shared.get("webhook") else None
        common = self._common(secret)
        for file in self.files:
            row = Row(file)
            self.rows.append(row)
            bar.label = str(file)
            try:
                film = is_film(file, None)
                job = client.submit(
                    None if film else file, film=file if film else None, name=name_of("", file), options=self.options,
                    idempotency_key=self._key_of(file, common), priority=self.priority, timeout=self.timeout,  # type: ignore[arg-type]
                    webhook_secret=secret, on_upload=bar.on_upload, **self.shared,
                )  # fmt: skip
            except NotAuthorized:
                raise
            except APIStatusError as error:
                row.error = error
                continue
            row.job = job.record
            self.session.following, self.session.others = job.id, len(submitted)
            submitted.append((row, job))
            err().print(f"{file}: job {job.id}", highlight=False, markup=False)
        return submitted

    def _follow(self, row: Row, job: RemoteJob, bar: Bar) -> None:
        """Wait for a job, and download its files if that is wanted."""
        from pliant.client.errors import PliantError

        try:
            done = job.wait(on_progress=bar.on_progress, load=False, timeout=self.timeout)
            if self.output is not None:
                folder = self.output / row.file.stem
                output_folder(folder, force=self.force, files=different_files(done.job, folder))
                done.download(folder, on_download=bar.on_download, timeout=self.timeout)
        except PliantError as error:
            row.error = error

    @property
    def exit_code(self) -> Exit:
        """How the command ends: well only if every file went well."""
        return Exit.FAILED if any(row.error is not None for row in self.rows) else Exit.DONE

    def show(self, *, as_json: bool) -> None:
        """Print the table."""
        if as_json:
            print_json([{"file": str(row.file), **self._outcome(row)} for row in self.rows])
            return
        from rich.table import Column, Table
        from rich.text import Text

        longest = max((len(row.job.id) for row in self.rows if row.job is not None), default=0)
        job_column = Column("job", no_wrap=True, min_width=longest)  # ids are for copying, also from narrow terminals
        table = Table("file", job_column, "status", "verdict", "seconds", "")
        for row in self.rows:
            job = row.job
            status = "refused" if job is None else str(job.status)
            took = (
                None
                if job is None or job.started_at is None or job.finished_at is None
                else job.finished_at - job.started_at
            )
            table.add_row(
                Text(str(row.file)), "" if job is None else job.id, Text(status, COLOURS.get(status, "red")),
                judged(job), "" if took is None else f"{took.total_seconds():.1f}",
                Text("" if row.error is None else self._refusal(row.error)),
            )  # fmt: skip
        out().print(table)

    def _refusal(self, error: Exception) -> str:
        """Return the message of an error, and where it is explained."""
        more = explained_at(details_of(error), self.url)
        return str(error) if more is None else f"{error} More about this error: {more}"

    def _outcome(self, row: Row) -> dict[str, Any]:
        """Return what became of a file, as JSON."""
        return {
            "job": None if row.job is None else row.job.model_dump(mode="json"),
            "error": None if row.error is None else str(row.error),
            "explained_at": None if row.error is None else explained_at(details_of(row.error), self.url),
        }

    def _common(self, secret: str | None) -> str:
        """Return what the requests of all files have in common: mesh, truth and rotations by content, the secret by its digest."""
        from pliant.client.multipart import sha256

        parts = {name: None if part is None else str(part) for name, part in self.shared.items()}
        for name in ("mesh", "ground_truth", "rotations"):
            path = self.shared.get(name)
            if path is not None and Path(path).is_file():
                parts[name] = sha256(Path(path))
        digest = None if secret is None else hashlib.sha256(secret.encode()).hexdigest()
        return json.dumps([self.key, self.options, self.priority, parts, digest], sort_keys=True)

    def _key_of(self, file: Path, common: str) -> str:
        """Return the idempotency key of a file: of its content, its name, and all that goes with it."""
        from pliant.client.multipart import sha256

        content = sha256(file) if file.is_file() else str(file.absolute())
        name = name_of("", file)
        return f"batch/{hashlib.sha256(f'{content} {name} {common}'.encode()).hexdigest()}"
