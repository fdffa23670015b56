"""`POST /v1/inspect` returns the interpretation of a job and keeps nothing."""

from __future__ import annotations

import httpx
import numpy as np
import pytest
from pliant.schemas.job import Interpretation
from serving import Running, form, npz, tracks

POINTS = np.random.default_rng(1).normal(size=(6, 12, 2)) * 100
GOOD = {
    "a grid": form(npz(tracks=POINTS), mesh="3x4"),
    "hidden points": form(npz(tracks=POINTS, visibility=np.arange(12) % 4 > np.zeros((6, 1)))),
    "a reading asked for": form(npz(W=np.random.default_rng(0).normal(size=(16, 9))), options={"rows": "stacked"}),
    "truth and cameras": form(
        npz(tracks=POINTS),
        ground_truth=npz(shapes=np.random.default_rng(2).normal(size=(6, 12, 3))),
        rotations=npz(rotations=np.tile(np.eye(3), (6, 1, 1))),
    ),
}
BAD = {
    "no file": ({"name": (None, "x")}, 422, "missing_part"),
    "no tracks": (form(b"hello"), 422, "unknown_format"),
    "two frames": (form(tracks(2)), 422, "too_few_frames"),
    "two readings": (form(npz(W=np.random.default_rng(0).normal(size=(16, 9)))), 422, "ambiguous_layout"),
    "unknown option": (form(options={"metod": "robust"}), 422, "unknown_option"),
    "unknown part": (form() | {"pickles": ("x", b"x")}, 422, "unknown_part"),
}


@pytest.mark.parametrize("case", GOOD)
def test_inspection_returns_the_interpretation_without_creating_a_job(
    running: Running, http: httpx.Client, case: str
) -> None:
    before = running.waiting
    answer = http.post("/v1/inspect", files=GOOD[case])
    assert answer.status_code == 200, answer.text
    assert running.waiting == before
    assert running.left_on_disk == []
    interpretation = Interpretation.model_validate_json(answer.content)
    job = http.post("/v1/jobs", files=GOOD[case]).json()
    assert interpretation == Interpretation.model_validate(job["interpretation"])
    assert interpretation.mesh_grid == ((3, 4) if case == "a grid" else None)


def test_the_sample_is_the_tracks_upright_and_to_scale(http: httpx.Client) -> None:
    corners = np.array([[0.0, 0.0], [40, 0], [40, 20], [0, 20], [20, 10], [10, 5], [30, 5], [30, 15], [10, 15]])
    points = corners + 3 * np.arange(4)[:, None, None] * (1, 0)
    visible = np.ones((4, 9), bool)
    visible[2, 4] = False
    for y_axis, sign in (("down", 1), ("up", -1)):
        parts = form(npz(tracks=points, visibility=visible), mesh="none", options={"y_axis": y_axis})
        answer = http.post("/v1/inspect", files=parts)
        assert answer.status_code == 200, answer.text
        sample = np.array(answer.json()["sample"]).reshape(4, 9, 2)
        np.testing.assert_array_equal(sample[2, 4], [-1, -1])
        scale = (sample[0, 1] - sample[0, 0])[0] / 40
        assert 15 < scale < 25  # 49 units wide, with a margin of a tenth of the square
        np.testing.assert_allclose(sample[0] - sample[0, 0], scale * corners * (1, sign), atol=2)
        np.testing.assert_allclose(sample[3] - sample[0], np.tile([9 * scale, 0], (9, 1)), atol=2)
        assert sample[sample >= 0].max() <= 1000


@pytest.mark.parametrize("size", [(3, 2000), (500, 9)])
def test_the_sample_is_small_for_any_input(http: httpx.Client, size: tuple[int, int]) -> None:
    points = np.random.default_rng(3).normal(size=(*size, 2))
    points[0, 0] = 1e9  # one outlier must not shrink the rest to a dot
    sample = http.post("/v1/inspect", files=form(npz(tracks=points), mesh="none")).json()["sample"]
    assert len(sample) == min(size[0], 16)
    assert {len(frame) for frame in sample} == {2 * min(size[1], 200)}
    held = np.array(sample)
    assert held[held >= 0].std() > 100


@pytest.mark.parametrize("case", BAD)
def test_inspection_and_submission_reject_the_same_inputs(running: Running, http: httpx.Client, case: str) -> None:
    parts, status, code = BAD[case]
    answer, submitted = (http.post(f"/v1/{path}", files=parts) for path in ("inspect", "jobs"))
    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert answer.json() == submitted.json()
    assert running.left_on_disk == []


def test_inspection_of_an_earlier_jobs_inputs_points_to_its_record(http: httpx.Client) -> None:
    job = http.post("/v1/jobs", files=form(npz(tracks=POINTS))).json()["id"]
    problem = http.post("/v1/inspect", files={"inputs_of": (None, job)}).json()
    assert (problem["code"], problem["field"]) == ("unknown_part", "inputs_of")
    assert "`interpretation` of that job's record" in problem["detail"]
