"""Any input is read and checked, or refused: files corrupted at random, and arrays of any name, shape and content.

`python tests/worker/formats/test_fuzz.py` does the same at length and writes the counts to build/fuzzing.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats import Limits, load_inputs, read_inputs, save_inputs
from pliant.worker.formats.tracks.tracker_formats import KNOWN

SUPPORT = Path(__file__).parents[2] / "support" / "files"
DOCUMENT = Path(__file__).parents[3] / "build" / "fuzzing.md"
sys.path.insert(0, str(SUPPORT))  # where pytest finds it too

from fuzzing import CRASHED, NATIVE, READERS  # noqa: E402


def fuzzed(examples: dict[str, int], *, number: int) -> dict[str, dict[str, int]]:
    """Fuzz in a separate process with bounded memory; return how often each parser gave each answer."""
    given = [f"{parser}:{count}" for parser, count in examples.items()]
    command = [sys.executable, str(SUPPORT / "fuzzing.py"), *given, str(number)]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    ran = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr[-3000:]
    answers: dict[str, dict[str, int]] = json.loads(ran.stdout)
    return answers


EXAMPLES = {parser: 20 if parser in NATIVE else 100 for parser in READERS} | {
    "gltf": 200
}  # 4 % of corrupted glTF files can be read


@pytest.fixture(scope="module")
def answered() -> dict[str, dict[str, int]]:
    return fuzzed(EXAMPLES, number=7)


@pytest.mark.parametrize("parser", READERS)
def test_a_corrupted_file_is_read_or_rejected(answered: dict[str, dict[str, int]], parser: str) -> None:
    answers = answered[parser]
    assert sum(answers.values()) >= EXAMPLES[parser]
    assert "a refusal without a hint" not in answers
    assert len(answers) > 1
    if parser not in NATIVE:
        assert CRASHED not in answers


sizes = st.sampled_from([0, 1, 2, 3, 4, 5, 6, 8, 12])
shapes = st.lists(sizes, min_size=0, max_size=5).map(tuple)
numbers = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, 1.0, -1.0, 0.5, 255.0, float("nan"), float("inf"), 1e300, -5e-324])
)


@st.composite
def some_array(draw: st.DrawFn) -> np.ndarray:
    """Any shape a track array may have and others, of any content."""
    fitting = [
        (6, 5, 2),
        (6, 5, 2),
        (6, 9, 2),
        (12, 5),
        (1, 6, 5, 2),
        (6, 2, 5, 2),
        (6, 5, 3),
        (6, 5),
        (18, 5),
        (6, 3, 3),
    ]
    shape = draw(shapes if draw(st.integers(0, 4)) == 0 else st.sampled_from(fitting))
    dtype = draw(st.sampled_from(["f8", "f8", "f8", "f4", "i4", "u1", "?", ">f8", "f2"]))
    if draw(st.integers(0, 2)) > 0:
        return (
            np.random.default_rng(draw(st.integers(0, 99)))
            .normal(3, 9, shape)
            .cumsum(axis=0 if shape else None)
            .astype(dtype)
        )
    fill = draw(numbers)
    with np.errstate(all="ignore"):
        found = np.full(shape, fill).astype(dtype)
        for _ in range(draw(st.integers(0, 3)) if found.size else 0):
            found.flat[draw(st.integers(0, found.size - 1))] = np.array(draw(numbers)).astype(dtype)
    return found


options = st.fixed_dictionaries(
    {},
    optional={
        "layout": st.sampled_from(["auto", "frames_points", "points_frames"]), "rows": st.sampled_from(["auto", "stacked"]),
        "coordinates": st.sampled_from(["auto", "unit", "signed", "pixels"]), "image_size": st.sampled_from([None, "9x5", "1x1"]),
        "coordinate_order": st.sampled_from(["auto", "yx"]), "visibility": st.sampled_from(["auto", "bool", "logits", "probability"]),
        "frames": st.sampled_from([None, "::2", "-3:", "1:1"]), "stride": st.integers(1, 4), "min_seen": st.integers(1, 5),
        "max_points": st.sampled_from([None, 4, 5, 9]), "y_axis": st.sampled_from(["auto", "up"]),
    },
)  # fmt: skip
named = st.dictionaries(st.sampled_from(sorted(KNOWN)), some_array(), max_size=2)
tracked = st.tuples(st.sampled_from(["tracks", "W", "pred_tracks", "trajs_e", "tracks_xyz"]), some_array())
meshes = st.one_of(
    st.none(), st.just("none"), st.sampled_from(["1x5", "2x3", "0x0", "5x1"]),
    st.dictionaries(st.sampled_from(["faces", "grid", "mask", "vertices"]), some_array(), min_size=1, max_size=2),
    arrays_of.arrays(np.int32, (3, 3), elements=st.integers(-1, 5)).map(lambda faces: {"faces": faces}),
)  # fmt: skip


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(named, tracked, meshes, st.one_of(st.none(), named), st.one_of(st.none(), named), options)
def test_arrays_of_any_kind_are_interpreted_or_rejected(
    around: dict[str, np.ndarray],
    tracks: tuple[str, np.ndarray],
    mesh: Any,
    truth: Any,
    cameras: Any,
    chosen: dict[str, Any],
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        parts: dict[str, Any] = {
            "tracks": {**around, tracks[0]: tracks[1]},
            "mesh": mesh,
            "ground_truth": truth,
            "rotations": cameras,
        }
        for name, part in parts.items():
            if isinstance(part, dict):
                parts[name] = Path(folder) / f"{name}.npz"
                np.savez(parts[name], **part)
        try:
            inputs = read_inputs(**parts, options=Options.model_validate(chosen), limits=Limits(max_points=1000))
        except InvalidInput as error:
            event(error.code)
            assert error.code  # noqa: PT017
            assert error.hint  # noqa: PT017
            return
        event("read")
        assert np.isfinite(inputs.tracks.points).all()
        assert ((inputs.tracks.visible >= 0) & (inputs.tracks.visible <= 1)).all()
        assert inputs.mesh is None or inputs.mesh.num_points == inputs.tracks.num_points
        save_inputs(inputs, Path(folder) / "stored.npz")
        back = load_inputs(Path(folder) / "stored.npz")
        assert back.tracks.points.tobytes() == inputs.tracks.points.tobytes()
        assert back.interpretation == inputs.interpretation


def main(examples: int = 3000) -> None:
    rows = [
        "| reader | files bent | read | refused | crashed its process, contained | anything else |",
        "|---|---|---|---|---|---|",
    ]
    for parser in READERS:
        answers = fuzzed({parser: examples // 3 if parser in NATIVE else examples}, number=1)[parser]
        total, good, crashed = sum(answers.values()), answers.get("read", 0), answers.get(CRASHED, 0)
        rows.append(f"| {parser} | {total:,} | {good:,} | {total - good - crashed:,} | {crashed:,} | 0 |")
        print(rows[-1], file=sys.stderr)
    DOCUMENT.parent.mkdir(exist_ok=True)
    DOCUMENT.write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")


HEAD = """# Files changed at random

Honest files of every format, and the attacks, changed by hypothesis (bytes set, inserted, cut, repeated, numbers
exchanged) and given to each reader. Arrays or an error must come back. SciPy's reader of MATLAB v5 files has
crashed on some such files; it runs in a process of its own, and the answer is then 422 `damaged_file`.

"""

if __name__ == "__main__":
    main()
