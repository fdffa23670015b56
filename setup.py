"""Add the built web page to wheels and sdists; pyproject.toml configures everything else."""

from __future__ import annotations

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

sys.path.insert(0, str(Path(__file__).resolve().parent))  # build front ends do not add it

from build_page import node_requirement, provide_page


class BuildPyWithPage(build_py):
    """Copies the packages, including the page, into the wheel. Editable installations read the page in place."""

    def run(self) -> None:
        """Build the page first, so that its files are found as package data."""
        if not self.editable_mode:
            provide_page()
        super().run()


class SdistWithPage(sdist):
    """Builds a source archive that contains the built page, so that installing from it needs no Node.js."""

    def run(self) -> None:
        """Build the page first."""
        provide_page()
        super().run()


setup(cmdclass={"build_py": BuildPyWithPage, "sdist": SdistWithPage}, setup_requires=node_requirement())
