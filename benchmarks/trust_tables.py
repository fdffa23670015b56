"""The tables of `benchmarks.trust`: verdicts against true errors, and coverage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pliant.solver.evaluation.metrics import NINETY
from pliant.solver.evaluation.trust import LEAST_TURN, LOOSE_HELD_OUT

from benchmarks.sequences import RECONSTRUCTED

BEGIN, END = "<!-- trust tables -->", "<!-- end of trust tables -->"
"""Lines of the page that enclose the tables."""

VERDICTS = {"good": "good", "with_care": "with care", "do_not_use": "do not use"}

CLASSES = ((0.0, 0.03, "below .03"), (0.03, 0.15, ".03 to .15"), (0.15, np.inf, "above .15"))
"""Bounds of the true error."""

AIM = (0.85, 0.95)
"""Target range for the coverage of the central 90 % intervals."""

Row = dict[str, Any]


def written(rows: list[Row], calibration: Sequence[str], page: Path | None) -> None:
    """Print the tables, or insert them into a page between its markers.

    Raises
    ------
    ValueError
        The page lacks a marker.
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
    rows = with_truth(rows)
    chosen = [row for row in rows if is_of(row, calibration)]
    held = [row for row in rows if not is_of(row, calibration)]
    parts = [
        confusion("Sequences that constants were chosen on", chosen),
        confusion("Other sequences", held),
        missed(rows),
    ]
    parts += [separated(chosen, held), covered(chosen, held)]
    return "\n\n".join(part for part in parts if part)


def with_truth(rows: list[Row]) -> list[Row]:
    """Return the rows without sequences whose "true" shapes are a reconstruction."""
    return [row for row in rows if not is_of(row, RECONSTRUCTED)]


def is_of(row: Row, names: Sequence[str]) -> bool:
    """Return whether a row belongs to one of these sequences."""
    return any(row["sequence"].split(" with ")[0] == name for name in names)


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


def separated(chosen: list[Row], held: list[Row]) -> str:
    """Return a table of how many solves of each class of true error show each of `SIGNS`; empty if no row has them."""
    names = [name for _, _, name in CLASSES]
    lines = [
        "| sign | sequences | " + " | ".join(f"true error {name}" for name in names) + " | white noise |",
        "|---|---|---|---|---|---|",
    ]
    for sign, has in SIGNS.items():
        for title, rows in (("chosen on", chosen), ("others", held)):
            stated = [(row, found) for row in rows if (found := has(row)) is not None]
            cells = [f"{sum(found for _, found in part)} of {len(part)}" for part in _by_class(stated)]
            lines.append(f"| {sign} | {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) if any(has(row) is not None for has in SIGNS.values() for row in [*chosen, *held]) else ""


def _by_class(stated: list[tuple[Row, bool]]) -> list[list[tuple[Row, bool]]]:
    known = [each for each in stated if each[0]["true"] is not None]
    classes = [[each for each in known if low <= each[0]["true"] < high] for low, high, _ in CLASSES]
    return [*classes, [each for each in stated if each[0]["true"] is None]]


def misses_held_out(row: Row) -> bool | None:
    """Return whether held-out observations are far from their prediction; None if none were held out."""
    error = row.get("held_out")
    return None if error is None else error >= LOOSE_HELD_OUT


def turn_over_deformation(row: Row) -> float | None:
    """Return the turn per frame, radians, over the deformation per frame relative to the size; None for unordered photographs."""
    turn, change = row.get("degrees_per_frame"), row.get("deformation_per_frame")
    return None if turn is None or change is None else float(np.radians(turn) / max(change, np.finfo(float).tiny))


def turns_slowly(row: Row) -> bool | None:
    """Return whether turn over deformation is below `LEAST_TURN`; None for unordered photographs."""
    found = turn_over_deformation(row)
    return None if found is None else found < LEAST_TURN


SIGNS = {
    f"held-out observations {LOOSE_HELD_OUT:.0%} of the size and more from their prediction": misses_held_out,
    f"turn over deformation per frame below {LEAST_TURN:g}": turns_slowly,
}


def missed(rows: list[Row]) -> str:
    """Return a sentence on solves with a wrong verdict: good with an error above .15, or do not use below .03."""
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


def within(row: Row, width: float = NINETY) -> float | None:
    """Return the share of a solve's positions whose error is at most `width` standard deviations, from its quantiles.

    Quantiles are those at k/(n + 1), k = 1 … n; None without them.
    """
    quantiles = row.get("quantiles")
    if quantiles is None:
        return None
    levels = np.arange(1, len(quantiles) + 1) / (len(quantiles) + 1)
    return float(np.interp(width, [0.0, *quantiles], [0.0, *levels], right=(1 + levels[-1]) / 2))


def pooled(rows: list[Row], width: float = NINETY) -> float:
    """Return the mean share within `width` standard deviations: over the solves of a sequence, then over sequences.

    Solves of a sequence with and without `image_size` count as one sequence.
    """
    by_name: dict[str, list[float]] = {}
    for row in rows:
        share = within(row, width)
        if share is not None:
            by_name.setdefault(row["sequence"].split(" with ")[0], []).append(share)
    return float(np.mean([np.mean(shares) for shares in by_name.values()]))


def covered(chosen: list[Row], held: list[Row]) -> str:
    """Return a table of the coverage of the intervals, by positions and by solves."""
    lines = [
        "| | solves | positions within the 90 % interval, sequences weighted equally | solves with 85 to 95 % | above | below | "
        "true error within `interval` |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, rows in (("chosen on", chosen), ("others", held), ("all", [*chosen, *held])):
        values = np.array([share for row in rows if (share := within(row)) is not None])
        if not len(values):
            continue
        inside = [
            row["interval"][0] <= row["true"] <= row["interval"][1]
            for row in rows
            if row["interval"] and row["true"] is not None
        ]
        right = int(((values >= AIM[0]) & (values <= AIM[1])).sum())
        lines.append(
            f"| {name} | {len(values)} | {pooled(rows):.0%} | {right} | {int((values > AIM[1]).sum())} | "
            f"{int((values < AIM[0]).sum())} | {sum(inside)} of {len(inside)} |"
        )
    lines += ["", f"The interval is ± {NINETY:g} standard deviations; {exceptions([*chosen, *held])}"]
    return "\n".join(lines)


def exceptions(rows: list[Row]) -> str:
    """Return a sentence that names the solves with a coverage below `AIM`, the worst first."""
    shares = [(share, row) for row in rows if (share := within(row)) is not None]
    low = sorted(((share, row) for share, row in shares if share < AIM[0]), key=lambda each: each[0])
    if not low:
        return "no solve has fewer than 85 % of its positions within it."
    names = ", ".join(f"{row['sequence']} {row['kind']} {share:.0%}" for share, row in low)
    return f"solves with fewer than 85 % of their positions within it: {names}."
