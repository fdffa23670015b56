"""The report of a job, and the matching arrays of `shapes.npz`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pliant.schemas.options import Options
from pliant.solver.records import FocalCandidate
from pliant.worker.artifacts import build_report
from results import make_result, write


def test_a_perspective_camera_is_in_the_arrays_and_the_report(tmp_path: Path) -> None:
    inputs, solution, options = make_result()
    camera = replace(solution.camera, focal=900.0, focal_std=12.0, principal_point=np.array([640.0, 360.0]))
    candidates = (
        FocalCandidate(None, False, -1.0),
        FocalCandidate(900.0, True, -0.5),
        FocalCandidate(900.0, False, -2.0),
    )
    choices = replace(
        solution.choices, camera="perspective", depth_sign="settled", focal_candidates=candidates,
        reasons={"camera_model": "Perspective."},
    )  # fmt: skip
    files = write(tmp_path, (inputs, replace(solution, camera=camera, choices=choices), options))
    with np.load(files["shapes.npz"], allow_pickle=False) as got:
        assert (got["focal"], got["focal_std"]) == (900.0, 12.0)
        np.testing.assert_array_equal(got["principal_point"], [640.0, 360.0])
    report = json.loads(files["report.json"].read_text())["camera"]
    assert {name: report[name] for name in ("model", "focal", "focal_std", "depth_sign", "reason")} == {
        "model": "perspective", "focal": 900.0, "focal_std": 12.0, "depth_sign": "settled", "reason": "Perspective.",
    }  # fmt: skip
    assert report["principal_point"] == [640.0, 360.0]
    assert (report["field_of_view"], report["sentence"]) == (None, "Perspective camera, focal length 900 px ± 12.")
    assert report["candidates"][0] == {"focal": None, "mirrored": False, "nll": -1.0}


@pytest.mark.parametrize(
    ("focal", "std", "size", "sentence"),
    [
        (
            900.0,
            12.0,
            "1280x720",
            "Perspective camera, focal length 900 px ± 12, horizontal field of view 70.8° ± 0.72°.",
        ),
        (
            900.0,
            168.0,
            "1280x720",
            "Perspective camera, focal length 900 px ± 170, horizontal field of view 70.8° ± 10°.",
        ),
        (900.0, 0.0, "1280x720", "Perspective camera, focal length 900 px (given), horizontal field of view 70.8°."),
        (None, None, "1280x720", "Scaled orthographic camera."),
    ],
)
def test_the_report_states_the_field_of_view(focal: float | None, std: float | None, size: str, sentence: str) -> None:
    inputs, solution, _ = make_result()
    camera = replace(solution.camera, focal=focal, focal_std=std)
    model = "scaled_orthographic" if focal is None else "perspective"
    solution = replace(solution, camera=camera, choices=replace(solution.choices, camera=model))
    report = build_report(inputs, solution, Options(image_size=size), metrics={})["camera"]
    assert report["sentence"] == sentence
    if focal is not None:
        views = [np.degrees(2 * np.arctan(640 / (focal + shift))) for shift in (0, 1e-3)]
        assert report["field_of_view"] == pytest.approx(views[0])
        assert report["field_of_view_std"] == pytest.approx((views[0] - views[1]) / 1e-3 * std, rel=1e-4)


@pytest.mark.parametrize(
    ("farthest", "sentence"),
    [
        (
            1.34,
            "Scaled orthographic camera. The object's size in the picture changes by 34 %. This is read as a change of the camera's "
            "distance; a growing or shrinking object looks the same.",
        ),
        (1.004, "Scaled orthographic camera."),
    ],
)
def test_the_report_states_how_much_the_size_in_the_picture_changes(farthest: float, sentence: str) -> None:
    inputs, solution, options = make_result()
    scales = np.linspace(1, farthest, len(solution.camera.scales))[::-1] * 2
    solution = replace(
        solution,
        camera=replace(solution.camera, scales=scales),
        choices=replace(solution.choices, camera="scaled_orthographic"),
    )
    assert build_report(inputs, solution, options, metrics={})["camera"]["sentence"] == sentence


def test_the_report_describes_the_computation(tmp_path: Path) -> None:
    report = json.loads(write(tmp_path, make_result())["report.json"].read_text())
    assert report["outcome"] == "converged"
    assert report["sentence"] == "Converged."
    assert report["warnings"] == ["Look."]
    assert report["metrics"] == {"e3d_frame": 0.5, "rotation_degrees": None}
    assert report["choices"]["basis_size"] == {"value": 2, "reason": "Two shapes explain it."}
    assert report["choices"]["noise"] == {"value": None}
    assert report["options"]["fps"] == 25
    assert report["interpretation"]["num_points"] == 30
    assert report["trace"] == {"objective": [3.0, 2.0], "residual": [1.0, 0.5], "iterations": [0, 9]}
    assert report["seconds"]["cameras"] == 0.5
    assert report["seconds"]["exporting"] > 0
    assert report["peak_memory_bytes"] > 10_000_000
    assert set(report["versions"]) == {"pliant", "numpy", "scipy", "python", "system"}


def test_the_report_contains_the_verdict_and_the_expected_error(tmp_path: Path) -> None:
    made = make_result(hidden=True)
    report = json.loads(write(tmp_path, made)["report.json"].read_text())
    trust = made[1].trust
    assert trust is not None
    assert trust.interval is not None
    assert report["verdict"] == trust.verdict.value
    assert report["verdict_reasons"] == list(trust.reasons)
    assert report["expected_error"] == trust.expected_error
    assert report["expected_error_interval"] == list(trust.interval)
    assert report["trust_sentence"] == trust.sentence
    figures = ("turn_degrees", "degrees_per_frame", "deformation_per_frame", "held_out_error")
    assert [report[name] for name in figures] == [getattr(trust, name) for name in figures]
    inputs, solution, options = made
    silent = build_report(inputs, replace(solution, trust=None), options, metrics={})
    names = ("verdict", "expected_error", "expected_error_interval", "trust_sentence", *figures)
    assert [silent[name] for name in names] == [None] * len(names)
    assert silent["verdict_reasons"] == []


def test_without_standard_deviations_there_is_no_such_array_or_colour(tmp_path: Path) -> None:
    files = write(tmp_path, make_result(std=False, outputs="glb", colours="expected_error"))
    with np.load(files["shapes.npz"]) as arrays:
        assert "shapes_std" not in arrays
    report = json.loads(files["report.json"].read_text())
    assert report["expected_error"] is None
    assert report["trust_sentence"].startswith("The error is not estimated")
    assert "colours" not in report["artifacts"]["shapes.glb"], "nothing is painted where nothing is known"


def test_numbers_that_json_lacks_are_null_in_every_precision() -> None:
    metrics = {"one": np.float32("nan"), "two": np.float64("inf"), "three": np.float32(0.5)}
    report = build_report(*make_result(), metrics=metrics)
    assert report["metrics"] == {"one": None, "two": None, "three": 0.5}
