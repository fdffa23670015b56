"""Faults: every kind of process killed at every kind of moment, on a real installation; what the record said, and what was lost.

    python -m benchmarks.installation.faults

Prints a table. After each fault everything stored is compared with what the records say (as `pliant fsck` does), the
list of jobs with those that were acknowledged, and the process table with what was started. Exits with 1 if anything does not fit.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from benchmarks.installation import fault_jobs, fault_service
from benchmarks.installation.fault_list import FAULTS, Told
from benchmarks.installation.house import House

assert fault_service.__doc__, "imported for what it lists"


HEAD = "| what was done | what the record said | seconds | lost, doubled, half-written, left over |"


def main() -> int:
    """Commit every fault, print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--away", type=float, default=30.0, help="seconds that Valkey is away")
    parser.add_argument("--only", default="", help="names, commas between them: " + ", ".join(FAULTS))
    parser.add_argument("--into", type=Path, help="a document whose table of faults is to be replaced by this one")
    given = parser.parse_args()
    fault_jobs.AWAY[0] = given.away
    wanted = [name for name in given.only.split(",") if name] or list(FAULTS)
    wrong, rows = 0, [HEAD, "|---|---|---|---|"]
    print("\n".join(rows))
    with tempfile.TemporaryDirectory() as folder, House(Path(folder)) as house:
        for name in wanted:
            when, commit = FAULTS[name]
            try:
                told = commit(house)
            except AssertionError as surprise:
                told = Told(f"not as expected: {surprise}", 0.0)
                wrong += 1
            misfits = house.misfits()
            wrong += len(misfits)
            rows.append(f"| {when} | {told.said} | {told.seconds:.1f} | {' '.join(misfits) or 'nothing'} |")
            print(rows[-1], flush=True)
    if given.into is not None:
        replace_table(given.into, rows)
    return 1 if wrong else 0


def replace_table(document: Path, rows: list[str]) -> None:
    """Put the table in the place of the one that the document has."""
    lines = document.read_text().splitlines()
    begin = lines.index(HEAD)
    end = next(number for number in range(begin, len(lines) + 1) if number == len(lines) or not lines[number])
    document.write_text("\n".join([*lines[:begin], *rows, *lines[end:]]) + "\n")


if __name__ == "__main__":
    sys.exit(main())
