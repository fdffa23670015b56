"""`pliant submit` with several files: one job per file, found again if the command is repeated, and a table of outcomes."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pliant.cli.exits import Exit
from pliant.cli.films import as_one_file, is_film
from pliant.cli.paths import different_files, make_folder, output_folder, tracks_or_film
from pliant.cli.session import LINE_EVERY, Session, name_of
from pliant.cli.show import COLOURS, details_of, err, find_explanation, out, print_json, verdict_words
from pliant.schemas.pictures import pictures_in

if TYPE_CHECKING:
    from pliant.client import Client, RemoteJob
    from pliant.client.progress import Bar
    from pliant.schemas.job import Job
    from rich.text import Text

ENDINGS = frozenset({".npz", ".npy", ".mat", ".h5", ".hdf5", ".csv", ".txt"})
"""Extensions of track files in a folder."""


def expand(given: list[Path], region: Path | None) -> list[Path]:
    """Replace each folder of track files and each pattern by its files, sorted by name; a folder of pictures is a film.

    Raises
    ------
    BadArgument
        A folder is empty and there is no region, or contains both track files and pictures; a pattern matches nothing or contains ``**``.
    """
    from pliant.client.errors import BadArgument

    found: list[Path] = []
    for path in given:
        inside = [] if region is not None else track_files(path)
        if inside and (pictures := pictures_in(path)):
            raise BadArgument(
                f"{path}: expected track files or the pictures of a film, got a folder with both "
                f"({inside[0].name}, {pictures[0].name}). Name the track files, or move them to a folder of their own."
            )
        if inside:
            found += inside
        elif path.is_dir() and region is None and not any(path.iterdir()):
            raise BadArgument(
                f"{path}: expected track files ({', '.join(sorted(ENDINGS))}), got an empty folder. Name the files."
            )
        elif not path.exists() and any(sign in path.name for sign in "*?["):
            if "**" in path.name:  # Python before 3.13 raises ValueError, later versions treat it as one asterisk
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
    """Return the track files of a folder, sorted by name; empty if it has none or is not a folder."""
    if not folder.is_dir():
        return []
    return sorted(each for each in folder.iterdir() if each.suffix.lower() in ENDINGS and each.is_file())


def describe_verdict(job: Job | None) -> Text:
    """Return a job's verdict with its first reason; empty if it has no verdict."""
    from rich.text import Text

    if job is None or job.verdict is None:
        return Text()
    return Text.assemble(verdict_words(job), *(f"\n{reason}" for reason in job.verdict_reasons[:1]))


@dataclass(slots=True)
class Row:
    """A file and the outcome of its job."""

    file: Path
    job: Job | None = None
    error: Exception | None = None


@dataclass(slots=True, kw_only=True)
class Batch:
    """Several files that are submitted with the same options."""

    files: list[Path]
    shared: dict[str, Any]
    """Further parameters of `Client.submit`."""
    options: dict[str, Any]
    key: str
    """Distinguishes the batch from others with the same files."""
    priority: str
    timeout: float | None
    output: Path | None
    force: bool
    """Whether to replace files with different content in the output folders; otherwise they prevent the download."""
    wait: bool
    url: str
    """Address of the service."""
    session: Session
    """Its `following` and `others` name the jobs that continue after Ctrl-C."""
    rows: list[Row] = field(default_factory=list)

    def check(self, *, name: str, job_id: str | None, region: Path | None) -> None:
        """Refuse options that are only valid for a single job, and create the output folder.

        Raises
        ------
        BadArgument
            Such an option was given, a file cannot be read, two files have the same name, or a folder is not writable.
        """
        from pliant.client.errors import BadArgument

        given = [word for word, value in (("--name", name), ("--id", job_id), ("--region", region)) if value]
        if given:
            raise BadArgument(
                f"{', '.join(given)}: expected one file, got {len(self.files)}. Leave it out, or submit the files separately."
            )
        for file in self.files:
            tracks_or_film(file)
        if self.output is None:
            return
        names = [file.stem for file in self.files]
        twice = next((each for each in names if names.count(each) > 1), None)
        if twice is not None:
            raise BadArgument(
                f"--output: several files are named {twice}, and would share a folder. Submit them separately."
            )
        make_folder(self.output, "--output")
        for each in names:
            if (self.output / each).exists():  # the others are made for results only
                make_folder(self.output / each, "--output")

    def run(self, client: Client) -> None:
        """Submit all files and, if requested, wait for the jobs.

        A failure is recorded in its row and does not stop the others. Only a service that refuses the token or cannot be reached for
        a submission ends the command.
        """
        from pliant.client.errors import PliantError
        from pliant.client.progress import progress_bar

        with progress_bar(line_every=LINE_EVERY) as bar:
            submitted = self._submit(client, bar)
            for index, (row, job) in enumerate(submitted if self.wait else ()):
                self.session.following, self.session.others = job.id, len(submitted) - index - 1
                bar.label = str(row.file)
                self._follow(row, job, bar)
                try:
                    row.job = client.get(job.id).record
                except PliantError as error:
                    row.error = row.error or error
                    continue
                err().print(f"{row.file}: {row.job.status}")

    def _submit(self, client: Client, bar: Bar) -> list[tuple[Row, RemoteJob]]:
        """Submit each file and print its job id immediately, so that an interruption loses none.

        Raises
        ------
        NotAuthorized
            The token is missing or lacks a scope, so that every other file would be refused, too.
        Unreachable
            The service does not answer.
        """
        from pliant.client.errors import NotAuthorized, PliantError, Unreachable
        from pliant.schemas.digests import sha256
        from pliant.schemas.job import Status

        submitted: list[tuple[Row, RemoteJob]] = []
        secret = os.environ.get("PLIANT_WEBHOOK_SECRET") if self.shared.get("webhook") else None
        common = self._common(secret)
        for file in self.files:
            row = Row(file)
            self.rows.append(row)
            bar.label = str(file)
            try:
                film, name = is_film(file, None), name_of("", file)
                with as_one_file(file) as sent:
                    key = _key_of(f"{sha256(sent)} {name} {common}")
                    while True:
                        job = client.submit(
                            None if film else sent, film=sent if film else None, name=name, options=self.options,
                            idempotency_key=key, priority=self.priority, timeout=self.timeout,  # type: ignore[arg-type]
                            webhook_secret=secret, on_upload=bar.on_upload, **self.shared,
                        )  # fmt: skip
                        if job.status not in (Status.FAILED, Status.CANCELLED):
                            break
                        # An earlier job without a result does not prevent another one.
                        key = _key_of(f"{key} after {job.id}")
            except (NotAuthorized, Unreachable):
                raise
            except PliantError as error:
                row.error = error
                continue
            row.job = job.record
            self.session.following, self.session.others = job.id, len(submitted)
            submitted.append((row, job))
            err().print(f"{file}: job {job.id}")
        return submitted

    def _follow(self, row: Row, job: RemoteJob, bar: Bar) -> None:
        """Wait for a job, and download its files if there is an output folder."""
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
        """Exit code of the command: `DONE` only if every file succeeded."""
        return Exit.FAILED if any(row.error is not None for row in self.rows) else Exit.DONE

    def show(self, *, as_json: bool) -> None:
        """Print the outcomes as a table or JSON."""
        if as_json:
            print_json([{"file": str(row.file), **self._outcome(row)} for row in self.rows])
            return
        from rich.table import Column, Table
        from rich.text import Text

        longest = max((len(row.job.id) for row in self.rows if row.job is not None), default=0)
        job_column = Column("job", no_wrap=True, min_width=longest)  # ids stay complete on narrow terminals
        table = Table("file", job_column, "status", "verdict", "seconds")
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
                describe_verdict(job), "" if took is None else f"{took.total_seconds():.1f}",
            )  # fmt: skip
        out().print(table)
        for row in self.rows:
            if row.error is not None:  # not in the table, which would cut it off on narrow terminals
                out().print(Text(f"{row.file}: {self._refusal(row.error)}"), soft_wrap=True)

    def _refusal(self, error: Exception) -> str:
        """Return the message of an error with a reference to its explanation."""
        more = find_explanation(details_of(error), self.url)
        return str(error) if more is None else f"{error} More about this error: {more}"

    def _outcome(self, row: Row) -> dict[str, Any]:
        return {
            "job": None if row.job is None else row.job.model_dump(mode="json"),
            "error": None if row.error is None else str(row.error),
            "explained_at": None if row.error is None else find_explanation(details_of(row.error), self.url),
        }

    def _common(self, secret: str | None) -> str:
        """Return the parameters that all files share as text; mesh, ground truth, rotations and secret by their digests."""
        from pliant.schemas.digests import sha256

        parts = {name: None if part is None else str(part) for name, part in self.shared.items()}
        for name in ("mesh", "ground_truth", "rotations"):
            path = self.shared.get(name)
            if path is not None and Path(path).is_file():
                parts[name] = sha256(Path(path))
        digest = None if secret is None else hashlib.sha256(secret.encode()).hexdigest()
        return json.dumps([self.key, self.options, self.priority, parts, digest], sort_keys=True)


def _key_of(text: str) -> str:
    """Return the idempotency key of a submission that a text distinguishes from others."""
    return f"batch/{hashlib.sha256(text.encode()).hexdigest()}"
