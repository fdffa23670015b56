"""Submit several clips at once with asyncio, and follow their progress.

python examples/many_at_once.py CLIP.npz [CLIP.npz ...]
"""

import asyncio
import os
import sys

from pliant import AsyncClient


async def reconstruct(client: AsyncClient, path: str) -> str:
    job = await client.submit(path, name=os.path.basename(path))
    async for now in job.events():
        if now.progress is not None:
            print(f"{now.name}: {now.status}, {now.progress.stage} {now.progress.fraction:.0%}")
    result = await job.wait()
    return f"{path}: shapes {result.shapes.shape}, {result.job.sentence}"


async def main() -> None:
    async with AsyncClient() as client:
        for line in await asyncio.gather(*(reconstruct(client, path) for path in sys.argv[1:])):
            print(line)


if len(sys.argv) < 2:
    sys.exit(__doc__)
asyncio.run(main())
