r"""Measure time and memory, beside baselines and against the size.

    python -m benchmarks.speed compare --data DIR --only facescan99   the solver and the baselines on one energy
    python -m benchmarks.speed growth                                 against P and against F, with fitted exponents
    python -m benchmarks.speed growth --cameras estimated --settings "" --outliers 0 --kind talk --fixed-points 300 \
        --against-points "" --against-frames 300,1000,3000,10000 --results benchmarks/results/growth.jsonl
    python -m benchmarks.speed mesh --frames 30 --points 10000        a mesh and a grid of equal F and P
    python -m benchmarks.speed threads                                BLAS in one thread and in its default number

Without `--data` the sequence is synthetic (`--kind`). Each number comes from a separate process. Wall time counts on an idle machine; CPU
time of all threads is listed too, because it stays comparable when other work shares the cores.

`compare`: every baseline gets the normalised problem and the final translations free of charge, starts from the pseudo-inverse (with
`--start ours` from the solver's own start, also free of charge), and runs until it is within 1 % of the solver's final energy or `--cap`
seconds have passed. In the latter case the table gives a time extrapolated from its last rate, and marks it.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from benchmarks.rows import words
from benchmarks.speed.blas_threads import blas_threads
from benchmarks.speed.growth import FIXED_FRAMES, FIXED_POINTS, FRAMES, POINTS, Sizes, growth, mesh_against_grid
from benchmarks.speed.side_by_side import BASELINES, Workload, compare


def main() -> None:
    """Run the selected measurement."""
    options = _parser().parse_args()
    work = Workload(
        data=options.data, only=options.only, kind=options.kind, frames=options.frames, points=options.points, outliers=options.outliers,
        noise=options.noise, known=options.cameras == "true", settings=options.settings,
        start=options.start, scratch=options.scratch,
    )  # fmt: skip
    if options.what == "compare":
        compare(work, names=options.baselines, cap=options.cap, limit=int(options.memory * 1e9))
    elif options.what == "growth":
        sizes = Sizes(
            points=options.against_points, frames=options.against_frames,
            fixed_points=options.fixed_points, fixed_frames=options.fixed_frames,
        )  # fmt: skip
        growth(work, sizes, results=options.results, command=command_of(sys.argv[1:]))
    elif options.what == "threads":
        blas_threads()
    else:
        mesh_against_grid(work)


def command_of(arguments: list[str]) -> str:
    """Return the command that repeats the measurement, without `--results`."""
    kept = [each for each in arguments if not each.startswith("--results=")]
    if "--results" in kept:
        place = kept.index("--results")
        del kept[place : place + 2]
    return f"python -m benchmarks.speed {shlex.join(kept)}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    def sizes(text: str) -> tuple[int, ...]:
        return tuple(int(word) for word in words(text))

    parser.add_argument("what", choices=("compare", "growth", "mesh", "threads"))
    parser.add_argument("--data", type=Path, help="directory of sequences; a gallery face when not given")
    parser.add_argument("--only", default="facescan99", help="the first sequence whose name holds this word")
    parser.add_argument("--kind", default="face", choices=("face", "flag", "sphere", "talk"), help="gallery sequence")
    parser.add_argument("--frames", type=int, default=20, help="of the gallery face")
    parser.add_argument("--points", type=int, help="of the gallery face, or to thin a sequence to")
    parser.add_argument("--outliers", type=float, default=0.10)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--cameras", choices=("true", "estimated"), default="true")
    parser.add_argument("--settings", default="prior=smooth", help="name=value,…")
    parser.add_argument("--start", choices=("tracks", "ours"), default="tracks", help="what the baselines begin with")
    parser.add_argument("--baselines", type=words, default=list(BASELINES))
    parser.add_argument("--cap", type=float, default=1800.0, help="seconds a baseline may take")
    parser.add_argument("--memory", type=float, default=14.0, help="gigabytes of address space a baseline may take")
    parser.add_argument("--against-points", type=sizes, default=POINTS, help="values of P for growth")
    parser.add_argument("--against-frames", type=sizes, default=FRAMES, help="values of F for growth")
    parser.add_argument("--fixed-frames", type=int, default=FIXED_FRAMES, help="F of the growth with P")
    parser.add_argument("--fixed-points", type=int, default=FIXED_POINTS, help="P of the growth with F")
    parser.add_argument("--scratch", type=Path, help="folder for the file that holds the result of a large solve")
    parser.add_argument("--results", type=Path, help="file that growth appends its measurements to")
    return parser


if __name__ == "__main__":
    main()
