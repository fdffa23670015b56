"""Figures drawn from `benchmarks/results/*.jsonl`: `python -m benchmarks.figures.plots [--into docs/images]` (needs matplotlib)."""

from __future__ import annotations

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.sequences import RECONSTRUCTED

RESULTS = Path(__file__).parents[1] / "results"
Records = list[dict[str, Any]]

NAMES = {
    "pseudo_inverse": "pseudo-inverse",
    "temporal": "smooth in time (Dai et al.)",
    "spatio_temporal": "smooth in time and space (Dai et al.)",
    "robust": "robust (Dai et al.)",
    "robust+low_rank": "robust, low rank",
    "default": "Pliant's default",
}
COLOURS = {
    "pseudo_inverse": "#bbbbbb",
    "temporal": "#88ccee",
    "spatio_temporal": "#44aa99",
    "robust": "#117733",
    "robust+low_rank": "#ddaa33",
    "default": "#cc3311",
}
PEERS = {
    "pta": ("trajectory basis (Akhter et al.)", "^"),
    "bmm": ("block matrix (Dai, Li and He)", "s"),
    "pnd2": ("EM-PND2 (Lee et al.)", "D"),
}
SEQUENCES = {
    "facescan10_rot90": "face scans, 10 frames",
    "facescan99_rot30": "face scans, 99 frames",
    "aura_anim_rot45": "animated head",
    "ict_beat_9k_rot30": "speaking head",
    "horse_gallop": "galloping horse",
    "samba": "dancer",
    "mp_face37": "face landmarks",
    "shark_objframe": "shark",
    "akhter_drink": "mocap, drink",
    "akhter_pickup": "mocap, pick-up",
    "akhter_dance": "mocap, dance",
    "torresani_walking": "mocap, walking",
    "dinosaur_real": "animatronic dinosaur",
    "kinect_paper_dense23": "bending paper, real",
    "hulk21_px": "comic page, real",
}


def main() -> None:
    """Draw every figure whose results exist."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, default=Path("docs/images"))
    into = parser.parse_args().into
    mpl.use("Agg")
    plt.rcParams.update(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "pliant"}
    )
    for name, (source, draw) in FIGURES.items():
        records = read(source)
        if records:
            figure = draw(records)
            figure.savefig(into / f"{name}.png", dpi=110, bbox_inches="tight", metadata={"Software": None})
            plt.close(figure)


def read(name: str) -> Records:
    """Return the records of one results file; an empty list if it does not exist."""
    path = RESULTS / f"{name}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def error_by_sequence(records: Records) -> Figure:
    """Plot the error of every method by sequence; published figures are ticks, other authors' methods hollow markers."""
    chosen = [
        r for r in records
        if r["metric"] == "e3d_frame" and r["cameras"] == "estimated" and r["corruption"] == "clean"
        and r["visibility"] == "file" and r["points"] <= 1000 and r["sequence"] not in RECONSTRUCTED
    ]  # fmt: skip
    names = [name for name in SEQUENCES if any(r["sequence"] == name for r in chosen)]
    figure, axes = plt.subplots(figsize=(8, 4.2))
    for method, label in NAMES.items():
        found = {r["sequence"]: r["mean"] for r in chosen if r["method"] == method}
        at = [i for i, name in enumerate(names) if name in found]
        size, layer = (60, 3) if method == "default" else (26, 2)
        axes.scatter([found[names[i]] for i in at], at, s=size, color=COLOURS[method], label=label, zorder=layer)
    measured = {(r["sequence"], r["points"]) for r in chosen}
    peers: dict[str, dict[str, float]] = defaultdict(dict)
    for r in read("peers"):
        if r["method"] in PEERS and r["metric"] == "e3d_frame" and (r["sequence"], r["points"]) in measured:
            least = peers[r["method"]].get(r["sequence"], np.inf)
            peers[r["method"]][r["sequence"]] = min(least, r["value"])  # of the numbers of bases
    for method, found in peers.items():
        label, marker = PEERS[method]
        at = [names.index(name) for name in found]
        axes.scatter(
            list(found.values()),
            at,
            marker=marker,
            s=30,
            facecolors="none",
            edgecolors="#555555",
            label=label,
            zorder=4,
        )
    published = [r for r in read("published") if r["metric"] == "e3d_frame" and r["sequence"] in names]
    if published:
        at = [names.index(r["sequence"]) for r in published]
        axes.scatter([r["value"] for r in published], at, marker="|", s=160, color="black", label="published")
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), [SEQUENCES[name] for name in names])
    axes.invert_yaxis()
    axes.grid(axis="x", which="both", alpha=0.25)
    axes.set_xlabel("e3d_frame (error / size), estimated cameras, exactly orthographic tracks but for the real ones")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    return figure


def error_by_corruption(records: Records) -> Figure:
    """Plot error against noise, outliers and hidden points for the corrupted sequences."""
    chosen = [
        r for r in records
        if r["metric"] == "e3d_frame" and r["cameras"] == "estimated" and r["visibility"] == "file" and r["points"] <= 1000
    ]  # fmt: skip
    kinds: dict[str, dict[str, float]] = {
        "noise (share of the size)": {"clean": 0, "noise .01": 0.01, "noise .03": 0.03, "noise .05": 0.05},
        "outliers (%)": {"clean": 0, "outliers 2 %": 2, "outliers 6 %": 6, "outliers 10 %": 10},
        "more hidden (%)": {"clean": 0, "hidden 30 %": 30},
    }
    names = [n for n in SEQUENCES if any(r["sequence"] == n and r["corruption"] == "noise .01" for r in chosen)]
    figure, grid = plt.subplots(len(names), len(kinds), figsize=(9, 2.1 * len(names)), squeeze=False, sharey="row")
    for row, name in zip(grid, names, strict=True):
        for axes, (kind, levels) in zip(row, kinds.items(), strict=True):
            _against(axes, [r for r in chosen if r["sequence"] == name], levels)
            axes.set_xlabel(kind, fontsize=8)
        row[0].set_ylabel(f"{SEQUENCES[name]}\ne3d_frame", fontsize=8)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=8)
    figure.tight_layout()
    return figure


def _against(axes: Axes, records: Records, levels: dict[str, float]) -> None:
    for method, label in NAMES.items():
        points = sorted(
            (levels[r["corruption"]], r["mean"], r.get("std", 0.0))
            for r in records
            if r["method"] == method and r["corruption"] in levels
        )
        if points:
            x, y, spread = np.array(points).T
            axes.errorbar(x, y, spread, color=COLOURS[method], label=label, marker=".", lw=1, capsize=2)
    axes.set_yscale("log")
    axes.grid(alpha=0.25)


def error_by_level(records: Records) -> Figure:
    """Plot the default's error against the level of each corruption: every draw, and the mean."""
    figure, panels = plt.subplots(1, 3, figsize=(8, 3), sharey=True)
    for axes, (spoiling, words) in zip(
        panels, (("outliers", "share of outliers"), ("hidden", "share hidden"), ("noise", "noise r")), strict=True
    ):
        for at, sequence in enumerate(dict.fromkeys(r["sequence"] for r in records)):
            draws = defaultdict(list)
            for r in records:
                if r["sequence"] == sequence and r["spoiling"] in (spoiling, "clean"):
                    draws[r["level"]].append(r["e3d_frame"])
            levels = sorted(draws)
            name = SEQUENCES.get(sequence, sequence.replace("_", " "))
            axes.plot(levels, [np.mean(draws[level]) for level in levels], color=f"C{at}", lw=1.2, label=name)
            for level in levels:
                axes.plot([level] * len(draws[level]), draws[level], ".", ms=3, alpha=0.5, color=f"C{at}")
        axes.set_yscale("log")
        axes.set_xlabel(words)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("e3d_frame")
    panels[1].legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=3)
    figure.tight_layout()
    return figure


def growth(records: Records) -> Figure:
    """Plot time and memory against points and frames, with the fitted exponents of time."""
    figure, grid = plt.subplots(1, 2, figsize=(8, 4.2))
    for axes, quantity, label in zip(grid, ("seconds", "gigabytes"), ("wall time, s", "peak memory, GB"), strict=True):
        series: dict[tuple[str, str, str], list[tuple[float, float]]] = defaultdict(list)
        for r in records:
            if quantity in r:
                other = "frames" if r["against"] == "points" else "points"
                cameras = "" if r.get("cameras", "true") == "true" else ", cameras estimated"
                series[r["against"], f"{r[other]:,} {other}", r["prior"] + cameras].append(
                    (r[r["against"]], r[quantity])
                )
        for (against, at, prior), points in sorted(series.items()):
            x, y = np.array(sorted(points)).T
            label_of = f"{against} at {at}, {prior}"
            if quantity == "seconds":  # memory has a constant part, so its slope means little
                label_of += f": slope {np.polyfit(np.log(x), np.log(y), 1)[0]:.2f}"
            axes.loglog(x, y, marker="o", ms=4, label=label_of)
        axes.set_xlabel("points, or frames")
        axes.set_ylabel(label)
        axes.grid(alpha=0.25, which="both")
        axes.legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    figure.tight_layout()
    return figure


def baselines(records: Records) -> Figure:
    """Plot the time to reach within 1 % of the final energy, beside other minimisers."""
    figure, axes = plt.subplots(figsize=(6.5, 1.8))
    axes.barh([r["solver"] for r in records], [r["seconds"] for r in records], color="#4477aa")
    for at, r in enumerate(records):
        axes.text(r["seconds"] * 1.05, at, f"{r['seconds']:g} s, {r['gigabytes']:g} GB", va="center", fontsize=8)
    axes.set_xscale("log")
    axes.set_xlim(1, 1500)
    axes.invert_yaxis()
    axes.set_xlabel("wall time, s (99 × 29,299 points, 10 % outliers, known cameras, two cores)")
    return figure


def distance(records: Records) -> Figure:
    """Plot error against camera distance (infinite: orthography), for each sequence at the number of points with the most measurements."""
    places = {"3": 0, "5": 1, "10": 2, "inf": 3}
    chosen = [r for r in records if r["metric"] == "e3d_frame_scaled" and len(r["sequence"].split()) == 2]
    titles = {"orthographic": "orthographic camera model", "auto": "camera=auto (default), φ not given"}
    figure, grid = plt.subplots(1, len(titles), figsize=(4 * len(titles), 3.2), sharey=True, squeeze=False)
    for axes, method in zip(grid[0], titles, strict=True):
        for number, (name, label) in enumerate(SEQUENCES.items()):
            every = [r for r in chosen if r["sequence"].split()[0] == name]
            counts = Counter(int(r["sequence"].split("=")[1]) for r in every)
            count = max(counts, key=lambda each: (counts[each], each), default=0)
            own = [r for r in every if r["method"] == method and r["sequence"].endswith(f"={count}")]
            if own:
                points = sorted((places[r["distance"]], r["value"]) for r in own)
                axes.semilogy(
                    *np.array(points).T, marker="o", ms=4, color=f"C{number % 10}", label=f"{label} ({count} points)"
                )
        axes.set_xticks(list(places.values()), ["3", "5", "10", "∞"])
        axes.set_title(titles[method], fontsize=9)
        axes.set_xlabel("distance of the camera / half-size of the object")
        axes.grid(alpha=0.25, which="both")
    grid[0, 0].set_ylabel("e3d_frame_scaled")
    if grid[0, -1].get_legend_handles_labels()[0]:
        grid[0, -1].legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def progress(records: Records) -> Figure:
    """Plot displayed against true remaining time, as fractions of each run's duration."""
    figure, axes = plt.subplots(figsize=(6.5, 4))
    ends = np.array([0.0, 1.0])
    axes.fill_between(ends, (1 - ends) / 2, (1 - ends) * 2, color="#dddddd", label="within a factor of two")
    axes.plot(ends, 1 - ends, color="black", lw=1)
    for number, r in enumerate(records):
        at, left = np.array(r["ticks"]).T / r["seconds"]
        dashes = "--" if r["door"] == "command line" else "-"
        label = f"{r['run']}, {r['frames']} × {r['points']}, {r['door']}, {r['seconds']:.0f} s"
        axes.plot(
            at,
            left,
            dashes,
            color=plt.get_cmap("tab20").colors[2 * number % 20 + number // 10 % 2],
            lw=1.2,
            label=label,
        )
    axes.axvline(0.25, color="black", lw=0.5)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.6)
    axes.set_xlabel("elapsed time / duration")
    axes.set_ylabel("seconds left as shown / duration")
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


FIGURES: dict[str, tuple[str, Callable[[Records], Figure]]] = {
    "error-by-sequence": ("accuracy", error_by_sequence),
    "error-by-corruption": ("accuracy", error_by_corruption),
    "error-by-level": ("curves", error_by_level),
    "growth": ("growth", growth),
    "baselines": ("baselines", baselines),
    "error-by-distance": ("distances", distance),
    "seconds-left": ("progress", progress),
}
"""Results file and drawing function of each picture."""


if __name__ == "__main__":
    main()
