"""The complete job as a plain call."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from long_jobs import LONG, long_sequence
from pliant.schemas.job import Progress
from pliant.schemas.options import SOLVER_FIELDS, Options
from pliant.solver import InvalidInput, KnownCamera, Mesh, Outcome, Settings, solve
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.solver.shapes.irls import MAX_INNER
from pliant.worker.artifacts.result import file_warnings
from pliant.worker.errors import Interrupted, TimedOut
from pliant.worker.execution.failures import problem_of
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import Inputs
from pliant.worker.formats.solver_settings import solver_settings
from worker_house import make_inputs

CHEAP = Options(prior="smooth", max_reweightings=1, refine_rotations=False, surface="free", camera="orthographic")
"""Without the default prior, which takes longer to learn than all the solves of these tests."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return make_inputs(tmp_path_factory.mktemp("run") / "inputs.npz", frames=8, points=60)


def test_the_files_match_the_returned_results(inputs: Inputs, tmp_path: Path) -> None:
    steps: list[Progress] = []
    finished = reconstruct(
        inputs, CHEAP.model_copy(update={"max_reweightings": 4}), tmp_path / "new", on_progress=steps.append
    )
    report = json.loads((tmp_path / "new" / "report.json").read_text())
    assert (report["outcome"], report["sentence"]) == (finished.outcome, finished.sentence)
    assert report["metrics"] == pytest.approx(finished.metrics)
    assert {"e3d_sequence", "reprojection_median"} <= set(finished.metrics)
    assert finished.verdict in ("good", "with_care", "do_not_use")
    assert [report[name] for name in ("verdict", "trust_sentence")] == [finished.verdict, finished.trust_sentence]
    assert report["verdict_reasons"] == list(finished.verdict_reasons)
    for artifact in finished.artifacts:
        assert (tmp_path / "new" / artifact.name).stat().st_size == artifact.bytes
    with np.load(tmp_path / "new" / "shapes.npz") as arrays:
        assert arrays["shapes"].shape == (8, 60, 3)
        assert inputs.ground_truth is not None
        assert finished.metrics["e3d_frame"] == pytest.approx(e3d_frame(arrays["shapes"], inputs.ground_truth.shapes))
    stages = [each.stage for each in steps]
    assert stages[0] == "loading"
    assert stages[-1] == "exporting"
    assert {"cameras", "reweight"} <= set(stages)
    fractions = [each.fraction for each in steps]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1


def test_options_without_effect_on_the_files_are_reported(inputs: Inputs, tmp_path: Path) -> None:
    finished = reconstruct(inputs, CHEAP.model_copy(update={"colours": "expected_error"}), tmp_path)
    sentence = "colours=expected_error has no effect, because the solution has no expected error."
    assert finished.warnings.count(sentence) == 1
    assert json.loads((tmp_path / "report.json").read_text())["warnings"] == list(finished.warnings)
    plain = reconstruct(inputs, CHEAP.model_copy(update={"colours": "error", "glb_motion": "frames"}), tmp_path)
    assert not any("no effect" in each for each in plain.warnings)


@pytest.mark.parametrize(
    ("option", "value", "without", "within"),
    [
        ("normals", "none", "abc", "usd"),
        ("colours", "error", "mdd", "obj"),
        ("axes", "tracks", "glb", "ply"),
        ("glb_quantized", True, "usd", "glb"),
        ("glb_motion", "frames", "ply", "glb"),
    ],
)
def test_options_of_files_that_are_not_written_are_reported(
    option: str, value: object, without: str, within: str
) -> None:
    solution = SimpleNamespace(shapes=np.zeros((2, 1, 3)), shapes_std=None)
    chosen = Options.model_validate({option: value, "outputs": [without]})
    (sentence,) = file_warnings(chosen, solution)  # type: ignore[arg-type]
    assert sentence.startswith(f"{option} has no effect without ")
    assert within in sentence
    assert file_warnings(Options.model_validate({option: value, "outputs": [within]}), solution) == ()  # type: ignore[arg-type]


def test_more_frames_than_morph_targets_are_reported() -> None:
    few, many = (SimpleNamespace(shapes=np.zeros((frames, 1, 3)), shapes_std=None) for frames in (200, 201))
    options = Options(glb_motion="frames", outputs=("glb",))
    assert file_warnings(options, few) == ()  # type: ignore[arg-type]
    (sentence,) = file_warnings(options, many)  # type: ignore[arg-type]
    assert sentence.startswith("glb_motion=frames has no effect")
    (sentence,) = file_warnings(Options(glb_motion="frames", outputs=("ply",)), many)  # type: ignore[arg-type]
    assert sentence == "glb_motion has no effect without glb in outputs."


@pytest.mark.parametrize("stage", ["loading", "cameras", "initialise", "reweight", "exporting"])
def test_a_reconstruction_can_be_stopped_at_every_stage(inputs: Inputs, tmp_path: Path, stage: str) -> None:
    steps: list[Progress] = []
    with pytest.raises(Interrupted, match="stopped on request"):
        reconstruct(
            inputs,
            CHEAP,
            tmp_path,
            on_progress=steps.append,
            should_stop=lambda: any(p.stage == stage for p in steps),
        )
    assert stage == "exporting" or (steps[-1].stage != "exporting" and steps[-1].reweighting <= 1)
    assert not (tmp_path / "report.json").exists(), "the report is the last to be written"
    assert not list(tmp_path.glob(".*")), "no half-written file"


def test_the_time_limit_option_ends_a_reconstruction(inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(TimedOut, match=r"option time_limit of 0\.001 s") as caught:
        reconstruct(inputs, Options(time_limit=0.001), tmp_path)
    problem = problem_of(caught.value)
    assert (problem.code, problem.field, problem.retryable) == ("timed_out", "options.time_limit", True)
    assert reconstruct(inputs, CHEAP.model_copy(update={"time_limit": 100.0}), tmp_path).outcome == "max_reweightings"


def test_every_solver_option_reaches_the_solver_settings() -> None:
    chosen = {
        "method": "spatio_temporal", "camera": "perspective", "surface": "free", "basis_size": 2, "refine_rotations": False,
        "preset": "paper",
        "temporal_weight": 0.5, "spatial_weight": 0.25, "robust_scale": 0.125, "temporal_order": 2, "loss": "huber",
        "laplacian": "uniform", "prior": "smooth+low_rank", "low_rank_weight": 3.0, "max_reweightings": 7, "tolerance": 0.5,
        "precision": "float32", "seed": 9, "focal": 900.0, "field_of_view": None, "principal_point": "319.5,-2",
        "image_size": "640x480", "order": "film",
    }  # fmt: skip
    assert set(chosen) == set(SOLVER_FIELDS)
    expected = {**chosen, "principal_point": (319.5, -2.0), "image_size": (640.0, 480.0)}
    assert solver_settings(Options.model_validate(chosen)) == Settings(**expected)  # type: ignore[arg-type]
    angle = Options(field_of_view=60.0, image_size="640x480")
    assert solver_settings(angle, y_up=True) == Settings(field_of_view=60.0, image_size=(640.0, 480.0), y_up=True)


def test_contradictory_inputs_are_rejected_before_a_file_is_written(inputs: Inputs, tmp_path: Path) -> None:
    assert inputs.mesh is not None
    no_grid = Mesh.from_faces(inputs.mesh.faces, inputs.mesh.num_points)
    without = Inputs(inputs.tracks, no_grid, None, None, inputs.interpretation)
    with pytest.raises(InvalidInput):
        reconstruct(without, Options(laplacian="grid8"), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
@pytest.mark.slow
def test_the_long_job_of_the_fault_tests_is_long_by_construction() -> None:
    """Every reweighting uses all inner iterations and lowers the energy, so all 1000 of them run on any machine."""
    sequence, options = long_sequence(), dict(LONG, max_reweightings=2)
    solved = solve(sequence.tracks, cameras=KnownCamera(sequence.rotations), settings=Settings(**options))
    assert solved.outcome is Outcome.MAX_REWEIGHTINGS
    assert solved.trace.iterations.tolist() == [0, *[MAX_INNER] * 2]
    falls = -np.diff(solved.trace.objective) / solved.trace.objective[:-1]
    assert falls.min() > 1e-4, "very far from where nothing falls any more"
    assert LONG["max_reweightings"] == 1000
