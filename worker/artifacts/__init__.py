"""Writers: a solution in, result files out; each written aside and renamed when whole."""

from pliant.worker.artifacts.kinds import kinds_for
from pliant.worker.artifacts.report import build_report
from pliant.worker.artifacts.write import described, write_artifacts

__all__ = ["build_report", "described", "kinds_for", "write_artifacts"]
