"""Put the built web page into wheel and sdist; everything else is said in pyproject.toml."""

from __future__ import annotations

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

sys.path.insert(0, str(Path(__file__).resolve().parent))  # a build front end runs this file without it

from build_page import node_requirement, provide_page


class BuildPyWithPage(build_py):
    """Copies packages into the wheel, the page among them. An editable installation reads the page in place."""

    def run(self) -> None:
        """Build the page first, so that its files are found as package data."""
        if not self.editable_mode:
            provide_page()
        super().run()


class SdistWithPage(sdist):
    """Source archive with the built page, so that installing from it needs no Node.js."""

    def run(self) -> None:
        """Build the page first."""
        provide_page()
        super().run()


setup(cmdclass={"build_py": BuildPyWithPage, "sdist": SdistWithPage}, setup_requires=node_requirement())
