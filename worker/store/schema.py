"""Version of the stored records.

`RedisRecords` checks it before its first use. Newer data is rejected, because an older program could drop fields that it does not know.
"""

from __future__ import annotations

from typing import Any

from pliant.worker.errors import NewerData

CURRENT = 1
"""Version of the records that this code writes. A change that this code could not read back increases it and migrates older records."""


def check_version(client: Any, prefix: str) -> None:
    """Check the version of an installation's records; in a new installation, store it.

    Raises
    ------
    NewerData
        The records were written by a newer version.
    """
    client.set(f"{prefix}:schema", CURRENT, nx=True)
    found = int(client.get(f"{prefix}:schema"))
    if found > CURRENT:
        raise NewerData(found=found, known=CURRENT)
