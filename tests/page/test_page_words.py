"""Numbers and sentences of the page, without a browser: its modules run in Node.js."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from build_page import node_commands

ROOT = Path(__file__).parents[2]
WEB = ROOT / "service" / "web"
BUNDLER = WEB / "node_modules" / "esbuild"

pytestmark = [
    pytest.mark.node,
    pytest.mark.skipif(
        not BUNDLER.is_dir() and not os.environ.get("CI"), reason="esbuild is not installed; say `make page`"
    ),
]

RUN = """
import { build } from "esbuild";
const { outputFiles: [made] } = await build({ entryPoints: ["src/MODULE.ts"], bundle: true, write: false, format: "esm" });
const module = await import("data:text/javascript;base64," + Buffer.from(made.text).toString("base64"));
console.log(JSON.stringify(EXPRESSION));
"""


def node() -> list[str]:
    """The command that starts Node.js, as the build of the page finds it."""
    commands = node_commands()
    assert commands is not None
    return commands[0]


def evaluate(module: str, expression: str) -> Any:
    """Evaluate a JavaScript expression in which `module` is a module of the page."""
    script = RUN.replace("MODULE", module).replace("EXPRESSION", expression)
    command = [*node(), "--input-type=module", "-e", script]
    ran = subprocess.run(command, cwd=WEB, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_percentages_of_the_size_use_no_exponents_and_do_not_wrap() -> None:
    shares = [3.91, 0.996, 0.0995, 0.0345, 0.001, 0.00001, 0.000001, 5e-324, 0, 12.345]
    shown = evaluate("words", f"{shares}.map(module.ofSize)")
    digits = ["391", "100", "10", "3.5", "0.10", "0.0010", "0.00010", "0", "0", "1,235"]
    assert shown == [f"{each}\u00a0% of the size" for each in digits]
    assert evaluate("words", "[0, 0.004, 0.5].map(module.percent)") == ["0\u00a0%", "0.4\u00a0%", "50\u00a0%"]
    said = evaluate("words", "module.unbroken('About 4 % of the size; 5 % hidden.')")
    assert said == "About 4\u00a0% of the size; 5\u00a0% hidden."


def test_a_running_job_names_its_reweighting_and_the_time_left() -> None:
    progress = {"stage": "reweight", "reweighting": 3, "max_reweightings": 60, "seconds_left": 12}
    job = json.dumps({"status": "running", "progress": progress})
    assert evaluate("words", f"module.standing({job})") == "Refining the shapes, reweighting 3; about 12 seconds left."


def test_image_lengths_have_a_unit() -> None:
    words = "['film', 'given'].map((source) => module.inTracksUnit(0.5, {interpretation: {mesh_source: source}}))"
    assert evaluate("words", words) == ["0.500 pixels", "0.500 (tracks' unit)"]


def test_error_difference_is_grey_where_a_point_is_hidden_in_one_job() -> None:
    jobs = """[[[0, 1, 2], [1, 3, 2]], [[2, 1, 1], [0, 3, 2]], [[2, 4, 1], [0, 0, 0]]].map(([spread, residuals], at) => ({
      title: "abc"[at],
      preview: {
        points: 3, frames: 1, ready: 1, size: 1, header: { spread_step: 0.01 }, has: (name) => name === "spread",
        field: async (name) => (name === "spread" ? spread : residuals.flatMap((u) => [u === 3 ? -32768 : u, 0])),
        facts: () => ({ hidden: residuals.includes(3) ? 1 / 3 : 0 }),
      },
    }))"""
    shown = evaluate(
        "viewer/colours",
        f"""await (async () => {{
          const [a, b, c] = {jobs};
          return Promise.all([[a, b], [b, a], [c, c]].map(async ([one, other]) => {{
            const values = await module.errorDifference(one, other, null);
            const into = new Int16Array(3);
            values.write(0, into, 1, 0);
            return [values.words, values.low, values.high, values.hasUnknown, values.unknown, [...into]];
          }}));
        }})()""",
    )
    unknown = "hidden in one of the two"
    ends = ["−2.0\u00a0% of the size", "+2.0\u00a0% of the size"]
    assert shown == [
        ["Expected error, “a” minus “b”", *ends, True, unknown, [0, -32767, 24575]],
        ["Expected error, “b” minus “a”", *ends, True, unknown, [32767, -32767, 8191]],
        [
            "Expected error, “c” minus “c”",
            "−0\u00a0% of the size",
            "+0\u00a0% of the size",
            False,
            unknown,
            [16383] * 3,
        ],
    ]


def test_a_sample_of_a_grid_is_spread_over_its_columns() -> None:
    chosen = evaluate("viewer/scattered", "module.scattered(36 * 48, 500)")
    assert chosen == sorted(set(chosen))
    assert (len(chosen), len({point % 48 for point in chosen})) == (500, 48)
    assert evaluate("viewer/scattered", "module.scattered(3, 500)") == [0, 1, 2]
