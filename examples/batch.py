"""Reconstruct every track file of a folder, as many at once as the service has workers. Run it again to resume.

python examples/batch.py FOLDER OUT
"""

import sys
from pathlib import Path

from pliant import Client
from pliant.client import InvalidRequest, JobEnded

if len(sys.argv) < 3:
    sys.exit(__doc__)
folder, out = Path(sys.argv[1]), Path(sys.argv[2])

with Client() as client:
    jobs = {}
    for path in sorted(folder.glob("*.npz")):
        try:
            # The same file has the same key, so a second run of this script finds the jobs of the first run.
            jobs[path.stem] = client.submit(
                path, name=path.stem, idempotency_key=f"batch/{path.resolve()}/{path.stat().st_mtime_ns}"
            )
        except InvalidRequest as error:
            print(f"{path.name}: {error}")
    for name, job in jobs.items():
        try:
            files = job.wait(load=False, timeout=3600).download(out / name)
            print(f"{name}: {len(files)} files in {out / name}")
        except JobEnded as end:
            print(f"{name}: {end}")
