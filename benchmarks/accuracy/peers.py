"""Compare other authors' methods with Pliant on the same complete tracks, with the same metrics.

    python -m benchmarks.accuracy.peers --data DIR --code FOLDER [--only NAME] [--methods pta,bmm,pnd2] [--points 300] [--ours]
    python -m benchmarks.accuracy.peers --table

FOLDER holds checkouts of the authors' code, which this project does not contain. Octave runs it, with its package `signal`:

- `pta`: trajectory basis (Akhter, Sheikh, Khan and Kanade, 2008), `nrsfm_trajectory.m` of github.com/umutekingezer/ComputerVision, a
  course exercise that uses the authors' functions; no licence stated
- `bmm`: block matrix method (Dai, Li and He, 2012), `NRSFM_BMM.m` of github.com/jvlmdr/low-rank-nrsfm, with github.com/sqlp/sdpt3,
  installed; GPL 3 or later, its read-me says research only. SDPT3: GPL 2
- `pnd2`: EM-PND2, the Procrustean normal distribution (Lee, Cho, Choi and Oh, 2013; Lee, Cho and Oh, 2016), `NRSfM_PND2.m` of
  github.com/summmanpan/NRSfM_Consensus; GPL 3 or later, its read-me says research only

`pta` and `bmm` need the number of bases K. `AUTHORS` holds the authors' choices for `bmm`, which they found with the truth. Elsewhere every
K of a list is run, and the table shows the one with the least error; choosing it needs the truth, which favours the peers. Pliant runs with
default settings on the same tracks, without a mesh. Sequences without truth or with hidden points are skipped.

Tracks are divided by the mean standard deviation of their rows; the authors of `bmm` divide by that of the truth. `e3d_frame` allows one
reflection per sequence, `e3d_frame_similarity` one per frame. Seconds are processor time of one thread.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pliant.solver import solve
from pliant.solver.evaluation.metrics import e3d_frame, e3d_frame_similarity

from benchmarks.accuracy.octave import Failed, run
from benchmarks.accuracy.tables import number
from benchmarks.rows import append_row, parser_of, rows
from benchmarks.sequences import Case, cases

RESULTS = Path(__file__).parent.parent / "results" / "peers.jsonl"
METRICS = {"e3d_frame": e3d_frame, "e3d_frame_similarity": e3d_frame_similarity}
OURS = "default"
SECONDS = 300

BASES = {"pta": (2, 3, 5, 9, 12, 13), "bmm": (3, 5, 7)}
"""Numbers of bases to try; 12 and 13 are the ones given for `pta` on `akhter_pickup` and `akhter_drink`."""

AUTHORS = {
    "bmm": {"akhter_drink": 12, "akhter_pickup": 12, "akhter_dance": 10, "torresani_walking": 8, "shark_objframe": 4}
}
"""The authors' numbers of bases, from their `NRSFM_example.m`."""


@dataclass(frozen=True, slots=True)
class Peer:
    """How to call a method."""

    call: str
    """Octave statements that compute `S (3F, P)` from `W (2F, P)`; `{K}` is the number of bases."""

    files: tuple[str, ...]
    """Files whose folders, with all subfolders, must be on the path."""


PEERS = {
    "pta": Peer("S = nrsfm_trajectory (W, {K});", ("nrsfm_trajectory.m",)),
    "bmm": Peer("S = NRSFM_BMM (W, {K}, 0);", ("NRSFM_BMM.m", "install_sdpt3.m")),
    "pnd2": Peer(
        "D = zeros (3, columns (W), rows (W) / 2);  D(1, :, :) = W(1:2:end, :)';  D(2, :, :) = W(2:2:end, :)';\n"
        "seen = true (size (D));  seen(3, :, :) = false;\n"
        "S = reshape (permute (NRSfM_PND2 (D, seen), [1 3 2]), [], columns (W));",
        ("NRSfM_PND2.m",),
    ),
}


def bases(method: str, case: Case) -> tuple[int | None, ...]:
    """Return the numbers of bases to run, up to what a factorization of rank 3K permits."""
    if method not in BASES:
        return (None,)
    stated = AUTHORS.get(method, {}).get(case.name)
    most = min(2 * case.tracks.num_frames, case.tracks.num_points) // 3
    return tuple(count for count in (BASES[method] if stated is None else (stated,)) if count <= most)


def paths(peer: Peer, code: Path) -> list[Path]:
    """Return the folders that a method needs on the path.

    Raises
    ------
    SystemExit
        No checkout contains one of the files.
    """
    found = []
    for name in peer.files:
        at = next(iter(sorted(code.rglob(name))), None)
        if at is None:
            raise SystemExit(f"No {name} in {code}: see the checkouts that this command's help names.")
        below = sorted((each for each in at.parent.rglob("*") if each.is_dir()), reverse=True)
        found += [*(each for each in below if not each.relative_to(at.parent).parts[0].startswith(".")), at.parent]
    return found


def measured(method: str, case: Case, *, K: int | None, code: Path, seconds: int) -> Iterator[dict[str, Any]]:
    """Run a method once; yield a row per metric, or one row with the reason for its failure."""
    row = {
        "method": method, "sequence": case.name, "frames": case.tracks.num_frames, "points": case.tracks.num_points, "K": K
    }  # fmt: skip
    tracks = case.tracks.points
    size = float(tracks.std(axis=1).mean())
    try:
        if method == OURS:
            began = time.process_time()
            shapes = solve(case.tracks).shapes
            spent = time.process_time() - began
        else:
            peer = PEERS[method]
            found, spent = run(peer.call.format(K=K), tracks / size, paths=paths(peer, code), seconds=seconds)
            shapes = size * found
    except Failed as error:
        yield {**row, "metric": "failed", "value": None, "reason": str(error).replace(f"{code}/", "")}
        return
    for name, metric in METRICS.items():
        yield {**row, "metric": name, "value": metric(shapes, case.shapes), "seconds": round(spent, 1)}


def complete(data: Path, *, points: int | None, only: list[str]) -> Iterator[Case]:
    """Yield the sequences with truth whose points are all visible or can be treated as visible."""
    for case in cases(data, points=points, visibility="all", only=only):
        if case.shapes is not None and case.tracks.all_visible:
            yield case
        else:
            print(f"{case.name}: left out, no truth or hidden points")


def table(path: Path, metric: str = "e3d_frame") -> str:
    """Return a Markdown table of errors, with K and seconds in brackets; a method that failed with every K shows the reason."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows(path):
        if row["metric"] in (metric, "failed"):
            found[f"{row['sequence']}, {row['frames']} × {row['points']}", row["method"]].append(row)
    methods = [*PEERS, OURS]
    lines = ["| sequence | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    for sequence in dict.fromkeys(name for name, _ in found):
        cells = [_cell(found.get((sequence, method), [])) for method in methods]
        lines.append(f"| {sequence} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(measurements: list[dict[str, Any]]) -> str:
    values = [row for row in measurements if row["value"] is not None]
    if not values:
        return measurements[0]["reason"] if measurements else "–"
    best = min(values, key=lambda row: float(row["value"]))
    bases_of = "" if best["K"] is None else f"K = {best['K']}, "
    return f"{number(best['value'])} ({bases_of}{best['seconds']:.0f} s)"


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing and print the table."""
    parser = parser_of(__doc__, out=RESULTS, points=300)
    parser.add_argument("--code", type=Path, help="folder with the checkouts")
    parser.add_argument("--methods", default=",".join(PEERS), help="comma-separated: " + ", ".join(PEERS))
    parser.add_argument("--ours", action="store_true", help="measure Pliant on the same tracks as well")
    parser.add_argument("--timeout", type=int, default=SECONDS, help="processor seconds of one run of a peer")
    parser.add_argument("--table", action="store_true", help="only print what was measured")
    given = parser.parse_args(arguments)
    methods = [each for each in given.methods.split(",") if each] + [OURS] * given.ours
    done = {(row["method"], row["sequence"], row["points"], row["K"]) for row in rows(given.out)}
    for case in () if given.table else complete(given.data, points=given.points, only=given.only):
        for method, K in ((each, count) for each in methods for count in bases(each, case)):
            if (method, case.name, case.tracks.num_points, K) in done:
                continue
            for row in measured(method, case, K=K, code=given.code, seconds=given.timeout):
                append_row(given.out, row)
                print(json.dumps(row), flush=True)
    print(table(given.out))


if __name__ == "__main__":
    main()
