"""Writers of result files. Each file is written under a temporary name and renamed when complete."""

from pliant.worker.artifacts.kinds import kinds_for
from pliant.worker.artifacts.report import build_report
from pliant.worker.artifacts.write import described, write_artifacts

__all__ = ["build_report", "described", "kinds_for", "write_artifacts"]
