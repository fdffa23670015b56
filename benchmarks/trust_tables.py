"""The tables of `benchmarks.trust`: verdicts against true errors, coverage by sequence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

BEGIN, END = "<!-- trust tables -->", "<!-- end of trust tables -->"
"""Lines of the page between which the tables stand."""

VERDICTS = {"good": "good", "with_care": "with care", "do_not_use": "do not use"}

CLASSES = ((0.0, 0.03, "below .03"), (0.03, 0.15, ".03 to .15"), (0.15, np.inf, "above .15"))
"""Bounds of the true error."""

AIM = (0.85, 0.95)
"""Coverage of the central 90 % intervals that is aimed at."""

Row = dict[str, Any]


def written(rows: list[Row], calibration: Sequence[str], page: Path | None) -> None:
    """Print the tables, or put them into a page between its two marks.

    Raises
    ------
    ValueError
        The page has no marks.
    """
    text = tables(rows, calibration)
    if page is None:
        print(text)
        return
    old = page.read_text()
    if BEGIN not in old or END not in old:
        raise ValueError(f"{page} has no lines {BEGIN!r} and {END!r}")
    head, rest = old.split(BEGIN, 1)
    page.write_text(f"{head}{BEGIN}\n\n{text}\n\n{END}{rest.split(END, 1)[1]}")


def tables(rows: list[Row], calibration: Sequence[str]) -> str:
    """Return the tables in Markdown."""
    chosen = [row for row in rows if is_of(row, calibration)]
    held = [row for row in rows if not is_of(row, calibration)]
    parts = [confusion("Sequences that constants were chosen on", chosen), confusion("Held out", held), missed(rows)]
    parts += [covered(chosen, held), by_sequence(rows, calibration)]
    return "\n\n".join(part for part in parts if part)


def is_of(row: Row, calibration: Sequence[str]) -> bool:
    """Whether a row belongs to the sequences that constants were chosen on."""
    return any(row["sequence"].split(" with ")[0] == name for name in calibration)


def confusion(title: str, rows: list[Row]) -> str:
    """Return the number of solves by true error and verdict."""
    lines = [f"| {title}: true error | good | with care | do not use |", "|---|---|---|---|"]
    for low, high, name in CLASSES:
        inside = [row for row in rows if row["true"] is not None and low <= row["true"] < high]
        counts = [sum(row["verdict"] == verdict for row in inside) for verdict in VERDICTS]
        lines.append(f"| {name} | " + " | ".join(map(str, counts)) + " |")
    blind = [row for row in rows if row["true"] is None]
    if blind:
        counts = [sum(row["verdict"] == verdict for row in blind) for verdict in VERDICTS]
        lines.append("| white noise, no truth | " + " | ".join(map(str, counts)) + " |")
    return "\n".join(lines)


def missed(rows: list[Row]) -> str:
    """Return the solves whose verdict breaks a promise: above .15 and good, below .03 and not to be used."""
    wrong = [
        row for row in rows
        if row["true"] is not None
        and ((row["true"] > 0.15 and row["verdict"] == "good") or (row["true"] < 0.03 and row["verdict"] == "do_not_use"))
    ]  # fmt: skip
    if not wrong:
        return "No solve with a true error above .15 is *good*, and none below .03 is *do not use*."
    names = ", ".join(
        f"{row['sequence']} ({row['kind']}, {row['true']:.3f}, {VERDICTS[row['verdict']]})" for row in wrong
    )
    return f"Solves with a true error above .15 that are *good*, or below .03 that are *do not use*: {names}."


def covered(chosen: list[Row], held: list[Row]) -> str:
    """Return how many positions and sequences the intervals hold."""
    lines = [
        "| | solves | positions within the 90 % interval | solves with 85 to 95 % | true error within `interval` |",
        "|---|---|---|---|---|",
    ]
    for name, rows in (("chosen on", chosen), ("held out", held)):
        known = [row for row in rows if row.get("coverage") is not None]
        if not known:
            continue
        values = np.array([row["coverage"] for row in known])
        weights = [row["frames"] * row["points"] for row in known]
        inside = [row["interval"][0] <= row["true"] <= row["interval"][1] for row in known if row["interval"]]
        share = f"{sum(inside)} of {len(inside)}"
        lines.append(
            f"| {name} | {len(known)} | {np.average(values, weights=weights):.0%} of all, {values.mean():.0%} of a solve's on average | "
            f"{int(((values >= AIM[0]) & (values <= AIM[1])).sum())} | {share} |"
        )
    return "\n".join(lines)


def by_sequence(rows: list[Row], calibration: Sequence[str]) -> str:
    """Return one line a solve; * marks sequences that constants were chosen on."""
    lines = [
        "| sequence | tracks | verdict | first reason | expected | true | coverage | mean σ / RMS error |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: row["sequence"]):
        star = "*" if is_of(row, calibration) else ""
        reason = row["reasons"][0] if row["reasons"] else ""
        cells = (
            f"{row['sequence']}{star}", row["kind"], VERDICTS[row["verdict"]], reason, figure(row["expected"]), figure(row["true"]),
            percent(row.get("coverage")), ratio(row.get("std_over_error")),
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(value: float | None) -> str:
    """Return an error as the tables have it: `.042`."""
    return "–" if value is None else f"{value:.3g}".replace("0.", ".", 1) if value < 1 else f"{value:.2f}"


def percent(value: float | None) -> str:
    """Return a share in percent."""
    return "–" if value is None else f"{value:.0%}"


def ratio(value: float | None) -> str:
    """Return a ratio with two digits."""
    return "–" if value is None else f"{value:.2g}"
