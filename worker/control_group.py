"""Files of this process's control group (cgroup v2), in which a container or a systemd unit limits its resources."""

from __future__ import annotations

from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
"""Where the control groups are mounted."""

MEMBERSHIP = Path("/proc/self/cgroup")
"""File that names the group of this process, as a path below `ROOT`."""


def group_files(name: str, *, root: Path = ROOT, membership: Path = MEMBERSHIP) -> list[Path]:
    """Return the paths of a control file in this process's group and in the groups around it, the innermost first.

    Limits of all these groups apply. A file may be missing: the outermost group has none, and neither has a system with cgroup v1.
    """
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return []
    own = next((line[3:].strip().lstrip("/") for line in lines if line.startswith("0::")), "")
    folder = root / own
    return [each / name for each in (folder, *folder.parents) if each.is_relative_to(root)]
