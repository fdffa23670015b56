"""Expected error and verdict as seen by users of the SDK."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pliant.client.result import Reconstruction
from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options


def test_results_read_uncertainty_and_camera_from_files_verdict_from_the_job(tmp_path: Path) -> None:
    interpretation = Interpretation(
        num_frames=2, num_points=3, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="",
    )  # fmt: skip
    job = Job(
        id="job", status=Status.SUCCEEDED, created_at=datetime.now(UTC), options=Options(), interpretation=interpretation,
        verdict="good",
    )  # fmt: skip
    deviations = np.arange(6, dtype=np.float32).reshape(2, 3)
    for name, arrays in (("new", {"shapes_std": deviations, "inlier_probability": deviations / 5}), ("old", {})):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "shapes.npz", shapes=np.zeros((2, 3, 3)), **arrays)
    new, old = Reconstruction(job, tmp_path / "new"), Reconstruction(job, tmp_path / "old")
    assert new.shapes_std is not None
    np.testing.assert_array_equal(new.shapes_std, deviations)
    assert old.shapes_std is None
    assert new.inlier_probability is not None
    np.testing.assert_array_equal(new.inlier_probability, deviations / 5)
    assert old.inlier_probability is None
    assert new.verdict == "good"
    for result, camera in ((new, {"focal": 900.0, "field_of_view": 70.8}), (old, {"focal": None})):
        (result.folder / "report.json").write_text(json.dumps({"camera": {"model": "perspective", **camera}}))
        assert result.camera["model"] == "perspective"
        assert (result.focal, result.field_of_view) == (camera["focal"], camera.get("field_of_view"))
