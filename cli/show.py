"""Output of the command line: text and tables with rich, or JSON for scripts."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from pliant.cli.exits import Exit
    from pliant.schemas.job import Estimate, Interpretation, Job
    from pliant.worker.jobs.finished import Finished

COLOURS = {
    "queued": "cyan", "running": "blue", "cancelling": "yellow", "succeeded": "green", "failed": "red", "cancelled": "yellow",
}  # fmt: skip

VERDICTS = {"good": ("Good", "green"), "with_care": ("Use with care", "yellow"), "do_not_use": ("Do not use", "red")}

UNESTIMATED = "The error is not estimated"
"""Beginning of the sentence on trust if the prior has no posterior, as on the page (`service/web/src/verdict.ts`)."""


def out() -> Console:
    """Console on standard output; created per call, so that it follows redirections. Brackets in names and messages are no markup."""
    return Console(highlight=False, soft_wrap=True, markup=False, emoji=False)


METRIC_MEANINGS: Mapping[str, str] = {
    "e3d_frame_scaled": "3-D error: distance from the ground truth after rotating each frame and scaling all; share of the object's size",
    "e3d_frame": "the same without the scale; result and ground truth must have one unit",
    "e3d_sequence": "the same after one orthogonal alignment for the whole sequence",
    "e3d_frame_similarity": "the same after rotating, mirroring and scaling each frame to fit",
    "e3d_mocap": "as the motion capture literature defines it; share of the shape's spread",
    "size_ratio": "size of the ground truth divided by the result's; far from 1, their units differ and only scaled errors have a meaning",
    "coverage": "share of the positions within their 90 % interval",
    "reprojection_median": "median distance from a visible track to the projected shape, in the tracks' unit",
    "reprojection_rms": "root mean square of the same distances; sensitive to outliers",
    "rotation_degrees": "mean angle between estimated and true cameras, in degrees",
    "focal_error": "error of the focal length, share of the true value",
}
"""Meaning of each metric of a job, the headline metric first. The web page uses the same text (`service/web/src/results.ts`)."""


def err() -> Console:
    """Console on standard error, for everything but the command's output."""
    return Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)


def show_warnings(warnings: Iterable[str], screen: Console | None = None) -> None:
    """Print warnings, by default on standard error."""
    screen = screen or err()
    for warning in warnings:
        screen.print(Text.assemble(("warning ", "yellow"), warning))


def print_json(value: object) -> None:
    """Print one JSON document; characters that the output's encoding lacks, such as bytes of a path, are escaped."""
    text = json.dumps(value, indent=2, ensure_ascii=False)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        text = json.dumps(value, indent=2)
    print(text)


def dump_interpretation(interpretation: Interpretation) -> dict[str, Any]:
    """Return an interpretation for `--json`, without its pictures."""
    shown: dict[str, Any] = interpretation.model_dump(mode="json", exclude={"sample", "first_frame"})
    return shown


def show_fault(fault: BaseException, sentence: str, code: Exit, *, as_json: bool, url: str | None = None) -> None:
    """Print an error and a reference to its explanation on standard error; `url` is the service that the command used."""
    details = details_of(fault)
    more = find_explanation(details, url)
    if as_json:
        document = {
            "exit_code": int(code),
            "detail": sentence,
            "code": "_".join(re.findall("[A-Z][a-z]*", type(fault).__name__)).lower(),
            **details,
        }
        err().print_json(json.dumps(document if more is None else {**document, "explained_at": more}))
        return
    screen = err()
    show_warnings(getattr(getattr(fault, "job", None), "warnings", ()), screen)  # of a job that failed
    screen.print(Text.assemble(("error ", "bold red"), sentence))
    for choice in details.get("choices", ()):
        options = " ".join(f"-O {name}={value}" for name, value in choice.get("options", {}).items())
        evidence = f" ({choice['evidence']})" if "evidence" in choice else ""
        screen.print(f"  {choice.get('layout', '')}{evidence}: {options}")
    if more is not None:
        screen.print(f"More about this error: {more}")


def find_explanation(details: Mapping[str, Any], url: str | None) -> str | None:
    """Return the URL or command that explains the code in an error's `details_of`; None without a known code.

    Errors of the service at `url` are explained by a page of that service, others by `pliant explain`, which prints the same text.
    """
    from pliant.schemas.problems import find_code, type_of

    code = str(details.get("code", ""))
    if "type" in details and url is not None:
        return url.rstrip("/") + type_of(code)
    return None if find_code(code) is None else f"pliant explain {code}"


def details_of(fault: BaseException) -> dict[str, Any]:
    """Return the details of an error: the service's problem document, or the attributes of a local error."""
    problem = getattr(fault, "problem", None) or getattr(getattr(fault, "job", None), "error", None)
    if problem is not None:
        details: dict[str, Any] = problem.model_dump(exclude_none=True)
        return details
    from pliant.schemas.problems import ProblemCode

    if isinstance(fault, OSError) and type(fault).__module__ == "builtins":
        return {"code": ProblemCode.UNUSABLE_PATH.value}
    names = ("code", "field", "expected", "got", "hint", "choices")
    return {name: getattr(fault, name) for name in names if getattr(fault, name, None) is not None}


def show_job(job: Job, *, as_json: bool) -> None:
    """Print a job's record."""
    if as_json:
        print_json(job.model_dump(mode="json"))
        return
    from pliant.client.progress import describe

    screen = out()
    screen.print(Text.assemble((job.id, "bold"), "  ", (job.status, COLOURS[job.status]), f"  {job.name}"))
    table = Table.grid(padding=(0, 2))
    for name, value in describe_inputs(job.interpretation):
        table.add_row(Text(name, "dim"), value)
    if job.place_in_queue is not None:
        table.add_row(Text("in the queue", "dim"), "next" if job.place_in_queue == 0 else f"{job.place_in_queue} ahead")
    if job.progress is not None and not job.status.final:
        table.add_row(
            Text("progress", "dim"), f"{job.progress.stage} {job.progress.fraction:.0%} {describe(job.progress)}"
        )
    if job.finished_at is not None and job.started_at is not None:
        table.add_row(Text("took", "dim"), f"{(job.finished_at - job.started_at).total_seconds():.1f} s")
    if job.expires_at is not None:
        table.add_row(Text("kept until", "dim"), f"{job.expires_at:%Y-%m-%d %H:%M} UTC")
    if job.error is not None:
        table.add_row(Text("error", "red"), f"{job.error.detail} [{job.error.code}]")
    elif job.sentence is not None and job.verdict is None:
        table.add_row(Text("outcome", "dim"), job.sentence)
    for warning in job.warnings:
        table.add_row(Text("warning", "yellow"), warning)
    screen.print(table)
    if job.metrics:
        screen.print(metrics_table(job.metrics))
    for artifact in job.artifacts:
        screen.print(f"  {artifact.name}  {artifact.bytes / 1e6:.2f} MB  {artifact.description}")
    for line in verdict_lines(job):
        screen.print(line)


def verdict_lines(result: Job | Finished) -> list[Text]:
    """Return the lines with the verdict and its reasons; empty if there is no verdict."""
    if result.verdict is None:
        return []
    words, colour = verdict_words(result)
    trust = result.trust_sentence
    if trust is not None and trust.startswith(UNESTIMATED):  # as `words` say
        trust = trust.removeprefix(UNESTIMATED).lstrip("; ").capitalize()
    sentences = " ".join(sentence for sentence in (trust, result.sentence) if sentence)
    return [Text.assemble((words, f"bold {colour}"), f"  {sentences}")] + [
        Text(f"  {reason}") for reason in result.verdict_reasons
    ]


def verdict_words(result: Job | Finished) -> tuple[str, str]:
    """Return the verdict in words and its colour; without an estimate of the error, the words say so, in no colour."""
    words, colour = VERDICTS.get(result.verdict or "", (result.verdict or "", "yellow"))
    if result.verdict is not None and (result.trust_sentence or "").startswith(UNESTIMATED):
        return f"{words}, error not estimated", ""
    return words, colour


def describe_inputs(interpretation: Interpretation) -> list[tuple[str, str]]:
    """Return the interpretation of the inputs as pairs of label and text."""
    expected = [] if interpretation.estimate is None else [("estimate", describe_needs(interpretation.estimate))]
    if interpretation.mesh_source == "film" and interpretation.num_points == 0:  # not tracked yet
        return [("film", note) for note in interpretation.notes] + expected
    given = [
        name for name, there in
        (("ground truth", interpretation.has_ground_truth), ("cameras", interpretation.has_rotations)) if there
    ]  # fmt: skip
    rows = [
        ("tracks", f"{interpretation.num_frames} frames × {interpretation.num_points} points, {interpretation.layout}"),
        ("hidden", f"{interpretation.hidden_fraction:.1%} of the observations"),
        ("mesh", f"{interpretation.mesh_source}, {interpretation.num_faces} faces"),
        ("y axis", interpretation.y_axis),
    ]
    if interpretation.image_size is not None:
        rate = "" if interpretation.fps is None else f", {interpretation.fps:.4g} frames per second"
        rows.append(("film", f"{interpretation.image_size.replace('x', '×')} pixels{rate}"))
    if len(given) > 0:
        rows.append(("also given", ", ".join(given)))
    return rows + expected + [("note", note) for note in interpretation.notes]


def describe_needs(estimate: Estimate) -> str:
    """Return estimated memory and time in words."""
    tracking, solving = estimate.tracking_seconds, f"{estimate.seconds:,.0f} s on one core"
    time = solving if tracking is None else f"tracking {tracking:,.0f} s, reconstruction {solving}"
    return f"about {in_gigabytes(estimate)} of memory, {time}"


def in_gigabytes(estimate: Estimate) -> str:
    """Return the estimated memory with its unit."""
    return f"{estimate.memory_bytes / 1e9:.1f} GB"


def metrics_table(metrics: Mapping[str, float]) -> Table:
    """Return a table of the metrics and their meanings, `e3d_frame_scaled` first."""
    table = Table("metric")
    table.add_column("value", justify="right")
    table.add_column("meaning")
    for name in sorted(metrics, key=_place):
        table.add_row(name, f"{metrics[name]:.4g}", METRIC_MEANINGS.get(name, ""))
    return table


def _place(metric: str) -> int:
    order = list(METRIC_MEANINGS)
    return order.index(metric) if metric in order else len(order)


def show_jobs(jobs: Iterable[Job], *, as_json: bool) -> None:
    """Print a table of jobs."""
    if as_json:
        print_json([job.model_dump(mode="json") for job in jobs])
        return
    rows = [
        (
            job.id,
            Text(job.status if job.progress is None or job.status.final else f"{job.status} {job.progress.fraction:.0%}",
                 COLOURS[job.status]),
            f"{job.created_at.astimezone():%Y-%m-%d %H:%M}",
            Text(*verdict_words(job)),
            f"{job.interpretation.num_frames} × {job.interpretation.num_points or '?'}",  # a film may not be tracked yet
            Text(job.name),
        )
        for job in jobs
    ]  # fmt: skip
    table = Table(box=None, padding=(0, 1, 0, 0))
    # On narrow terminals and in pipes the last columns wrap: the others, among them ids to copy, stay complete.
    for number, heading in enumerate(("id", "status", "created")):
        table.add_column(heading, no_wrap=True, min_width=max((len(row[number]) for row in rows), default=0))
    for heading in ("verdict", "frames × points", "name"):
        table.add_column(heading, overflow="fold", min_width=8)
    for row in rows:
        table.add_row(*row)
    out().print(table)


def show_options(schema: Mapping[str, Any], *, as_json: bool) -> None:
    """Print the options of a JSON Schema."""
    if as_json:
        print_json(schema)
        return
    table = Table(show_lines=False, box=None, pad_edge=False, padding=(0, 2, 1, 0))
    table.add_column("option", style="bold")
    table.add_column("default")
    table.add_column("meaning", overflow="fold")
    for name, entry in schema["properties"].items():
        meaning = Text(entry.get("description", ""))
        meaning.append(f"\n{describe_values(entry)}", "dim")
        table.add_row(name, json.dumps(entry.get("default")), meaning)
    out().print(table, soft_wrap=False)


def describe_values(entry: Mapping[str, Any]) -> str:
    """Describe the values that an option accepts."""
    forms = []
    for variant in entry.get("anyOf", [entry]):
        if "enum" in variant:
            forms.append(" | ".join(map(str, variant["enum"])))
        elif "enum" in variant.get("items", {}):
            forms.append("any of " + ", ".join(map(str, variant["items"]["enum"])))
        elif "$ref" not in variant and variant.get("type") != "null":
            signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
            bounds = [f"{sign} {variant[key]:g}" for key, sign in signs.items() if key in variant]
            forms.append(" ".join([str(variant.get("type", variant.get("const", ""))), *bounds]))
        elif variant.get("type") == "null":
            forms.append("null")
    return " or ".join(forms)
