"""Inject faults into a real installation: kill every kind of process at different times; report the job record and any losses.

    python -m benchmarks.installation.faults

Prints a table. After each fault, compares the stored data with the job records (as `pliant fsck` does), the list of jobs with the
acknowledged ones, and the process table with the started processes. Exits with 1 on any mismatch.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from benchmarks.installation import fault_jobs, fault_service
from benchmarks.installation.fault_list import FAULTS, Outcome
from benchmarks.installation.instance import Instance

assert fault_service.__doc__, "imported for what it lists"


HEAD = "| fault | state of the record | seconds | lost, duplicated, half-written, left over |"


def main() -> int:
    """Inject every fault, print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--away", type=float, default=30.0, help="seconds that Valkey is away")
    parser.add_argument("--only", default="", help="names, separated by commas: " + ", ".join(FAULTS))
    parser.add_argument("--into", type=Path, help="a document whose table of faults is to be replaced by this one")
    given = parser.parse_args()
    fault_jobs.AWAY[0] = given.away
    wanted = [name for name in given.only.split(",") if name] or list(FAULTS)
    wrong, rows = 0, [HEAD, "|---|---|---|---|"]
    print("\n".join(rows))
    with tempfile.TemporaryDirectory() as folder, Instance(Path(folder)) as instance:
        for name in wanted:
            when, inject = FAULTS[name]
            try:
                outcome = inject(instance)
            except AssertionError as surprise:
                outcome = Outcome(f"not as expected: {surprise}", 0.0)
                wrong += 1
            misfits = instance.misfits()
            wrong += len(misfits)
            rows.append(f"| {when} | {outcome.record} | {outcome.seconds:.1f} | {' '.join(misfits) or 'nothing'} |")
            print(rows[-1], flush=True)
    if given.into is not None:
        replace_table(given.into, rows)
    return 1 if wrong else 0


def replace_table(document: Path, rows: list[str]) -> None:
    """Replace the table of faults in a document."""
    lines = document.read_text().splitlines()
    begin = lines.index(HEAD)
    end = next(number for number in range(begin, len(lines) + 1) if number == len(lines) or not lines[number])
    document.write_text("\n".join([*lines[:begin], *rows, *lines[end:]]) + "\n")


if __name__ == "__main__":
    sys.exit(main())
