"""Writers: a solution in, result files out; each written aside and renamed when whole."""

from pliant.worker.artifacts.report import build_report
from pliant.worker.artifacts.write import write_artifacts

__all__ = ["build_report", "write_artifacts"]
